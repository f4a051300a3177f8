"""Density estimators: families and their settings, training, and the posterior given an observation."""
