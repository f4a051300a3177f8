"""Sensitivity grids: every run is the one it stands for, however the grid is cut, stopped or shared out."""

import csv
import dataclasses
import functools
import json
import os
import pathlib
import shutil
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console

import jaxlfi
from jaxlfi.bayessim import memory
from jaxlfi.envs import gaussian_linear
from jaxlfi.heuristics import Centre, Edge, Matched, Mode
from jaxlfi.io import files as atomic
from jaxlfi.io.workfolder import StoreError
from jaxlfi.studies import grid as study
from jaxlfi.studies.grid import Axis, Grid, chunks
from jaxlfi.studies.grid import folder as store
from jaxlfi.studies.grid.grid import observations
from jaxlfi.tasks.host import HostSimulator, SimulatorError
from tests.small import FLAGS, SETTINGS, command, whole_runs  # noqa: F401 - a fixture

REFERENCE = "tests.studies.test_grid:task"
AXES = (Axis("mass_threshold", (0.005, 0.9)), Axis("expansion", (0.1, 0.5)))
SEEDS = (3, 0, 1)
LENGTH = 5
"""Runs in a chunk: twelve runs make three chunks, of which the last is more padding than runs."""
QUIET = Console(quiet=True)
CHUNKS = pathlib.Path("nowhere")


@functools.cache
def task():
    """The Gaussian task with a region where simulations fail, so that success rates differ."""
    base = gaussian_linear.task()

    def simulate(key, theta):
        return base.simulate(key, theta), theta[1] > -2.0

    return dataclasses.replace(base, simulate=simulate)


TASK = task()


def make_grid(**changes) -> Grid:
    """The grid of these tests."""
    given = {
        "task": TASK,
        "support": TASK.support("misspecified"),
        "rule": Edge(),
        "axes": AXES,
        "seeds": SEEDS,
        "settings": SETTINGS,
        "reference": REFERENCE,
        "support_name": "misspecified",
    }
    return Grid(**(given | changes))


@pytest.fixture(scope="module")
def finished(tmp_path_factory, whole_runs):  # noqa: F811 - the fixture
    """A whole grid: its folder, its work with the compiled engine, its arrays."""
    folder = tmp_path_factory.mktemp("grids") / "grid"
    work = study.begin(folder, make_grid(), runs_per_chunk=LENGTH)
    return folder, work, study.advance(folder, work, QUIET)


@pytest.mark.slow
def test_every_run_is_that_of_its_values_and_seed(finished):
    """Compared with `infer`, summed up in plain NumPy. Tolerances are for batched arithmetic."""
    _, work, arrays = finished
    for i, threshold in enumerate(AXES[0].values):
        for j, expansion in enumerate(AXES[1].values):
            for s, seed in enumerate(SEEDS):
                rule = Edge(mass_threshold=jnp.float32(threshold), expansion=jnp.float32(expansion))
                own = {"support": "misspecified", "heuristic": rule, "settings": SETTINGS}
                history = jaxlfi.infer(seed, TASK, work.observed[s], **own).history
                errors = np.asarray(history["sample_theta_error"][-1])
                expected = {
                    "theta_error": errors.sum(1).mean(),
                    "theta_error_by_parameter": errors.mean(0),
                    "trajectory_error": np.nanmean(history["sample_trajectory_error"][-1]),
                    "success_rate": history["succeeded"].sum() / history["attempted"].sum(),
                    "support_low": history["support_low"][-1],
                    "support_high": history["support_high"][-1],
                }
                for name, value in expected.items():
                    np.testing.assert_allclose(
                        arrays[name][i, j, s], value, rtol=5e-3, atol=5e-3, err_msg=f"{name} {i, j, s}"
                    )
    # The grid is one on which these comparisons can fail: axes, seeds and failures all show.
    assert 0.5 < arrays["success_rate"].min() < arrays["success_rate"].max() < 1
    for axis in range(3):
        assert np.ptp(arrays["support_high"][..., 0], axis=axis).max() > 0.1 or axis == 2
        assert np.ptp(arrays["theta_error"], axis=axis).max() > 0.05


def test_shapes_and_axes_of_the_arrays(finished):
    folder, _, arrays = finished
    stored = atomic.read_arrays(folder / "grid.npz")
    assert set(stored) == set(arrays) == {
        "axes", "values/mass_threshold", "values/expansion", "seeds", "names", *study.MEASURES,
    }  # fmt: skip
    assert stored["axes"].tolist() == ["mass_threshold", "expansion"]
    assert stored["values/expansion"].tolist() == [0.1, 0.5] and stored["seeds"].tolist() == [3, 0, 1]
    assert stored["theta_error"].shape == stored["success_rate"].shape == (2, 2, 3)
    assert stored["support_low"].shape == stored["theta_error_by_parameter"].shape == (2, 2, 3, 2)


def test_the_table_has_a_line_for_each_combination_and_seed(finished):
    folder, _, arrays = finished
    with (folder / "table.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert len(lines) == 12
    for line in lines:
        place = (
            AXES[0].values.index(float(line["mass_threshold"])),
            AXES[1].values.index(float(line["expansion"])),
            SEEDS.index(int(line["seed"])),
        )
        for name in ("theta_error", "trajectory_error", "success_rate"):
            assert float(line[name]) == arrays[name][place]


def test_a_run_does_not_depend_on_its_chunk(finished):
    """The same program with other neighbours, at another place in the chunk: the same bits."""
    _, work, arrays = finished
    turned = make_grid(axes=AXES[::-1], seeds=SEEDS[::-1])
    other = study.Work(turned, work.observed[::-1], work.x[::-1], LENGTH)
    parts = [(study.run_chunk(other, places)[0], len(places)) for places in store.store_of(CHUNKS, other).chunks]
    results = {name: np.concatenate([part[name][:count] for part, count in parts]) for name in study.MEASURES}
    again = study.arranged(turned, results)
    for name in study.MEASURES:
        np.testing.assert_array_equal(np.swapaxes(again[name], 0, 1)[:, :, ::-1], arrays[name], err_msg=name)


@pytest.mark.slow
def test_one_chunk_gives_what_several_give(finished):
    """Another length is another program: equal to what training makes of rounding."""
    _, _, arrays = finished
    whole = study.measure(make_grid())
    for name in study.MEASURES:
        np.testing.assert_allclose(whole[name], arrays[name], rtol=5e-3, atol=5e-3, err_msg=name)


def interrupted(folder, work, monkeypatch, after: int) -> None:
    """Run until a chunk is about to begin."""
    original = study.run_chunk

    def stop(work, places, *rest):
        if places.start == after * LENGTH:
            raise KeyboardInterrupt
        return original(work, places, *rest)

    with monkeypatch.context() as patch:
        patch.setattr(store, "run_chunk", stop)
        with pytest.raises(KeyboardInterrupt):
            study.advance(folder, work, QUIET)


def test_a_resumed_grid_computes_what_is_missing_to_the_same_bits(finished, tmp_path, monkeypatch):
    folder, work, _ = finished
    broken = tmp_path / "broken"
    study.create(broken, work)
    interrupted(broken, work, monkeypatch, after=2)
    (broken / "chunks" / "000.npz").unlink()  # as if another machine had lost it
    kept = (broken / "chunks" / "001.npz").read_bytes()
    assert not (broken / "grid.npz").exists()
    computed, original = [], study.run_chunk
    monkeypatch.setattr(
        store, "run_chunk", lambda work, places, *rest: computed.append(places) or original(work, places, *rest)
    )
    assert command("resume", broken, "--no-figures") == 0
    assert computed == [range(5), range(10, 12)] and (broken / "chunks" / "001.npz").read_bytes() == kept
    for name in ("grid.npz", "table.csv", "observation.npz"):
        assert (broken / name).read_bytes() == (folder / name).read_bytes(), name
    ours, theirs = (json.loads((f / "config.json").read_text()) for f in (broken, folder))
    assert ours["status"] == theirs["status"] == "finished"


def test_resuming_what_is_complete_says_so(finished, capsys):
    folder, _, _ = finished
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    assert command("resume", folder) == 0
    assert "is complete" in capsys.readouterr().out
    assert before == {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def spoiled(folder, tmp_path, spoil):
    """A copy of a folder that was stopped before its end, with something changed."""
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    for name in ("grid.npz", "table.csv"):
        (copy / name).unlink()
    config = json.loads((copy / "config.json").read_text())
    config["status"] = "running"
    (copy / "chunks" / "002.npz").unlink()
    spoil(copy, config)
    atomic.write_json(copy / "config.json", config)
    return copy


def _truncate(name):
    def spoil(folder, _):
        path = folder / name
        path.write_bytes(path.read_bytes()[:-40])

    return spoil


def _chunk_of_another(folder, _):
    path = folder / "chunks" / "001.npz"
    atomic.write_arrays(path, atomic.read_arrays(path) | {"fingerprint": np.asarray("another")})


def _chunk_in_the_wrong_place(folder, _):
    arrays = atomic.read_arrays(folder / "chunks" / "000.npz")
    atomic.write_arrays(folder / "chunks" / "002.npz", arrays)


SPOILED = {
    "settings": (lambda _, config: config["settings"].update(rounds=3), "got changed ones"),
    "axis": (lambda _, config: config["axes"][0]["values"].reverse(), "got changed ones"),
    "seeds": (lambda _, config: config["seeds"].append(9), "got changed ones"),
    "chunk length": (lambda _, config: config.update(runs_per_chunk=4), "got changed ones"),
    "task": (lambda _, config: config.update(task="jaxlfi.envs.gaussian_linear:broken"), "complete description"),
    "parameters": (lambda _, config: config.update(names=["a", "b"]), "got changed ones"),
    "missing part": (lambda _, config: config.pop("axes"), "complete description"),
    "an older version": (lambda _, config: config.update(version=1), "of version 4, got version 1"),
    "version": (lambda _, config: config.update(version=9), "expected jaxlfi-grid of version 4, got version 9"),
    "observation": (_truncate("observation.npz"), "expected a complete .npz"),
    "damaged chunk": (_truncate("chunks/001.npz"), "delete it, and resuming computes it again"),
    "chunk of another grid": (_chunk_of_another, "got one of another"),
    "chunk in the wrong place": (_chunk_in_the_wrong_place, "of 2 runs"),
}  # fmt: skip


@pytest.mark.parametrize("case", SPOILED)
def test_a_changed_or_damaged_grid_is_not_resumed(case, finished, tmp_path, capsys):
    spoil, expected = SPOILED[case]
    folder = spoiled(finished[0], tmp_path, spoil)
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    assert command("resume", folder) == 2
    message = capsys.readouterr().err
    assert expected in message and message.count("\n") == 1
    assert before == {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_task_that_has_changed_is_not_resumed(finished, monkeypatch):
    changed = dataclasses.replace(TASK, truth=np.array([1.0, 0.5]))
    monkeypatch.setattr(type(store.TASKS), "load", lambda self, reference: changed)
    with pytest.raises(StoreError, match="the task as they were"):
        study.reopen(finished[0])


def test_nothing_is_overwritten(finished):
    with pytest.raises(StoreError, match="new or empty folder"):
        study.begin(finished[0], make_grid())


def test_a_simulator_that_always_fails_is_refused(finished, monkeypatch):
    _, work, _ = finished

    class Hopeless:
        """An engine whose simulations fail."""

        task, failure_messages = TASK, ""
        start = begin = compile = lambda *_: None

        def round(self, state, index):
            """One round."""
            failed = np.full((LENGTH, len(TASK.reasons)), 25)
            return None, {"attempted": np.full(LENGTH, 25), "succeeded": np.zeros(LENGTH, int), "failed": failed}

    monkeypatch.setattr(chunks, "engine_for", lambda *_, **__: Hopeless())
    with pytest.raises(SimulatorError, match="got none"):
        study.run_chunk(work, range(LENGTH))


@pytest.mark.slow
def test_a_grid_of_a_host_simulator(whole_runs):  # noqa: F811 - the fixture
    def simulate(rng, theta):
        return theta @ gaussian_linear.MIXING.T + gaussian_linear.NOISE * rng.normal(size=theta.shape)

    problem = dataclasses.replace(gaussian_linear.task(), simulate=HostSimulator(simulate))
    settings = SETTINGS.replace(rounds=1)
    axes, rule = (Axis("expansion", (0.1, 0.5)),), Edge(zone_fraction=1.0, mass_threshold=0.1)  # every bound moves
    arrays = study.measure(make_grid(task=problem, rule=rule, axes=axes, seeds=(4,), settings=settings))
    np.testing.assert_allclose(arrays["support_high"][:, 0, 0], [0.3, 1.5], rtol=1e-5)
    np.testing.assert_array_equal(arrays["success_rate"], 1.0)
    assert np.isfinite(arrays["theta_error"]).all() and np.isfinite(arrays["trajectory_error"]).all()


def test_chunks_are_cut_to_the_memory(monkeypatch):
    """Without compiling: a program is said to need `each` bytes for each run of a device."""
    tried, each = [], 0

    def program_bytes(engine):
        tried.append(engine.runs)
        return each * engine.runs

    monkeypatch.setattr(chunks, "program_bytes", program_bytes)
    one = chunks.run_bytes(study.Work(make_grid(), *observations(make_grid()), 1))
    monkeypatch.setattr(memory, "free_memory", lambda devices: 1e12)
    assert study.prepare(make_grid()).length == 12
    assert study.prepare(make_grid(), runs_per_chunk=100).length == 12
    room = 7.5 * memory.PROGRAM_PER_STATE * one / memory.FRACTION
    monkeypatch.setattr(memory, "free_memory", lambda devices: room)
    assert study.prepare(make_grid(), runs_per_chunk=3).length == 3
    assert study.prepare(make_grid()).length == 6  # 7 fit, and two chunks of 6 need no padding
    # The program turns out to need four times what was estimated: 1.9 runs fit.
    each = 4 * memory.PROGRAM_PER_STATE * one
    tried.clear()
    assert study.prepare(make_grid()).length == 1 and tried == [6, 1]
    with pytest.raises(ValueError, match="runs_per_chunk: expected fewer runs"):
        study.prepare(make_grid(), runs_per_chunk=12)
    # Not even the states fit: refused without compiling.
    tried.clear()
    monkeypatch.setattr(memory, "free_memory", lambda devices: one)
    for given in (None, 2):
        with pytest.raises(ValueError, match="fill the memory"):
            study.prepare(make_grid(), runs_per_chunk=given)
    assert tried == []


def test_free_memory_is_shared_by_the_devices_of_a_cpu():
    (device,) = jax.local_devices()[:1]
    one, two = memory.free_memory([device]), memory.free_memory([device] * 2)
    assert 2**20 < one < os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    assert two == pytest.approx(one / 2, rel=0.2)


@pytest.mark.parametrize("devices", [1, 2, 3])
def test_even_lengths_are_the_fewest_equal_chunks(devices):
    for size in range(1, 40):
        for most in range(1, 45):
            length = memory.even_length(size, most, devices)
            step = devices if most >= devices else 1
            assert 1 <= length <= min(most, size)
            assert -(-size // length) == -(-size // min(size, most // step * step))
            assert length % step == 0 or length == size


def test_heuristics_are_the_product_of_the_axes():
    assert [(e.mass_threshold, e.expansion) for e in study.heuristics(Edge(tail=0.5), AXES)] == [
        (0.005, 0.1), (0.005, 0.5), (0.9, 0.1), (0.9, 0.5),
    ]  # fmt: skip
    matched = study.heuristics(Matched(Mode()), [Axis("proximity", (0.2, 0.3))])
    assert [rule.rule.proximity for rule in matched] == [0.2, 0.3]
    runs = study.grid_runs(make_grid())
    assert [run.seed for run in runs[:4]] == [3, 0, 1, 3]
    assert runs[3].configuration == "mass_threshold=0.005 expansion=0.5"


BAD_AXES = {
    "none": ((), "at least one hyperparameter"),
    "twice": ((AXES[0], AXES[0]), "each once"),
    "unknown": ((Axis("proximity", (0.1,)),), "expected a hyperparameter that the heuristic has"),
    "empty": ((Axis("tail", ()),), "at least one value"),
    "same": ((Axis("tail", (0.1, 0.2, 0.1)),), "each once, got 0.1,0.2,0.1"),
    "same in single precision": ((Axis("tail", (0.1, 0.1 + 1e-12)),), "each once"),
    "mass above 1": ((Axis("mass_threshold", (0.1, 1.5)),), "mass_threshold: expected finite numbers in"),
    "negative": ((Axis("expansion", (-0.1,)),), "expansion: expected finite numbers in"),
    "infinite": ((Axis("expansion", (float("inf"),)),), "expansion: expected finite numbers"),
    "nan": ((Axis("expansion", (float("nan"), 1.0)),), "expansion: expected finite numbers"),
}


@pytest.mark.parametrize("case", BAD_AXES)
def test_axes_that_are_refused(case):
    axes, expected = BAD_AXES[case]
    with pytest.raises(ValueError, match=expected):
        make_grid(axes=axes)


def test_other_things_that_are_refused():
    with pytest.raises(ValueError, match="it has none"):
        make_grid(rule=Centre())
    for seeds in ((), (1, 1)):
        with pytest.raises(ValueError, match="seeds: expected"):
            make_grid(seeds=seeds)
    with pytest.raises(ValueError, match=r"rounds: expected a whole number in \[1, 100000\]"):
        make_grid(settings=SETTINGS.replace(rounds=0))


TWO_DEVICES = """
import sys
from pathlib import Path
from jaxlfi.cli.parser import main
import jax
assert jax.local_device_count() == 2
sys.exit(main(sys.argv[1:]))
"""


def start(script: str, *arguments, devices: int) -> subprocess.Popen:
    """A process of its own with so many devices."""
    flags = f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count={devices}"
    environment = os.environ | {"XLA_FLAGS": flags}
    return subprocess.Popen(
        [sys.executable, "-c", script, *map(str, arguments)],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


@pytest.mark.slow
def test_two_devices_give_what_one_gives(finished, tmp_path):
    """Through the command line; chunks of five on two devices: one run of each chunk is padding."""
    vary = [f"{axis.name}={','.join(map(str, axis.values))}" for axis in AXES]
    given = ["--vary", *vary, "--support", "misspecified", "--runs-per-chunk", LENGTH, "--seeds", 2, "--prune", 0]
    out = tmp_path / "out"
    process = start(TWO_DEVICES, "grid", REFERENCE, *given, *FLAGS, "--out", out, devices=2)
    output, _ = process.communicate(timeout=150)
    assert process.returncode == 0, output
    assert "in 2 chunks of 5" in output and json.loads((out / "config.json").read_text())["devices"] == 2
    arrays = atomic.read_arrays(out / "grid.npz")
    for name in study.MEASURES:  # seeds 0 and 1 here, 3, 0 and 1 there
        np.testing.assert_allclose(arrays[name], finished[2][name][:, :, 1:], rtol=5e-3, atol=5e-3, err_msg=name)
