"""The comparison of embeddings: what its candidates see, and its table from arrays whose figures are known."""

import jax
import numpy as np

from experiments.embedding import candidate, table
from experiments.widths import DRAWS, judged
from jaxlfi.io import files as atomic
from jaxlfi.registry import TASKS


def test_candidates_see_the_summaries_or_the_trajectory():
    task = TASKS.load("lotka_volterra")
    for name, size, embedding in (("summaries", 9, "none"), ("raw", 302, "none"), ("series", 302, "series")):
        observed, settings = candidate(name, task)
        assert jax.eval_shape(observed.summary, jax.ShapeDtypeStruct((151, 2), np.float32)).shape == (size,)
        assert observed.named_summaries(size) and settings.check().estimator.embedding == embedding


def arrays(offset: np.ndarray, denser: np.ndarray) -> dict[str, np.ndarray]:
    """Posteriors of two parameters: draws at a distance from their truths, so many of them denser than the truth."""
    draws = np.broadcast_to(offset[:, None, None], (len(offset), DRAWS, 2)) * [1.0, 10.0]
    log_prob = np.where(np.arange(DRAWS) < denser[:, None], 1.0, -1.0)
    one = {"draws": draws, "log_prob": log_prob, "truth_log_prob": np.zeros(len(offset))}
    named = {f"{name}_{field}": value for name in ("own", "box") for field, value in one.items()}
    found = judged(np.zeros((len(offset), 2)), named)  # what the comparison saves, with the box's width
    return found | {"width": np.array([2.0, 20.0]), "seconds": np.asarray(8.0)}


def test_the_table_has_errors_in_widths_of_the_box_and_coverage(tmp_path):
    atomic.write_arrays(tmp_path / "series-own.npz", arrays(np.full(4, 0.2), np.array([DRAWS, 0, 0, 0])))
    atomic.write_arrays(tmp_path / "series-drawn.npz", arrays(np.full(4, -0.4), np.array([DRAWS, 150, 60, 60])))
    atomic.write_arrays(tmp_path / "raw-own.npz", arrays(np.full(4, 1.0), np.zeros(4)))
    header, _, raw, series = table(tmp_path).splitlines()
    cells = [cell.strip() for cell in series.split("|")[1:-1]]
    assert cells[:3] == ["`series`", "0.100 [0.100, 0.100] (0.100)", "0.75"]
    assert cells[3:] == ["0.200 [0.200, 0.200] (0.200)", "0.50", "0.75", "0.00", "2.0"]
    assert raw.startswith("| `raw` | 0.500 [") and raw.count("|") == header.count("|")
