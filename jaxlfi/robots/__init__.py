"""Robots: what one must provide, a loop in which a policy controls it, and robots in processes of their own.

Needs NumPy only, so that a robot's computer need not have JAX.
"""
