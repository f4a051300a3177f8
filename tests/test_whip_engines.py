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

from envs.whip.apply import apply_parameters
from envs.whip.chain import Chain
from envs.whip.engine import State, rollout
from envs.whip.engines import pick
from envs.whip.kinematics import frames
from envs.whip.mjx_engine import MjxEngine
from envs.whip.mjx_step import kinematics
from envs.whip.native import NativeEngine
from envs.whip.parameters import WhipParameters, median
from envs.whip.scene import CUBES, Scene, base_model, compile_model

SCENE = Scene()
HIT = 0.036
"""Displacement in the plane of the picture, in m, that counts as a hit."""

QUICK = {"xla_backend_optimization_level": 0}
OLD_EMITTERS = {"xla_cpu_use_fusion_emitters": False}
"""They compile faster."""

# Two by two scenes that do not come near the stack: short and stiff, long and soft, long and stiff, the median.
FREE = median(length=np.array([[0.05, 0.35], [0.35, 0.25]]), young=np.array([[5e5, 5e2], [5e5, 2.5e4]]))
SWING = np.array([[0.36, 0.42], [0.30, 0.44], [0.36, 0.40], [0.40, 0.46], [0.34, 0.44], [0.29, 0.47]], np.float32)

# And four that knock cubes off a stack that stands nearer, each in another way.
NEAR = median(length=np.array([[0.25, 0.33], [0.14, 0.3]]), young=np.array([[2.5e4, 1.5e3], [2e5, 1e5]]))
NEAR = NEAR.replace(stack=np.broadcast_to(np.array([-0.1, 0.003], np.float32), (2, 2, 2)))
BLOWS = np.array(
    [
        [[0.363, 0.321], [0.423, 0.261], [0.483, 0.286], [0.543, 0.290], [0.55, 0.246], [0.55, 0.196]],
        [[0.399, 0.403], [0.459, 0.422], [0.519, 0.434], [0.550, 0.474], [0.55, 0.419], [0.55, 0.444]],
        [[0.370, 0.375], [0.430, 0.342], [0.490, 0.297], [0.550, 0.261], [0.55, 0.277], [0.55, 0.279]],
        [[0.381, 0.404], [0.441, 0.391], [0.501, 0.420], [0.550, 0.454], [0.55, 0.490], [0.55, 0.462]],
    ],
    np.float32,
).reshape(2, 2, 6, 2)
KNOCKED = np.array([[0, 1, 1, 1, 1, 1], [0, 0, 0, 0, 0, 1], [0, 0, 0, 1, 1, 1], [0, 0, 0, 0, 1, 1]]).reshape(2, 2, 6)


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


def rolled(engine, **options):
    """Rollouts of two by two scenes by one program, which is compiled once."""
    roll = functools.partial(rollout, engine)
    return jax.jit(jax.vmap(jax.vmap(roll)), **options)


@pytest.fixture(scope="module")
def by_mjx(engine):
    return rolled(engine, compiler_options=QUICK | OLD_EMITTERS)


@pytest.fixture(scope="module")
def by_native():
    return rolled(NativeEngine(SCENE, threads=1))


@pytest.fixture(scope="module")
def blows(by_mjx) -> State:
    return by_mjx(NEAR, BLOWS)


def seen(parameters: WhipParameters, states: State):
    look = jax.vmap(functools.partial(frames, SCENE), in_axes=(None, 0))
    return jax.jit(jax.vmap(jax.vmap(look)))(parameters, states.qpos)


def knocked(states: State) -> np.ndarray:
    """Which cubes have been knocked off at any time."""
    cubes = np.asarray(states.qpos)[..., SCENE.first_cube :].reshape(*states.qpos.shape[:-1], CUBES, 7)[..., [0, 2]]
    return (np.linalg.norm(cubes - cubes[:, :, :1], axis=-1) > HIT).any(axis=2)


# ---------------------------------------------------------------------------------------------------- kinematics


@pytest.mark.parametrize("planar", [True, False])
def test_kinematics_are_those_of_mujoco(planar):
    """Of bent chains and turned cubes whose quaternions are not normalised, in an applied model."""
    scene = Scene(chain=Chain(elements=5, planar=planar))
    parameters = jax.tree.map(lambda leaf: leaf[1, 0], NEAR)
    compiled = compile_model(scene, jax.tree.map(np.float64, parameters))
    model, data = mjx.put_model(base_model(scene)), mjx.make_data(base_model(scene))
    reference = mujoco.MjData(compiled)
    reference.qpos = compiled.qpos0 + np.random.default_rng(0).normal(size=compiled.nq, scale=0.5)
    mujoco.mj_kinematics(compiled, reference)

    move = lambda qpos: kinematics(scene, apply_parameters(scene, model, parameters), data.replace(qpos=qpos))
    ours = jax.device_get(jax.jit(move)(jnp.asarray(reference.qpos)))
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


def test_no_kernel_computes_a_links_ancestors_anew():
    """By default XLA would make one of MJX's kinematics that takes a thousand times as long as the rest of a step."""

    def program(scene, move):
        model, data = mjx.put_model(base_model(scene)), mjx.make_data(base_model(scene))

        def velocities(qpos, qvel):
            moved = move(model, data.replace(qpos=qpos, qvel=qvel))
            return mjx.com_vel(model, mjx.com_pos(model, moved)).cvel

        lowered = jax.jit(jax.vmap(velocities)).lower(jnp.zeros((3, model.nq)), jnp.zeros((3, model.nv)))
        return lowered.compile(QUICK).as_text()

    for scene in (SCENE, Scene(chain=Chain(planar=False))):
        assert 1 < recomputed(program(scene, functools.partial(kinematics, scene))) < 500
    assert recomputed(program(Scene(chain=Chain(elements=3)), mjx.kinematics)) > 5000


# -------------------------------------------------------------------------------------------------------- parity


def test_free_motion_is_that_of_mujoco(by_mjx, by_native):
    """A second of it, of the whole DLO, within 0.1 mm (measured: 0.0005 mm)."""
    targets = np.broadcast_to(SWING, (2, 2, 6, 2))
    ours, reference = by_mjx(FREE, targets), by_native(FREE, targets)
    assert not ours.failed.any() and not reference.failed.any()
    ours, reference = seen(FREE, ours), seen(FREE, reference)
    assert np.ptp(reference.dlo[..., -1, 0], axis=-1).min() > 0.1  # the tips have moved
    np.testing.assert_allclose(ours.dlo, reference.dlo, atol=1e-5)
    np.testing.assert_allclose(ours.cubes, reference.cubes, atol=1e-5)


def test_cubes_are_knocked_off_as_by_mujoco(blows, by_native):
    """The same ones, in blows after which MuJoCo itself does not depend on a tenth of a millimetre."""
    nudge = np.random.default_rng(1).normal(size=BLOWS.shape, scale=1e-4).astype(np.float32)
    for reference in (by_native(NEAR, BLOWS), by_native(NEAR, BLOWS + nudge)):
        np.testing.assert_array_equal(knocked(reference), KNOCKED)
    np.testing.assert_array_equal(knocked(blows), KNOCKED)


@pytest.mark.parametrize("name", ["by_mjx", "by_native"])
def test_a_simulation_that_breaks_down_is_reported_and_stays(name, request, blows):
    """And its neighbours go on, to the bit: a chain of negative stiffness, among others."""
    unstable = NEAR.replace(young=np.array([[2.5e4, -1e5], [2e5, 1e5]], np.float32))
    roll = request.getfixturevalue(name)
    states, others = jax.device_get(roll(unstable, BLOWS)), blows if name == "by_mjx" else roll(NEAR, BLOWS)
    failed = states.failed[0, 1]
    assert failed[-1] and not failed[0] and np.all(np.diff(failed.astype(int)) >= 0)
    last = np.argmax(failed) - 1
    assert np.isfinite(states.qpos).all() and np.isfinite(states.qvel).all()
    np.testing.assert_array_equal(states.qpos[0, 1, last:], states.qpos[0, 1, [last] * (7 - last)])
    for i, j in ((0, 0), (1, 0), (1, 1)):
        assert not states.failed[i, j].any()
        np.testing.assert_array_equal(states.qpos[i, j], others.qpos[i, j])


def test_one_scene_without_a_batch(engine, blows):
    """Through another program than the batch's, from the middle of a rollout."""
    pick_out = lambda tree: jax.tree.map(lambda leaf: leaf[0, 0], tree)
    before, after = (jax.tree.map(lambda leaf, i=i: leaf[i], pick_out(blows)) for i in (1, 2))
    advance = jax.jit(engine.advance, compiler_options=QUICK | OLD_EMITTERS)
    alone = advance(pick_out(NEAR), before, BLOWS[0, 0, 1])
    np.testing.assert_allclose(alone.qpos, after.qpos, atol=1e-5)
    np.testing.assert_array_equal(alone.target, BLOWS[0, 0, 1])
    gone = advance(pick_out(NEAR), before.replace(failed=jnp.asarray(True)), BLOWS[0, 0, 1])
    assert gone.failed
    np.testing.assert_array_equal(gone.qpos, before.qpos)


def test_programs_are_compiled_once(by_mjx, by_native, blows):
    assert by_mjx._cache_size() == by_native._cache_size() == 1


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
def test_what_is_not_installed_is_told(name, missing, advice, monkeypatch):
    monkeypatch.setitem(sys.modules, missing, None)
    if name == "mjx":
        monkeypatch.delattr(mujoco, "mjx")
        monkeypatch.delitem(sys.modules, "envs.whip.mjx_engine")
    with pytest.raises(ImportError, match=f"engine: '{name}' needs .*{advice}"):
        pick(name)
