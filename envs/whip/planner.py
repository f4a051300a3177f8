"""Open-loop plans by the cross-entropy method: actions that hit the top cube of a scene that is known."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from jaxlfi.envs.whip import rules
from jaxlfi.envs.whip.parameters import HIGHEST, WhipParameters
from jaxlfi.envs.whip.physics import engine as physics
from jaxlfi.envs.whip.physics.engine import Engine
from jaxlfi.envs.whip.physics.kinematics import frames
from jaxlfi.envs.whip.physics.scene import START
from jaxlfi.envs.whip.vision.camera import project, side_camera

MARGIN = 0.005
"""How far plans keep the set-point from the limits of the workspace, in m: the DLO pulls the gripper off it."""


@dataclasses.dataclass(frozen=True)
class CrossEntropy:
    """How actions are searched for (Rubinstein, 1999).

    Attributes:
        population: sequences of actions tried in an iteration.
        elites: the best of them, which the next iteration's are like.
        iterations: at most.
        stacks: places of the stack over which the return of an episode is averaged.
        jitter: how far these are from the scene's own place, at most, along x, in m.
        deviation: of an action at first, in m.
        correlation: of an action with the next one's, along the same axis: whipping takes a long move, and uncorrelated
            displacements of a few centimetres go nowhere.
        smoothing: share of the last mean and deviation in the next.
        least: to which deviations shrink at most, in m.
        enough: mean return at which the search ends; 2 is the greatest there is, for the top cube alone everywhere.
    """

    population: int = 48
    elites: int = 6
    iterations: int = 14
    stacks: int = 3
    jitter: float = HIGHEST.stack[0]
    deviation: float = 0.04
    correlation: float = 0.7
    smoothing: float = 0.2
    least: float = 0.004
    enough: float = 1.98


@struct.dataclass
class Search:
    """What the next iteration needs.

    Attributes:
        mean: of actions, in m, shape [16, 2].
        deviation: of each.
        actions: the best so far, shape [16, 2].
        value: their mean return.
    """

    mean: Float[Array, "16 2"]
    deviation: Float[Array, "16 2"]
    actions: Float[Array, "16 2"]
    value: Float[Array, ""]


@struct.dataclass
class Plan:
    """What has been found.

    Attributes:
        actions: displacements dx, dz of the gripper's set-point, in m, shape [16, 2].
        value: their return, the mean over the places of the stack.
        history: of all that was tried, shape [iterations, population]; NaN in iterations that were not needed.
    """

    actions: Float[Array, "16 2"]
    value: Float[Array, ""]
    history: Float[Array, "iterations population"]


@struct.dataclass
class Outcome:
    """What an episode comes to.

    Attributes:
        value: its return, the sum of rewards until it ends.
        hit: cubes hit until then, bottom-up, shape [6].
        outside: whether it ends outside of the workspace.
        failed: or as the simulation has broken down.
        steps: that it takes.
    """

    value: Float[Array, ""]
    hit: Bool[Array, "6"]
    outside: Bool[Array, ""]
    failed: Bool[Array, ""]
    steps: Int[Array, ""]


def plan(key: jax.Array, engine: Engine, parameters: WhipParameters, method: CrossEntropy = CrossEntropy()) -> Plan:
    """Search for actions of a high return in one scene; vmap for many.

    Args:
        key: of all draws.
        engine: of the physics.
        parameters: of the scene.
        method: how to search.

    Example:
        >>> import jax
        >>> from jaxlfi.envs.whip.physics.native import NativeEngine
        >>> from jaxlfi.envs.whip.parameters import median
        >>> method = CrossEntropy(population=4, elites=2, iterations=1, stacks=1)
        >>> plan(jax.random.key(0), NativeEngine(), median(length=0.3), method).actions.shape
        (16, 2)
    """

    def unfinished(carry):
        i, search, _ = carry
        return (i < method.iterations) & (search.value < method.enough)

    def iterate(carry):
        i, search, history = carry
        search, values = step(jax.random.fold_in(key, i), engine, parameters, search, method)
        return i + 1, search, history.at[i].set(values)

    history = jnp.full((method.iterations, method.population), jnp.nan)
    _, search, history = jax.lax.while_loop(unfinished, iterate, (jnp.asarray(0), init(method), history))
    return Plan(search.actions, search.value, history)


def init(method: CrossEntropy) -> Search:
    """Before the first iteration."""
    still = jnp.zeros((rules.STEPS, 2))
    return Search(still, jnp.full_like(still, method.deviation), still, jnp.asarray(-jnp.inf))


def step(
    key: jax.Array, engine: Engine, parameters: WhipParameters, search: Search, method: CrossEntropy
) -> tuple[Search, Float[Array, " population"]]:
    """One iteration: try some, and make the next like the best of them and the best so far.

    Returns:
        The search after it, and the mean returns of what it tried, shape [population].
    """
    noise = jax.random.normal(key, (method.population, rules.STEPS, 2))
    tried = jax.vmap(lambda noise: draw(noise, search.mean, search.deviation, method.correlation))(noise)
    values = jax.vmap(lambda actions: mean_return(engine, parameters, actions, method.stacks, method.jitter))(tried)
    everything = jnp.concatenate([search.actions[None], tried])
    all_values = jnp.concatenate([search.value[None], values])
    _, best = jax.lax.top_k(all_values, method.elites)
    elites = everything[best]
    blend = lambda old, new: method.smoothing * old + (1 - method.smoothing) * new
    after = Search(
        mean=blend(search.mean, elites.mean(axis=0)),
        deviation=jnp.maximum(blend(search.deviation, elites.std(axis=0)), method.least),
        actions=elites[0],
        value=all_values[best[0]],
    )
    return after, values


def draw(
    noise: Float[Array, "16 2"], mean: Float[Array, "16 2"], deviation: Float[Array, "16 2"], correlation: float
) -> Float[Array, "16 2"]:
    """Actions around a mean, correlated in time, that keep the set-point inside of the workspace.

    Args:
        noise: independent, standard normal.
        mean: of actions, in m.
        deviation: of each, in m.
        correlation: of neighbours; it decays geometrically.
    """
    lag = np.subtract.outer(np.arange(rules.STEPS), np.arange(rules.STEPS))
    fresh = np.where(np.arange(rules.STEPS) == 0, 1.0, (1 - correlation**2) ** 0.5)
    mixing = jnp.asarray(np.where(lag >= 0, correlation ** np.maximum(lag, 0) * fresh, 0.0), jnp.float32)
    return inside(mean + deviation * jnp.matmul(mixing, noise, precision="highest"))


def inside(actions: Float[Array, "16 2"]) -> Float[Array, "16 2"]:
    """Actions within their limit, and shortened where they would move the set-point out of the workspace."""

    def move(place, action):
        after = jnp.clip(rules.moved_target(place, action), rules.WORKSPACE[0] + MARGIN, rules.WORKSPACE[1] - MARGIN)
        return after, after - place

    return jax.lax.scan(move, jnp.asarray(START), actions)[1]


def mean_return(
    engine: Engine,
    parameters: WhipParameters,
    actions: Float[Array, "16 2"],
    stacks: int,
    jitter: Float[Array, ""] | float,
) -> Float[Array, ""]:
    """The return of actions, averaged over places of the stack: the middles of equal parts of a range along x.

    Args:
        engine: of the physics.
        parameters: of the scene; its own place of the stack is the middle of the range.
        actions: in m.
        stacks: number of places.
        jitter: half the range, in m.
    """
    middles = (2 * np.arange(stacks) + 1) / stacks - 1
    shifts = jitter * jnp.asarray(np.stack([middles, np.zeros(stacks)], axis=-1), jnp.float32)
    displaced = lambda shift: parameters.replace(stack=parameters.stack + shift)
    return jnp.mean(jax.vmap(lambda shift: play(engine, displaced(shift), actions).value)(shifts))


def play(engine: Engine, parameters: WhipParameters, actions: Float[Array, "16 2"]) -> Outcome:
    """One episode of given actions, as `episode.Whip` has it, but of the cubes only, which are seen without error."""
    camera = side_camera(parameters)
    see = lambda state: project(camera, frames(engine.scene, parameters, state.qpos).cubes)
    first = physics.reset(engine.scene, parameters)
    start = see(first)

    def act(carry, action):
        state, over, before = carry
        state = engine.advance(parameters, state, rules.moved_target(state.target, action))
        hit, out = rules.hits(before.hit, start, see(state)), rules.outside(state.qpos[:2])
        earned = jnp.where(state.failed, 0.0, rules.reward(hit, out))
        outcome = Outcome(before.value + earned, hit, out, state.failed, before.steps + 1)
        outcome = jax.tree.map(lambda old, new: jnp.where(over, old, new), before, outcome)
        over |= hit[rules.TOP] | out | state.failed
        # To the engine an episode that is over has failed: such scenes it need not simulate.
        return (state.replace(failed=over), over, outcome), None

    no = jnp.asarray(False)
    nothing = Outcome(jnp.asarray(0.0), jnp.zeros(6, bool), no, no, jnp.asarray(0))
    return jax.lax.scan(act, (first, no, nothing), actions)[0][2]
