"""How well the learnt vision of the whip works, and what it costs Real2Sim."""
