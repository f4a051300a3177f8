"""Delays, gains and offsets of sensors, and controls that do not keep time; against plain loops and closed forms."""

import numpy as np
import pytest

mujoco = pytest.importorskip("mujoco")

from envs_mujoco import ARM, recorded

from jaxlfi.envs.mujoco.logs import Log
from jaxlfi.envs.mujoco.model_task import mujoco_task
from jaxlfi.envs.mujoco.parameters import Parameter

QUIET = {"angle": 0.0, **{f"velocity[{i}]": 0.0 for i in range(3)}}
CART = """
<mujoco><option timestep="0.002"/><worldbody><body name="cart"><joint name="rail" type="slide" axis="1 0 0"/>
  <geom size="0.1" mass="0.4"/></body></worldbody><actuator><motor name="motor" joint="rail"/></actuator></mujoco>
"""


def simulator(parameters, xml=ARM, log=None, noises=QUIET):
    return mujoco_task(xml, parameters, log or recorded(), noises=noises).simulate.function


def test_a_sensor_is_late_by_parts_of_a_step_and_has_a_gain_besides_its_offset():
    names = {"delay": (0.0, 0.1), "gain": (0.5, 2.0), "bias": (-1.0, 1.0)}
    own = simulator([Parameter(f"sensor/angle/{name}", bounds) for name, bounds in names.items()])
    rows, _ = own.clean([[0.0137, 1.3, -0.2], [0.0, 1.0, 0.0]])
    steps, plain = recorded(interval=0.004, count=501), recorded()
    before = np.interp(plain.times - 0.0137, steps.times, recorded_at_steps()["angle"])
    np.testing.assert_allclose(rows[0, :, 0], 1.3 * before - 0.2, atol=1e-9)
    np.testing.assert_allclose(rows[1, :, 0], plain.signals["angle"], atol=1e-9)
    np.testing.assert_allclose(rows[0, :, 1:], rows[1, :, 1:], atol=1e-12)
    assert np.abs(rows[0, :, 0] - (1.3 * rows[1, :, 0] - 0.2)).max() > 0.05


def recorded_at_steps():
    """Signals at every step, under the controls that are held for five of them."""
    model = mujoco.MjModel.from_xml_string(ARM)
    data, log, found = mujoco.MjData(model), recorded(), []
    for step in range(501):
        data.ctrl[0] = log.signals["motor"][step // 5]
        mujoco.mj_step(model, data)
        found.append(data.sensordata.copy())
    return {"angle": np.array(found)[:, 0], "velocity": np.array(found)[:, 1:]}


def test_a_sensor_of_several_numbers_is_late_as_a_whole():
    rows, _ = simulator([Parameter("sensor/velocity/delay", (0.0, 0.1))]).clean([[0.0211]])
    whole = recorded_at_steps()["velocity"]
    expected = [np.interp(recorded().times - 0.0211, 0.004 * np.arange(501), column) for column in whole.T]
    np.testing.assert_allclose(rows[0, :, 1:], np.stack(expected, axis=1), atol=1e-9)
    np.testing.assert_allclose(rows[0, :, 0], recorded().signals["angle"], atol=1e-9)


def pushed(forces, times, jitter, count=1000):
    """Last velocities of a cart in many simulations."""
    log = Log(times, {"motor": np.array(forces), "joint/rail/qvel": np.zeros(len(times))})
    own = simulator([Parameter("clock/jitter", (0.0, 0.2))], CART, log, {"joint/rail/qvel": 0.0})
    rows, outcome = own(np.random.default_rng(3), np.full((count, 1), jitter))
    assert not outcome.any()
    return rows[:, -1, 0], own


def test_controls_act_at_times_that_spread():
    """A push that begins at 0.3 s and lasts until the end at 1 s: velocities are as the times are, normal."""
    last, own = pushed([0.0, np.nan, 1.2, np.nan, 1.2], [0.0, 0.15, 0.3, 0.65, 1.0], 0.03)
    assert last.mean() == pytest.approx(1.2 * 0.7 / 0.4, abs=5 * 0.09 / np.sqrt(1000))
    assert last.std() == pytest.approx(1.2 * 0.03 / 0.4, rel=5 / np.sqrt(2 * 1000))
    clean, _ = own.clean([[0.03]])
    assert clean[0, -1, 0] == pytest.approx(1.2 * 0.7 / 0.4)


def test_controls_do_not_overtake_one_another():
    """A push of 10 ms, whose beginning and end spread by far more: it never pulls."""
    last, _ = pushed([0.0, 1.2, 0.0, 0.0], [0.0, 0.3, 0.31, 1.0], 0.05)
    assert last.min() >= 0 and (last < 1e-9).mean() > 0.2 and last.max() > 0.3


def test_without_jitter_the_clock_is_that_of_the_recording():
    last, _ = pushed([0.0, np.nan, 1.2, np.nan, 1.2], [0.0, 0.15, 0.3, 0.65, 1.0], 0.0, count=2)
    np.testing.assert_allclose(last, 1.2 * 0.7 / 0.4, rtol=1e-9)


@pytest.mark.parametrize(
    ("name", "bounds", "expected"),
    [
        ("sensor/angle/delay", (-0.1, 0.1), r"'sensor/angle/delay': expected bounds of at least 0, got \[-0.1, 0.1\]"),
        ("sensor/angle/noise", (-0.1, 0.1), "expected bounds of at least 0"),
        ("clock/jitter", (-0.1, 0.1), "expected bounds of at least 0"),
        ("clock/drift", (0.0, 0.1), "expected control/delay or clock/jitter of a model with actuators, got 'clock/dr"),
        ("sensor/angle/lag", (0.0, 0.1), "expected gain, bias, delay, noise of a sensor, got 'lag'"),
        ("sensor/velocty/delay", (0.0, 0.1), r"expected a signal such as velocity"),
    ],
)
def test_what_is_not_possible_is_one_line(name, bounds, expected):
    with pytest.raises(ValueError, match=expected) as refusal:
        simulator([Parameter(name, bounds)])
    assert "\n" not in str(refusal.value)


def test_a_clock_that_nothing_is_driven_by():
    xml = CART.replace('<motor name="motor" joint="rail"/>', "")
    log = Log([0.0, 0.1], {"joint/rail/qpos": [0.0, 0.0]})
    with pytest.raises(ValueError, match="expected control/delay or clock/jitter of a model with actuators"):
        simulator([Parameter("clock/jitter", (0.0, 0.1))], xml, log, {"joint/rail/qpos": 0.1})


def test_mjx_refuses_jitter_before_it_compiles():
    pytest.importorskip("mujoco.mjx")
    with pytest.raises(ValueError, match=r"expected native for what MJX cannot simulate, got mjx: .* got clock/jitter"):
        mujoco_task(ARM, [Parameter("clock/jitter", (0.0, 0.1))], recorded(), noises=QUIET, engine="mjx")
