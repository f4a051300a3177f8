"""The study of one wrong bound: boxes that exclude what they should, and a table that follows from its arrays."""

from pathlib import Path

import jax
import numpy as np
import pytest

from experiments import wrong_bounds as study
from jaxlfi.io import files as atomic

RESULTS = Path(study.__file__).parent / "results" / "wrong-bounds"


@pytest.mark.parametrize("name", study.PROBLEMS)
def test_each_wrong_box_excludes_the_truth_by_one_bound(name):
    problem = study.PROBLEMS[name]
    truth, _, _ = study._arrays(problem)
    for wrong in (True, False):
        low, high = study.boxes(problem, problem.seed, wrong)
        excludes = np.stack([truth < low, truth > high])
        assert np.all(low < high) and np.all(excludes.sum(axis=(0, 2)) == wrong)
        assert not wrong or not excludes[..., problem.informed or len(truth) :].any()


@pytest.mark.slow
@pytest.mark.parametrize("name", study.PROBLEMS)
def test_each_problem_simulates_its_truth(name):
    task = study.problem_task(study.PROBLEMS[name])
    assert np.all(np.isfinite(task.simulate(jax.random.key(0), task.truth)))


def test_counts_tell_the_boxes_apart():
    """Two runs of one parameter on wrong boxes, one on a right box."""
    excludes = np.array([[[True], [False]], [[False], [True]], [[False], [False]]])
    named = np.array([[[True], [True]], [[False], [False]], [[True], [False]]])
    found = study.counts({"excludes": excludes}, named)
    assert found == {"wrong": (1, 2), "right of wrong boxes": (1, 2), "right of right boxes": (1, 2)}


def test_the_saved_table_is_that_of_the_saved_arrays():
    assert study.table(RESULTS) == (RESULTS / "table.md").read_text()


def test_wrong_bounds_are_named_and_right_ones_are_not():
    """Counted over all problems; the posterior's mass alone would miss a quarter of the wrong bounds."""
    found = [atomic.read_arrays(path) for path in RESULTS.glob("*.npz")]
    assert len(found) >= 6
    rates = lambda rule: np.sum([list(study.counts(one, rule(one)).values()) for one in found], axis=0)
    now, before = rates(lambda one: one["wrong"]), rates(lambda one: one["mass"] > study.MASS_BEYOND)
    share = now[:, 0] / now[:, 1]
    assert share[0] > 0.95 and share[1] < 0.05 and share[2] < 0.02
    assert before[0, 0] / before[0, 1] < 0.8
