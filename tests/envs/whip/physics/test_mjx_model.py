"""Parameters applied to a model of MJX, against compiling the model anew and against inverting matrices."""

import dataclasses
import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

mujoco = pytest.importorskip("mujoco")
mjx = pytest.importorskip("mujoco.mjx")

from jaxlfi.envs.whip.parameters import FEASIBLE, HIGHEST, LOWEST, WhipParameters
from jaxlfi.envs.whip.physics.chain import Chain
from jaxlfi.envs.whip.physics.mjx_model import apply_parameters, respond
from jaxlfi.envs.whip.physics.scene import Scene, base_model, compile_model

PLANAR, BALLS = Scene(), Scene(chain=Chain(planar=False))
both = pytest.mark.parametrize("scene", [PLANAR, BALLS], ids=["planar", "balls"])

WITHOUT_EFFECT = {".stat.center", ".stat.extent", ".stat.meanmass", ".stat.meansize", ".actuator_acc0"}
"""Of the viewer and of muscles; left as they are."""
DERIVED = {".stat.meaninertia", ".body_subtreemass", ".body_invweight0", ".dof_invweight0", ".dof_M0"}


@functools.cache
def mjx_model(scene: Scene) -> mjx.Model:
    return mjx.put_model(base_model(scene))


NAMES = [field.name for field in dataclasses.fields(WhipParameters)]


@functools.cache
def scenes() -> WhipParameters:
    """The corners of Phi with the nuisances at either end, and some from within, batched."""
    corners = [
        dataclasses.replace(nuisances, length=length, young=young)
        for length, young, nuisances in itertools.product(*np.stack([FEASIBLE.low, FEASIBLE.high]).T, (LOWEST, HIGHEST))
    ]
    generator = np.random.default_rng(5)
    draw = lambda name: generator.uniform(getattr(LOWEST, name), getattr(HIGHEST, name))
    within = [WhipParameters(**{name: draw(name) for name in NAMES}) for _ in range(4)]
    stack = lambda name: np.stack([np.asarray(getattr(one, name), np.float32) for one in (*corners, *within)])
    return WhipParameters(**{name: stack(name) for name in NAMES})


@functools.cache
def applied(scene: Scene) -> dict[str, np.ndarray]:
    """The models of all these scenes, by one compiled program."""
    apply = jax.jit(jax.vmap(functools.partial(apply_parameters, scene, mjx_model(scene))))
    return leaves_of(jax.device_get(apply(scenes())))


def leaves_of(tree) -> dict[str, np.ndarray]:
    return {jax.tree_util.keystr(path): leaf for path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]}


@both
def test_applying_is_compiling(scene):
    """Every field of the model, the inverse inertias among them, to single precision."""
    base, differing = leaves_of(jax.device_get(mjx_model(scene))), set()
    for i in range(len(scenes().length)):
        one = jax.tree.map(lambda leaf, i=i: np.float64(leaf[i]), scenes())
        compiled = leaves_of(jax.device_get(mjx.put_model(compile_model(scene, one))))
        assert compiled.keys() == applied(scene).keys()
        for name in compiled.keys() - WITHOUT_EFFECT:
            rtol = 5e-6 if name in DERIVED else 2e-6
            np.testing.assert_allclose(applied(scene)[name][i], compiled[name], rtol, err_msg=name)
            if not np.array_equal(compiled[name], base[name]):
                differing.add(name)
    assert differing > DERIVED | {".body_pos", ".body_mass", ".jnt_stiffness", ".qpos0", ".geom_rbound"}


def test_a_scene_of_a_batch_is_what_it_is_alone():
    """Whatever the model it is made from."""
    first, other = (jax.tree.map(lambda leaf, i=i: leaf[i], scenes()) for i in (1, 6))
    twice = lambda one, other: apply_parameters(PLANAR, apply_parameters(PLANAR, mjx_model(PLANAR), other), one)
    for name, leaf in leaves_of(jax.device_get(jax.jit(twice)(first, other))).items():
        np.testing.assert_allclose(leaf, applied(PLANAR)[name][1], rtol=1e-6, err_msg=name)


@pytest.mark.slow
@pytest.mark.parametrize("base", [0.8, np.inf])
def test_responses_are_the_inverse_of_the_inertia(base):
    """Uneven links: the kinetic energy's matrix, inverted in double precision."""
    lengths, masses, inertias = np.array([[0.3, 0.1, 0.5], [0.2, 0.05, 0.4], [2e-3, 3e-4, 1e-2]])
    n = len(lengths)
    # Shifts across of the base, the centres and the ends, and rotations, by the speeds of the base and the joints.
    rotations = np.concatenate([np.zeros((n, 1)), np.tril(np.ones((n, n)))], axis=1)
    ends = np.cumsum(lengths[:, None] * rotations, axis=0) + np.eye(1, n + 1)
    centres = ends - lengths[:, None] / 2 * rotations
    finite = 1e12 if np.isinf(base) else base
    matrix = centres.T @ np.diag(masses) @ centres + rotations.T @ np.diag(inertias) @ rotations
    matrix[0, 0] += finite
    inverse = np.linalg.inv(matrix)
    response = respond(*(jnp.asarray(x, jnp.float32) for x in (lengths, masses, inertias)), base)
    close = functools.partial(np.testing.assert_allclose, rtol=2e-6)
    close(response.base, 0.0 if np.isinf(base) else inverse[0, 0], atol=1e-11)
    close(response.joints, np.diag(inverse)[1:])
    close(response.centres, np.diag(centres @ inverse @ centres.T))
    close(response.rotations, np.diag(rotations @ inverse @ rotations.T))
