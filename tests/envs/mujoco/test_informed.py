"""What a recording does not determine: sentences in closed form, and fits of machines whose parameters act jointly."""

import json

import numpy as np
import pytest

pytest.importorskip("mujoco")

import mujoco
import small

from jaxlfi.diagnostics import identifiability
from jaxlfi.diagnostics.identifiability import sentences, untouched
from jaxlfi.envs.mujoco import commands, sysid_point
from jaxlfi.envs.mujoco.least_squares import best_fits, fit
from jaxlfi.envs.mujoco.logs import Log
from jaxlfi.envs.mujoco.model_task import mujoco_task
from jaxlfi.envs.mujoco.parameters import Parameter
from jaxlfi.envs.mujoco.sysid_point import uninformed_directions

CART = """
<mujoco model="cart">
  <option timestep="0.01" integrator="implicitfast" gravity="0 0 0"/>
  <worldbody>
    <body name="cart"><joint name="rail" type="slide" axis="1 0 0" damping="{damping}"/>
      <geom size="0.1" mass="2"/></body>
    <body name="idle" pos="0 1 0"><joint name="other" type="slide" axis="1 0 0" damping="0.3"/><geom size="0.1"/></body>
  </worldbody>
  <actuator>
    <general name="motor" joint="rail" gear="2" gainprm="1.5" biastype="affine" biasprm="0 0 {back}"/>
  </actuator>
  <sensor><jointpos name="place" joint="rail"/><jointpos name="idle" joint="other"/></sensor>
</mujoco>
"""
GAIN = Parameter("actuator/motor/gainprm[0]", (0.5, 5.0), log=True)
GEAR = Parameter("actuator/motor/gear[0]", (0.5, 8.0))
MASS = Parameter("body/cart/mass", (0.5, 8.0), unit="kg")
DAMPING = Parameter("joint/rail/damping", (0.1, 2.0))
IDLE = Parameter("joint/other/damping", (0.01, 3.0), log=True)
BACK = Parameter("actuator/motor/biasprm[2]", (-2.0, 0.1))


def cart(*parameters, damping=0.5, back=-0.2, noise=1e-3):
    """A cart that is pushed to and fro, and one that nothing moves, with noise."""
    xml = CART.format(damping=damping, back=back)
    model = mujoco.MjModel.from_xml_string(xml)
    data, times, places = mujoco.MjData(model), 0.05 * np.arange(60), []
    pushes = np.sin(4 * times) + 0.5 * np.cos(1.3 * times)
    for step in range(5 * len(times)):
        data.ctrl[0] = pushes[step // 5]
        mujoco.mj_step(model, data)
        if step % 5 == 0:
            places.append(data.sensordata.copy())
    places = np.array(places) + noise * np.random.default_rng(0).standard_normal((60, 2))
    log = Log(times, {"motor": pushes, "place": places[:, 0], "idle": places[:, 1]}, "cart")
    return mujoco_task(xml, list(parameters), log, noises={"place": noise, "idle": noise})


def said(task, point):
    return [line for line in commands.said(task, [point]) if "constrain" in line or "separately" in line]


# ------------------------------------------------------------------------------------------------------------- names


def test_single_parameters_and_combinations_are_named():
    """Along one direction, two, and both at once; exponents and weights by the direction that nothing changes along."""
    names = ["a", "b", "c", "d"]
    log, linear, ones = [True] * 4, [False] * 4, np.ones(4)

    def of(*directions, log=log, theta=ones, names=names):
        rows = np.array(directions, float)
        orthonormal = np.linalg.qr(rows.T)[0]
        return sentences(names, log, theta, orthonormal, ones)

    together, alone = "are not separately identifiable: only", "The observation does not constrain"
    assert of([0, 1, 0, 0]) == [f"{alone} b."]
    assert of([0, 1, 0, 0], [0, 0, 0, 1]) == [f"{alone} {name}." for name in "bd"]
    assert of([1, -1, 0, 0]) == [f"a and b {together} a * b is well determined."]
    assert of([1, 0, 1, 0]) == [f"a and c {together} a / c is well determined."]
    assert of([1, -2, 0, 0]) == [f"a and b {together} a^2 * b is well determined."]
    assert of([1, -1, 0, 0], [0, 1, 0, -1]) == [f"a, b and d {together} a * b * d is well determined."]
    assert of([1, -1, 0, 0], [0, 0, 1, 0]) == [f"a and b {together} a * b is well determined.", f"{alone} c."]
    assert of([1, -1, 0, 0], [0, 0, 1, 1]) == [
        f"a and b {together} a * b is well determined.",
        f"c and d {together} c / d is well determined.",
    ]
    (three,) = of([1, -1, 1, 0])
    assert three.startswith(f"a, b and c {together} ") and " and " in three.partition("only ")[2]
    # Of numbers that are no logarithms: steps of the same size leave a sum, and relative ones a product.
    assert of([1, -1, 0, 0], log=linear, theta=np.array([2.0, 5, 1, 1])) == [
        f"a and b {together} a + b is well determined."
    ]
    assert of([1, 1, 0, 0], log=linear, theta=np.array([2.0, 5, 1, 1])) == [
        f"a and b {together} a - b is well determined."
    ]
    assert of([2, -5, 0, 0], log=linear, theta=np.array([2.0, 5, 1, 1])) == [
        f"a and b {together} a * b is well determined."
    ]
    assert of([1, -0.37, 0, 0], log=linear, theta=np.array([0.0, 5, 1, 1])) == [
        f"a and b {together} a + 2.7 * b is well determined."
    ]
    assert of([1, -5, 0, 0], log=[True, False, True, True], theta=np.array([2.0, 5, 1, 1])) == [
        f"a and b {together} a * b is well determined."
    ]


def test_a_small_part_of_a_direction_is_none():
    rows = np.array([[1.0, 0.03, 0.0]]) / np.hypot(1, 0.03)
    assert untouched(rows).tolist() == [False, True, True]
    assert sentences(["a", "b", "c"], [False] * 3, np.ones(3), rows.T, np.ones(3)) == [
        "The observation does not constrain a."
    ]
    assert untouched(np.zeros((0, 2))).all()


def test_directions_are_those_of_the_whole_decomposition():
    """This also holds for fewer numbers than parameters."""
    rng = np.random.default_rng(0)
    for rows in (2, 3, 40):
        jacobian = rng.standard_normal((rows, 3)) @ np.diag([1.0, 10.0, 1e-9])
        sizes, found = identifiability.directions(jacobian)
        expected = np.zeros(3)
        expected[: min(rows, 3)] = np.linalg.svd(jacobian, compute_uv=False)
        np.testing.assert_allclose(sizes, expected, atol=1e-12)
        np.testing.assert_allclose(found @ found.T, np.eye(3), atol=1e-12)
        np.testing.assert_allclose(np.linalg.norm(jacobian @ found.T, axis=0), sizes, atol=1e-12)
    found = uninformed_directions(np.diag([100.0, 0.0, 0.1]), np.array([2.0, 0.5, 1.0]))
    np.testing.assert_allclose(found @ found.T, np.diag([0.0, 0.25, 1.0]), atol=1e-12)


# -------------------------------------------------------------------------------------------------------------- fits


@pytest.mark.parametrize(
    ("parameters", "start", "damping", "back", "known", "lines"),
    [
        ([DAMPING, IDLE], [1, 0.1], 0.5, 0, [True, False], ["The observation does not constrain joint/other/damping."]),
        (
            [GAIN, GEAR, DAMPING],
            [1, 3, 1],
            0.5,
            0,
            [False, False, True],
            ["motor/gear[0] is well determined."],
        ),
        ([GAIN, MASS], [1, 1], 0, -0.2, [True, True], []),  # which the known damping of the motor tells apart
        (
            [GAIN, MASS],
            [1, 1],
            0,
            0,
            [False, False],
            ["only actuator/motor/gainprm[0] / body/cart/mass is well determined."],
        ),
        (
            [DAMPING, BACK],
            [1, 0],
            0.5,
            -0.2,
            [False, False],
            ["/rail/damping - 4 * actuator/motor/biasprm[2] is well determined."],
        ),
    ],
)
def test_what_acts_together_only_has_no_interval(parameters, start, damping, back, known, lines):
    task = cart(*parameters, damping=damping, back=back)
    point = fit(task, start)
    assert point.informed.tolist() == known and np.isnan(point.interval[~point.informed]).all()
    found = said(task, point)
    assert len(found) == len(lines) and all(line.endswith(own) for line, own in zip(found, lines, strict=True))
    truth = {GAIN: 1.5, GEAR: 2.0, MASS: 2.0, DAMPING: damping, IDLE: 0.3, BACK: back}
    for (low, high), one in zip(point.interval, parameters, strict=True):
        if np.isfinite(low):
            assert one.support[0] <= low < high <= one.support[1]
            assert low - 0.5 * (high - low) < truth[one] < high + 0.5 * (high - low)


def test_points_that_one_combination_joins_are_the_same():
    task = cart(GAIN, GEAR, MASS, damping=0, back=0)
    fits = best_fits(task, np.array([[1.0, 3.0, 1.5], [2.0, 1.0, 3.0], [0.7, 5.0, 2.0]]), keep=3)
    assert len(fits) == 1 and not fits[0].informed.any() and fits[0].uninformed.shape == (3, 2)
    (line,) = said(task, fits[0])
    assert line.endswith("only actuator/motor/gainprm[0] * actuator/motor/gear[0] / body/cart/mass is well determined.")
    gain, gear, mass = fits[0].theta
    assert gain * gear / mass == pytest.approx(1.5, rel=0.01)


def test_a_recording_of_nothing_informs_nothing():
    own = cart(DAMPING, IDLE)
    log = own.simulate.function.logs[0]
    still = Log(log.times, {name: 1e-3 * np.cos(9 * i + np.arange(60)) for i, name in enumerate(log.signals)})
    still.signals["motor"][:] = 0.0
    task = mujoco_task(CART.format(damping=0.5, back=0), [DAMPING, IDLE], still, noises={"place": 1e-3, "idle": 1e-3})
    points = best_fits(task, np.array([[0.5, 0.1], [1.0, 0.5], [0.2, 2.0]]), keep=3)
    assert len(points) == 1 and not points[0].informed.any() and not points[0].at_bound.any()
    assert len(said(task, points[0])) == 2 and np.isfinite(points[0].covariance).all()


def test_friction_that_never_slips():
    xml = """<mujoco><option timestep="0.005"/><worldbody><geom type="plane" size="1 1 0.1"/>
      <body name="box" pos="0 0 0.05"><freejoint name="free"/><geom name="box" type="box" size="0.05 0.05 0.05"/></body>
      </worldbody></mujoco>"""
    times = 0.02 * np.arange(30)
    signals = {
        f"body/box/pos[{i}]": np.full(30, place) + 1e-3 * np.cos(7 * times * (i + 1))
        for i, place in ((0, 0.0), (2, 0.05))
    }
    friction = Parameter("geom/box/friction[0]", (1.0, 3.0))
    task = mujoco_task(xml, [friction], Log(times, signals), noises=dict.fromkeys(signals, 1e-3))
    point = fit(task, [2.0])
    assert said(task, point) == ["The observation does not constrain geom/box/friction[0]."]
    assert np.isnan(point.interval).all()


def test_a_bound_that_holds_a_point_leaves_one_side():
    task = cart(DAMPING, Parameter(GEAR.name, (0.5, 1.9)), IDLE)
    point = fit(task, [0.5, 1.5, 0.1])
    assert point.at_bound.tolist() == [False, True, False] and point.informed.tolist()[2] is False
    low, high = point.interval[1]
    assert np.isnan(low) or (0.5 <= low < high <= 1.9 + 1e-6)


def test_points_of_sysid_have_no_such_intervals_either(monkeypatch):
    """Their own intervals would be wide, infinite, missing, or set by rounding."""
    for name, value in (("require_sysid", lambda: None), ("solved", lambda residuals, start, low, high: start)):
        monkeypatch.setattr(sysid_point, name, value)
    task = cart(DAMPING, GAIN, GEAR, damping=0.5, back=0)
    for half, known in (([0.1, 0.2, 0.3], True), ([0.1, np.inf, np.nan], True), ([5.0, 1e-9, 1e-9], False)):
        monkeypatch.setattr(sysid_point, "half_widths", lambda left, jacobian, half=half: np.array(half))
        found = sysid_point.sysid_point(task)
        assert np.isnan(found.interval[1:]).all() and np.isfinite(found.interval[0]).all() == known
        assert not found.at_bound.any()
    centre = found.theta
    np.testing.assert_allclose(centre, [1.05, np.sqrt(0.5 * 5.0), 4.25], rtol=1e-5)


def test_a_signal_without_noise_that_is_constant_is_refused():
    task = cart(DAMPING)
    log = task.simulate.function.logs[0]
    constant = Log(log.times, dict(log.signals) | {"idle": np.zeros(60)})
    own = mujoco_task(CART.format(damping=0.5, back=0), [DAMPING], constant, noises={"place": 1e-3})
    with pytest.raises(ValueError, match=r"noise: expected standard deviations above 0 for .*, got none for idle"):
        fit(own, [0.5])


def test_all_that_is_printed_and_kept_does_without_an_interval(tmp_path, capsys):
    """The table, the file and the picture."""
    (tmp_path / "cart.xml").write_text(CART.format(damping=0.5, back=0))
    log = cart(DAMPING).simulate.function.logs[0]
    np.savez(tmp_path / "cart.npz", times=log.times, **log.signals)
    (tmp_path / "cart.toml").write_text(
        'model = "cart.xml"\nlog = ["cart.npz"]\nnoise = { place = 0.001, idle = 0.001 }\n'
        '[parameters."joint/rail/damping"]\nsupport = [0.1, 2.0]\n'
        '[parameters."joint/other/damping"]\nsupport = [0.01, 3.0]\nlog = true\n'
        '[parameters."sensor/idle/noise"]\nsupport = [0.0001, 0.1]\nlog = true\n'.replace(", idle = 0.001", "")
    )
    words = ("fit", tmp_path / "cart.toml", "--starts", 4, "--keep", 2, "--out", tmp_path / "fit")
    assert small.command("mujoco", *words) == 0
    printed = capsys.readouterr().out
    assert "point 1 of 1" in printed and printed.count("not constrained by this recording") == 1
    assert "sensor/idle/noise is not estimated by least squares: inference does." in printed
    (point,) = json.loads((tmp_path / "fit/fit.json").read_text())["points"]
    assert point["interval"][1:] == [[None, None]] * 2 and np.isfinite(point["interval"][0]).all()
    assert np.shape(point["uninformed"]) == (3, 2) and (tmp_path / "fit/pairs.png").exists()
