"""Grids: how sensitive a heuristic is to its hyperparameters, as a grid of runs in compiled chunks.

Each combination of values and a seed is one run; the same seed means the same observation in all combinations. Runs
are stepped in chunks of equal length (the last is padded by repeating its last run), so that all use one compiled
program.
"""

from jaxlfi.studies.grid.chunks import MEASURES, Work, arranged, measure, prepare, run_chunk
from jaxlfi.studies.grid.folder import advance, begin, create, reopen
from jaxlfi.studies.grid.grid import Axis, Grid, combinations, grid_runs, heuristics, parse_axes

__all__ = [
    "MEASURES", "Axis", "Grid", "Work", "advance", "arranged", "begin", "combinations", "create", "grid_runs",
    "heuristics", "measure", "parse_axes", "prepare", "reopen", "run_chunk",
]  # fmt: skip
