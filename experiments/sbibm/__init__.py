"""The field's benchmark of simulation-based inference (Lueckmann et al. 2021), two of its tasks."""
