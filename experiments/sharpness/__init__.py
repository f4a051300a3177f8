"""How sharp and how honest posteriors are, on problems as users bring them, each with an exact posterior."""
