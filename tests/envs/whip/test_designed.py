"""Whips to choose: what is played, what is simulated, what fails, and that errors are independent as is said."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

pytest.importorskip("mujoco")

from jaxlfi.design.fisher import FisherRater
from jaxlfi.design.recommendation import chosen_method
from jaxlfi.design.regions import region
from jaxlfi.envs.whip import designed, rules
from jaxlfi.envs.whip.exploration import exploratory_actions
from jaxlfi.envs.whip.physics.native import NativeEngine
from jaxlfi.envs.whip.real2sim import NUISANCES, task, whip_task
from jaxlfi.envs.whip.rig import START
from jaxlfi.envs.whip.vision.keypoints import DETECTORS
from jaxlfi.tasks.experiments import at, experiments, single
from jaxlfi.tasks.simulation import trajectory_and_outcome

ENGINE = NativeEngine()
THETA = np.array([[230.0, 8e3], [280.0, 2e3]])
INTO_THE_STACK = [0.52] * 8 + [0.36] * 8
STILL = [START[0]] * 8 + [START[1]] * 8


@pytest.fixture(scope="module")
def whip():
    return task(engine="native")


def test_every_design_can_be_played(whip):
    rng = np.random.default_rng(0)
    design = whip.design
    for one in [design.low, design.high, *design.of_unit(rng.random((200, 16)))]:
        actions = designed.actions(one)
        assert actions.shape == (16, 2) and np.abs(actions).max() <= rules.ACTION_LIMIT + 1e-12
        path = np.array(START) + np.cumsum(actions, axis=0)
        assert (path >= rules.WORKSPACE[0] + 0.01).all() and (path <= rules.WORKSPACE[1] - 0.0099).all()
        assert (path[:, 1] >= START[1] - 1e-9).all()
    headings, rows = design.controls(design.low)
    assert headings == ["time [s]", "dx [m]", "dz [m]"]
    np.testing.assert_allclose(rows[:, 0], 0.16 * np.arange(16))
    near = designed.actions(design.nominal) - np.asarray(exploratory_actions())
    assert np.abs(np.cumsum(near, axis=0)[1::2]).max() < 0.03  # where the exploratory actions are, every other step


def test_a_point_is_gone_to_as_fast_as_actions_may():
    actions = designed.actions(np.array([0.50] * 4 + [0.40] * 4 + [0.46] * 8))
    np.testing.assert_allclose(actions[:3], [[0.06, 0.06], [0.04, 0.04], [0.0, 0.0]], atol=1e-12)
    np.testing.assert_allclose(actions[8:11, 0], [-0.06, -0.04, 0.0], atol=1e-12)


def test_what_is_inferred_does_not_change(whip):
    """Recordings are simulated as ever; the design is of other experiments of the same parameters."""
    assert whip.design.of is single(whip) and whip.design.of.observation is None and not whip.on_host
    assert whip.settings == single(whip).settings and single(whip).name == "whip"
    several = task(object=["dlo-0", "dlo-1"], engine="native")
    assert single(several).design.names == whip.design.names and several.observation.shape == (32, 30)


@pytest.mark.slow
def test_a_design_is_simulated_as_a_recording_of_it_would_be(whip):
    """Compared with the task of recorded actions, without the detector's errors."""
    clean = task(detector="clean", engine="native")
    rng = np.random.default_rng(1)
    chosen = whip.design.of_unit(rng.random(16))
    rows, outcome = at(clean, chosen).simulate.batch(jax.random.key(0), THETA)
    recorded = whip_task(ENGINE, DETECTORS["clean"], NUISANCES["fixed"], designed.actions(chosen))
    for row, theta in zip(rows, THETA, strict=True):
        inner = recorded.space.to_inference(jnp.asarray(theta, jnp.float32))
        expected, failure = trajectory_and_outcome(recorded, jax.random.key(0), inner)
        assert failure == 0
        np.testing.assert_allclose(row, expected, atol=1e-4)
    assert outcome.tolist() == [0, 0]
    both, outcome = experiments(clean, [chosen, STILL]).simulate.batch(jax.random.key(0), THETA)
    assert both.shape == (2, 32, 30) and outcome.tolist() == [0, 0]
    np.testing.assert_allclose(both[:, :16], rows, atol=1e-4)


@pytest.mark.slow
def test_a_stack_that_is_touched_is_a_failure_if_it_is_to_be_left_alone(whip):
    free = task(engine="native", stack="any")
    failed = [at(one, INTO_THE_STACK).simulate.batch(jax.random.key(0), THETA)[1] for one in (whip, free)]
    assert single(whip).failures[failed[0][1] - 1] == "touched" and failed[1].tolist() == [0, 0]
    assert at(whip, STILL).simulate.batch(jax.random.key(0), THETA)[1].tolist() == [0, 0]
    with pytest.raises(ValueError, match="stack: expected one of"):
        task(stack="none")


def test_errors_of_a_detector_become_independent():
    """Errors with a lasting part, drawn by NumPy, have the stated covariance once they are weighted."""
    rng = np.random.default_rng(2)
    detector = DETECTORS["mask"]
    noise = designed.noise_of(detector)
    bias = float(detector.bias) * rng.standard_normal((4000, 1, 20))
    errors = bias + noise * rng.standard_normal((4000, 16, 20))
    weighted = np.asarray(jax.vmap(lambda one: designed.independent(detector, one))(jnp.asarray(errors, jnp.float32)))
    for column in (0, 19):  # of the DLO, and of a cube
        covariance = np.cov(weighted[:, :, column], rowvar=False) / noise[column] ** 2
        np.testing.assert_allclose(covariance, np.eye(16), atol=0.12)  # five standard errors


def test_designs_are_rated_by_fisher_information_where_errors_are_known():
    methods = {}
    for detector, nuisances in (("mask", "fixed"), ("transporter", "fixed"), ("mask", "random")):
        own = task(detector=detector, nuisances=nuisances, engine="native")
        methods[detector, nuisances] = chosen_method(single(own), "auto")
    assert list(methods.values()) == ["fisher", "contrastive", "contrastive"]


def test_a_whip_tells_more_than_none(whip):
    """A DLO at rest shows its length and nothing of its stiffness."""
    rng = np.random.default_rng(0)
    draws = np.stack([230 + 2 * rng.normal(size=200), np.log(8e3) + 0.1 * rng.normal(size=200)], axis=1)
    rater = FisherRater(jax.random.key(0), single(whip), (region(1.0, draws),), draws=2)
    still, moved = rater.precision(np.array([STILL, whip.design.nominal])).mean(axis=1)
    assert still[0, 0] > 0.1 and abs(still[1, 1]) < 10 < moved[1, 1] ** 0.5  # of ln E, known to better than a tenth
