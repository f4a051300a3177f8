"""Policies for inferred domains: PPO on a belief, evaluation, and policy files.

This needs the extra `policy` (Brax). Exceptions are `policy` and `deployment`, which run trained policies with NumPy
alone, the export of policies, and `gym`, which needs gymnasium (extra `whip`).
"""
