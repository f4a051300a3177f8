"""Run folders: every file and shape, whole at any moment, and never anything else's."""

import dataclasses
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxlfi.bayessim import algorithm as bayessim
from jaxlfi.bayessim.presets import METHODS, PRESETS
from jaxlfi.bayessim.record import posterior_draws
from jaxlfi.distributions.support import Support
from jaxlfi.envs import lotka_volterra, lynx_hare, mg1
from jaxlfi.estimators.posterior import draws_within
from jaxlfi.heuristics import Centre, Choice, Edge, Fixed, Matched, Mode
from jaxlfi.io import files as atomic
from jaxlfi.io.serialise import heuristic_from_json, heuristic_to_json, settings_from_json, settings_to_json
from jaxlfi.runs import folder as run_store
from jaxlfi.runs.checkpoint import Checkpoint, CheckpointError
from jaxlfi.runs.inference import observe
from jaxlfi.tasks.simulation import trajectory_and_outcome
from tests.small import FLAGS, SETTINGS, TASK, command, gaussian, share_engine, whole_runs  # noqa: F401 - a fixture

ROUNDS, ADDITIONS, ATTEMPTS, DIM, COMPONENTS, OBS, SAMPLES = 2, 20, 25, 2, 4, 2, 20


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """One small run."""
    out = tmp_path_factory.mktemp("store") / "run"
    assert command("infer", TASK, "--support", "misspecified", "--out", out, *FLAGS) == 0
    return out


def test_a_run_leaves_exactly_its_plain_files(folder):
    names = {path.relative_to(folder).as_posix() for path in folder.rglob("*")}
    assert names == {
        "config.json",
        "ledger.jsonl",
        "posterior.npz",
        "dataset.npz",
        "history.npz",
        "observation.npz",
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
            "names": (DIM,),
        },
        "dataset.npz": {
            "theta": (ROUNDS * ADDITIONS, DIM),
            "x": (ROUNDS * ADDITIONS, OBS),
            "round": (ROUNDS * ADDITIONS,),
            "names": (DIM,),
        },
        "history.npz": {
            "theta": (ROUNDS, ATTEMPTS, DIM),
            "counted": (ROUNDS, ATTEMPTS),
            "kept": (ROUNDS, ATTEMPTS),
            "failure": (ROUNDS, ATTEMPTS),
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
            "summaries": (OBS,),
            "channels": (1,),
            "times": (2,),
            "record_label": (),
        },
    }
    for name, shapes in expected.items():
        arrays = atomic.read_arrays(folder / name)
        assert {key: arrays[key].shape for key in shapes} == shapes
        assert not any(value.dtype.hasobject for value in arrays.values())


def test_summaries_and_draws_are_those_of_the_last_posterior(folder):
    history, posterior, observation = (
        atomic.read_arrays(folder / f"{name}.npz") for name in ("history", "posterior", "observation")
    )
    np.testing.assert_array_equal(history["final_x"], history["final_trajectory"])  # this task's summary
    assert observation["summaries"].tolist() == ["x_1", "x_2"] and str(observation["record_label"]) == "record"
    rng = np.random.default_rng(0)
    weight = np.exp(posterior["logits"] - posterior["logits"].max())
    component = rng.choice(COMPONENTS, 100_000, p=weight / weight.sum())
    noise = rng.normal(size=(100_000, DIM))
    mixture = posterior["means"][component] + np.einsum("nij,nj->ni", posterior["scale_tril"][component], noise)
    low, high = posterior["support_low"], posterior["support_high"]
    clipped = np.clip(mixture, low, high)
    draws = posterior["draws"]
    assert ((draws >= low) & (draws <= high)).all()
    np.testing.assert_allclose(draws.mean(0), clipped.mean(0), atol=5 * clipped.std(0).max() / np.sqrt(1000))
    np.testing.assert_allclose(draws.std(0), clipped.std(0), rtol=0.15)


def test_draws_of_a_flow_are_its_own():
    """Not those of the mixture that stands for it."""
    task, settings = gaussian(), METHODS["apt"](SETTINGS)
    settings = settings.replace(estimator=settings.estimator.replace(hidden=(8, 8), transforms=1))
    state = bayessim.init(jax.random.key(0), task, task.support("ok"), settings, jnp.zeros(OBS))
    x, box = jnp.array([0.8, -0.6]), Support(jnp.array([-1.0, 0.0]), jnp.array([2.0, 1.5]))
    belief = state.belief.replace(support=box)
    got = posterior_draws(jax.random.key(1), settings, state.network, x, state.feasible, belief, 50)
    own, _ = draws_within(jax.random.key(1), settings.estimator, state.network, x, state.feasible, box, 50)
    np.testing.assert_array_equal(got, own)
    far = belief.replace(mixture=belief.mixture.replace(means=belief.mixture.means + 100))
    again = posterior_draws(jax.random.key(1), settings, state.network, x, state.feasible, far, 50)
    np.testing.assert_array_equal(got, again)


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
    ledger = run_store.read_ledger(folder)
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
    assert config["heuristic"]["hyperparameters"]["mass_threshold"] == 0.005
    assert config["settings"]["rounds"] == 2 and config["settings"]["estimator"]["hyperparameters"]["hidden"] == [16]
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


class Killed(BaseException):
    """The process dies here."""


def kill_at(monkeypatch, nth: int, before_replace: bool):
    """Let the nth write of a file be the process's last act; `before_replace` leaves its .part behind."""
    real, count = atomic.write_bytes, [0]

    def write(path, content, durable=False):
        count[0] += 1
        if count[0] == nth:
            if before_replace:
                path.with_name(path.name + ".part").write_bytes(content[: len(content) // 2])
            else:
                real(path, content, durable)
            raise Killed
        real(path, content, durable)

    monkeypatch.setattr(atomic, "write_bytes", write)


def test_a_run_killed_at_any_write_resumes_to_the_same_bits(tmp_path, monkeypatch):
    arguments = ("infer", TASK, "--support", "misspecified", *FLAGS, "--seeds", "2", "--out")
    share_engine(monkeypatch)
    assert command(*arguments, tmp_path / "whole") == 0
    created, killed = 0, 0
    for nth in range(1, 100):
        out = tmp_path / f"killed_{nth}"
        with monkeypatch.context() as patch:
            kill_at(patch, nth, before_replace=bool(nth % 2))
            try:
                assert command(*arguments, out) == 0
                break
            except Killed:
                killed += 1
        if not out.exists():  # not yet created: nothing was begun, and nothing is in the way
            continue
        created += 1
        assert command("resume", out, "--no-figures") == 0
        for seed in ("seed_000", "seed_001"):
            for name in ("posterior.npz", "dataset.npz"):
                assert_same_arrays(tmp_path / "whole" / seed / name, out / seed / name)
            assert not list((out / seed).glob("*.part"))
        assert not (out / "checkpoint").exists()
    assert killed >= 15 and created >= 12


def assert_same_arrays(a, b):
    """Equal to the last bit."""
    first, second = atomic.read_arrays(a), atomic.read_arrays(b)
    assert first.keys() == second.keys()
    for name, value in first.items():
        assert value.tobytes() == second[name].tobytes(), (a, name)


@pytest.fixture(scope="module")
def stopped(tmp_path_factory):
    """A run that was killed after its first round."""
    out = tmp_path_factory.mktemp("stopped") / "run"
    with pytest.MonkeyPatch.context() as patch:
        kill_at(patch, 5, before_replace=False)
        with pytest.raises(Killed):
            command("infer", TASK, *FLAGS, "--out", out)
    assert Checkpoint(out).rounds_done() == 1
    return out


@pytest.mark.parametrize(
    ("damage", "file"),
    [
        (damage, file)
        for damage in ("truncated", "flipped", "missing", "foreign")
        for file in ("state.npz", "round_000.npz", "start.npz")
        if (damage, file) != ("missing", "state.npz")  # without a state a run begins with its first round
    ],
)
def test_a_damaged_checkpoint_is_refused_and_left_alone(stopped, tmp_path, capsys, file, damage):
    import shutil

    out = tmp_path / "run"
    shutil.copytree(stopped, out)
    path = out / "checkpoint" / file
    content = path.read_bytes()
    if damage == "truncated":
        path.write_bytes(content[: len(content) // 2])
    elif damage == "flipped":
        middle = len(content) // 2
        path.write_bytes(content[:middle] + bytes([content[middle] ^ 255]) + content[middle + 1 :])
    elif damage == "missing":
        path.unlink()
    else:
        np.savez(path, something=np.zeros(3))
    before = {p: p.read_bytes() for p in out.rglob("*") if p.is_file()}
    capsys.readouterr()
    assert command("resume", out, "--no-figures") == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1 and file in message and "expected" in message
    assert {p: p.read_bytes() for p in out.rglob("*") if p.is_file()} == before


def test_a_state_of_another_shape_is_refused(tmp_path):
    checkpoint = Checkpoint(tmp_path)
    checkpoint.write_start(np.zeros((1, 2)), np.zeros((1, 2)))
    checkpoint.write_round(0, {"a": np.zeros(3)}, {"b": np.ones(2), "final_x": np.zeros((1, 20, 2))}, 0.1)
    rows, seconds, final = checkpoint.read_rounds(1)
    assert [list(row) for row in rows] == [["b"]] and seconds == [0.1] and list(final) == ["final_x"]
    assert checkpoint.read_state({"a": np.ones(3)})["a"].tolist() == [0, 0, 0]
    with pytest.raises(CheckpointError, match=r"expected .* of shape"):
        checkpoint.read_state({"a": np.zeros(4)})


def test_python_objects_are_never_written(tmp_path):
    with pytest.raises(TypeError, match="objects"):
        atomic.write_arrays(tmp_path / "a.npz", {"a": np.array([{}, None])})
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("content", [None, "{", "[]", '{"format": "other"}', '{"format": "jaxlfi-run", "version": 99}'])
def test_foreign_folders_are_refused(tmp_path, content):
    if content is not None:
        (tmp_path / "config.json").write_text(content)
    with pytest.raises(run_store.StoreError, match="expected"):
        run_store.read_config(tmp_path)


def test_a_grid_is_named_where_a_run_is_expected(tmp_path):
    (tmp_path / "config.json").write_text('{"format": "jaxlfi-grid", "version": 1}')
    with pytest.raises(run_store.StoreError, match=r"expected a run folder, got .* is of format 'jaxlfi-grid'"):
        run_store.read_config(tmp_path)


def test_occupied_folders_are_refused_and_empty_ones_taken(tmp_path):
    run_store.create(tmp_path / "new", {"a": 1}, lambda folder: None)
    (tmp_path / "empty").mkdir()
    run_store.create(tmp_path / "empty", {"a": 1}, lambda folder: None)
    with pytest.raises(run_store.StoreError, match="resume"):
        run_store.create(tmp_path / "new", {"a": 2}, lambda folder: None)
    assert json.loads((tmp_path / "new" / "config.json").read_text()) == {"a": 1}
    assert sorted(p.name for p in tmp_path.iterdir()) == ["empty", "new"]


# ---------------------------------------------------------------------------------------------------- provenance


def test_a_command_is_told_without_the_machines_folders(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    below, elsewhere = tmp_path / "runs" / "a b", tmp_path.parent / "other" / "table.csv"
    argv = ["/usr/bin/jaxlfi", "infer", "task", "--out", str(below), f"--observation={elsewhere}", "--vary", "tau=0.1"]
    told = run_store.command_line(argv)
    assert told == "jaxlfi infer task --out 'runs/a b' --observation=table.csv --vary tau=0.1"
    assert run_store.command_line(["jaxlfi", "grid", "runs/x", "--tail", "-1"]) == "jaxlfi grid runs/x --tail -1"


def test_kept_results_name_no_folder_of_a_machine():
    kept = sorted((Path(run_store.__file__).parents[1] / "experiments" / "results").rglob("*.json"))
    commands = {path: json.loads(path.read_text()).get("command_line", "") for path in kept}
    assert len(kept) > 20 and [path for path, told in commands.items() if " /" in told or "=/" in told] == []
