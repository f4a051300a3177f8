"""Robots: their interface, the control loop, and robots in separate processes.

Needs NumPy only, so that a robot's computer need not have JAX.
"""
