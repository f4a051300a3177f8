"""Algorithm 1: settings, rounds, batches of runs, and what is recorded of them."""
