"""Export: a run as InferenceData, or a word on what is missing."""

import sys

import numpy as np
import pytest

from jaxlfi.distributions.support import Support
from jaxlfi.envs import gaussian_linear
from jaxlfi.heuristics import Fixed
from jaxlfi.io import files as atomic
from jaxlfi.runs import folder as run_store
from jaxlfi.runs.export import MissingLibrary, to_inference_data
from jaxlfi.runs.load import posterior_samples
from jaxlfi.tasks.task import Task
from tests.small import command, settings

X = np.array([0.9, -0.7], np.float32)
TASK = Task(
    gaussian_linear.simulate,
    names=("mass", "drag"),
    units=("kg", "N s/m"),
    supports={"ok": Support([0.5, -3.0], [3.0, 3.0])},
    feasible=Support([0.1, -10.0], [10.0, 10.0]),
    log=("mass",),
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A run of one parameter as its logarithm, whose second of four last simulations failed."""
    out, box = tmp_path_factory.mktemp("export") / "run", TASK.supports["ok"]
    config = run_store.run_config(
        task=TASK, reference="spring", support_name="ok", support=box, heuristic=Fixed(), preset=None,
        settings=settings(), seed=3, configuration="ok",
    )  # fmt: skip
    exact = gaussian_linear.posterior(X)

    def fill(beside):
        belief = {"logits": exact.logits, "means": exact.means, "scale_tril": exact.scale_tril}
        atomic.write_arrays(beside / "posterior.npz", belief | {"support_low": box.low, "support_high": box.high})
        about = {"channels": np.array(["x", "y"]), "times": np.array([0.0, 0.5, 1.0])}
        trajectory = np.arange(6.0).reshape(3, 2)
        atomic.write_arrays(beside / "observation.npz", {"trajectory": trajectory, "x": X} | about)
        error = np.array([[1.0] * 4, [0.1, np.nan, 0.3, 0.4]])
        simulated = np.arange(24.0).reshape(4, 3, 2)
        atomic.write_arrays(beside / "history.npz", {"final_trajectory": simulated, "sample_trajectory_error": error})

    run_store.create(out, config, fill)
    return out


def test_what_is_exported(folder):
    pytest.importorskip("arviz")
    data = to_inference_data(folder, 40, seed=2)
    draws, names, _ = posterior_samples(folder, 40, seed=2)
    assert names == ["mass", "drag"] and set(data.posterior.data_vars) == set(names)
    for d, name in enumerate(names):
        np.testing.assert_array_equal(data.posterior[name].values, draws[None, :, d])
    assert data.posterior["mass"].values.min() > 1 and data.posterior["mass"].attrs["units"] == "kg"
    np.testing.assert_array_equal(data.observed_data["trajectory"].values, np.arange(6.0).reshape(3, 2))
    assert data.observed_data["trajectory"].dims == ("time", "channel")
    np.testing.assert_array_equal(data.observed_data["time"], [0.0, 0.5, 1.0])
    predictive = data.posterior_predictive["trajectory"]
    assert predictive.dims == ("chain", "draw", "time", "channel")
    np.testing.assert_array_equal(predictive.values[0], np.arange(24.0).reshape(4, 3, 2)[[0, 2, 3]])


def test_the_command_line_writes_netcdf(folder, tmp_path, capsys):
    arviz = pytest.importorskip("arviz")
    out = tmp_path / "draws.nc"
    assert command("sample", folder, "-n", 30, "--out", out) == 0
    assert list(tmp_path.iterdir()) == [out]
    read = arviz.from_netcdf(str(out))
    assert {"posterior", "observed_data", "posterior_predictive"} <= set(read.groups())
    draws, _, _ = posterior_samples(folder, 30, seed=0)
    np.testing.assert_array_equal(read.posterior["drag"].values[0], draws[:, 1])
    assert command("sample", folder, "--out", out) == 2 and "exists" in capsys.readouterr().err


def test_without_arviz_it_is_told_how_to_get_it(folder, tmp_path, monkeypatch, capsys):
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
        assert "expected a whole run" in capsys.readouterr().err
    finally:
        (folder / "history.npz").write_bytes(history)
