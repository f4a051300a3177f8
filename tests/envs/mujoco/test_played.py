"""Experiments of a MuJoCo model: what is played, what is simulated, and what the model does not allow."""

import jax
import numpy as np
import pytest

pytest.importorskip("mujoco")

from envs_mujoco import ARM, recorded

from jaxlfi.design.choosing import failures, rate
from jaxlfi.design.fisher import FisherRater
from jaxlfi.design.recommendation import chosen_method
from jaxlfi.design.regions import region
from jaxlfi.envs.mujoco.model_task import mujoco_task
from jaxlfi.envs.mujoco.parameters import Parameter
from jaxlfi.envs.mujoco.played import Played
from jaxlfi.tasks.experiments import at, single

LIMITED = ARM.replace('gear="1.5"', 'gear="1.5" ctrllimited="true" ctrlrange="-1 1"')
PARAMETERS = [
    Parameter("joint/shoulder/damping", (0.02, 0.5), (0.02, 0.5), "N m s/rad", log=True),
    Parameter("actuator/motor/gear[0]", (0.5, 3.0)),
]


def task(design, xml=LIMITED):
    log = recorded(xml, count=41)
    return mujoco_task(xml, PARAMETERS, log, ["angle"], {"angle": 0.01}, design=design, threads=1)


def test_what_is_played_is_what_the_numbers_say():
    times = np.linspace(0.0, 2.0, 201)
    sines = Played("motor", "sines", 2, -1.0, 1.0, (0.0, 0.5), (0.2, 3.0))
    assert list(sines.variables) == [f"motor {what} {i}" for what in ("amplitude", "frequency") for i in (1, 2)]
    expected = 0.2 * np.sin(2 * np.pi * times) + 0.1 * np.sin(4 * np.pi * times)
    np.testing.assert_allclose(sines.samples(np.array([0.2, 0.1, 1.0, 2.0]), times), expected, atol=1e-12)
    chirp = Played("motor", "chirp", 1, -1.0, 1.0, (0.0, 1.0), (0.2, 3.0))
    crossings = np.flatnonzero(np.diff(np.sign(chirp.samples(np.array([1.0, 0.5, 2.5]), times[1:]))))
    assert len(crossings) == 5  # 0.5 Hz to 2.5 Hz in 2 s are three turns: zeros at half turns 1 to 5
    moves = Played("motor", "moves", 2, -1.0, 1.0, (-1.0, 1.0), (0.2, 3.0))
    played = moves.samples(np.array([0.8, -0.4]), times)
    np.testing.assert_allclose(played[[0, 50, 100, 200]], [0.0, 0.4, 0.8, -0.4], atol=1e-6)
    assert np.abs(np.diff(played[98:103])).max() < 1e-3  # it rests where two moves meet


def test_experiments_are_simulated_as_a_recording_of_them_would_be():
    own = task({"duration": 0.8, "controls": {"motor": {"kind": "sines", "amplitude": [0.0, 1.0]}}})
    assert own.observation is not None and own.design.of is single(own)
    design = {"motor amplitude": 0.7, "motor frequency": 1.5}
    headings, rows = own.design.controls(own.design.values(design))
    assert headings == ["time [s]", "motor"] and rows.shape == (41, 2)
    np.testing.assert_allclose(rows[:, 1], 0.7 * np.sin(3 * np.pi * rows[:, 0]), atol=1e-12)
    from jaxlfi.envs.mujoco.logs import Log

    log = Log(rows[:, 0], {"motor": rows[:, 1], "angle": np.linspace(0.0, 1.0, 41)}, "played")
    again = mujoco_task(LIMITED, PARAMETERS, log, ["angle"], {"angle": 0.01}, threads=1)
    theta = np.array([[0.08, 1.5], [0.3, 1.0]])
    clean = again.simulate.function.clean(theta)[0]
    np.testing.assert_allclose(own.design.response(theta, np.array([0.7, 1.5])), clean, atol=1e-9)
    noisy, outcome = at(own, design).simulate.batch(np.random.default_rng(0), theta)
    assert (outcome == 0).all() and 0.007 < (noisy - clean).std() < 0.013


def test_the_start_of_an_episode_can_be_chosen():
    own = task({"duration": 0.4, "controls": {}, "initial": {"shoulder/qpos": [-1.0, 1.0]}})
    assert own.design.names == ("start shoulder/qpos",)
    found = own.design.response(np.array([[0.08, 1.5]]), np.array([0.6]))
    assert found[0, 0, 0] == pytest.approx(0.6, abs=1e-6)


def test_designs_of_a_model_are_rated_by_differences():
    """Nothing is learnt of the motor where it does not move, and unsafe designs are counted."""
    own = task({"duration": 0.8, "limits": {"angle": [-0.3, 0.3]}})
    one = single(own)
    assert chosen_method(one, "auto") == "fisher"
    rng = np.random.default_rng(0)
    draws = np.stack([np.log(0.08) + 0.1 * rng.normal(size=200), 1.5 + 0.1 * rng.normal(size=200)], axis=1)
    about = np.array([[0.0, 1.0]])
    rater = FisherRater(jax.random.key(0), one, (region(1.0, draws),), about, draws=4)
    found = rate(rater, np.array([[0.0, 1.0], [0.05, 1.0]]), tolerance=0.99)
    assert found.value[0] == pytest.approx(0.0, abs=0.01) and found.value[1] > 0.3
    assert failures(rater, np.array([[0.05, 1.0], [1.0, 0.3]])).tolist() == [0.0, 1.0]


@pytest.mark.parametrize(
    ("design", "message"),
    [
        ({"speed": 1}, "design: expected keys among duration"),
        ({"duration": -1}, "design: duration: expected seconds above 0"),
        ({"interval": 1e-5}, "design: expected an interval of at least the model's step"),
        ({"controls": {"moter": {}}}, "design: controls: moter: expected one of motor"),
        ({"controls": {"motor": {"kind": "noise"}}}, "kind: expected one of sines, chirp, moves"),
        ({"controls": {"motor": {"count": 0}}}, "count: expected 1 to 20"),
        ({"controls": {"motor": {"amplitude": [0, 2]}}}, "expected controls within ctrlrange, -1 to 1"),
        ({"controls": {"motor": {"frequency": [3, 1]}}}, r"frequency: expected \[LOW, HIGH\]"),
        ({"controls": {"motor": {"frequency": [-1, 1]}}}, "frequency: expected 0 to at most 25 Hz"),
        ({"controls": {"motor": {"frequency": [1, 30]}}}, "frequency: expected 0 to at most 25 Hz"),
        ({"initial": {"knee/qpos": [0, 1]}}, "knee"),
        ({"limits": {"angel": [0, 1]}}, "design: limits: expected some of angle"),
        ({"controls": {}}, "expected controls or an initial state to choose, got none"),
    ],
)
def test_what_a_model_does_not_allow_is_refused(design, message):
    with pytest.raises(ValueError, match=message) as caught:
        task(design)
    assert "\n" not in str(caught.value)


def test_a_start_keeps_within_the_range_of_its_joint():
    xml = LIMITED.replace('name="shoulder"', 'name="shoulder" limited="true" range="-57.29578 57.29578"', 1)
    assert xml != LIMITED
    with pytest.raises(ValueError, match=r"initial: shoulder/qpos: expected bounds within the joint's range, -1 to 1"):
        task({"initial": {"shoulder/qpos": [-1.5, 0.5]}}, xml)
    assert "start shoulder/qvel" in task({"initial": {"shoulder/qvel": [-1.5, 0.5]}}, xml).design.names


def test_frequencies_that_are_not_given_are_those_that_samples_can_follow():
    high = lambda interval: dict(zip((own := task({"interval": interval}).design).names, own.high, strict=True))
    assert high(0.02)["motor frequency"] == 3.0 and high(0.25)["motor frequency"] == pytest.approx(2.0)


def test_an_actuator_without_a_range_needs_bounds():
    with pytest.raises(ValueError, match="amplitude: expected bounds, as the actuator has no ctrlrange"):
        task({}, ARM)
    own = task({"controls": {"motor": {"amplitude": [0, 2]}}}, ARM)
    assert own.design.high[0] == 2.0
    rows = own.design.controls(np.array([1.5, 1.0]))[1]
    np.testing.assert_allclose(rows[:, 1], 1.5 * np.sin(2 * np.pi * rows[:, 0]), atol=1e-12)
