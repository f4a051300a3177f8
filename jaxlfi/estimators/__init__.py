"""Density estimators: families and their settings, training, and the posterior of an observation."""
