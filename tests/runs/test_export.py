"""Export: a run as InferenceData, or a word on what is missing."""

import sys

import jax
import numpy as np
import pytest

import jaxlfi
from jaxlfi.distributions.support import Support
from jaxlfi.envs import gaussian_linear
from jaxlfi.runs.export import MissingLibrary, to_inference_data
from jaxlfi.runs.load import load
from tests.small import command, settings, whole_runs  # noqa: F401 - a fixture

X = np.array([0.9, -0.7], np.float32)


def simulate(key, theta):
    """Three records of two channels; one in four or so fails."""
    x = gaussian_linear.simulate(key, theta)
    return x + jax.numpy.array([[0.0], [0.1], [0.2]]), x[0] < 1.2


TASK = jaxlfi.Task(
    simulate,
    names=("mass", "drag"),
    units=("kg", "N s/m"),
    supports={"ok": Support([0.5, -3.0], [3.0, 3.0])},
    feasible=Support([0.1, -10.0], [10.0, 10.0]),
    log=("mass",),
    summary=lambda trajectory: trajectory[0],
    channels=("x", "y"),
    times=np.array([0.0, 0.5, 1.0]),
    name="spring",
)
OBSERVED = X + np.array([[0.0], [0.1], [0.2]], np.float32)


@pytest.fixture(scope="module")
def folder(tmp_path_factory, whole_runs):  # noqa: F811 - the fixture
    """A run of one parameter as its logarithm, some of whose last simulations failed."""
    run = jaxlfi.infer(jax.random.key(3), TASK, OBSERVED, settings=settings(rounds=1))
    valid = np.isfinite(run.history["sample_trajectory_error"][-1])
    assert 0 < valid.sum() < 20
    return run.save(tmp_path_factory.mktemp("export") / "run")


def test_what_is_exported(folder):
    pytest.importorskip("arviz")
    data, run = to_inference_data(folder, 1000, seed=2), load(folder)
    draws = np.asarray(run.posterior.sample(jax.random.key(2), 1000))
    assert set(data.posterior.data_vars) == {"mass", "drag"}
    for d, name in enumerate(("mass", "drag")):
        np.testing.assert_array_equal(data.posterior[name].values, draws[None, :, d])
    box = run.final_support()
    assert float(box.low[0]) <= data.posterior["mass"].values.min() and data.posterior["mass"].attrs["units"] == "kg"
    assert data.posterior.attrs["task"] == "spring" and data.posterior.attrs["seed"] == "3"
    np.testing.assert_array_equal(data.observed_data["trajectory"].values, OBSERVED)
    assert data.observed_data["trajectory"].dims == ("time", "channel")
    np.testing.assert_array_equal(data.observed_data["time"], [0.0, 0.5, 1.0])
    assert data.observed_data["channel"].values.tolist() == ["x", "y"]
    predictive = data.posterior_predictive["trajectory"]
    assert predictive.dims == ("chain", "draw", "time", "channel")
    valid = np.isfinite(run.history["sample_trajectory_error"][-1])
    np.testing.assert_array_equal(predictive.values[0], run.history["final_trajectory"][valid])


def test_the_command_line_writes_netcdf(folder, tmp_path, capsys):
    arviz = pytest.importorskip("arviz")
    out = tmp_path / "draws.nc"
    assert command("sample", folder, "-n", 1000, "--out", out) == 0
    assert list(tmp_path.iterdir()) == [out]
    read = arviz.from_netcdf(str(out))
    assert {"posterior", "observed_data", "posterior_predictive"} <= set(read.groups())
    draws = load(folder).posterior.sample(jax.random.key(0), 1000)
    np.testing.assert_array_equal(read.posterior["drag"].values[0], draws[:, 1])
    assert command("sample", folder, "--out", out) == 2 and "exists" in capsys.readouterr().err


def test_without_arviz_the_error_says_how_to_get_it(folder, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "arviz", None)
    with pytest.raises(MissingLibrary, match=r"pip install 'jaxlfi\[arviz\]'"):
        to_inference_data(folder, 10)
    assert command("sample", folder, "--out", tmp_path / "draws.nc") == 2
    message = capsys.readouterr().err
    assert "pip install 'jaxlfi[arviz]'" in message and message.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_a_damaged_run_is_one_line(folder, tmp_path, capsys):
    pytest.importorskip("arviz")
    assert command("sample", tmp_path, "--out", tmp_path / "draws.nc") == 2
    assert "config.json" in capsys.readouterr().err
    history = (folder / "history.npz").read_bytes()
    (folder / "history.npz").write_bytes(history[:50])
    try:
        assert command("sample", folder, "--out", tmp_path / "draws.nc") == 2
        message = capsys.readouterr().err
        assert "history.npz: expected a complete .npz file" in message and message.count("\n") == 1
    finally:
        (folder / "history.npz").write_bytes(history)
