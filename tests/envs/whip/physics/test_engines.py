"""MJX against MuJoCo: kinematics, motion, contacts and failures; and engines by name."""

import collections
import functools
import re
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

mujoco = pytest.importorskip("mujoco")
mjx = pytest.importorskip("mujoco.mjx")

from jaxlfi.envs.whip.parameters import HIGHEST, WhipParameters, median
from jaxlfi.envs.whip.physics.chain import Chain
from jaxlfi.envs.whip.physics.engine import State, reset, rollout
from jaxlfi.envs.whip.physics.engines import pick
from jaxlfi.envs.whip.physics.kinematics import frames
from jaxlfi.envs.whip.physics.mjx_engine import MjxEngine
from jaxlfi.envs.whip.physics.mjx_step import kinematics, solve
from jaxlfi.envs.whip.physics.native import NativeEngine
from jaxlfi.envs.whip.physics.scene import CUBES, Scene, base_model, compile_model

SCENE = Scene()
HIT = 0.036
"""Displacement in the plane of the picture, in m, that counts as a hit."""

# Two by three scenes. In the first two the DLO swings freely: long and soft, short and stiff. In the next three it
# knocks cubes off a stack that stands nearer, each in another way. The last has negative stiffness and damping.
SHAPE = (2, 3)
LENGTH = np.array([0.35, 0.05, 0.25, 0.33, 0.14, 0.25], np.float32).reshape(SHAPE)
YOUNG = np.array([5e2, 5e5, 2.5e4, 1.5e3, 2e5, -1e5], np.float32).reshape(SHAPE)
NEARER = np.broadcast_to(np.array([[0.0, 0.0]] * 2 + [[-0.1, 0.003]] * 4, np.float32).reshape(*SHAPE, 2), (*SHAPE, 2))
TARGETS = np.array(
    [
        [[0.360, 0.420], [0.300, 0.440], [0.360, 0.400], [0.400, 0.460], [0.34, 0.440], [0.29, 0.470]],
        [[0.360, 0.420], [0.300, 0.440], [0.360, 0.400], [0.400, 0.460], [0.34, 0.440], [0.29, 0.470]],
        [[0.363, 0.321], [0.423, 0.261], [0.483, 0.286], [0.543, 0.290], [0.55, 0.246], [0.55, 0.196]],
        [[0.399, 0.403], [0.459, 0.422], [0.519, 0.434], [0.550, 0.474], [0.55, 0.419], [0.55, 0.444]],
        [[0.370, 0.375], [0.430, 0.342], [0.490, 0.297], [0.550, 0.261], [0.55, 0.277], [0.55, 0.279]],
        [[0.360, 0.420], [0.300, 0.440], [0.360, 0.400], [0.400, 0.460], [0.34, 0.440], [0.29, 0.470]],
    ],
    np.float32,
).reshape(*SHAPE, 6, 2)
KNOCKED = [[0, 0, 0, 0, 0, 0]] * 2 + [[0, 1, 1, 1, 1, 1], [0, 0, 0, 0, 0, 1], [0, 0, 0, 1, 1, 1]]
FREE, STABLE, UNSTABLE = slice(2), slice(5), 5
"""Among all six."""


def scenes() -> WhipParameters:
    return median(LENGTH, YOUNG).replace(stack=jnp.asarray(NEARER))


@pytest.fixture(scope="module")
def engine():
    """An engine whose model has no numbers where MJX is not supposed to look for any."""

    original = mjx.put_model

    def put_model(*args, **kwargs):
        model = original(*args, **kwargs)
        names = ["stat.center", "stat.extent", "stat.meanmass", "stat.meansize", "actuator_acc0"]
        nothing = lambda name: jnp.full_like(functools.reduce(getattr, name.split("."), model), jnp.nan)
        return model.tree_replace({name: nothing(name) for name in names})

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mjx, "put_model", put_model)
        return MjxEngine(SCENE)


def rolled(engine, targets=TARGETS, **options) -> State:
    """Rollouts by one program for a batch of two axes, which are then made one."""
    states = jax.jit(jax.vmap(jax.vmap(functools.partial(rollout, engine))), **options)(scenes(), targets)
    return jax.tree.map(lambda leaf: np.asarray(leaf).reshape(6, *leaf.shape[2:]), states)


@pytest.fixture(scope="module")
def by_mjx(engine) -> State:
    return rolled(engine)


@pytest.fixture(scope="module")
def by_native() -> State:
    return rolled(NativeEngine(SCENE, threads=1))


def nodes(states: State) -> np.ndarray:
    """Positions of the freely swinging DLO's nodes, shape [2, time, P, 3]."""
    parameters = jax.tree.map(lambda leaf: leaf.reshape(6, *leaf.shape[2:])[FREE], scenes())
    look = jax.vmap(functools.partial(frames, SCENE), in_axes=(None, 0))
    return np.asarray(jax.jit(jax.vmap(look))(parameters, states.qpos[FREE]).dlo)


def knocked(states: State) -> np.ndarray:
    """Which cubes have been knocked off at any time, in the scenes that are stable."""
    cubes = states.qpos[STABLE, :, SCENE.first_cube :].reshape(5, -1, CUBES, 7)[..., [0, 2]]
    return (np.linalg.norm(cubes - cubes[:, :1], axis=-1) > HIT).any(axis=1)


# ---------------------------------------------------------------------------------------------------- kinematics


@pytest.mark.parametrize("planar", [True, False])
def test_kinematics_are_those_of_mujoco(planar):
    """Checked for bent chains and turned cubes, whose quaternions are not normalised."""
    scene = Scene(chain=Chain(elements=5, planar=planar))
    compiled = compile_model(scene, HIGHEST)
    model, data = mjx.put_model(compiled), mjx.make_data(compiled)
    reference = mujoco.MjData(compiled)
    reference.qpos = compiled.qpos0 + np.random.default_rng(0).normal(size=compiled.nq, scale=0.5)
    mujoco.mj_kinematics(compiled, reference)

    move = jax.jit(lambda qpos: kinematics(scene, model, data.replace(qpos=qpos)))
    ours = jax.device_get(move(jnp.asarray(reference.qpos)))
    for name in ("xpos", "xquat", "xmat", "xipos", "ximat", "xanchor", "xaxis", "geom_xpos", "geom_xmat"):
        expected, actual = getattr(reference, name), getattr(ours, name)
        slides = 2 if name == "xanchor" else 0  # whose anchors are of no consequence
        np.testing.assert_allclose(actual.reshape(expected.shape)[slides:], expected[slides:], atol=1e-6, err_msg=name)
    mujoco.mj_normalizeQuat(compiled, reference.qpos)
    np.testing.assert_allclose(ours.qpos, reference.qpos, atol=1e-6)


def recomputed(program: str) -> int:
    """How often, at most, a number is computed anew in a kernel that XLA fused, as it has no memory of its own."""
    most = 0
    for block in program.split("\n\n"):
        if not block.lstrip().startswith("%fused"):
            continue
        lines = [re.match(r"\s*(ROOT )?%([\w.-]+) = .*?[\w-]+\((.*)", line) for line in block.splitlines()[1:]]
        operands = {line[2]: re.findall(r"%([\w.-]+)", line[3]) for line in lines if line}
        uses = collections.Counter(line[2] for line in lines if line and line[1])
        for name in reversed(operands):
            for operand in operands[name]:
                uses[operand] += uses[name]
        most = max(most, *uses.values())
    return most


@pytest.mark.slow
def test_no_kernel_computes_a_links_ancestors_anew():
    """By default XLA fuses MJX's kinematics into a kernel that takes a thousand times as long as the rest of a step."""

    def program(scene, move):
        model, data = mjx.put_model(base_model(scene)), mjx.make_data(base_model(scene))
        places = jax.jit(jax.vmap(lambda qpos: move(model, data.replace(qpos=qpos)).geom_xpos))
        return places.lower(jnp.zeros((3, model.nq))).compile().as_text()

    for scene in (SCENE, Scene(chain=Chain(planar=False))):
        assert 1 < recomputed(program(scene, functools.partial(kinematics, scene))) < 200
    assert recomputed(program(Scene(chain=Chain(elements=3)), mjx.kinematics)) > 2000


@pytest.mark.slow
def test_double_precision_leaves_states_single():
    with jax.enable_x64(True):
        scene = Scene(chain=Chain(elements=3))
        roll = functools.partial(rollout, MjxEngine(scene), median(), jnp.zeros((2, 2)))
        states = jax.eval_shape(roll)
    assert states.qpos.dtype == states.qvel.dtype == states.target.dtype == jnp.float32


# -------------------------------------------------------------------------------------------------------- solver


def test_the_solver_goes_on_where_single_precision_ends():
    """With a mass matrix that is as little indefinite as rounding makes it; any other is solved as MJX does."""
    compiled, start = base_model(SCENE), reset(SCENE, median())
    model, reference = mjx.put_model(compiled), mujoco.MjData(compiled)
    reference.qpos, reference.ctrl = start.qpos, start.target
    mujoco.mj_forward(compiled, reference)
    data = jax.device_get(mjx.put_data(compiled, reference))
    assert np.any(data._impl.efc_J, axis=1).sum() > 50  # the cubes rest on the table and on each other
    inertia = np.asarray(data._impl.M, np.float64)
    scale = 1 / np.sqrt(np.diag(inertia))
    values, vectors = np.linalg.eigh(scale[:, None] * inertia * scale)
    least = vectors[:, 0] / scale
    broken = inertia - (values[0] + 5e-6) * np.outer(least, least)
    mended = broken + 1e-5 * np.diag(np.diag(inertia))
    with_inertia = lambda matrix: data.tree_replace({"_impl.M": matrix.astype(np.float32)})

    theirs, ours = jax.jit(functools.partial(mjx.solve, model)), jax.jit(functools.partial(solve, model))
    for field in ("qacc", "qfrc_constraint"):
        np.testing.assert_allclose(getattr(ours(data), field), getattr(theirs(data), field), rtol=1e-5, atol=1e-8)
    assert not np.isfinite(theirs(with_inertia(broken)).qacc).all()
    actual = ours(with_inertia(broken)).qacc
    np.testing.assert_allclose(actual, theirs(with_inertia(mended)).qacc, rtol=1e-4, atol=1e-4)
    several = jax.vmap(lambda matrix: ours(with_inertia(matrix)).qacc)(np.float32([inertia, broken]))
    np.testing.assert_allclose(several, [ours(data).qacc, actual], rtol=1e-4, atol=1e-4)


# -------------------------------------------------------------------------------------------------------- parity


@pytest.mark.slow
def test_free_motion_is_that_of_mujoco(by_mjx, by_native):
    """A second of it, of the whole DLO, within 0.1 mm (measured: 0.0005 mm)."""
    assert np.ptp(nodes(by_native)[:, :, -1, 0], axis=1).min() > 0.08  # the tips have moved
    np.testing.assert_allclose(nodes(by_mjx), nodes(by_native), atol=1e-5)
    np.testing.assert_allclose(by_mjx.qpos[FREE, :, -7 * CUBES :], by_native.qpos[FREE, :, -7 * CUBES :], atol=1e-5)


@pytest.mark.slow
def test_cubes_are_knocked_off_as_by_mujoco(by_mjx, by_native):
    """The same ones, by blows whose outcome does not depend on a tenth of a millimetre."""
    nudge = np.random.default_rng(1).normal(size=TARGETS.shape, scale=1e-4).astype(np.float32)
    for states in (by_native, rolled(NativeEngine(SCENE, threads=1), TARGETS + nudge), by_mjx):
        np.testing.assert_array_equal(knocked(states), KNOCKED)


@pytest.mark.parametrize("name", [pytest.param("by_mjx", marks=pytest.mark.slow), "by_native"])
def test_a_simulation_that_breaks_down_is_reported_and_stays(name, request):
    """Its neighbours in the batch go on."""
    states = request.getfixturevalue(name)
    assert not states.failed[STABLE].any()
    failed = states.failed[UNSTABLE]
    assert failed[-1] and not failed[0] and np.all(failed[1:] >= failed[:-1])
    assert np.isfinite(states.qpos).all() and np.isfinite(states.qvel).all()
    last = np.argmax(failed) - 1
    for leaf in (states.qpos, states.qvel):
        np.testing.assert_array_equal(leaf[UNSTABLE, last:], leaf[UNSTABLE, [last] * (7 - last)])


# ---------------------------------------------------------------------------------------------------- by name


def test_engines_by_name(monkeypatch):
    scene = Scene(iterations=11)
    for name, kind in (("native", NativeEngine), ("mjx", MjxEngine)):
        picked = pick(name, scene)
        assert isinstance(picked, kind) and picked.scene == scene
    for platform, kind in (("cpu", NativeEngine), ("gpu", MjxEngine), ("tpu", MjxEngine)):
        monkeypatch.setattr(jax, "default_backend", lambda platform=platform: platform)
        assert isinstance(pick(), kind)


def test_unknown_engines_are_refused():
    with pytest.raises(ValueError, match="engine: expected one of auto, native, mjx, warp, got 'isaac'"):
        pick("isaac")
    with pytest.raises(ValueError, match=r"implementation: expected one of .*, got 'cpp'"):
        MjxEngine(SCENE, "cpp")


@pytest.mark.parametrize(
    ("name", "missing", "advice"),
    [("mjx", "mujoco.mjx", r"pip install 'jaxlfi\[whip\]'"), ("warp", "warp", r"pip install 'mujoco-mjx\[warp\]'")],
)
def test_what_is_not_installed_is_named(name, missing, advice, monkeypatch):
    monkeypatch.setitem(sys.modules, missing, None)
    if name == "mjx":
        monkeypatch.delattr(mujoco, "mjx")
        monkeypatch.delitem(sys.modules, "jaxlfi.envs.whip.physics.mjx_engine")
    with pytest.raises(ImportError, match=f"engine: '{name}' needs .*{advice}"):
        pick(name, Scene(iterations=12))  # one that is not made yet
