"""Boxes, spaces, mixtures of Gaussians, beliefs, and truncation to a box."""
