"""The whipping scene's model against what was declared, its edits against compiling anew, and its native engine."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

mujoco = pytest.importorskip("mujoco")

from jaxlfi.envs.whip.parameters import (
    HIGHEST,
    LOWEST,
    MEDIAN,
    NUISANCES,
    WhipParameters,
    check,
    median,
    randomised,
)
from jaxlfi.envs.whip.physics import engine as physics
from jaxlfi.envs.whip.physics.chain import Chain, elasto_gravity
from jaxlfi.envs.whip.physics.edits import edited_model
from jaxlfi.envs.whip.physics.kinematics import frames, initial_positions
from jaxlfi.envs.whip.physics.native import NativeEngine
from jaxlfi.envs.whip.physics.scene import Scene, base_model, compile_model, refuse_plugins
from jaxlfi.envs.whip.rig import START

PLANAR, BALLS = Scene(), Scene(chain=Chain(planar=False))
NAMES = ("length", "young", *NUISANCES)
both = pytest.mark.parametrize("scene", [PLANAR, BALLS], ids=["planar", "balls"])


def within_ranges(fractions) -> WhipParameters:
    """Parameters at these fractions of their ranges, per entry of `NAMES` (two for the stack, three for the camera)."""
    fractions = iter(fractions)
    values = {}
    for name in NAMES:
        low, high = np.asarray(getattr(LOWEST, name)), np.asarray(getattr(HIGHEST, name))
        values[name] = low + (high - low) * np.reshape([next(fractions) for _ in range(low.size)], low.shape)
    return WhipParameters(**values)


def some_parameters() -> list[WhipParameters]:
    """Corners of Phi with the nuisances at their least or greatest, and a few from within."""
    corners = [
        [length, young, *[nuisances] * 10] for length, young, nuisances in ((0, 0, 1), (0, 1, 0), (1, 0, 0), (1, 1, 1))
    ]
    return [within_ranges(fractions) for fractions in [*corners, *np.random.default_rng(3).uniform(size=(3, 12))]]


def links(model) -> list[int]:
    return [i for i in range(model.nbody) if model.body(i).name.startswith("link")]


# ------------------------------------------------------------------------------------------------ what was declared


@both
@pytest.mark.parametrize("elements", [5, 12])
def test_links_are_a_square_beam(scene, elements):
    scene = dataclasses.replace(scene, chain=dataclasses.replace(scene.chain, elements=elements))
    parameters = MEDIAN.replace(length=0.31, young=7e3, density=88.0)
    model = compile_model(scene, parameters)
    lengths = 0.31 / elements * np.array([0.5, *[1.0] * (elements - 1), 0.5])
    masses = 88.0 * 0.015**2 * lengths
    bodies, geoms = links(model), [model.body(i).geomadr[0] for i in links(model)]
    assert len(bodies) == elements + 1
    np.testing.assert_allclose(model.body_mass[bodies], masses, rtol=1e-12)
    assert model.body_mass[bodies].sum() == pytest.approx(88.0 * 0.015**2 * 0.31, rel=1e-12)
    np.testing.assert_allclose(model.body_inertia[bodies][:, 0], masses * (0.015**2 + 0.015**2) / 12, rtol=1e-12)
    for axis in (1, 2):
        np.testing.assert_allclose(model.body_inertia[bodies][:, axis], masses * (0.015**2 + lengths**2) / 12)
    np.testing.assert_allclose(model.body_iquat[bodies], np.tile([1.0, 0, 0, 0], (elements + 1, 1)), atol=1e-12)
    np.testing.assert_allclose(model.body_ipos[bodies], lengths[:, None] / 2 * [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(model.body_pos[bodies[1:]], lengths[:-1, None] * [1, 0, 0], atol=1e-7)
    np.testing.assert_allclose(model.geom_size[geoms][:, :2].T, [[0.0075] * (elements + 1), lengths / 2], atol=1e-8)
    # E I / h and (tau E + eta_0) I / h
    inertia, h = 0.015**4 / 12, 0.31 / elements
    joints = [j for j in range(model.njnt) if model.joint(j).name.startswith("joint")]
    dofs = (model.jnt_dofadr[joints][:, None] + np.arange(scene.chain.dofs)).ravel()
    assert len(joints) == elements and set(model.jnt_bodyid[joints]) == set(bodies[1:])
    np.testing.assert_allclose(model.jnt_stiffness[joints], 7e3 * inertia / h, rtol=1e-12)
    np.testing.assert_allclose(model.dof_damping[dofs], (0.005 * 7e3 + 60.0) * inertia / h, rtol=1e-12)
    assert not model.dof_armature.any() and not model.dof_frictionloss.any()


@both
def test_the_rest_of_the_scene(scene):
    parameters = MEDIAN.replace(cube_side=0.022, cube_density=110.0)
    model = compile_model(scene, parameters)
    cubes = [model.body(f"{colour} cube").id for colour in ("red", "green", "blue", "orange", "purple", "yellow")]
    np.testing.assert_allclose(model.body_mass[cubes], 110.0 * 0.022**3, rtol=1e-12)
    np.testing.assert_allclose(model.body_inertia[cubes], 110.0 * 0.022**3 * 0.022**2 / 6, rtol=1e-12)
    np.testing.assert_allclose(model.geom_size[[model.body(i).geomadr[0] for i in cubes]], 0.011, rtol=1e-12)
    gripper = model.body("gripper").id
    assert model.body_mass[gripper] == 1.0
    np.testing.assert_array_equal(model.body_gravcomp, np.arange(model.nbody) == gripper)
    np.testing.assert_array_equal(model.actuator_gainprm[:, 0], [900, 900])
    np.testing.assert_array_equal(model.actuator_biasprm[:, :3], [[0, -900, -60]] * 2)
    np.testing.assert_allclose(model.opt.gravity, [0, 0, -9.81])
    # 6 + 15 cubes on the table and each other, 13 x 6 links on cubes, 12 on the table, 6 under the gripper
    assert model.npair == 6 + 15 + 13 * 6 + 12 + 6 == 117
    assert not model.geom_contype.any() and not model.geom_conaffinity.any()
    np.testing.assert_array_equal(model.pair_dim, 3)
    assert model.nplugin == 0 and model.neq == 0
    assert model.nq == 2 + 12 * (1 if scene.chain.planar else 4) + 42
    assert model.nv == 2 + 12 * (1 if scene.chain.planar else 3) + 36


@both
def test_simulations_that_fail_are_not_reset(scene):
    """Automatic resets would make them look like scenes at rest."""
    model = compile_model(scene)
    assert model.opt.disableflags == mujoco.mjtDisableBit.mjDSBL_AUTORESET
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER
    assert model.opt.iterations == 10 and model.opt.ls_iterations == 20 and model.opt.timestep == 0.004


def test_plugins_are_refused():
    cable = """
    <mujoco><extension><plugin plugin="mujoco.elasticity.cable"/></extension><worldbody><body>
      <composite prefix="c" type="cable" vertex="0 0 0 .1 0 0 .2 0 0 .3 0 0" initial="none">
        <plugin plugin="mujoco.elasticity.cable"><config key="bend" value="1e5"/></plugin>
        <joint kind="main"/><geom type="capsule" size=".0075" density="75"/>
      </composite></body></worldbody></mujoco>"""
    with pytest.raises(ValueError, match="model: expected no plugins, as MJX ignores them silently, got 1"):
        refuse_plugins(mujoco.MjModel.from_xml_string(cable))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("length", 0.049),
        ("length", 0.351),
        ("young", 499.0),
        ("young", np.nan),
        ("density", 101.0),
        ("poisson", 0.29),
        ("cube_side", 0.031),
        ("cube_density", 79.0),
        ("stack", (0.0, 0.006)),
        ("camera", (0.0, -0.026, 0.0)),
        ("length", [0.2, 0.36]),
        ("stack", 0.0),
    ],
)
def test_impossible_parameters_are_refused_by_name(name, value):
    with pytest.raises(ValueError, match=f"^{name}: expected .* got "):
        check(MEDIAN.replace(**{name: value}))


def test_possible_parameters(key):
    drawn = jax.jit(jax.vmap(lambda key: randomised(key, 0.35, 500.0)))(jax.random.split(key, 100))
    for parameters in (LOWEST, HIGHEST, MEDIAN, drawn, median(jnp.array([0.05, 0.3]), 5e5)):
        assert check(parameters) is parameters
    for name in NUISANCES:  # all of the range, each axis for itself
        low, high = np.asarray(getattr(LOWEST, name)), np.asarray(getattr(HIGHEST, name))
        fraction = (np.asarray(getattr(drawn, name)) - low) / (high - low)
        assert np.all(fraction.min(axis=0) < 0.1) and np.all(fraction.max(axis=0) > 0.9)


def test_elasto_gravity_numbers():
    assert elasto_gravity(0.25, 2.5e4, 75.0) == pytest.approx(24.525)
    assert elasto_gravity(0.305, 1e3, 75.0) == pytest.approx(1113.3, rel=1e-4)


# ------------------------------------------------------------------------------------------- editing and compiling

FOR_DISPLAY = {"meanmass", "meansize", "extent", "center"}
"""Statistics of a model that its physics do not use."""


def fields(model) -> dict[str, np.ndarray]:
    """All numbers of a model."""
    numbers = {name: getattr(model, name) for name in dir(model) if not name.startswith("_")}
    numbers = {name: value for name, value in numbers.items() if isinstance(value, np.ndarray)}
    numbers |= {f"opt.{name}": np.asarray(getattr(model.opt, name)) for name in dir(model.opt) if name[0] != "_"}
    statistics = [name for name in dir(model.stat) if name[0] != "_" and name not in FOR_DISPLAY]
    numbers |= {f"stat.{name}": np.asarray(getattr(model.stat, name)) for name in statistics}
    return {name: value.astype(float) for name, value in numbers.items() if value.dtype.kind in "biuf" and value.size}


@both
def test_editing_is_compiling(scene):
    """Every field of the compiled model, what MuJoCo derives too."""
    changed, base = set(), fields(base_model(scene))
    for parameters in some_parameters():
        expected, got = fields(compile_model(scene, parameters)), fields(edited_model(scene, parameters))
        assert set(expected) == set(got) and len(expected) > 100
        apart = [name for name, value in expected.items() if not close(got[name], value)]
        assert not apart
        changed |= {name for name, value in expected.items() if not close(value, base[name])}
    assert {"body_mass", "jnt_stiffness", "dof_damping", "geom_rbound", "dof_invweight0", "stat.meaninertia"} <= changed


def close(got: np.ndarray, expected: np.ndarray) -> bool:
    """Equality up to the single precision in which MuJoCo places a cable's vertices."""
    return got.shape == expected.shape and np.abs(got - expected).max() <= 2e-6 * np.abs(expected).max()


def test_editing_leaves_the_base_alone():
    before = fields(base_model(PLANAR))
    edited_model(PLANAR, HIGHEST)
    after = fields(base_model(PLANAR))
    assert all(np.array_equal(after[name], value) for name, value in before.items())


# ------------------------------------------------------------------------------------------------------ kinematics


@both
def test_initial_positions_are_those_of_the_model(scene):
    for parameters in some_parameters():
        expected = compile_model(scene, parameters).qpos0
        np.testing.assert_allclose(initial_positions(scene, parameters), expected, rtol=0, atol=1e-7)


@both
def test_the_cubes_begin_at_rest(scene):
    """Sunk in as far as their weight wants, whatever their size and density."""
    for parameters in some_parameters():
        model = compile_model(scene, parameters)
        data = mujoco.MjData(model)
        data.ctrl[:] = START
        mujoco.mj_forward(model, data)
        assert data.ncon == 24
        assert np.abs(data.qacc[-36:].reshape(6, 6)[:, :3]).max() < 0.005 * 9.81


@both
def test_where_everything_is(scene):
    """Compared with MuJoCo's forward kinematics at random poses."""
    rng = np.random.default_rng(5)
    where = jax.jit(functools.partial(frames, scene))
    for parameters in some_parameters()[-3:]:
        model = compile_model(scene, parameters)
        data = mujoco.MjData(model)
        mujoco.mj_integratePos(model, data.qpos, rng.normal(scale=0.5, size=model.nv), 1.0)
        mujoco.mj_forward(model, data)
        seen = where(jax.tree.map(jnp.float32, parameters), jnp.asarray(data.qpos, jnp.float32))
        bodies = links(model)
        half = 2 * data.xipos[bodies] - data.xpos[bodies]  # links' far ends: twice the way to their centres
        np.testing.assert_allclose(seen.dlo, [*data.xpos[bodies], half[-1]], atol=2e-6)
        np.testing.assert_allclose(seen.dlo[1:], half, atol=2e-6)
        np.testing.assert_allclose(seen.gripper, data.body("gripper").xpos[[0, 2]], atol=1e-6)
        cubes = [model.body(i).id for i in range(model.nbody) if model.body(i).name.endswith(" cube")]
        np.testing.assert_allclose(seen.cubes, data.xpos[cubes], atol=1e-6)
        np.testing.assert_allclose(seen.orientations, data.xquat[cubes], atol=1e-6)
        assert np.ptp(seen.dlo[:, 0]) > 0.01


# ---------------------------------------------------------------------------------------------------- native engine

SWEEP = jnp.asarray(START) + 0.045 * jnp.array([[-1, 0.5], [0, 0], [1, 0], [2.5, -0.5], [4, -0.5], [4, -0.5]])
"""Set-points of six steps that swing the longest DLO into the stack."""


@functools.cache
def engine(planar: bool = True, threads: int = 1) -> NativeEngine:
    return NativeEngine(PLANAR if planar else BALLS, threads=threads)


@functools.partial(jax.jit, static_argnums=0)
def sweep_all(engine, scenes):
    return jax.vmap(lambda parameters: physics.rollout(engine, parameters, SWEEP))(scenes)


def three_scenes() -> WhipParameters:
    """As different as can be, the second one's stack aside."""
    scenes = median(jnp.array([0.35, 0.2, 0.35]), jnp.array([1e5, 2e3, 600.0]))
    return scenes.replace(
        density=jnp.array([100.0, 60.0, 50.0]),
        cube_side=jnp.array([0.03, 0.02, 0.024]),
        stack=jnp.array([[-0.02, 0.0], [0.02, 0.005], [0.0, 0.0]]),
    )


def touches(model, data) -> bool:
    """Whether the DLO or the gripper touches a cube."""
    cubes = [model.geom(i).name.endswith(" cube") for i in range(model.ngeom)]
    table = model.geom("table").id
    return any(cubes[a] != cubes[b] and table not in (a, b) for a, b in data.contact.geom)


@both
def test_a_rollout_is_a_plain_simulation(scene):
    """Step by step by MuJoCo's own step, the set-point ramped, with a model of its own for each scene."""
    batch = three_scenes()
    states = sweep_all(engine(scene.chain.planar), batch)
    assert not states.failed.any()
    first_touch = []
    for i in range(3):
        model = compile_model(scene, jax.tree.map(lambda leaf, i=i: np.asarray(leaf[i], np.float64), batch))
        data = mujoco.MjData(model)
        before, touched = np.asarray(START), []
        for step, target in enumerate(np.asarray(SWEEP)):
            hits = 0
            for substep in range(40):
                data.ctrl[:] = before + substep / 40 * (target - before)
                mujoco.mj_step(model, data)
                hits += touches(model, data)
            before = target
            touched.append(hits > 0)
            if any(touched):  # from then on small differences become large ones
                assert not np.array_equal(states.qpos[i, step + 1, -42:], states.qpos[i, 0, -42:])
            else:
                np.testing.assert_allclose(states.qpos[i, step + 1, :-42], data.qpos[:-42], atol=1e-5)
                np.testing.assert_allclose(states.qvel[i, step + 1, :-36], data.qvel[:-36], atol=1e-3)
                np.testing.assert_allclose(states.qpos[i, step + 1, -42:], data.qpos[-42:], atol=2e-3)
        first_touch.append(touched.index(True) if any(touched) else None)
    assert first_touch[0] in (4, 5)


def test_rollouts_are_the_same_every_time_and_one_by_one():
    batch = three_scenes()
    together, again = sweep_all(engine(), batch), sweep_all(engine(), batch)
    threaded = sweep_all(engine(threads=2), batch)
    alone = [sweep_all(engine(), jax.tree.map(lambda leaf, i=i: leaf[i : i + 1], batch)) for i in range(3)]
    for one, *others in zip(*map(jax.tree.leaves, (together, again, threaded)), strict=True):
        for other in others:
            np.testing.assert_array_equal(one, other)
    for i in range(3):
        jax.tree.map(lambda one, row, i=i: np.testing.assert_array_equal(one[0], row[i]), alone[i], together)


@pytest.mark.parametrize("name", ["length", "young", "density", "cube_side", "cube_density", "stack"])
def test_every_parameter_has_its_effect(name):
    """On a scene in which the DLO hits the stack."""
    base = jax.tree.map(lambda leaf: leaf[:1], three_scenes())
    other = base.replace(**{name: getattr(base, name) * 0.97 - (0.002 if name == "stack" else 0.0)})
    both = sweep_all(engine(), jax.tree.map(lambda *leaves: jnp.concatenate(leaves), base, other))
    assert np.abs(both.qpos[0, -1] - both.qpos[1, -1]).max() > 1e-4


@pytest.mark.parametrize("name", ["poisson", "camera"])
def test_what_physics_do_not_depend_on(name):
    base = jax.tree.map(lambda leaf: leaf[:1], three_scenes())
    other = base.replace(**{name: getattr(base, name) + 0.01})
    both = sweep_all(engine(), jax.tree.map(lambda *leaves: jnp.concatenate(leaves), base, other))
    np.testing.assert_array_equal(both.qpos[0], both.qpos[1])


def test_a_simulation_that_breaks_down_stays_where_it_was(tmp_path, monkeypatch):
    """Its neighbours in the batch go on."""
    monkeypatch.chdir(tmp_path)  # MuJoCo writes a log
    batch = jax.tree.map(lambda leaf: leaf[:2], three_scenes())
    start = jax.vmap(functools.partial(physics.reset, PLANAR))(batch)
    broken = start.replace(qvel=start.qvel.at[0, 5].set(1e12))
    advance = jax.jit(jax.vmap(engine().advance))
    targets = jnp.tile(SWEEP[:1], (2, 1))
    after = advance(batch, broken, targets)
    np.testing.assert_array_equal(after.failed, [True, False])
    np.testing.assert_array_equal(after.qpos[0], start.qpos[0])
    np.testing.assert_array_equal(after.qpos[1], advance(batch, start, targets).qpos[1])
    later = advance(batch, after, targets)
    np.testing.assert_array_equal(later.failed, [True, False])
    np.testing.assert_array_equal(later.qpos[0], start.qpos[0])
