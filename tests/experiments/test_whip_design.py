"""The study of chosen whips: its posteriors against closed forms, and its table from arrays whose figures are known."""

import numpy as np
import pytest

pytest.importorskip("mujoco")

from experiments.whip_design import ARMS, Known, table
from jaxlfi.io import files


def test_the_posterior_of_a_linear_response_is_the_closed_one():
    rng = np.random.default_rng(0)
    slope = rng.normal(size=(30, 2)) * np.array([2.0, 40.0])
    known = Known(lambda theta: theta @ slope.T, np.array([195.0, 6.9]), np.array([305.0, 10.8]))
    deviation = np.sqrt(np.diagonal(np.linalg.inv(slope.T @ slope)))
    rows = [known.posterior(np.random.default_rng(seed), np.array([230.0, 9.0])) for seed in range(200)]
    np.testing.assert_allclose(rows[0]["fisher_sd"], deviation, rtol=1e-6)
    np.testing.assert_allclose(np.mean([row["sd"] for row in rows], axis=0), deviation, rtol=0.06)
    errors = (np.array([row["mean"] for row in rows]) - [230.0, 9.0]) / deviation
    np.testing.assert_allclose(errors.std(axis=0), 1.0, atol=0.2)  # four standard errors
    held = np.mean([row["held"] for row in rows], axis=0)
    assert (held > 0.8).all() and (held < 0.97).all()
    assert np.mean([row["effective"] for row in rows]) > 15


def test_the_table_is_of_geometric_means(tmp_path):
    sd = np.array([[1.0, 0.04], [4.0, 0.01]])
    held = np.array([[True, True], [True, False]])
    for name, factor in zip(ARMS, (1.0, 0.5), strict=True):
        files.write_arrays(tmp_path / f"{name}.npz", {"sd": factor * sd, "held": held})
    files.write_arrays(tmp_path / "outcomes.npz", {"outcome": np.array([[0, 3], [0, 0]])})
    fixed, chosen, alone = table(tmp_path).splitlines()[2:]
    assert fixed == "| exploratory actions 0 and 1 | 2.00 | 0.0200 | – | 2, 1 of 2 |"
    assert chosen == "| chosen | 1.00 | 0.0100 | 0.50, 0.50 times | 2, 1 of 2 |"
    assert alone == "| chosen, where the stack is not touched | 0.50 | 0.0200 | 0.50, 0.50 times | 1, 1 of 1 |"
