"""Policies for the domains that inference found: PPO on a belief, its evaluation, and policies as files.

Needs the extra `policy` (Brax), but for `policy` and `deployment`, which run trained policies with NumPy alone, and
their export; and `gym`, which needs gymnasium (extra `whip`).
"""
