"""load and save: a run folder is the run that made it, in this process and in another."""

import dataclasses
import json
import shutil
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlfi
from jaxlfi.estimators.base import untrained
from jaxlfi.estimators.flow_estimators import SplineFlow
from jaxlfi.estimators.mixture_network import MixtureNetwork
from jaxlfi.heuristics import Choice, Edge, Fixed, Matched, Mode
from jaxlfi.io import files as atomic
from jaxlfi.io import formats, trees
from jaxlfi.io.workfolder import StoreError
from jaxlfi.runs.describe import settings_to_json
from jaxlfi.runs.load import LINEAR_TERMS, _network, load
from tests.small import FLAGS, SETTINGS, TASK, command, gaussian, whole_runs  # noqa: F401 - a fixture

OBSERVED = np.array([0.8, -0.6], np.float32)
CHOICE = Choice(1, (Edge(), Matched(Mode(proximity=0.3)), Fixed()))


def same_leaves(a, b) -> None:
    """Equal pytrees, to the last bit."""
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for ours, theirs in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(ours, theirs)


@pytest.fixture(scope="module")
def run(whole_runs):  # noqa: F811 - the fixture
    """A run that says it was by a choice of rules, one of them nested, with a seed of more than 32 bits.

    By the program that most tests share; `tests/test_fields.py` keeps one that was by a choice.
    """
    key = jax.random.wrap_key_data(jnp.array([5, 7], jnp.uint32))
    made = jaxlfi.infer(key, gaussian(), OBSERVED, support="misspecified", heuristic=Edge(), settings=SETTINGS)
    return made.replace(heuristic=CHOICE)


@pytest.fixture(scope="module")
def saved(run, tmp_path_factory):
    """It, in a folder."""
    return run.save(tmp_path_factory.mktemp("load") / "run")


def test_a_saved_run_is_loaded_as_it_was(run, saved):
    again = load(saved, gaussian())
    assert type(again) is type(run)
    same_leaves(again.belief, run.belief)
    assert again.history.keys() == run.history.keys()
    for name, value in run.history.items():
        np.testing.assert_array_equal(again.history[name], value, err_msg=name)
    size = int(run.dataset.size)
    assert int(again.dataset.size) == size == 40
    for name in ("theta", "x", "round", "weight"):
        np.testing.assert_array_equal(getattr(again.dataset, name)[:size], getattr(run.dataset, name)[:size])
        assert getattr(again.dataset, name).shape == getattr(run.dataset, name).shape
    same_leaves(again.heuristic, run.heuristic)
    assert again.settings == run.settings and settings_to_json(again.settings) == settings_to_json(run.settings)
    np.testing.assert_array_equal(jax.random.key_data(again.key), jax.random.key_data(run.key))
    same_leaves((again.support, again.feasible), (run.support, run.feasible))
    np.testing.assert_array_equal(again.observed, run.observed)
    np.testing.assert_array_equal(again.x, run.x)
    assert again.space == run.space and again.task == run.task and again.warnings == run.warnings
    assert again.units == run.units == run.task.units
    np.testing.assert_array_equal(again.draws(), run.draws())


def test_saving_what_was_loaded_gives_the_same_files(saved, tmp_path):
    again = load(saved, gaussian()).save(tmp_path / "again")
    assert {path.name for path in again.iterdir()} == {path.name for path in saved.iterdir()}
    for path in saved.glob("*.npz"):
        first, second = atomic.read_arrays(path), atomic.read_arrays(again / path.name)
        assert first.keys() == second.keys()
        for name, value in first.items():
            np.testing.assert_array_equal(value, second[name])
    assert (again / "ledger.jsonl").read_text() == (saved / "ledger.jsonl").read_text()
    configs = [json.loads((folder / "config.json").read_text()) for folder in (saved, again)]
    for config in configs:
        for measured in ("started", "command_line"):
            config.pop(measured)
    assert configs[0] == configs[1]


def test_a_finished_run_can_be_replaced_and_nothing_else(run, saved, tmp_path, monkeypatch):
    out, files = tmp_path / "run", lambda folder: {path.name: path.read_bytes() for path in folder.rglob("*.npz")}
    whole = files(run.save(out, exist_ok=True))  # nothing is there yet
    (out / "figures").mkdir()
    assert files(run.save(out, exist_ok=True)) == whole and not (out / "figures").exists()
    assert [path.name for path in tmp_path.iterdir()] == ["run"]
    with pytest.raises(ValueError, match="expected a new or empty folder"):
        run.save(out)
    (out / "notes.txt").write_text("mine")
    with pytest.raises(ValueError, match=r"^save: expected a folder with only a run to replace, got .* 'notes.txt'$"):
        run.save(out, exist_ok=True)
    (out / "notes.txt").unlink()
    for name, text in {"config.json": "{}", "posterior.npz": None}.items():
        spoilt = shutil.copytree(out, tmp_path / f"without {name}")
        (spoilt / name).write_text(text) if text else (spoilt / name).unlink()
        with pytest.raises(ValueError, match="expected"):
            run.save(spoilt, exist_ok=True)
    renamed = Path.rename

    def refused(self, target):
        if self.name.startswith(".run-"):
            raise OSError("no")
        return renamed(self, target)

    monkeypatch.setattr(Path, "rename", refused)
    with pytest.raises(OSError, match="no"):
        run.save(out, exist_ok=True)
    assert files(out) == whole


def test_a_run_of_a_task_made_in_python_is_loaded_without_it(run, saved, tmp_path):
    assert json.loads((saved / "config.json").read_text())["task"] is None
    again = load(saved)
    assert again.task is None and again.space == run.space
    np.testing.assert_array_equal(again.draws(), run.draws())
    assert np.isfinite(again.posterior.log_prob(again.draws())).all()
    with pytest.raises(
        StoreError, match=r"^save: expected a run whose task is known: jaxlfi\.load\(folder, task=\.\.\.\)"
    ):
        again.save(tmp_path / "new")
    other = dataclasses.replace(gaussian(), names=("a", "b"))
    with pytest.raises(StoreError, match="expected the task as it was when the run was made, with parameters"):
        load(saved, other)


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    """A comparison of two configurations, of one seed each."""
    out = tmp_path_factory.mktemp("compare") / "comparison"
    own = ("--configurations", "misspecified", "misspecified+edge", "--seeds", "1", "--rounds", "1", "--no-predictive")
    assert command("compare", TASK, *FLAGS, *own, "--out", out) == 0
    return out


FRESH = """
import sys, jax, numpy as np, jaxlfi
run = jaxlfi.load(sys.argv[1])
draws = run.posterior.sample(jax.random.key(0), 1000)
np.savez(sys.argv[2], draws=draws, means=run.mixture.means, task=run.task.name, amortised=run.amortised)
"""


@pytest.mark.slow
def test_a_fresh_process_loads_a_run_of_a_comparison(compared, tmp_path):
    for configuration in ("misspecified", "misspecified+edge"):
        folder = compared / configuration / "seed_000"
        here = load(folder)
        assert here.origin.configuration == configuration and here.origin.reference == TASK
    arguments = [sys.executable, "-c", FRESH, str(folder), str(tmp_path / "fresh.npz")]
    done = subprocess.run(arguments, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    fresh = np.load(tmp_path / "fresh.npz")
    np.testing.assert_array_equal(fresh["means"], here.mixture.means)
    np.testing.assert_allclose(fresh["draws"], here.posterior.sample(jax.random.key(0), 1000), rtol=1e-4, atol=1e-5)
    assert str(fresh["task"]) == "gaussian_linear" and bool(fresh["amortised"])


# ------------------------------------------------------------------------------------------------- damaged folders


def config_with(**changes):
    """Change the folder's config.json."""

    def damage(folder):
        config = json.loads((folder / "config.json").read_text())
        (folder / "config.json").write_text(json.dumps(config | changes))

    return damage


def without(name):
    """Delete an entry of config.json."""

    def damage(folder):
        config = json.loads((folder / "config.json").read_text())
        del config[name]
        (folder / "config.json").write_text(json.dumps(config))

    return damage


def cut(name):
    """Leave half of a file."""

    def damage(folder):
        content = (folder / name).read_bytes()
        (folder / name).write_bytes(content[: len(content) // 2])

    return damage


def replaced(name, **arrays):
    """Other arrays in a file."""
    return lambda folder: atomic.write_arrays(folder / name, arrays)


COMPARED = {"format": formats.COMPARE, "runs": [{"folder": "misspecified/seed_000"}]}
"""What a folder of several runs says of itself."""


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda folder: shutil.rmtree(folder), "expected a run folder, got .*, which is not a folder"),
        (lambda folder: (folder / "config.json").unlink(), "without a readable config.json"),
        (cut("config.json"), "without a readable config.json"),
        (config_with(format="other"), "config.json is not of jaxlfi"),
        (config_with(format="jaxlfi-grid"), "config.json is of format 'jaxlfi-grid'"),
        (config_with(**COMPARED), "expected the folder of one run, such as .*misspecified/seed_000$"),
        (
            config_with(version=1),
            r"expected jaxlfi-run of version 4, got version 1, which jaxlfi 0.* reads; or run its command again",
        ),
        (config_with(status="running"), "expected a finished run; continue it with jaxlfi resume"),
        (lambda folder: (folder / "posterior.npz").unlink(), "expected a finished run"),
        (without("settings"), "config.json: expected a complete description of the run"),
        (without("parameters"), "config.json: expected a complete description of the run"),
        (without("task"), "config.json: expected a complete description of the run"),
        (config_with(seed="none"), "config.json: expected a complete description of the run"),
        (
            config_with(heuristic={"name": "never", "hyperparameters": {}}),
            "config.json: expected a complete desc.*never",
        ),
        (config_with(settings=[1]), "config.json: expected a complete description of the run"),
        (cut("posterior.npz"), "posterior.npz: expected a complete .npz file"),
        (cut("history.npz"), "history.npz: expected a complete .npz file"),
        (lambda folder: (folder / "dataset.npz").unlink(), "dataset.npz: expected a complete .npz file"),
        (replaced("observation.npz", x=np.zeros(2)), "observation.npz: expected an array trajectory, got none"),
        (replaced("network.npz", a=np.zeros(2)), "network.npz: expected an array"),
    ],
)
def test_folders_that_hold_no_whole_run_are_one_line(saved, tmp_path, damage, message):
    folder = tmp_path / "run"
    shutil.copytree(saved, folder)
    damage(folder)
    with pytest.raises(ValueError, match=message) as refused:
        load(folder)
    assert "\n" not in str(refused.value) and str(folder) in str(refused.value)


def test_flows_saved_without_weights_count_the_same(tmp_path):
    settings = SETTINGS.replace(estimator=SplineFlow(hidden=(4,), transforms=1, ensemble_size=2, regression=1, bins=2))
    feasible, space = gaussian().feasible, gaussian().space
    network = untrained(jax.random.key(1), settings.estimator, 2, feasible, space)
    weighted = trees.named_leaves(network.replace(log_weights=jnp.log(jnp.array([0.9, 0.1]))))
    atomic.write_arrays(tmp_path / "now.npz", weighted)
    atomic.write_arrays(tmp_path / "before.npz", {name: v for name, v in weighted.items() if name != ".log_weights"})
    loaded = lambda name: _network(tmp_path / name, settings, (2,), feasible, space, None, formats.VERSION)
    np.testing.assert_allclose(np.exp(loaded("now.npz").log_weights), [0.9, 0.1], rtol=1e-6)
    assert loaded("before.npz").log_weights is None
    same_leaves(loaded("before.npz"), network.replace(log_weights=None))


def test_spline_flows_saved_without_linear_terms_have_the_identity(tmp_path):
    settings = SETTINGS.replace(estimator=SplineFlow(hidden=(4,), transforms=1, bins=2))
    feasible, space = gaussian().feasible, gaussian().space
    network = untrained(jax.random.key(1), settings.estimator, 2, feasible, space)
    before = {name: v for name, v in trees.named_leaves(network).items() if not name.endswith(LINEAR_TERMS)}
    assert len(before) == len(trees.named_leaves(network)) - 2
    atomic.write_arrays(tmp_path / "network.npz", before)
    loaded = _network(tmp_path / "network.npz", settings, (2,), feasible, space, None, formats.VERSION)
    same_leaves(loaded, network)  # it starts as the identity


@pytest.mark.parametrize("obs", [5, 12])
def test_networks_saved_without_robust_estimates_or_residuals_or_more_are_read(tmp_path, obs):
    estimator = MixtureNetwork(hidden=(4,), ensemble_size=2, reduction="half", warm_start=False)
    settings = SETTINGS.replace(estimator=estimator)
    feasible, space = gaussian().feasible, gaussian().space
    network = untrained(jax.random.key(1), estimator.for_layout((obs, 1)), obs, feasible, space)
    shapes = network.regression.of_earlier_versions(obs)
    assert len(shapes) == (5 if obs == 12 else 2)  # the first is today's of few numbers
    ones = lambda tree: jax.tree.map(lambda leaf: jnp.ones(leaf.shape, leaf.dtype), tree)
    for saved in (network, *(network.replace(regression=ones(earlier)) for earlier in shapes)):
        named = trees.named_leaves(saved)
        atomic.write_arrays(tmp_path / "network.npz", {name: leaf for name, leaf in named.items() if leaf.size})
        loaded = _network(tmp_path / "network.npz", settings, (obs, 1), feasible, space, None, formats.VERSION)
        same_leaves(loaded, saved)
        assert np.isfinite(loaded.given(jnp.arange(float(obs)))).all()


def untrained_of(obs, path):
    """A network of so many numbers, half of whose ensemble sees features, and what reads one from a file."""
    estimator = MixtureNetwork(hidden=(4,), ensemble_size=2, reduction="half", warm_start=False)
    settings, feasible, space = SETTINGS.replace(estimator=estimator), gaussian().feasible, gaussian().space
    network = untrained(jax.random.key(1), estimator.for_layout((obs, 1)), obs, feasible, space)
    return network, lambda: _network(path, settings, (obs, 1), feasible, space, None, formats.VERSION)


def test_a_network_of_many_numbers_without_estimates_from_them_is_refused(tmp_path):
    obs, path = 130, tmp_path / "network.npz"
    network, read = untrained_of(obs, path)
    named = trees.named_leaves(network)
    atomic.write_arrays(path, named)
    same_leaves(read(), network)
    earlier = network.regression.of_earlier_versions(obs)
    assert len(earlier) == 2  # without robust estimates, and without residuals either
    for shapes in earlier:
        before = network.replace(regression=jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes))
        atomic.write_arrays(path, {n: v for n, v in trees.named_leaves(before).items() if v.size})
        same_leaves(read(), before)
    atomic.write_arrays(path, {n: leaf for n, leaf in named.items() if ".inverse." not in n})
    with pytest.raises(StoreError, match="of an earlier version: infer again"):
        read()


def test_a_network_of_all_numbers_of_a_long_summary_is_refused(tmp_path):
    path = tmp_path / "network.npz"
    network, read = untrained_of(600, path)
    named = {name: leaf for name, leaf in trees.named_leaves(network).items() if leaf.size}
    atomic.write_arrays(path, named)
    same_leaves(read(), network)
    kernel = next(name for name in named if "Dense_0" in name and "kernel" in name)
    inputs = (*named[kernel].shape[:-1], 600 + named[kernel].shape[-1])
    atomic.write_arrays(path, named | {kernel: jnp.zeros(inputs)})
    with pytest.raises(StoreError, match="saw all of its 600 numbers: infer again"):
        read()


@pytest.mark.slow  # golden runs are read by test_formats.py
def test_a_regression_by_kernels_is_read_with_as_many_simulations_as_it_has(tmp_path):
    estimator = SplineFlow(
        hidden=(4,), transforms=1, bins=2, reduction="half", regressor="kernel", ensemble_size=2, warm_start=False
    )
    settings = SETTINGS.replace(estimator=estimator)
    feasible, space = gaussian().feasible, gaussian().space
    network = untrained(jax.random.key(1), estimator.for_layout((20, 1)), 20, feasible, space, rows=30)
    network = jax.tree.map(lambda leaf: leaf + 0.5, network)
    atomic.write_arrays(tmp_path / "network.npz", trees.named_leaves(network))
    loaded = _network(tmp_path / "network.npz", settings, (20, 1), feasible, space, None, formats.VERSION)
    assert [part.rows.shape[0] for both in loaded.regression.parts for part in both] == [30] * 4
    same_leaves(loaded, network)
    x = jnp.arange(20.0)
    np.testing.assert_allclose(loaded.given(x), network.given(x))
