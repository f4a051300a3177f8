"""Quality of the whip's learnt vision, and its cost for Real2Sim."""
