"""How sharp and how well calibrated posteriors are, on problems as users bring them, each with an exact posterior."""
