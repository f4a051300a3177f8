"""The study of policies: soft-DTW against a sum over all alignments, intervals, tables and text of known numbers."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

pytest.importorskip("mujoco")
pytest.importorskip("brax")

from experiments.policies import (
    collection,
    contrasts,
    evaluation,
    findings,
    intervals,
    making,
    report,
    results,
    sysid,
    tables,
)
from experiments.policies.barycentres import barycentre, soft_dtw
from experiments.policies.evaluation import domains_of, objects_of
from experiments.policies.simulation import KNOWN, Performed, lowest, perform
from experiments.policies.study import FEM, ORDER, PAPER, SIMULATED, Study, chosen, truth
from jaxlfi.envs.whip import recording, trajectory
from jaxlfi.envs.whip.environment import make
from jaxlfi.envs.whip.exploration import exploratory_actions
from jaxlfi.envs.whip.parameters import median
from jaxlfi.envs.whip.physics.engines import pick
from jaxlfi.envs.whip.rig import CONTROL_INTERVAL
from jaxlfi.envs.whip.vision.camera import project, side_camera
from jaxlfi.envs.whip.vision.keypoints import along
from jaxlfi.io import files, formats, serialise
from jaxlfi.rl import training
from jaxlfi.rl.domains import Domain
from jaxlfi.rl.evaluation import evaluate
from jaxlfi.rl.settings import PRESETS

# ---------------------------------------------------------------------------------------------------------- barycentres


def alignments(n, m, i=0, j=0):
    """All ways from (0, 0) to (n - 1, m - 1) by steps down, to the right, or both."""
    if (i, j) == (n - 1, m - 1):
        yield ((i, j),)
        return
    for down, right in ((1, 0), (0, 1), (1, 1)):
        if i + down < n and j + right < m:
            for rest in alignments(n, m, i + down, j + right):
                yield ((i, j), *rest)


def by_enumeration(one, other, gamma):
    costs = [sum(np.sum((one[i] - other[j]) ** 2) for i, j in way) for way in alignments(len(one), len(other))]
    least = min(costs)
    return least - gamma * math.log(sum(math.exp(-(cost - least) / gamma) for cost in costs))


ONE = np.array([[0.0, 1.0], [2.0, -1.0], [2.5, 0.5]])
OTHER = np.array([[0.3, 0.8], [0.4, 0.0], [1.9, -0.7], [3.0, 1.0]])


@pytest.mark.parametrize("gamma", [0.05, 1.0, 7.0])
def test_soft_dtw_sums_over_all_alignments(gamma):
    expected = by_enumeration(ONE, OTHER, gamma)
    padded = np.concatenate([OTHER, np.full((3, 2), 9.0)])
    np.testing.assert_allclose(soft_dtw(ONE, OTHER, gamma), expected, rtol=1e-5)
    np.testing.assert_allclose(soft_dtw(ONE, padded, gamma, len(OTHER)), expected, rtol=1e-5)


def test_the_barycentre_of_one_trajectory_is_that_trajectory():
    np.testing.assert_allclose(barycentre([OTHER], gamma=1e-3), OTHER, atol=0.02)


def test_the_barycentre_does_not_mind_when_a_step_is_made():
    """The mean of a step made early and of one made late has two half steps; the barycentre has a whole one."""
    early, late = (np.repeat([[0.0, 0.0], [1.0, -2.0]], counts, axis=0) for counts in ((2, 6), (6, 2)))
    middle = barycentre([early, late], gamma=1e-3)
    ends = np.abs(middle - [0.0, 0.0]).max(axis=1), np.abs(middle - [1.0, -2.0]).max(axis=1)
    assert np.abs((early + late) / 2 - [0.5, -1.0]).max(axis=1).min() == 0
    assert np.minimum(*ends).max() < 0.2


def test_a_barycentre_of_nothing_is_refused():
    with pytest.raises(ValueError, match="trajectories: expected at least one, got none"):
        barycentre([])


# ------------------------------------------------------------------------------------------------------------ intervals


def test_an_interval_knows_of_seeds_and_of_places():
    rng = np.random.default_rng(1)
    of_seeds = np.repeat(rng.normal(size=(4, 1)), 16, axis=1)
    of_places = np.repeat(rng.normal(size=(1, 16)), 4, axis=0)
    # A bootstrap of n means has the standard deviation of their population over the root of n.
    for values, n in ((of_seeds, 4), (of_places, 16)):
        middle, low, high = intervals.mean(values)
        assert middle == pytest.approx(values.mean())
        assert (high - low) / (2 * 1.96) == pytest.approx(values.std() / n**0.5, rel=0.12)
    assert intervals.mean(np.full((1, 3), 1.5)) == (1.5, 1.5, 1.5)


def test_what_all_meet_alike_is_no_difference():
    places = np.random.default_rng(2).normal(size=(1, 16))
    middle, low, high = intervals.difference(places + 0.75, places)
    np.testing.assert_allclose([middle, low, high], 0.75)
    with pytest.raises(ValueError, match=r"places: expected the same everywhere, got \[15, 16\] of them"):
        intervals.difference(places, places[:, :15])


def test_the_same_policies_on_several_objects_are_one_entry():
    rng = np.random.default_rng(3)
    seeds, zero = rng.normal(size=(4, 1)) + np.zeros((4, 16)), np.zeros((4, 16))
    width = lambda found: found[2] - found[1]
    once = intervals.contrast([zero], [np.mean([seeds] * 4, axis=0)])
    apart = intervals.contrast([zero], [seeds] * 4)
    assert width(once) > 1.5 * width(apart)  # four times as many seeds are not there


# -------------------------------------------------------------------------------------------------------- names, places


def test_every_policy_has_a_domain_and_a_place():
    assert len(set(ORDER)) == len(ORDER) and set(PAPER) <= set(ORDER)
    assert {f"{dlo}-true" for dlo in SIMULATED} < set(KNOWN)
    assert objects_of("plan-dlo-2") == ["dlo-2"] == objects_of("dlo-2-sysid") and objects_of("sim-in-edge") == []
    assert tuple(objects_of("dlo-2-none")) == FEM
    assert domains_of("sim-long-none") == ["sim-long-true", "uniform"]


def test_unknown_names_are_refused():
    assert chosen(["uniform", "dlo-0-edge", "uniform"], ORDER) == ["uniform", "dlo-0-edge"]
    with pytest.raises(ValueError, match=r"only: expected some of .*, got dlo-9-edge"):
        chosen(["uniform", "dlo-9-edge"], ORDER)


def test_domains_are_named_as_the_command_line_does(tmp_path):
    study = Study(tmp_path)
    assert study.domain("feasible") == "uniform:feasible" and study.domain("median") == "median"
    assert study.domain("sim-stiff-true") == "point:170,120000"
    assert study.domain("dlo-1-none") == str(study.posterior("dlo-1-none"))
    length, young = truth("dlo-0")
    assert length == 200 and young == pytest.approx(1e5, rel=0.02)


CONFIG = {
    "format": formats.TRAINING, "version": 1, "environment_name": "whip", "environment": {},
    "versions": {},
}  # fmt: skip
"""Of a training, but for its settings and trainings."""


def settings():
    return serialise.fields_to_json(PRESETS["quick"], serialise.class_name)


def test_a_training_of_other_seeds_or_settings_is_not_taken_for_the_one_asked_for(tmp_path):
    study = Study(tmp_path)
    out = study.training("uniform")
    out.mkdir(parents=True)
    config = CONFIG | {"settings": settings(), "trainings": [{"domain": "u", "seed": 0}]}
    files.write_json(out / "config.json", config)
    (out / "table.csv").write_text("")
    making.learn(study, ["uniform"], 1, [])
    with pytest.raises(ValueError, match="expected a training of 2 seeds, got one of 1"):
        making.learn(study, ["uniform"], 2, [])
    with pytest.raises(ValueError, match="expected a training of the same settings, got another total_steps: remove"):
        making.learn(study, ["uniform"], 1, ["--total-steps", "960"])


def test_domains_trained_side_by_side_get_folders_of_their_own(tmp_path):
    together, outs = tmp_path / "a+b", [tmp_path / "first", tmp_path / "second"]
    trainings = [{"domain": domain, "seed": seed} for domain in ("point-1-2", "b") for seed in (0, 1)]
    for one in trainings:
        folder = together / one["domain"] / f"seed_{one['seed']:03d}"
        folder.mkdir(parents=True)
        (folder / "policy.npz").write_text(f"{one}")
    config = CONFIG | {"settings": settings(), "trainings": trainings}
    files.write_json(together / "config.json", config)
    files.write_arrays(together / "curves.npz", {"value": np.arange(12.0).reshape(3, 4)})
    files.write_arrays(together / "outcomes.npz", {"value": np.arange(20).reshape(4, 5)})
    points = {"trained": np.arange(24).reshape(4, 3, 2), "held_out": -np.arange(8).reshape(4, 1, 2)}
    files.write_sealed(together / "domains.npz", {**points, "parameters": np.array(["length", "young"])})
    (together / "table.csv").write_text("domain,seed,return\npoint-1-2,0,1\npoint-1-2,1,2\nb,0,3\nb,1,4\n")

    making.split(together, outs)
    assert not together.exists()
    assert (outs[1] / "table.csv").read_text() == "domain,seed,return\nb,0,3\nb,1,4\n"
    assert training.read_config(outs[1])["trainings"] == trainings[2:]
    assert (outs[0] / "point-1-2" / "seed_001" / "policy.npz").read_text() == f"{trainings[1]}"
    np.testing.assert_array_equal(files.read_arrays(outs[1] / "curves.npz")["value"], [[2, 3], [6, 7], [10, 11]])
    np.testing.assert_array_equal(files.read_arrays(outs[0] / "outcomes.npz")["value"], np.arange(10).reshape(2, 5))
    own = files.read_arrays(outs[1] / "domains.npz")
    np.testing.assert_array_equal(own["trained"], points["trained"][2:])
    assert own["parameters"].tolist() == ["length", "young"]


def test_evaluations_are_kept_with_the_policies_that_they_are_of(tmp_path):
    study, episodes = Study(tmp_path), 3
    shapes = {"actions": (1, 3, 16, 2), "gripper": (1, 3, 16), "lowest": (1, 3, 16)}
    performed = Performed(**{name: np.ones(shapes.get(name, (1, 3))) for name in Performed.__annotations__})
    study.actions("constant").parent.mkdir(parents=True)
    files.write_arrays(study.actions("constant"), {"actions": np.zeros((16, 2))})
    out = tmp_path / "runs" / "simulation" / "constant" / "uniform.npz"
    evaluation._write(out, performed, evaluation.fingerprints(study, "constant"))
    is_there = lambda n: evaluation._is_there(out, (1, n), evaluation.fingerprints(study, "constant"))
    assert is_there(episodes) and not is_there(episodes + 1)

    collection.collect(study)
    before = (tmp_path / "simulation.npz").read_bytes()
    assert results.load(tmp_path).simulated("constant", "uniform").tolist() == [[1.0] * episodes]
    (tmp_path / "posteriors.csv").write_text((tmp_path / "posteriors.csv").read_text() + "sim-in,edge,1,2,3,4,5,6\n")
    out.unlink()
    collection.collect(study)
    assert (tmp_path / "simulation.npz").read_bytes() == before  # though it is not there any more
    assert "sim-in,edge,1,2,3,4,5,6\n" in (tmp_path / "posteriors.csv").read_text()

    evaluation._write(out, performed, evaluation.fingerprints(study, "constant"))
    files.write_arrays(study.actions("constant"), {"actions": np.full((16, 2), 0.01)})
    assert not is_there(episodes)
    collection.collect(study)
    assert results.load(tmp_path).simulation == {}


def test_the_lowest_keypoint_is_seen_where_it_is():
    scene = median().replace(camera=jnp.array([0.01, -0.02, 0.015]))
    camera = side_camera(scene)
    points = np.array([[0.4, 0.0, 0.3], [0.5, 0.0, 0.07], [0.45, 0.0, 0.2], [0.3, 0.0, 0.11]], np.float32)
    observation = np.concatenate([[0.4, 0.36], np.ravel(project(camera, points)), np.full(18, 0.99)])
    assert float(lowest(camera, observation)) == pytest.approx(0.07, abs=1e-5)


@pytest.mark.slow
def test_episodes_are_those_of_the_evaluation():
    environment, theta = make(), jnp.array([[250.0, 2.5e4], [200.0, 1e5]])
    act = lambda seen: jnp.array([0.03, -0.03]) + 0.01 * seen[:2]
    made = jax.jit(lambda key: perform(key, environment, lambda seen, _: act(seen), theta))(jax.random.key(3))
    other = jax.jit(lambda key: evaluate(key, environment, act, Domain(theta)))(jax.random.key(3))
    np.testing.assert_allclose(made.value, other.value)
    np.testing.assert_array_equal(made.steps, other.steps)
    np.testing.assert_array_equal(made.outside, other.facts["outside"])
    for rows in (made.actions[..., 0], made.gripper, made.lowest):
        np.testing.assert_array_equal(np.isfinite(rows).sum(axis=1), made.steps)


def test_residuals_vanish_at_the_truth():
    engine, actions = pick("auto"), exploratory_actions()
    view, failed = jax.jit(lambda: trajectory.seen(engine, median(0.21, 3e4), actions))()
    points = jax.vmap(lambda line: along(line, jnp.array(sysid.ARCS)))(view.dlo)
    camera = side_camera(median())
    rollout = recording.Recording(
        times=CONTROL_INTERVAL * np.arange(17),
        gripper=np.asarray(view.gripper),
        keypoints=np.asarray(project(camera, jnp.concatenate([points, view.cubes], axis=1))),
        seen=np.ones((17, 10), bool),
        actions=np.asarray(actions),
        camera=camera,
        source="simulated",
        description="known truth",
        frame_rate=1 / CONTROL_INTERVAL,
        image_size=256,
    )
    left = sysid.residuals(rollout)(np.array([[2.1, 2.2, 2.1], np.log([3e4, 3e4, 2e4])]))
    assert not failed and left.shape == (160, 3)
    right, longer, softer = np.sqrt(np.mean(left**2, axis=0))
    assert right < 0.01 < 0.5 < min(longer, softer)


# -------------------------------------------------------------------------------------------------- tables and the text


def made_up(returns, posteriors=()):
    """Results in which a policy gets a return everywhere on an object, a little more with every place."""
    rows = lambda value, n: {
        "value": value + np.zeros((4, 1)) + 0.001 * np.arange(n),
        "clean": np.full((4, n), value > 1),
        "outside": np.full((4, n), value < 0),
        "path": np.full((4, n), 1.0 + value),
        "gripper": np.full((4, n), 0.3),
        "lowest": np.full((4, n), 0.05),
        "steps": np.full((4, n), 7),
    }
    objects = {pair: rows(value, 20) for pair, value in returns.items() if pair[1] in FEM}
    simulation = {pair: rows(value, 64) for pair, value in returns.items() if pair[1] not in FEM}
    return results.Results(simulation, objects, {}, list(posteriors))


RETURNS = {
    ("dlo-0-edge", "dlo-0"): 1.75,
    ("dlo-0-none", "dlo-0"): 0.5,
    ("uniform", "dlo-0"): 1.25,
    ("uniform", "dlo-1"): -1.0,
    ("dlo-2-edge", "dlo-2"): 0.25,
    ("dlo-2-none", "dlo-2"): 1.0,
    ("uniform", "dlo-2"): 1.95,
    ("sim-stiff-edge", "sim-stiff-true"): 1.5,
    ("uniform", "sim-stiff-true"): 0.25,
}


def test_the_question_is_answered_with_its_sign():
    rows = {row["where"]: row for row in tables.question(made_up(RETURNS))}
    assert rows["dlo-0, FEM object"]["− U"] == "0.50 [0.50, 0.50]"
    assert rows["dlo-0, FEM object"]["− fixed support"] == "1.25 [1.25, 1.25]"
    assert rows["dlo-0, FEM object"]["− truth"] == tables.NONE
    assert rows["dlo-2, FEM object"]["− U"] == "-1.70 [-1.70, -1.70]"
    assert rows["sim-stiff, its truth simulated"]["− U"] == "1.25 [1.25, 1.25]"
    assert "dlo-1, FEM object" not in rows
    answer = report.answer(made_up(RETURNS))
    assert (
        "Against PPO-U: on FEM objects (dlo-0, dlo-2) -0.60 [-0.60, -0.60], better on dlo-0 and worse on dlo-2; on "
        "simulated objects with known parameters (sim-stiff) 1.25 [1.25, 1.25], better on sim-stiff." in answer
    )
    assert "posterior mean" not in answer


def test_contrasts_over_objects():
    """EDGE is 0.25 to 1.51 ahead of U by object, 0.1 of the truth but on the last, 1.02; the mean has no dlo-3."""
    own, truths = (1.5, 1.75, 0.5, 1.76), (1.4, 1.65, 0.4, 0.74)
    returns = {(f"{dlo}-edge", dlo): value for dlo, value in zip(FEM, own, strict=True)}
    returns |= {(f"{dlo}-true", dlo): value for dlo, value in zip(FEM, truths, strict=True)}
    returns |= {("uniform", dlo): 0.25 for dlo in FEM} | {(f"{dlo}-mean", dlo): 0.0 for dlo in FEM[:3]}
    rows = {row["EDGE −"]: row for row in contrasts.table(made_up(returns))}
    assert list(rows) == ["U", "truth"]  # the others were not evaluated on all objects
    assert rows["U"]["difference"].startswith("1.13 [") and rows["truth"]["difference"].startswith("0.33 [0.10, ")
    assert rows["U"]["p"] == "< 0.001" and rows["U"]["A"] == rows["truth"]["A"] == "1.00"
    low, high = (float(end) for end in rows["U"]["difference"].split("[")[1].strip("]").split(", "))
    assert 0.25 <= low < 0.75 and 1.25 < high <= 1.51


def test_findings_hold_or_not():
    rows = {row["the paper finds"]: row for row in findings.table(made_up(RETURNS))}
    assert rows["PPO-0' is better than PPO-0 on DLO-0"]["holds here?"] == "yes"
    assert rows["PPO-2' is better than PPO-2 on DLO-2"]["difference"] == "-0.75 [-0.75, -0.75]"
    assert rows["PPO-2' is better than PPO-2 on DLO-2"]["holds here?"] == "no"
    assert rows["PPO-0' has shorter trajectories on DLO-0 than PPO-0"]["difference"] == "-1.250 [-1.250, -1.250]"
    assert "PPO-1 is more robust than PPO-1' on DLO-1" not in rows
    assert findings.verdict((0.1, -0.2, 0.4), level=False) == "not shown"
    assert findings.verdict((0.3, 0.2, 0.4), level=True) == "no"


def test_difficulty_is_the_papers():
    average, consistency, difficulty = tables.of_agents([0.5, 2.0, 1.0, -0.5, 1.5], low=-1.0, high=2.0)
    assert (average, consistency) == (0.9, 1.0) and difficulty == pytest.approx(1 / 3)
    assert math.isnan(tables.of_agents([2.0, 2.0], 2.0, 2.0)[2])  # extremes that coincide
    rows = {(row["policies"], row["DLO"]): row for row in tables.difficulty(made_up(RETURNS))}
    # PPO-0' and PPO-U on DLO-0: 1.75 and 1.25, of extremes -1 and 1.953, a little more at later places.
    assert rows["EDGE", "dlo-0"]["consistency, nominal"] == "1.50"
    assert rows["EDGE", "dlo-0"]["difficulty, nominal"] == "0.15"
    assert rows["fixed support", "dlo-0"]["consistency, nominal"] == "0.88"


def test_the_text_is_written_between_its_lines(tmp_path, monkeypatch):
    readme = tmp_path / "README.md"
    monkeypatch.setattr(report.results, "load", lambda _: made_up(RETURNS))
    monkeypatch.setattr(report.files, "read_arrays", lambda _: {})
    monkeypatch.setattr("experiments.policies.figures.save", lambda *_: [])
    readme.write_text("nothing")
    with pytest.raises(ValueError, match="readme: expected the lines"):
        report.write(tmp_path, readme)
    readme.write_text(f"before\n{report.BEGIN}\nstale\n{report.END}\nafter\n")
    report.write(tmp_path, readme)
    written = readme.read_text()
    assert written.startswith(f"before\n{report.BEGIN}\n") and written.endswith(f"{report.END}\nafter\n")
    assert "stale" not in written and "| PPO-0' | 1.76 [1.76, 1.76]; 1.00; 1.75; 0.00 |" in written
    assert (tmp_path / "tables" / "question.csv").read_text().count("\n") == 4
