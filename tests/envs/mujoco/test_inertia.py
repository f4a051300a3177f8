"""Whole inertias of bodies, against clouds of points that are stretched, sheared and moved."""

import itertools

import numpy as np
import pytest

mujoco = pytest.importorskip("mujoco")

from envs_mujoco import ARM, recorded

from jaxlfi.envs.mujoco import config, inertia
from jaxlfi.envs.mujoco.effects import built, effects
from jaxlfi.envs.mujoco.model_task import mujoco_task
from jaxlfi.envs.mujoco.parameters import Parameter

NAMES = [f"body/fore/inertial[{i}]" for i in range(10)]


def specification(xml=ARM):
    spec = mujoco.MjSpec.from_string(xml)
    return spec, spec.compile()


def compiled(coordinates, xml=ARM):
    spec, model = specification(xml)
    does = effects(spec, model, NAMES, [(-0.3, 0.3)] * 10, [])
    return built(spec, does, np.asarray(coordinates)), model


def axes_of(body):
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, body.iquat)
    return rotation.reshape(3, 3)


def of_points(masses, points):
    """Mass, centre and inertia about it of a cloud of points."""
    mass = masses.sum()
    centre = masses @ points / mass
    off = points - centre
    moments = (masses[:, None] * off).T @ off
    return mass, centre, np.trace(moments) * np.eye(3) - moments


def of_body(model):
    body = model.body("fore")
    rotation = axes_of(body)
    return body.mass[0], np.array(body.ipos), rotation @ np.diag(body.inertia) @ rotation.T


def cloud(model):
    """Eight points with the inertia of the model's own body: shape [8, 3] in its principal axes, and their masses."""
    body = model.body("fore")
    extents = np.sqrt((0.5 * body.inertia.sum() - body.inertia) / body.mass[0])
    return np.full(8, body.mass[0] / 8), np.array(list(itertools.product([-1.0, 1.0], repeat=3))) * extents, extents


@pytest.mark.parametrize("seed", range(5))
def test_it_is_that_of_a_cloud_of_points_which_is_stretched_sheared_and_moved(seed):
    x = 0.7 * np.random.default_rng(seed).standard_normal(10)
    found, before = compiled(x)
    masses, points, extents = cloud(before)
    sheared = np.array([[np.exp(x[1]), x[4], x[6]], [0, np.exp(x[2]), x[5]], [0, 0, np.exp(x[3])]])
    warped = extents * ((points / extents) @ sheared.T + x[7:])
    body = before.body("fore")
    expected = of_points(np.exp(2 * x[0]) * masses, body.ipos + warped @ axes_of(body).T)
    for own, other in zip(of_body(found), expected, strict=True):
        np.testing.assert_allclose(own, other, rtol=1e-9, atol=1e-12)


def test_the_models_own_body_is_at_zero_bit_for_bit():
    found, before = compiled(np.zeros(10))
    for field in ("body_mass", "body_ipos", "body_iquat", "body_inertia", "dof_M0", "dof_invweight0"):
        np.testing.assert_array_equal(getattr(found, field), getattr(before, field))
    near, _ = compiled(np.full(10, 1e-9))
    np.testing.assert_allclose(of_body(near)[2], of_body(before)[2], rtol=1e-6, atol=1e-12)


def test_every_draw_is_a_body_that_can_exist():
    """Principal moments satisfy the triangle inequalities over very wide draws, and MuJoCo accepts all of them."""
    rng = np.random.default_rng(0)
    own = inertia.inertial(specification()[1], "fore", "fore")
    for _ in range(2000):
        mass, _, moments, quaternion = own(2.0 * rng.standard_normal(10))
        assert mass > 0 and moments.min() > 0 and np.linalg.norm(quaternion) == pytest.approx(1)
        assert 2 * moments.max() <= moments.sum() * (1 + 1e-12)
    for _ in range(30):
        model, _ = compiled(2.0 * rng.standard_normal(10))
        mass, centre, tensor = of_body(model)
        second = 0.5 * np.trace(tensor) * np.eye(3) - tensor
        pseudo = np.block([[second + mass * np.outer(centre, centre), mass * centre[:, None]], [mass * centre, mass]])
        assert np.linalg.eigvalsh(pseudo)[0] > -1e-12 * np.trace(pseudo)


@pytest.mark.parametrize("size", ["0.2 0.1 1e-6", "0.2 1e-5 1e-5"])
def test_thin_bodies_stay_bodies(size):
    xml = ARM.replace(
        'type="capsule" fromto="0 0 0 0.1 0 -0.3" size="0.015" density="700"', f'type="box" size="{size}" mass="1"'
    )
    rng = np.random.default_rng(1)
    for _ in range(20):
        compiled(rng.standard_normal(10), xml)


def test_simulations_move_as_a_model_with_that_inertia_written_in():
    x = np.array([0.2, 0.1, -0.1, 0.3, 0.1, -0.2, 0.2, 0.3, 0.1, -0.4])
    mass, centre, moments, quaternion = inertia.inertial(specification()[1], "fore", "fore")(x)
    text = lambda values: " ".join(f"{value:.17g}" for value in values)
    own = f'<inertial pos="{text(centre)}" mass="{mass:.17g}" quat="{text(quaternion)}" diaginertia="{text(moments)}"/>'
    written = ARM.replace('<joint name="elbow"', f'{own}<joint name="elbow"')
    several, noises = inertia.parameters("body/fore/inertial", 0.5), {"angle": 0.0}
    rows, _ = mujoco_task(ARM, several, recorded(), ["angle"], noises).simulate.function.clean(x[None])
    expected = recorded(written)
    np.testing.assert_allclose(rows[0, :, 0], expected.signals["angle"], atol=1e-9)
    assert np.abs(rows[0, :, 0] - recorded().signals["angle"]).max() > 0.01


def test_a_table_of_the_file_stands_for_all_ten():
    table = {"parameters": {"body/fore/inertial": {"spread": 0.2, "feasible": [-1, 1]}}}
    several = config.parameters_of(table)
    assert [one.name for one in several] == NAMES
    assert several[3].support == (-0.2, 0.2) and several[3].feasible == (-1.0, 1.0)


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["body/fore/inertial"], r"'body/fore/inertial': expected body/fore/inertial\[0\] to \[9\], or a spread"),
        (["body/fore/inertial[10]"], r"expected body/fore/inertial\[0\] to \[9\]"),
        (["body/for/inertial[1]"], "expected a body such as fore, got 'for'"),
        (["body/*/inertial[1]"], "expected an attribute .*, got 'inertial'"),
        (["body/fore/mass", "body/fore/inertial[1]"], "expected one for each number, got .* of body/fore/mass"),
    ],
)
def test_names_that_are_no_part_of_an_inertia_are_one_line(names, expected):
    spec, model = specification()
    tied = ["shared" if "*" in name else None for name in names]
    with pytest.raises(ValueError, match=expected) as refusal:
        effects(spec, model, names, [(0.1, 0.2)] * len(names), [], tied)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("table", "expected"),
    [
        ({"spread": 0.2, "log": True}, "expected keys among spread, feasible, got log"),
        ({"spread": -1}, "spread: expected a number above 0, got -1"),
        ({"spread": "wide"}, "spread: expected a number, got 'wide'"),
    ],
)
def test_spreads_that_are_none(table, expected):
    with pytest.raises(ValueError, match=expected):
        config.parameters_of({"parameters": {"body/fore/inertial": table}})
    with pytest.raises(ValueError, match="spread: expected for body/NAME/inertial only"):
        config.parameters_of({"parameters": {"body/fore/mass": {"spread": 0.2}}})


def test_a_body_without_a_mass():
    xml = ARM.replace('<site name="tip"', '<body name="empty"/><site name="tip"')
    spec, model = specification(xml)
    with pytest.raises(ValueError, match="expected a body with a mass that extends in space, got empty"):
        effects(spec, model, ["body/empty/inertial[0]"], [(-0.1, 0.1)], [])


def test_parameters_are_as_others():
    assert inertia.parameters("body/fore/inertial", 0.2)[0] == Parameter("body/fore/inertial[0]", (-0.2, 0.2))
