"""The field's benchmark of simulation-based inference (Lueckmann et al. 2021), four of its tasks."""
