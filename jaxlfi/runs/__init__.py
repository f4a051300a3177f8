"""Inference runs: executed, saved, resumed and loaded."""
