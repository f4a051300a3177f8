"""The example: its recording is that of its script, and what the first guess leaves out is found."""

import csv
import importlib.util
import shutil
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco")

import jax

import jaxlfi
from jaxlfi.tasks import registry

FOLDER = Path(__file__).parents[3] / "examples/mujoco"
SETTINGS = jaxlfi.QUICK.replace(
    rounds=6,
    min_rounds=6,
    simulations_per_round=60,
    simulation_budget=75,
    predictive=False,
    estimator=jaxlfi.QUICK.estimator.replace(ensemble_size=2),
)


def test_the_recording_is_made_by_its_script(tmp_path, monkeypatch):
    """To the digits that other processors agree on: the pendulum swings, and does not go over the top."""
    spec = importlib.util.spec_from_file_location("record", FOLDER / "record.py")
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    shutil.copy(FOLDER / "furuta.xml", tmp_path)
    monkeypatch.setattr(script, "FOLDER", tmp_path)
    script.furuta()
    made, kept = (list(csv.reader((folder / "furuta.csv").open())) for folder in (tmp_path, FOLDER))
    assert made[0] == kept[0]
    np.testing.assert_allclose(np.array(made[1:], float), np.array(kept[1:], float), atol=2e-4)


def test_a_damping_that_the_first_guess_leaves_out_is_found():
    task = registry.load(f"mujoco,config={FOLDER / 'furuta.toml'}")
    truth = np.asarray(task.truth)
    first = task.supports["initial"]
    assert truth[0] < first.low[0] and (truth[1:] > first.low[1:]).all() and (truth < first.high).all()
    run = jaxlfi.infer(jax.random.key(0), task, heuristic=jaxlfi.Edge(), settings=SETTINGS)
    assert run.final_support().low[0] < truth[0]
    error = np.median(run.draws(), axis=0) / truth - 1
    np.testing.assert_array_less(np.abs(error), [0.3, 0.3, 0.1])
