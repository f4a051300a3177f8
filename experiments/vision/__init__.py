"""What the whip's learnt vision sees, and what seeing costs."""
