"""Simulations and training that fail are warned of, and settings that train nothing are refused, in one line."""

import types

import numpy as np
import pytest

from jaxlfi.cli.summaries import failure_warnings, training_warnings
from tests.small import FLAGS, SETTINGS, TASK, command, whole_runs  # noqa: F401 - a fixture


def plan_of(*configurations: str):
    """What the warnings are made from."""
    specs = [types.SimpleNamespace(configuration=name) for name in configurations]
    return types.SimpleNamespace(settings=SETTINGS, specs=specs)


def run_of(*nonfinite: int):
    """A run with so many steps that were not finite in each round, by one network."""
    return types.SimpleNamespace(history={"nonfinite": np.array(nonfinite)[:, None]})


def test_runs_whose_gradients_were_finite_give_no_warning():
    assert training_warnings(plan_of("ok+edge", "ok+edge"), [run_of(0, 0), run_of(0, 0)]) == []


def test_each_configuration_whose_training_failed_is_named():
    plan = plan_of("ok+edge", "ok+edge", "wide+none", "wide+none")
    warnings = training_warnings(plan, [run_of(0, 0), run_of(0, 0), run_of(3, 17), run_of(0, 0)])
    assert len(warnings) == 1
    assert warnings[0].startswith("wide+none: up to 17 gradient steps of a round were not finite")
    assert "in 1 of 2 runs" in warnings[0] and "learning_rate (0.001)" in warnings[0] and "\n" not in warnings[0]


def test_each_configuration_without_a_simulation_to_begin_with_is_named():
    begun = lambda first: types.SimpleNamespace(history={"succeeded": np.array([first, 100])})
    plan = plan_of("ok", "wrong", "wrong", "wrong")
    assert failure_warnings(plan, [begun(100), begun(1), begun(100), begun(100)]) == []
    (warning,) = failure_warnings(plan, [begun(100), begun(0), begun(7), begun(0)])
    assert warning.startswith("wrong: all simulations of the first round failed in 2 of 3 runs")


@pytest.mark.slow
def test_training_that_diverges_is_warned_of(tmp_path, capsys):
    """The learning rate is a million; the run completes all the same."""
    out = tmp_path / "run"
    assert command("infer", TASK, *FLAGS, "--learning-rate", "1e6", "--out", out) == 0
    printed = " ".join("".join(capsys.readouterr()).split())
    assert "gradient steps of a round were not finite" in printed and "lower learning_rate (1e+06)" in printed
    assert "widths: not measured" in printed
    with np.load(out / "history.npz") as history:
        assert (history["nonfinite"] > 0).any()


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ("--patience -1", "patience"),
        ("--clip-norm 0", "clip"),
        ("--learning-rate -1e-3", "learning"),
        ("--tail 2", "tail"),
        ("--prune 2", "prune"),
        ("--validation 0.999", "validation"),
        ("--estimator nsf --transforms 0", "transforms"),
        ("--rounds 3000000000", "rounds"),
        ("--simulations-per-round 1000000000000", "simulations"),
        ("--heuristic edge --expansion -1", "expansion"),
    ],
)
def test_settings_that_train_nothing_are_refused_before_a_folder_is_made(flags, message, tmp_path, capsys):
    out = tmp_path / "run"
    assert command("infer", TASK, *flags.split(), "--no-figures", "--out", out) == 2
    error = capsys.readouterr().err
    assert message in error and "Traceback" not in error and not out.exists()
    assert len(error.strip().splitlines()) == 1 or error.strip().splitlines()[-1].count("error") == 1
