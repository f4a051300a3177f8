"""Trainings in folders: what they leave, that they go on to the same bits, and what is refused; the command line."""

import csv
import dataclasses
import json
from types import SimpleNamespace

import jax
import numpy as np
import pytest

pytest.importorskip("brax")

import small
from killed import Killed, kill_at
from rich.console import Console
from rl import events
from rl.toy import SETTINGS, Line, assert_same_results

from jaxlfi import infer
from jaxlfi.cli import domains as words_of
from jaxlfi.cli import evaluate as evaluating
from jaxlfi.cli import train as command
from jaxlfi.cli.tables import Output
from jaxlfi.distributions.support import Support
from jaxlfi.io import files
from jaxlfi.io.workfolder import StoreError
from jaxlfi.rl import domains, training
from jaxlfi.rl.evaluation import cross_evaluate
from jaxlfi.rl.policy import Policy, load
from jaxlfi.tasks.task import Task

pytestmark = pytest.mark.usefixtures("keys_of_brax")

LINE = Line()
REFERENCE = "rl.toy:Line"
WORDS = ("--environments 4 --unroll 5 --segments 2 --minibatches 4 --epochs 3 --total-steps 160 --hidden 8 8").split()


@pytest.fixture(autouse=True)
def two_updates_between_checkpoints(monkeypatch):
    monkeypatch.setattr(training, "MAX_CHUNK", 3)


def plan(**changes):
    box = LINE.supports["initial"]
    draws = {
        "uniform": lambda key, n: domains.uniform(key, box, n),
        "median": lambda key, n: domains.point(LINE.nominal, n),
    }
    return training.Plan(REFERENCE, LINE, SETTINGS.replace(**changes), None, draws, (0, 5))


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    out = tmp_path_factory.mktemp("training") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training, "MAX_CHUNK", 3)
        training.begin(plan(), out)
        return out, training.resumed(out, LINE, lambda updates, curves: None)


def test_what_it_leaves(finished):
    out, result = finished
    assert result.names == (("uniform", 0), ("uniform", 5), ("median", 0), ("median", 5))
    assert {path.relative_to(out).as_posix() for path in out.rglob("*.*")} == {
        *("config.json", "domains.npz", "curves.npz", "outcomes.npz", "table.csv"),
        *(f"{domain}/seed_{seed:03d}/policy.npz" for domain, seed in result.names),
    }
    points = files.read_arrays(out / "domains.npz")
    assert points["trained"].shape == (4, 4, 2) and points["held_out"].shape == (4, 128, 2)
    np.testing.assert_array_equal(points["trained"][2:], np.broadcast_to(np.float32(LINE.nominal), (2, 4, 2)))
    assert not np.array_equal(points["trained"][0], points["trained"][1])  # each seed has points of its own
    on = load(out / "uniform/seed_005/policy.npz").schema["trained_on"]
    assert [one["unit"] for one in on.values()] == list(LINE.units) and tuple(on) == LINE.space.names
    own = points["trained"][1]
    bounds = np.stack([own.min(axis=0), own.max(axis=0)], axis=1)
    np.testing.assert_allclose([[one["low"], one["high"]] for one in on.values()], bounds)
    curves = files.read_arrays(out / "curves.npz")
    assert curves["value"].shape == (4, 4) and curves["episodes"].min() >= 1
    with (out / "table.csv").open() as file:
        rows = list(csv.DictReader(file))
    returns = files.read_arrays(out / "outcomes.npz")["value"].mean(axis=1)
    np.testing.assert_allclose([float(row["return"]) for row in rows], returns, atol=1e-4)
    assert training.finished(out)


def test_the_table_is_that_of_the_saved_policies(finished):
    """The policies' files, in a plain loop over NumPy's numbers, earn what the table says."""
    out, result = finished
    theta, start = np.asarray(result.outcomes["theta"][1]), jax.random.split(training._keys(jax.random.key(5))[3], 128)
    policy = load(out / "uniform/seed_005/policy.npz").require("line", LINE.observations, LINE.actions)
    for i in range(0, 128, 16):
        gain, target = theta[i]
        position, value = 0.1 * float(jax.random.normal(start[i])), 0.0
        for _ in range(LINE.steps):
            position += gain * policy([position, target])[0]
            value -= 0.0 if abs(position) > 3 else abs(position - target)
            if abs(position) > 3 or abs(position - target) < 0.05:
                break
        assert value == pytest.approx(float(result.outcomes["value"][1, i]), abs=1e-3)


def test_a_training_that_was_stopped_goes_on_to_the_same_bits(finished, tmp_path):
    out, _ = finished
    again = tmp_path / "again"
    training.begin(plan(), again)

    def stop(updates, curves):
        raise KeyboardInterrupt

    for done in (0, 3):
        assert training.updates_done(again) == done
        with pytest.raises(KeyboardInterrupt):
            training.resumed(again, LINE, stop)
    assert not training.finished(again)
    training.resumed(again, LINE, stop if training.updates_done(again) < 4 else lambda updates, curves: None)
    assert_same_results(out, again)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("nth", "midway", "updates"), [(3, False, 3), (4, True, 3), (6, True, 4), (9, False, 4), (11, True, 4)]
)
def test_a_training_that_was_killed_at_a_write_goes_on_to_the_same_bits(
    finished, nth, midway, updates, tmp_path, monkeypatch
):
    """It is killed at checkpoints, curves, a policy, and the table; `midway` leaves half a file."""
    out, _ = finished
    again = tmp_path / "again"
    with monkeypatch.context() as patch, pytest.raises(Killed):
        kill_at(patch, nth, midway)
        training.begin(plan(), again)
        training.resumed(again, LINE, lambda updates, curves: None)
    assert training.updates_done(again) == updates and not training.finished(again)
    training.resumed(again, LINE, lambda updates, curves: None)
    assert_same_results(out, again)
    assert not list(again.rglob("*.part"))


def test_what_cannot_be_gone_on_with_is_refused(finished, tmp_path):
    out, _ = finished
    with pytest.raises(ValueError, match="expected a new"):
        training.begin(plan(), out)
    with pytest.raises(StoreError, match="without a readable"):
        training.read_config(tmp_path)
    config = json.loads((out / "config.json").read_text())
    (tmp_path / "config.json").write_text(json.dumps(config | {"version": 0}))
    with pytest.raises(StoreError, match="expected jaxlfi-training of version 1, got version 0"):
        training.read_config(tmp_path)
    (tmp_path / "config.json").write_text(json.dumps(config | {"environment_name": "whip"}))
    with pytest.raises(StoreError, match="expected a training of line, got one of whip"):
        training.resumed(tmp_path, LINE, print)
    (tmp_path / "config.json").write_text(json.dumps(config))
    with pytest.raises(StoreError, match=r"domains\.npz: expected a complete"):
        training.resumed(tmp_path, LINE, print)
    files.write_arrays(tmp_path / "domains.npz", files.read_arrays(out / "domains.npz"))
    files.write_sealed(tmp_path / "checkpoint.npz", {"done": np.asarray(3)})
    with pytest.raises(StoreError, match=r"checkpoint\.npz: expected .*params.*, got "):
        training.resumed(tmp_path, LINE, print)


# --------------------------------------------------------------------------------------------------- command line


def run(*words):
    return command.main([REFERENCE, *WORDS, *map(str, words)])


@pytest.mark.slow
def test_the_command_trains_what_the_library_does(finished, tmp_path, capsys):
    out, _ = finished
    assert run("--domain", "uniform", "median", "--seeds", "1", "--out", tmp_path / "run", "--learning-rate", "3e-3",
               "--entropy", "0", "--initial-deviation", "1") == 0  # fmt: skip
    printed = capsys.readouterr().out
    assert "update 4 of 4" in printed and "uniform" in printed
    assert "worst tenth" in printed and "at first" in printed
    assert f"jaxlfi evaluate {REFERENCE} {tmp_path / 'run'}/*/*/policy.npz --domain" in printed
    for path in ("uniform/seed_000/policy.npz", "median/seed_000/policy.npz"):
        ours, theirs = load(tmp_path / "run" / path), load(out / path)
        for a, b in zip(ours.weights, theirs.weights, strict=True):
            np.testing.assert_allclose(a, b, atol=1e-4)
    picture = (tmp_path / "run" / "curves.png").read_bytes()
    assert picture.startswith(b"\x89PNG") and len(picture) > 5000


def test_how_a_policy_fares_is_told_by_its_own_points_and_how_it_began():
    """The worst tenth of 20 points is two; an update in which no episode ended says nothing."""
    outcomes = {"value": np.stack([np.arange(20.0), np.full(20, 3.0)]), "steps": np.ones((2, 20)), "hit": np.eye(2, 20)}
    curves = {"value": np.array([[np.nan, np.nan], [-4.0, np.nan], [5.0, np.nan]])}
    result = training.Result((("uniform", 0), ("median", 0)), curves, outcomes, None)
    assert result.fared(0) == {"return": 9.5, "worst tenth": 0.5, "at first": -4.0, "hit": 0.05}
    assert np.isnan(result.fared(1)["at first"]) and result.fared(1)["worst tenth"] == 3.0


@pytest.mark.slow
def test_the_command_is_resumed(tmp_path, capsys, monkeypatch):
    from jaxlfi.cli import parser

    out = tmp_path / "run"
    original = training._write_checkpoint

    def killed(*arguments):
        original(*arguments)
        raise KeyboardInterrupt

    monkeypatch.setattr(training, "_write_checkpoint", killed)
    assert run("--domain", "median", "--tensorboard", "--out", out) == 130
    assert f"continue with: jaxlfi resume {out}" in capsys.readouterr().err
    monkeypatch.setattr(training, "_write_checkpoint", original)
    assert parser.main(["resume", str(out), "--no-figures", "--no-cache"]) == 0
    assert training.finished(out)
    (out / "checkpoint.npz").touch()  # as it was killed after its table was written
    returns = files.read_arrays(out / "curves.npz")["value"][:, 0]
    steps = 40 * np.arange(1, 5)
    np.testing.assert_allclose(
        events.scalars(out / "median/seed_000")["episodes/return"], np.stack([steps, returns], 1)
    )
    for drawn in (True, False):
        assert parser.main(["resume", str(out)]) == 0
        printed = capsys.readouterr().out
        assert "complete: nothing to resume" in printed and ("learning curves: " in printed) == drawn
        assert (out / "curves.png").read_bytes().startswith(b"\x89PNG")
        assert not (out / "checkpoint.npz").exists()


def test_a_full_disk_is_one_line_and_the_folder_is_kept(tmp_path, capsys, monkeypatch):
    def full(*arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(training, "resumed", full)
    out = tmp_path / "run"
    assert run("--domain", "median", "--out", out) == 2
    expected = f"jaxlfi train: error: [Errno 28] No space left on device; continue with: jaxlfi resume {out}\n"
    assert capsys.readouterr().err == expected and training.read_config(out)


@pytest.mark.parametrize(("values", "expected"), [([[np.nan], [np.nan]], ""), ([[1.0], [np.nan]], ", return 1.00")])
def test_a_return_is_shown_where_an_episode_has_ended(finished, monkeypatch, values, expected, recwarn):
    from jaxlfi.io import progress

    out, result = finished
    shown = []
    monkeypatch.setattr(progress.RoundProgress, "advance", lambda self, updates, text: shown.append(text))

    def resumed(out, environment, on_chunk, processes):
        on_chunk(2, {"value": np.array(values)})
        return result

    monkeypatch.setattr(training, "resumed", resumed)
    command.run(out, LINE, Output(*[Console(quiet=True)] * 3), figures=False)
    assert shown == [expected] and not recwarn.list


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--domain", "nowhere"], "domain: expected the folder of a run, uniform"),
        (["--domain", "uniform:mars"], "domain: expected uniform:NAME of initial, wide, got 'uniform:mars'"),
        (["--domain", "point:1"], "domain: expected 2 numbers (gain, target)"),
        (["--domain", "point:1,x"], "domain: expected point:X,Y,... of numbers"),
        (["--domain", "point:1,2.5"], "domain: expected target between -2 and 2 (Phi), got 2.5"),
        (["--domain", "median", "median"], "domain: expected distinct ones, got 'median' twice"),
        (["--domain", "median", "--seeds", "0"], "seeds: expected at least 1, got 0"),
        (["--domain", "median", "--first-seed", "-1"], "first_seed: expected seeds from 0 to 4294967295, got -1"),
        (["--domain", "median", "--first-seed", str(10**20)], "first_seed: expected seeds from 0 to 4294967295"),
        (["--domain", "median", "--minibatches", "3"], "minibatches: expected minibatches x segments"),
        (["--domain", "median", "--discount", "2"], "discount: expected a number in [0, 1], got 2"),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(words, expected, tmp_path, capsys):
    assert run(*words, "--out", tmp_path / "run") == 2
    error = capsys.readouterr().err
    assert error.startswith("jaxlfi train: error: ") and error.count("\n") == 1
    assert expected in error
    assert not list(tmp_path.iterdir())


def test_domains_that_print_alike_are_told_apart(tmp_path, monkeypatch):
    run = SimpleNamespace(space=LINE.space, feasible=LINE.space.box_to_inference(LINE.feasible), units=None)
    run.heuristic, run.belief, run.task = SimpleNamespace(grows=True), None, None
    monkeypatch.setattr("jaxlfi.runs.load.load", lambda folder: run)
    folders = [tmp_path / name for name in ("a/one/posterior", "b/one/posterior", "b/two/posterior", "other")]
    for folder in folders:
        folder.mkdir(parents=True)
    words = [*map(str, folders), "point:1,0.5", "point:1,0.50000001", "median"]
    names = list(words_of.domains_of(LINE, words))
    assert names == ["a-one-posterior", "b-one-posterior", "two-posterior", "other", "point-1.0-0.5",
                     "point-1.0-0.50000001", "median"]  # fmt: skip
    for twice in ([str(folders[0]), str(folders[1].parent / "../../a/one/posterior")], ["point:1,2", "point:1.0,2"]):
        with pytest.raises(ValueError, match=r"domain: expected distinct ones, got '.*' twice"):
            words_of.domains_of(LINE, twice)


def test_a_posterior_in_other_units_is_no_domain():
    domains.check_belief(LINE, LINE.space, LINE.feasible, ("", "m"))
    domains.check_belief(LINE, LINE.space, LINE.feasible, ("", ""))  # a task that declares none
    with pytest.raises(
        ValueError, match=r"domain: expected a posterior in units \['', 'm'\], .*, got one in \['', 'mm'"
    ):
        domains.check_belief(LINE, LINE.space, LINE.feasible, ("", "mm"))


def test_bounds_that_were_logarithms_may_be_rounded():
    rounded = Support([0.25 * (1 - 1e-6), -2.0], [4.0 * (1 + 1e-6), 2.0])
    domains.check_belief(LINE, LINE.space, rounded)
    with pytest.raises(ValueError, match="inside the feasible domain Phi"):
        domains.check_belief(LINE, LINE.space, Support([0.249, -2.0], [4.0, 2.0]))


@pytest.mark.slow
def test_the_posterior_of_a_run_is_a_domain(tmp_path, capsys):
    """A run's mixture, clipped to Phi; the posterior of other parameters is refused."""

    def simulate(key, theta):
        return theta + 0.1 * jax.random.normal(key, (2,))

    task = Task(
        simulate, names=LINE.space.names, log=("gain",), supports={"initial": LINE.supports["initial"]},
        feasible=LINE.feasible, truth=(0.8, 0.6),
    )  # fmt: skip
    found = infer(jax.random.key(0), task, settings=small.settings(rounds=1))
    found.save(tmp_path / "found")
    name, draw = words_of.domain(LINE, str(tmp_path / "found"))
    theta = np.asarray(draw(jax.random.key(1), 500).theta)
    assert name == "found" and theta.shape == (500, 2)
    np.testing.assert_allclose(np.log(theta[:, 0]).mean(), found.mixture.mean[0], atol=0.1)
    np.testing.assert_allclose(theta[:, 1].mean(), found.mixture.mean[1], atol=0.1)
    assert bool(LINE.feasible.contains(theta).all())
    renamed = dataclasses.replace(task, names=("first", "second"), log=("first",))
    found.replace(task=renamed).save(tmp_path / "other")
    assert run("--domain", tmp_path / "other", "--out", tmp_path / "run") == 2
    assert "domain: expected a posterior of gain, target, the parameters of line" in capsys.readouterr().err


# ------------------------------------------------------------------------------------------------------ evaluation


def test_saved_policies_are_evaluated_on_any_domain(finished, tmp_path, capsys):
    """The returns of the training's own table, and a NumPy loop's at a point."""
    out, _ = finished
    paths = [str(out / name / "policy.npz") for name in ("uniform/seed_000", "median/seed_005")]
    file = tmp_path / "made" / "cross.csv"
    words = [REFERENCE, *paths, "--domain", "median", "point:1,-1", "--episodes", "40", "--out", str(file)]
    assert evaluating.main(words) == 0
    with file.open() as text:
        rows = {(row["policy"], row["domain"]): row for row in csv.DictReader(text)}
    assert list(rows) == [(path, domain) for domain in ("median", "point-1--1") for path in paths]
    _, key = jax.random.split(jax.random.key(0))
    starts = 0.1 * np.array([float(jax.random.normal(one)) for one in jax.random.split(key, 40)])
    policy, position, value = load(paths[1]), starts, np.zeros(40)
    over = np.zeros(40, bool)
    for _ in range(LINE.steps):
        position = position + policy(np.stack([position, np.full(40, -1.0)], axis=1))[:, 0]
        distance = np.abs(position + 1.0)
        value -= np.where(over | (np.abs(position) > 3), 0.0, distance)
        over |= (distance < 0.05) | (np.abs(position) > 3)
    assert float(rows[paths[1], "point-1--1"]["return"]) == pytest.approx(value.mean(), abs=1e-3)
    assert evaluating.main(words) == 2
    assert "out: expected a new .csv file" in capsys.readouterr().err
    assert [path.name for path in file.parent.iterdir()] == ["cross.csv"]


def test_each_policy_keeps_its_own_scaling():
    """A policy that is always at its limit, of a small and a large one: both stay outside of the target's 5 cm."""

    def pushing(scale):
        schema = {"environment": "line", "observations": dataclasses.asdict(LINE.observations)}
        schema["actions"] = dataclasses.asdict(LINE.actions) | {"centre": [0.0], "scale": [scale]}
        return Policy((np.zeros((2, 1), np.float32),), (np.float32([5.0]),), schema)

    draws = {"far": lambda key, n: domains.point((1.0, 2.0), n)}
    rows = cross_evaluate(LINE, {"weak": pushing(0.01), "strong": pushing(0.1)}, draws, 16)
    sums = [-sum(2.0 - scale * step for step in range(1, 8)) for scale in (0.01, 0.1)]
    np.testing.assert_allclose([row["return"] for row in rows], sums, atol=0.4)  # starts have a mean of 0 +- 0.025


@pytest.mark.parametrize("given", [{"episodes": 0}, {"episodes": 10**30}, {"seed": -1}, {"seed": 10**30}])
def test_numbers_of_episodes_and_seeds_that_are_none(given):
    with pytest.raises(ValueError, match=f"{next(iter(given))}: expected a number from"):
        cross_evaluate(LINE, {}, {}, **{"episodes": 1} | given)


def test_policies_of_other_environments_are_not_evaluated(finished, tmp_path, capsys):
    out, _ = finished
    path = out / "median/seed_000/policy.npz"
    other = load(path)
    other.schema["environment"] = "whip"
    other.save(tmp_path / "other.npz")
    for file, expected in (
        (tmp_path / "other.npz", "policy: expected environment 'line', got one of 'whip'"),
        (tmp_path / "none.npz", "expected a complete .npz"),
    ):
        assert evaluating.main([REFERENCE, str(file), "--domain", "median"]) == 2
        assert expected in capsys.readouterr().err
