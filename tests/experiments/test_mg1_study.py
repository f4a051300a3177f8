"""The M/G/1 study: what it computes of small made-up runs, by hand."""

import json

import numpy as np
import pytest
from scipy import stats

from experiments.mg1 import MEASURES, entropy, main, measures, ordered, sample_trajectories, table
from jaxlfi.envs import mg1
from jaxlfi.figures import load
from tests.figures.test_figures import change, write_run

TRUTH = np.array([1.0, 5.0, 0.2])


def write_queue(folder, configuration, seed, samples):
    """A run of mg1 that ended with these posterior samples."""
    write_run(folder, configuration=configuration, seed=seed, dim=3, rounds=2, simulation_budget=10, channels=("time",))
    change(folder, "observation.npz", lambda a: a.update(names=np.array(mg1.NAMES), truth=TRUTH))

    def last_round(arrays):
        arrays["sample_theta"][-1] = samples
        arrays["sample_theta_error"][-1] = np.abs(samples - TRUTH)

    change(folder, "history.npz", last_round)
    return folder


@pytest.fixture
def runs(tmp_path):
    """Two configurations of two seeds: on the truth but for a shift, and on its mirror image."""
    shift = np.linspace(0, 0.4, 20)[:, None] * [1.0, -1.0, 0.1]
    for seed in range(2):
        write_queue(tmp_path / "ok" / f"seed_{seed:03d}", "ok", seed, TRUTH + (1 + seed) * shift)
        mirrored = (TRUTH + shift)[:, [1, 0, 2]]
        write_queue(tmp_path / "broad" / f"seed_{seed:03d}", "broad", seed, mirrored)
    (tmp_path / "config.json").write_text(json.dumps({"format": "jaxlfi-compare", "task": "mg1"}))
    return tmp_path


def test_percentiles_and_rows_are_named():
    queue = mg1.task(percentiles=(10, 62.5), order="departure")
    assert queue.summary_names == ("percentile 10", "percentile 62.5") and queue.record_label == "job"
    assert mg1.task().record_label == "rank"


def test_a_queue_and_its_mirror_are_one():
    theta = np.array([[1.0, 5.0, 0.2], [5.0, 1.0, 0.2], [2.0, 2.0, 7.0]])
    np.testing.assert_array_equal(ordered(theta), [[1.0, 5.0, 0.2], [1.0, 5.0, 0.2], [2.0, 2.0, 7.0]])


def test_entropy_of_one_gaussian_and_of_two_far_apart():
    rng = np.random.default_rng(3)
    tril = np.tril(rng.normal(size=(2, 3, 3)), -1) + np.diag([0.4, 2.0, 0.05])
    each = [stats.multivariate_normal(np.zeros(3), factor @ factor.T).entropy() for factor in tril]
    one = entropy(np.zeros(1), np.ones((1, 3)), tril[:1])
    assert one == pytest.approx(each[0], abs=5 * np.sqrt(1.5 / 10_000))
    weight = np.array([0.3, 0.7])
    two = entropy(np.log(weight) + 9, np.array([[0.0] * 3, [1000.0] * 3]), tril)
    assert two == pytest.approx(weight @ each + stats.entropy(weight), abs=0.08)


def test_measures_of_a_mirrored_posterior(runs):
    straight, mirrored = (measures(load(runs / name / "seed_000")) for name in ("ok", "broad"))
    assert straight["plain"] == pytest.approx(0.2 + 0.2 + 0.02)
    assert straight["sorted"] == pytest.approx(straight["plain"])
    assert mirrored["plain"] == pytest.approx(2 * (4 - 0.2) + 0.02)  # (5 - s) - 1, 5 - (1 + s), s / 10
    for name, value in {"sorted": 0.42, "min": 0.2, "max": 0.2, "rate": 0.02}.items():
        assert mirrored[name] == pytest.approx(value)
    assert set(straight) == set(MEASURES) and all(np.isfinite(list(straight.values())))


def test_the_table_has_mean_interval_and_median():
    values = {name: np.array([1.0, 2.0, 6.0]) for name in MEASURES}
    (head, rule, line) = table({"misspecified+edge": values}).splitlines()
    assert head.count("|") == rule.count("|") == line.count("|") == len(MEASURES) + 2
    first = line.split("|")[2].strip()
    assert first.startswith("3.00 [1.") and first.endswith("] (2.00)")


def test_sample_trajectories_are_three_queues_at_the_truth():
    times = sample_trajectories()
    assert times.shape == (3, 50) and (times >= 1.0).all()
    assert len({float(row.sum()) for row in times}) == 3
    assert all((np.diff(row) < 0).any() for row in times)  # in the order of departure
    assert times.mean() == pytest.approx(5.0, rel=0.25)  # 1 / 0.2: the server has time to spare


def test_main_writes_a_table_arrays_and_a_picture(runs, tmp_path, capsys):
    out = tmp_path / "results"
    main([str(runs), "--out", str(out)])
    assert {path.name for path in out.iterdir()} == {
        "table.md",
        "errors.npz",
        "errors.png",
        "samples.npz",
        "samples.png",
    }
    with np.load(out / "errors.npz") as errors:
        np.testing.assert_allclose(errors["ok/sorted"], [0.42, 0.84])
        np.testing.assert_allclose(errors["broad/sorted"], [0.42, 0.42])
    text = (out / "table.md").read_text()
    assert "0.63 [0.42, 0.84] (0.63)" in text and text in capsys.readouterr().out


def test_other_folders_are_refused(tmp_path, capsys):
    write_run(tmp_path / "lotka", dim=3, rounds=1)
    for folder, message in ((tmp_path / "lotka", "expected runs of mg1"), (tmp_path / "none", "expected a run folder")):
        with pytest.raises(SystemExit):
            main([str(folder), "--out", str(tmp_path / "out")])
        assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
