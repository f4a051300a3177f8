"""The comparison of widths: its table from arrays whose figures are known."""

import numpy as np

from experiments.widths import DRAWS, judged, table
from jaxlfi.io import files as atomic


def arrays(offset: np.ndarray, outranked: np.ndarray) -> dict[str, np.ndarray]:
    """Posteriors of two parameters: draws at a distance from their truths, so many of them denser than the truth."""
    theta = np.zeros((len(offset), 2))
    draws = np.broadcast_to(offset[:, None, None], (len(offset), DRAWS, 2))
    log_prob = np.where(np.arange(DRAWS) < outranked[:, None], 1.0, -1.0)
    truth = np.where(np.arange(len(offset)) == 0, -np.inf, -0.5)
    one = {"draws": draws, "log_prob": log_prob, "truth_log_prob": truth}
    named = {f"{name}_{field}": value for name in ("own", "box") for field, value in one.items()}
    seeds = np.arange(len(offset))
    return judged(theta, named) | {"rounds": seeds + 10, "seeds": seeds, "seconds": np.asarray(8.0)}


def test_the_table_counts_errors_lost_runs_and_coverage(tmp_path):
    own = arrays(np.array([0.1, 0.2, 0.3, 1.0]), np.array([DRAWS, 0, 0, 0]))
    drawn = arrays(np.full(4, -0.1), np.array([DRAWS, 150, 60, 60]))
    for kind, values in (("own", own), ("drawn", drawn)):
        atomic.write_arrays(tmp_path / f"quick-{kind}.npz", values)
    cells = [cell.strip() for cell in table(tmp_path).splitlines()[-1].split("|")[1:-1]]
    assert cells[:2] == ["`quick`", "11.5"] and cells[2].startswith("0.80 [") and cells[2].endswith("(0.50)")
    assert cells[3:7] == ["1 of 4", "0.75", "0.50", "0.75"]
    assert cells[9] == f"{(-30 - 0.5 * 3) / 4:.1f}" and cells[10] == "2.0"
