"""Run folders: every file and shape, and never anything else's."""

import dataclasses
import json
from pathlib import Path

import jax
import numpy as np
import pytest

from jaxlfi.bayessim.presets import PRESETS
from jaxlfi.envs import lotka_volterra, lynx_hare, mg1
from jaxlfi.heuristics import Centre, Choice, Edge, Fixed, Matched, Mode
from jaxlfi.io import files as atomic
from jaxlfi.io import provenance, workfolder
from jaxlfi.runs import folder as folders
from jaxlfi.runs.describe import heuristic_from_json, heuristic_to_json, settings_from_json, settings_to_json
from jaxlfi.tasks.observation import observe
from jaxlfi.tasks.simulation import trajectory_and_outcome
from tests.small import FLAGS, TASK, command, gaussian, read_ledger, whole_runs  # noqa: F401 - a fixture

ROUNDS, SIMULATIONS, BUDGET, DIM, COMPONENTS, OBS, SAMPLES = 2, 20, 25, 2, 4, 2, 20


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """One small run."""
    out = tmp_path_factory.mktemp("store") / "run"
    assert command("infer", TASK, "--support", "misspecified", "--out", out, *FLAGS) == 0
    return out


def test_a_run_leaves_exactly_its_plain_files(folder):
    names = {path.relative_to(folder).as_posix() for path in folder.rglob("*")}
    state = {name for name in names if name.startswith("checkpoint")}  # for more rounds
    assert all(name.endswith(".npz") for name in state - {"checkpoint"})
    assert names - state == {
        "config.json",
        "ledger.jsonl",
        "posterior.npz",
        "dataset.npz",
        "history.npz",
        "observation.npz",
        "summary.json",
    }


def test_arrays_have_the_documented_shapes(folder):
    expected = {
        "posterior.npz": {
            "logits": (COMPONENTS,),
            "means": (COMPONENTS, DIM),
            "scale_tril": (COMPONENTS, DIM, DIM),
            "support_low": (DIM,),
            "support_high": (DIM,),
            "draws": (1000, DIM),
            "parameters": (DIM,),
            "log": (DIM,),
            "names": (DIM,),
        },
        "dataset.npz": {
            "theta": (ROUNDS * SIMULATIONS, DIM),
            "x": (ROUNDS * SIMULATIONS, OBS),
            "round": (ROUNDS * SIMULATIONS,),
            "weight": (ROUNDS * SIMULATIONS,),
            "names": (DIM,),
        },
        "history.npz": {
            "theta": (ROUNDS, BUDGET, DIM),
            "counted": (ROUNDS, BUDGET),
            "kept": (ROUNDS, BUDGET),
            "failure": (ROUNDS, BUDGET),
            "proposal_low": (ROUNDS, DIM),
            "proposal_high": (ROUNDS, DIM),
            "support_low": (ROUNDS, DIM),
            "support_high": (ROUNDS, DIM),
            "logits": (ROUNDS, COMPONENTS),
            "means": (ROUNDS, COMPONENTS, DIM),
            "scale_tril": (ROUNDS, COMPONENTS, DIM, DIM),
            "loss": (ROUNDS, 1, 2),
            "validation_loss": (ROUNDS, 1, 2),
            "sample_theta": (ROUNDS, SAMPLES, DIM),
            "sample_theta_error": (ROUNDS, SAMPLES, DIM),
            "sample_trajectory_error": (ROUNDS, SAMPLES),
            "attempted": (ROUNDS,),
            "succeeded": (ROUNDS,),
            "failed": (ROUNDS, 2),
            "reasons": (2,),
            "seconds": (ROUNDS,),
            "low_shift": (ROUNDS, DIM),
            "high_shift": (ROUNDS, DIM),
            "chosen_epoch": (ROUNDS, 1),
            "nonfinite": (ROUNDS, 1),
            "effective_size": (ROUNDS,),
            "not_positive_definite": (ROUNDS,),
            "mass_inside": (ROUNDS,),
            "effective_share": (ROUNDS,),
            "moved": (ROUNDS,),
            "rescaled": (ROUNDS,),
            "turned": (ROUNDS,),
            "settled": (ROUNDS,),
            "predictive_simulations": (ROUNDS,),
            "names": (DIM,),
            "final_trajectory": (SAMPLES, 2),
            "final_x": (SAMPLES, OBS),
            "evidence/mass_left": (ROUNDS, DIM),
            "evidence/mass_right": (ROUNDS, DIM),
        },
        "observation.npz": {
            "trajectory": (2,),
            "x": (OBS,),
            "truth": (DIM,),
            "names": (DIM,),
            "layout": (2,),
            "summaries": (OBS,),
            "channels": (1,),
            "times": (2,),
            "record_label": (),
        },
    }
    for name, shapes in expected.items():
        arrays = atomic.read_arrays(folder / name)
        assert {key: value.shape for key, value in arrays.items()} == shapes
        assert not any(value.dtype.hasobject for value in arrays.values())


def test_summaries_and_draws_are_those_of_the_last_posterior(folder):
    history, posterior, observation = (
        atomic.read_arrays(folder / f"{name}.npz") for name in ("history", "posterior", "observation")
    )
    # This task's summary is the trajectory itself.
    np.testing.assert_allclose(history["final_x"], history["final_trajectory"], rtol=1e-6)
    assert observation["summaries"].tolist() == ["x_1", "x_2"] and str(observation["record_label"]) == "record"
    rng = np.random.default_rng(0)
    weight = np.exp(posterior["logits"] - posterior["logits"].max())
    component = rng.choice(COMPONENTS, 100_000, p=weight / weight.sum())
    noise = rng.normal(size=(100_000, DIM))
    mixture = posterior["means"][component] + np.einsum("nij,nj->ni", posterior["scale_tril"][component], noise)
    low, high = posterior["support_low"], posterior["support_high"]
    inside = mixture[((mixture >= low) & (mixture <= high)).all(axis=1)]
    draws = posterior["draws"]
    assert ((draws > low) & (draws < high)).all()
    np.testing.assert_allclose(draws.mean(0), inside.mean(0), atol=5 * inside.std(0).max() / np.sqrt(1000))
    np.testing.assert_allclose(draws.std(0), inside.std(0), rtol=0.15)


def test_names_of_summaries_are_refused_before_anything_runs():
    named = dataclasses.replace(gaussian(), summary_names=("a", "b"))
    assert named.named_summaries(2) == ("a", "b") and gaussian().named_summaries(3) == ("x_1", "x_2", "x_3")
    three = dataclasses.replace(gaussian(), summary_names=("a", "b", "c"))
    with pytest.raises(ValueError, match=r"^summary_names: expected one for each of the summary's 2 numbers, got 3"):
        observe(jax.random.key(0), three, np.array([0.8, -0.6], np.float32))


@pytest.mark.parametrize("module", [lotka_volterra, lynx_hare, mg1])
def test_tasks_name_as_many_summaries_as_they_have(module):
    task = module.task()
    summary = lambda key, theta: task.summary(trajectory_and_outcome(task, key, theta)[0])
    seen = jax.eval_shape(summary, jax.random.key(0), task.feasible.low)
    assert len(set(task.named_summaries(*seen.shape))) == seen.size
    assert "x_1" not in task.named_summaries(*seen.shape)


def test_the_ledger_agrees_with_the_history(folder):
    ledger = read_ledger(folder)
    history = atomic.read_arrays(folder / "history.npz")
    assert [line["round"] for line in ledger] == [0, 1]
    for i, line in enumerate(ledger):
        assert line["attempted"] == history["counted"][i].sum() == line["succeeded"] + sum(line["failed"].values())
        assert line["support_low"] == history["support_low"][i].tolist()
        assert line["proposal_high"] == history["proposal_high"][i].tolist()
        assert line["evidence"]["mass_right"] == history["evidence/mass_right"][i].tolist()
        np.testing.assert_allclose(line["theta_error"], history["sample_theta_error"][i].sum(-1).mean(), rtol=1e-6)
        assert np.isnan(line["validation_loss"])  # null in the file: there was nothing held out
    assert history["proposal_low"][0].tolist() == [-3, -3]
    np.testing.assert_array_equal(history["proposal_high"][1], history["support_high"][0])


def test_config_says_what_was_run_and_with_what(folder):
    text = (folder / "config.json").read_text()
    config = json.loads(text, parse_constant=lambda word: pytest.fail(f"{word} is not JSON"))
    assert config["format"] == "jaxlfi-run" and config["status"] == "finished"
    assert config["task"] == TASK and config["seed"] == 0 and config["names"] == ["first", "second"]
    assert config["support"] == {"name": "misspecified", "low": [-3.0, -3.0], "high": [0.0, 3.0]}
    assert config["heuristic"]["hyperparameters"]["mass_threshold"] == 0.12
    assert config["settings"]["rounds"] == 2 and config["settings"]["estimator"]["name"] == "mdn"
    assert config["settings"]["estimator"]["hyperparameters"]["hidden"] == [16]
    assert config["version"] == 4 and config["task_name"] == "gaussian_linear"
    assert config["parameters"] == ["first", "second"] and config["log"] == [False, False]
    assert config["versions"]["jax"] == jax.__version__ and config["platform"]["backend"] == "cpu"


@pytest.mark.parametrize("preset", PRESETS)
def test_settings_survive_their_description(preset):
    description = json.loads(json.dumps(settings_to_json(PRESETS[preset]), allow_nan=False))
    assert settings_from_json(description) == PRESETS[preset]


@pytest.mark.parametrize(
    "heuristic",
    [
        Fixed(),
        Edge(),
        Edge(expansion=np.array([0.1, 0.3], np.float32)),
        Matched(Mode(proximity=0.3)),
        Choice(1, (Edge(), Matched(Mode()), Centre())),
        Centre(),
    ],
)
def test_heuristics_survive_their_description(heuristic):
    again = heuristic_from_json(json.loads(json.dumps(heuristic_to_json(heuristic))))
    assert jax.tree.structure(again) == jax.tree.structure(heuristic)
    assert all(np.array_equal(a, b) for a, b in zip(jax.tree.leaves(again), jax.tree.leaves(heuristic), strict=True))


def test_python_objects_are_never_written(tmp_path):
    with pytest.raises(TypeError, match="objects"):
        atomic.write_arrays(tmp_path / "a.npz", {"a": np.array([{}, None])})
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("content", [None, "{", "[]", '{"format": "other"}', '{"format": "jaxlfi-run", "version": 99}'])
def test_foreign_folders_are_refused(tmp_path, content):
    if content is not None:
        (tmp_path / "config.json").write_text(content)
    with pytest.raises(workfolder.StoreError, match="expected"):
        folders.read_config(tmp_path)


def test_a_grid_is_named_where_a_run_is_expected(tmp_path):
    (tmp_path / "config.json").write_text('{"format": "jaxlfi-grid", "version": 2}')
    with pytest.raises(workfolder.StoreError, match=r"expected a run folder, got .* is of format 'jaxlfi-grid'"):
        folders.read_config(tmp_path)


def test_occupied_folders_are_refused_and_empty_ones_taken(tmp_path):
    workfolder.create(tmp_path / "new", {"a": 1}, lambda folder: None)
    (tmp_path / "empty").mkdir()
    workfolder.create(tmp_path / "empty", {"a": 1}, lambda folder: None)
    with pytest.raises(workfolder.StoreError, match="resume"):
        workfolder.create(tmp_path / "new", {"a": 2}, lambda folder: None)
    assert json.loads((tmp_path / "new" / "config.json").read_text()) == {"a": 1}
    assert sorted(p.name for p in tmp_path.iterdir()) == ["empty", "new"]


def test_a_link_to_an_empty_folder_is_that_folder_and_the_current_one_is_refused(tmp_path, monkeypatch):
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to("real")
    workfolder.create(tmp_path / "link", {"a": 1}, lambda folder: None)
    assert (tmp_path / "link").is_symlink() and json.loads((tmp_path / "real" / "config.json").read_text()) == {"a": 1}
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    with pytest.raises(workfolder.StoreError, match=r"expected a new or empty folder, got '\.', the current one"):
        workfolder.create(Path("."), {"a": 1}, lambda folder: None)


# ---------------------------------------------------------------------------------------------------- provenance


def test_a_command_is_recorded_without_the_machines_folders(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    below, elsewhere = tmp_path / "runs" / "a b", tmp_path.parent / "other" / "table.csv"
    argv = ["/usr/bin/jaxlfi", "infer", "task", "--out", str(below), f"--observation={elsewhere}", "--vary", "tau=0.1"]
    assert provenance.command_line(argv) == "jaxlfi infer task --out 'runs/a b' --observation=table.csv --vary tau=0.1"
    assert provenance.command_line(["jaxlfi", "grid", "runs/x", "--tail", "-1"]) == "jaxlfi grid runs/x --tail -1"


def test_kept_results_name_no_folder_of_a_machine():
    kept = sorted((Path(__file__).parents[2] / "experiments" / "results").rglob("*.json"))
    commands = {path: json.loads(path.read_text()).get("command_line", "") for path in kept}
    assert len(kept) > 20 and [path for path, line in commands.items() if " /" in line or "=/" in line] == []
