"""Policies for inferred domains: PPO on a belief, evaluation, and policy files.

Needs the extra `policy` (Brax), but for `policy` and `deployment`, which run trained policies with NumPy alone, and
their export; and `gym`, which needs gymnasium (extra `whip`).
"""
