"""The study of wrong bounds: which are wrong, what is counted, and that its table follows from its saved arrays."""

import json

import numpy as np
import pytest

from experiments import bound_warnings as study
from jaxlfi.io import files as atomic

RESULTS = study.Path(study.__file__).parent / "results" / "bound-warnings"


def test_a_bound_is_wrong_where_the_truth_lies_beyond_it():
    truth = np.array([[1.0, 5.0]])
    np.testing.assert_array_equal(
        study.wrong_bounds(truth, np.array([0.0, 0.0]), np.array([2.0, 9.0])), np.zeros((2, 2))
    )
    found = study.wrong_bounds(truth, np.array([1.5, 0.0]), np.array([2.0, 4.0]))
    np.testing.assert_array_equal(found, [[1, 0], [0, 1]])


def test_of_two_truths_one_inside_makes_the_support_right():
    truth = np.array([[1.0, 5.0], [5.0, 1.0]])
    found = study.wrong_bounds(truth, np.array([3.0, 0.0]), np.array([10.0, 7.0]))
    np.testing.assert_array_equal(found, np.zeros((2, 2)))
    found = study.wrong_bounds(truth, np.array([3.0, 2.0]), np.array([10.0, 7.0]))  # either lower bound could give way
    np.testing.assert_array_equal(found, [[-1, -1], [0, 0]])
    found = study.wrong_bounds(truth, np.array([0.0, 6.0]), np.array([10.0, 7.0]))
    np.testing.assert_array_equal(found, [[0, 1], [0, 0]])


def judged(wrong, named) -> study.Judged:
    """Runs of which `named` bounds have the number 1."""
    named = np.asarray(named, float)
    return study.Judged("named", "ok", np.asarray(wrong), {"beyond": named})


def test_counts_of_right_and_wrong_supports():
    """Two runs of one parameter on a wrong support, three on a right one."""
    wrong = judged([[1], [0]], [[[1], [0]], [[0], [1]]])
    right = judged([[0], [0]], [[[1], [1]], [[0], [0]], [[1], [0]]])
    own = study.counts([wrong, right], "beyond", 0.5)
    assert {name: tuple(pair) for name, pair in own.items()} == {
        "hits": (1, 2),
        "runs_hit": (1, 2),
        "false": (3, 6),
        "runs_false": (2, 3),
        "blamed": (1, 2),
    }


def test_a_bound_that_is_one_remedy_of_several_counts_for_its_run_only():
    own = study.counts([judged([[-1, -1], [0, 0]], [[[1, 0], [0, 1]]])], "beyond", 0.5)
    assert own["hits"].tolist() == [0, 0] and own["runs_hit"].tolist() == [1, 1] and own["blamed"].tolist() == [1, 2]


@pytest.mark.parametrize(("hits", "of", "expected"), [(0, 10, (0.0, 0.2775)), (10, 20, (0.2993, 0.7007))])
def test_wilson_intervals(hits, of, expected):
    """Compared with published values."""
    np.testing.assert_allclose(study.wilson(hits, of), expected, atol=1e-3)


def test_every_set_excludes_the_truth_where_it_says():
    wrong = {}
    for runs in study.SETS.values():
        name = runs.task.rpartition(":")[2]
        task = getattr(study, name)()
        for support in runs.supports:
            box = task.supports[support]
            found = study.wrong_bounds(study.truths(runs.task), np.asarray(box.low), np.asarray(box.high))
            wrong[name, support] = [f"{d + 1}{'-+'[side]}" for side, d in np.argwhere(found == 1)]
    assert wrong["lotka_volterra", "misspecified"] == ["1-", "2+"]
    assert wrong["lotka_volterra", "slightly"] == ["1-", "3+"]
    assert wrong["gaussian_linear", "second-high"] == ["2+"]
    assert wrong["lynx_hare", "misspecified"] == ["2+"] and wrong["lynx_hare", "prey-low"] == ["3-"]
    assert wrong["mg1", "rate-high"] == ["3+"]
    right = ["ok", "broad", "inside", "tight"]
    assert not any(bounds for (_, support), bounds in wrong.items() if support in right)


@pytest.fixture(scope="module")
def every() -> list[study.Judged]:
    names = [name for name in study.SETS if (RESULTS / f"{name}.npz").exists()]
    return [one for name in names for one in study.judge(name, atomic.read_arrays(RESULTS / f"{name}.npz"))]


@pytest.mark.slow
def test_the_saved_table_is_that_of_the_saved_posteriors(every):
    assert sum(len(one.scores["beyond"]) for one in every) >= 100
    assert study.tables(every, study.THRESHOLDS) == (RESULTS / "table.md").read_text()


@pytest.mark.slow
def test_the_rule_keeps_what_it_was_chosen_for(every):
    """Most wrong supports are named, and few right ones, of which the former rule named most."""
    now, before = (study.counts(every, *rule) for rule in (study.CHOSEN, study.FORMER))
    rate = lambda pair: pair[0] / pair[1]
    assert rate(now["runs_hit"]) > 0.8 and rate(now["runs_false"]) < 0.2
    assert rate(before["runs_false"]) > 0.5


def test_provenance_lies_beside_the_posteriors():
    for path in RESULTS.glob("*.npz"):
        saved = json.loads(path.with_suffix(".json").read_text())
        assert saved["command"].startswith("jaxlfi compare") and "settings" in saved["config"]
