"""Studies of many runs: grids of hyperparameters, and calibration."""
