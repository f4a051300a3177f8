"""The comparison with baselines, tiny and on the Gaussian task: its rows, its files, and what its table says."""

import json

import jax
import numpy as np
import pytest

from experiments import baselines
from jaxlfi.diagnostics.bootstrap import bootstrap_interval
from tests.small import SETTINGS, gaussian, whole_runs  # noqa: F401 - a fixture


def test_every_row_has_the_same_budget():
    for row in baselines.ROWS.values():
        settings = row.settings(SETTINGS).check()
        assert (
            settings.rounds * settings.simulations_per_round == 40
            and settings.rounds * settings.simulation_budget == 50
        )
        assert settings.estimator == SETTINGS.estimator
        assert settings.rounds == (1 if "one round" in row.what else 2)


@pytest.mark.slow
def test_a_row_is_run():
    """With tails, in one round: all of the budget, the support that Phi allows, and errors that add up."""
    arrays = baselines.run_row(baselines.ROWS["tails-0.2-static"], gaussian(), SETTINGS, seeds=2)
    assert arrays["theta_error"].shape == arrays["trajectory_error"].shape == (2,)
    np.testing.assert_allclose(arrays["theta_error_by_parameter"].sum(axis=1), arrays["theta_error"], rtol=1e-5)
    assert arrays["theta_error"][0] != arrays["theta_error"][1]
    np.testing.assert_array_equal(arrays["succeeded"], [[40], [40]])
    np.testing.assert_array_equal(arrays["attempted"], [[40], [40]])  # the Gaussian task never fails
    np.testing.assert_array_equal(arrays["support_low"], [gaussian().feasible.low] * 2)
    np.testing.assert_array_equal(arrays["support_high"], [gaussian().feasible.high] * 2)


def made_up(errors) -> dict[str, np.ndarray]:
    """Arrays of a row of three seeds."""
    errors = np.asarray(errors)
    return {
        "theta_error": errors,
        "theta_error_by_parameter": np.stack([0.25 * errors, 0.75 * errors], axis=1),
        "trajectory_error": np.array([1.0, np.nan, 2.0]),
        "attempted": np.array([[10, 30], [20, 20], [40, 0]]),
        "succeeded": np.array([[10, 10], [20, 10], [30, 0]]),
        "seconds": np.asarray(6.0),
    }


def test_rows_are_run_once_and_leave_arrays_table_and_figure(tmp_path, monkeypatch, capsys):
    ran = []

    def run_row(row, task, settings, seeds):
        ran.append((row.what, settings.rounds, settings.estimator.steps, seeds))
        return made_up([4.0, 1.0, len(ran)])

    monkeypatch.setattr(baselines, "run_row", run_row)
    monkeypatch.setattr(baselines, "lotka_volterra", gaussian)
    names = ["misspecified+edge", "tails-0.2"]
    arguments = ["--seeds", "3", "--rounds", "2", "--steps", "20", "--out", str(tmp_path)]
    for rows in (names[1:], names):
        baselines.main([*arguments, "--rows", *rows])
    assert ran == [(baselines.ROWS[name].what, 2, 20, 3) for name in reversed(names)]
    for name in names:
        config = json.loads((tmp_path / f"{name}.json").read_text())
        assert config["seeds"] == 3 and config["versions"]["jax"] == jax.__version__
    rows = baselines.saved(tmp_path)
    assert list(rows) == names and (tmp_path / "table.md").read_text() == baselines.table(rows)
    assert (tmp_path / "seeds.png").stat().st_size > 10_000
    capsys.readouterr()
    with pytest.raises(SystemExit):
        baselines.main([*arguments[:-2], "--steps", "99", *arguments[-2:], "--rows", "ok"])
    assert "expected a row of the same settings; choose another --out" in capsys.readouterr().err
    assert len(ran) == 2


def test_the_table_says_what_the_arrays_say():
    first, reference = [4.0, 1.0, 7.0], [1.0, 2.0, 1.5]
    lines = baselines.table({"ok": made_up(first), baselines.REFERENCE: made_up(reference)}).splitlines()
    header, _, ok, edge = ([cell.strip() for cell in line.split("|")[1:-1]] for line in lines)
    low, high = bootstrap_interval(np.array(first))
    assert ok[0] == "`ok`" and ok[2] == f"4.00 [{low:.2f}, {high:.2f}] (4.00)"
    low, high = bootstrap_interval(np.array([3.0, -1.0, 5.5]))
    assert ok[3] == f"2.50 [{low:.2f}, {high:.2f}]" and edge[3] == ""
    assert header[4:6] == ["theta_1", "theta_2"] and ok[4:6] == ["1.00", "3.00"]
    assert ok[6:] == ["1.50", "67%", "2.0"]
