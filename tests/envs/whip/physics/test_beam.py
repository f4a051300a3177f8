"""The whipping scene's physics against beam theory and mechanics, and the study that measures them."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

mujoco = pytest.importorskip("mujoco")

from experiments.whip_physics import beam, models, statics
from experiments.whip_physics.__main__ import statistics, table
from experiments.whip_physics.energy import swing
from experiments.whip_physics.measure import DEFAULT, ELEMENTS, SWINGS
from experiments.whip_physics.rollouts import fastest_cube, random_scene, random_targets
from jaxlfi.envs.whip import rules
from jaxlfi.envs.whip.parameters import MEDIAN, median
from jaxlfi.envs.whip.physics import engine as physics
from jaxlfi.envs.whip.physics.chain import Chain
from jaxlfi.envs.whip.physics.kinematics import frames
from jaxlfi.envs.whip.physics.native import NativeEngine
from jaxlfi.envs.whip.physics.scene import Scene, compile_model
from jaxlfi.envs.whip.reference_objects.elastica import heavy_elastica
from jaxlfi.envs.whip.rig import GRAVITY, SECTION, START

OURS = ("ball joints", "planar hinges")
DLO = MEDIAN.replace(length=0.22, young=1.7e4, density=64.0)
"""Not the median, so that nothing is right by chance."""
RIGIDITY, LINE_DENSITY = 1.7e4 * 0.015**4 / 12, 64.0 * 0.015**2
both = pytest.mark.parametrize("kind", OURS)


# ------------------------------------------------------------------------------------------------------- the theory


def test_frequencies_of_a_beam():
    """Tabulated roots of cos(b) cosh(b) = -1."""
    for mode, beta in ((1, 1.8751040687), (2, 4.6940911330), (3, 7.8547574382)):
        assert beam.frequency(mode, 0.5, 3.0, 2.0) == pytest.approx(beta**2 * np.sqrt(3.0 / 2.0 / 0.5**4), rel=1e-9)
    # The ratio of mean squared slope to that of the first mode, by quadrature of its textbook shape.
    s, b = np.linspace(0, 1, 20_001), 1.8751040687
    sigma = (np.cosh(b) + np.cos(b)) / (np.sinh(b) + np.sin(b))
    shape = np.cosh(b * s) - np.cos(b * s) - sigma * (np.sinh(b * s) - np.sin(b * s))
    rotary = np.trapezoid(np.gradient(shape, s) ** 2, s) / np.trapezoid(shape**2, s)
    expected = (1 + 0.01**2 * rotary) ** -0.5
    assert beam.frequency(1, 1.0, 1.0, 1.0, 0.01) / beam.frequency(1, 1.0, 1.0, 1.0) == pytest.approx(
        expected, rel=1e-8
    )


@pytest.mark.parametrize("number", [1e-3, 7.0, 300.0])
def test_the_heavy_elastica_balances_its_weight(number):
    """The curvature everywhere against the moment of all that hangs beyond, by quadrature."""
    s = np.linspace(0, 1, 4001)
    along, below = heavy_elastica(number, s).T
    angle = np.unwrap(np.arctan2(np.gradient(below, s), np.gradient(along, s)))
    area = np.concatenate([[0], np.cumsum((along[1:] + along[:-1]) / 2 * np.diff(s))])
    moment = number * (area[-1] - area - (1 - s) * along)
    curvature = np.gradient(angle, s)
    assert np.abs(curvature - moment)[5:-5].max() < 2e-3 * moment[0]
    np.testing.assert_allclose(np.hypot(np.diff(along), np.diff(below)).sum(), 1.0, rtol=1e-5)
    if number == 1e-3:
        assert below[-1] == pytest.approx(number / 8, rel=1e-5)


# ------------------------------------------------------------------------------------------------------ statics


def tip_error(kind: str, elements: int) -> float:
    load = 1e-3 * RIGIDITY / DLO.length**2
    return statics.tip_deflection(models.model(kind, elements, DLO), load) / (load * DLO.length**3 / 3 / RIGIDITY) - 1


@both
def test_deflection_under_a_small_load(kind):
    """P L^3 / 3 E I to 0.2 %, and to second order in the elements' length."""
    assert abs(tip_error(kind, 12)) < 2e-3
    assert tip_error(kind, 8) / tip_error(kind, 16) == pytest.approx(4.0, rel=0.02)


def test_the_plain_cable_is_too_stiff():
    """It converges only to first order, because its first element does not bend."""
    assert tip_error("plain cable", 12) == pytest.approx(-0.12, abs=0.005)
    assert tip_error("plain cable", 8) / tip_error("plain cable", 16) == pytest.approx(2.0, rel=0.05)


@functools.cache
def sag_error(kind: str, elements: int, number: float) -> np.ndarray:
    """Errors of the tip: relative for how far it hangs down, in lengths of the DLO for how far it reaches."""
    exact = heavy_elastica(number, np.array([1.0]))[0]
    tip = statics.sagged(models.model(kind, elements, models.with_number(DLO, number)), GRAVITY)[-1] / DLO.length
    return np.array([tip[1] / exact[1] - 1, tip[0] - exact[0]])


@pytest.mark.parametrize(
    ("number", "sag", "reach"), [(0.5, 0.004, 1e-4), (24.5, 0.006, 0.003), (400.0, 0.02, 0.009), (1113.0, 0.03, 0.016)]
)
def test_sag_under_its_own_weight(number, sag, reach):
    """Compared with the heavy elastica, from rods to ropes."""
    errors = np.abs(sag_error("planar hinges", 12, number))
    assert errors[0] < sag and errors[1] < reach


def test_sag_converges_and_is_the_same_in_space():
    ratio = sag_error("planar hinges", 6, 24.5) / sag_error("planar hinges", 12, 24.5)
    np.testing.assert_allclose(ratio, 4.0, rtol=0.1)
    np.testing.assert_allclose(sag_error("ball joints", 12, 24.5), sag_error("planar hinges", 12, 24.5), atol=1e-8)


def test_balance_by_mujocos_own_accelerations():
    model = models.model("planar hinges", 12, DLO)
    data = statics.equilibrium(model, np.zeros(3), np.array([GRAVITY, 0.0, 0.0]))
    assert statics.nodes(model, data)[-1, 0] - statics.nodes(model, data)[0, 0] > 0.1
    mujoco.mj_forward(model, data)
    assert np.abs(data.qacc).max() < 1e-4
    model.opt.gravity[0] *= 1.01
    mujoco.mj_forward(model, data)
    assert np.abs(data.qacc).max() > 1.0


def test_what_has_no_equilibrium_is_refused():
    model = models.model("planar hinges", 4, DLO)
    model.jnt_stiffness[:] = 0  # a force along no spring
    with pytest.raises(RuntimeError, match=r"equilibrium: expected torques that balance to 1e-9 .* got "):
        statics.equilibrium(model, np.array([1e-3, 0.0, 0.0]), np.array([np.nan, 0.0, 0.0]))
    with pytest.raises(ValueError, match="kind: expected one of plain cable, ball joints, planar hinges, got 'rope'"):
        models.model("rope", 12, DLO)


# ----------------------------------------------------------------------------------------------------- vibration


@both
def test_natural_frequencies(kind):
    """Compared with a beam with rotary inertia, to second order; the first mode also with the paper's formula."""
    exact = np.array([beam.frequency(mode, 0.22, RIGIDITY, LINE_DENSITY, SECTION / 12**0.5) for mode in (1, 2)])
    errors = {n: statics.frequencies(models.model(kind, n, DLO))[:2] / exact - 1 for n in (6, 12)}
    assert np.all(np.abs(errors[12]) < [0.002, 0.007])
    np.testing.assert_allclose(errors[6] / errors[12], 4.0, rtol=0.1)
    plain = beam.frequency(1, 0.22, RIGIDITY, LINE_DENSITY)
    assert statics.frequencies(models.model(kind, 12, DLO))[0] == pytest.approx(plain, rel=0.002)


def test_a_plucked_beam_comes_back_after_a_period():
    """The linearised frequency against simulation."""
    model = models.model("planar hinges", 12, DLO)
    model.dof_damping[:] = 0
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
    small = 1e-6 * (1 - np.arange(12) / 12)
    period = 2 * np.pi / statics.frequencies(model)[0]
    model.opt.timestep = period / 4000
    data = mujoco.MjData(model)
    data.qpos[:] = small
    last = statics.links(model)[-1]
    displacements = [statics.tip(model, statics.bent(model, data.qpos.copy()), last)[0] - START[0]]
    for _ in range(4000):
        mujoco.mj_step(model, data)
        displacements.append(statics.tip(model, data, last)[0] - START[0])
    displaced = np.array(displacements)[1:] / displacements[0]
    assert displaced[1999] == pytest.approx(-1, abs=0.06)  # the second mode has some part in it
    assert displaced[3999] == pytest.approx(1, abs=0.06)
    assert np.flatnonzero(np.diff(np.sign(displaced))).size == 2


# -------------------------------------------------------------------------------------------------------- energy


def test_energy_is_conserved_without_damping():
    """Energy drifts at the integrator's order: a drift of the model itself would not vanish with the time step."""

    def drift(timestep, runge_kutta):
        model = models.model("planar hinges", 12, MEDIAN)
        model.dof_damping[:] = 0
        return np.abs(swing(model, timestep, 0.6, runge_kutta) - 1).max()

    assert drift(1e-3, False) < 0.05
    assert drift(1e-3, False) / drift(5e-4, False) == pytest.approx(2.0, rel=0.15)
    assert drift(2e-4, True) < 1e-6


@pytest.mark.parametrize(("length", "young"), SWINGS)
def test_energy_never_grows(length, young):
    """Checked with the scene's own time step, damping and air, in all corners of the box."""
    model = models.model("planar hinges", 12, MEDIAN.replace(length=length, young=young))
    model.opt.density = Scene().air
    energy = swing(model, Scene().timestep)
    assert np.diff(energy).max() <= 0
    assert energy[-1] < 0.5


def test_swings_in_space_are_those_in_the_plane():
    planar, ball = (swing(models.model(kind, 12, DLO), 0.002, 0.5) for kind in reversed(OURS))
    np.testing.assert_allclose(planar, ball, atol=1e-9)
    assert planar[-1] < 0.99


# --------------------------------------------------------------------------------------------------- plain mechanics


def test_mass_length_and_inertia_do_not_depend_on_the_number_of_elements():
    for kind in OURS:
        for elements in (3, 12, 31):
            model = models.model(kind, elements, DLO)
            data = statics.bent(model, np.zeros(model.nv))
            line = statics.nodes(model, data)
            mass = 64.0 * SECTION**2 * 0.22
            assert statics.mass(model) == pytest.approx(mass, rel=1e-12)
            np.testing.assert_allclose(line[-1] - line[0], [0, 0, -0.22], atol=1e-7)
            links = statics.links(model)
            below = line[0, 2] - data.xipos[links, 2]
            about_grip = np.sum(model.body_mass[links] * below**2 + model.body_inertia[links, 1])
            assert about_grip == pytest.approx(mass * (0.22**2 / 3 + SECTION**2 / 12), rel=1e-6)


@pytest.mark.parametrize("planar", [True, False])
def test_free_fall(planar):
    """All of the scene alike, the DLO straight, when nothing holds it and there is neither air nor table."""
    model = compile_model(Scene(chain=Chain(planar=planar), air=0.0), DLO)
    model.actuator_gainprm[:] = model.actuator_biasprm[:] = 0
    model.body_gravcomp[:] = 0
    data = mujoco.MjData(model)
    data.qpos[1] += 5.0
    data.qpos[-42:].reshape(6, 7)[:, 2] += 5.0 + 0.1 * np.arange(6)
    mujoco.mj_forward(model, data)
    start = data.xpos.copy()
    for _ in range(100):
        mujoco.mj_step(model, data)
    time = 0.4
    fallen = 0.5 * GRAVITY * time * (time + 0.004)  # Euler's: a step more than in continuous time
    mujoco.mj_kinematics(model, data)
    np.testing.assert_allclose((start - data.xpos)[1:, 2], fallen, rtol=1e-9)
    np.testing.assert_allclose((start - data.xpos)[1:, :2], 0, atol=1e-9)


def test_air_drags_on_falling_cubes():
    """As on plates of drag coefficient 1: v = v_t tanh(g t / v_t), v_t^2 = 2 m g / (rho s^2)."""
    model = compile_model(Scene(), MEDIAN)
    data = mujoco.MjData(model)
    data.ctrl[:] = START
    data.qpos[-42:].reshape(6, 7)[:, 2] += 20.0 + 0.1 * np.arange(6)
    for _ in range(250):
        mujoco.mj_step(model, data)
    terminal = np.sqrt(2 * 100.0 * 0.025 * GRAVITY / 1.2)
    expected = terminal * np.tanh(GRAVITY / terminal)
    np.testing.assert_allclose(data.qvel[-36:].reshape(6, 6)[:, 2], -expected, rtol=3e-3)
    assert expected < 0.65 * GRAVITY


@pytest.mark.parametrize(("side", "density"), [(0.025, 100.0), (0.020, 80.0), (0.030, 120.0)])
def test_the_stack_stands_still_for_five_seconds(side, density):
    model = compile_model(Scene(), MEDIAN.replace(cube_side=side, cube_density=density))
    data = mujoco.MjData(model)
    data.ctrl[:] = START
    data.qvel[-36:] = 1e-6
    start = data.qpos[-42:].reshape(6, 7).copy()
    for _ in range(1250):
        mujoco.mj_step(model, data)
        moved = np.abs(data.qpos[-42:].reshape(6, 7) - start)
        assert moved[:, :3].max() < 0.5e-3 and moved[:, 3:].max() < 0.02
    assert data.time == pytest.approx(5.0)


@pytest.mark.parametrize("planar", [True, False])
def test_mirrored_actions_give_mirrored_motion(planar, key):
    """With the stack far away."""
    engine = NativeEngine(Scene(chain=Chain(planar=planar)), threads=1)
    parameters = median(0.28, 6e3).replace(stack=jnp.array([5.0, 0.0]))
    targets = random_targets(key, False)[:6]
    mirrored = targets.at[:, 0].set(2 * START[0] - targets[:, 0])
    run = jax.jit(jax.vmap(lambda targets: physics.rollout(engine, parameters, targets)))
    states = run(jnp.stack([targets, mirrored]))
    view = jax.jit(jax.vmap(jax.vmap(lambda qpos: frames(engine.scene, parameters, qpos))))(states.qpos)
    one, other = np.asarray(view.dlo)
    assert not states.failed.any() and np.ptp(one[:, -1, 0]) > 0.05
    np.testing.assert_allclose(one * [-1, 1, 1] + [2 * START[0], 0, 0], other, atol=1e-4)
    np.testing.assert_allclose(one[..., 1], 0, atol=1e-6)


# ------------------------------------------------------------------------------------------------------ the study


def test_random_episodes_are_of_all_scenes_and_stay_in_the_workspace(key):
    key_scenes, key_targets = jax.random.split(key)
    scenes = jax.jit(jax.vmap(random_scene))(jax.random.split(key_scenes, 400))
    for value, low, high in ((scenes.length, 0.05, 0.35), (np.log(scenes.young), np.log(500), np.log(5e5))):
        counts, _ = np.histogram(value, bins=4, range=(low, high))
        assert counts.sum() == 400 and counts.min() > 60
    saturated = jnp.arange(200) % 2 == 1
    targets = jax.jit(jax.vmap(random_targets))(jax.random.split(key_targets, 200), saturated)
    assert np.all((targets >= rules.WORKSPACE[0]) & (targets <= rules.WORKSPACE[1]))
    moves = np.abs(np.diff(targets, axis=1, prepend=np.broadcast_to(np.float32(START), (200, 1, 2))))
    assert moves.max() <= rules.ACTION_LIMIT + 1e-6
    assert np.mean(moves[1::2] > 0.0599) > 0.6 and np.mean(moves[::2] > 0.0599) < 0.01
    assert targets[..., 0].min() == rules.WORKSPACE[0, 0] and targets[..., 0].max() == rules.WORKSPACE[1, 0]


def test_the_fastest_cube_by_hand():
    """Velocities, not turning, of cubes, not of the DLO."""
    qvel = np.zeros((3, 14 + 36))
    qvel[1, 13] = qvel[2, 14 + 3] = 99.0
    qvel[1, 14 + 6 : 14 + 9] = [3.0, 0.0, -4.0]
    state = physics.State(
        qpos=jnp.zeros((3, 56)), qvel=jnp.asarray(qvel), target=jnp.zeros((3, 2)), failed=jnp.zeros(3, bool)
    )
    assert fastest_cube(state) == 5.0


def test_the_table_by_hand():
    shape = (3, len(ELEMENTS))
    at = ELEMENTS.index(DEFAULT)
    arrays = {name: np.zeros(shape) for name in ("tip", "mass", "length")} | {"frequency": np.zeros((*shape, 2))}
    arrays["tip"][2, at], arrays["frequency"][1, at, 1] = -0.00174, 0.25
    episodes = {
        "failed": np.array([False, True, False, False]),
        "saturated": np.array([False, True, False, True]),
        "cube": np.array([1.0, 9.0, 4.5, 0.0]),
        "depth": np.array([0.01, 0.5, 0.02, -0.1]),
        "lag": np.array([0.03, 0.9, 0.02, 0.01]),
        "stack median": np.array([1e-4, 2e-4, 3e-4]),
    }
    numbers = statistics(episodes)
    assert numbers["failed"] == numbers["failed_saturated"] == numbers["wild"] == 1
    assert numbers["failed_fraction"] == 0.25
    assert (numbers["fastest_cube"], numbers["deepest"], numbers["greatest_lag"]) == (4.5, 0.02, 0.03)
    assert numbers["stacks"] == {"median": {"lateral": 1e-4, "vertical": 2e-4, "drift": 3e-4}}
    plain, balls, planar = table(arrays, {"planar hinges": {**numbers, "steps_per_second": 1234.6}})
    assert planar["tip_error"] == "-1.74e-03" and balls["second_frequency_error"] == "2.50e-01"
    assert (planar["failed"], planar["rollouts"], planar["steps_per_second"]) == (1, 4, 1235)
    assert plain["failed"] == plain["steps_per_second"] == ""
