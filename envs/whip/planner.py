"""Open-loop plans by the cross-entropy method: actions that hit the top cube of a known scene."""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from jaxlfi.envs.whip import rules
from jaxlfi.envs.whip.aftermath import Aftermath
from jaxlfi.envs.whip.parameters import HIGHEST, WhipParameters
from jaxlfi.envs.whip.physics import engine as physics
from jaxlfi.envs.whip.physics.engine import Engine, State
from jaxlfi.envs.whip.physics.kinematics import frames
from jaxlfi.envs.whip.rig import START
from jaxlfi.envs.whip.settling import aftermath
from jaxlfi.envs.whip.vision.camera import project, side_camera

MARGIN = 0.005
"""Margin of planned set-points to the limits of the workspace, in m, as the DLO pulls the gripper off its set-point."""


@dataclasses.dataclass(frozen=True)
class CrossEntropy:
    """Settings of the search for actions (Rubinstein, 1999).

    Attributes:
        population: number of action sequences per iteration.
        elites: number of best sequences that the next iteration's distribution is fitted to.
        iterations: maximum number of iterations.
        stacks: number of positions of the stack over which the return of an episode is averaged.
        jitter: maximum distance of these positions from the scene's own, along x, in m.
        deviation: initial standard deviation of an action, in m.
        correlation: correlation of successive actions along the same axis: whipping takes a long move, and
            uncorrelated displacements of a few centimetres go nowhere.
        smoothing: weight of the previous mean and standard deviation in the next ones.
        min_deviation: lower bound of the standard deviations, in m.
        target_return: mean return at which the search ends; the maximum is 2, for hitting only the top cube at every
            position.
    """

    population: int = 48
    elites: int = 6
    iterations: int = 14
    stacks: int = 3
    jitter: float = HIGHEST.stack[0]
    deviation: float = 0.04
    correlation: float = 0.7
    smoothing: float = 0.2
    min_deviation: float = 0.004
    target_return: float = 1.98


class Search(struct.PyTreeNode):
    """State of the search between two iterations.

    Attributes:
        mean: mean of the actions, in m, shape [16, 2].
        deviation: standard deviation of each action, in m, shape [16, 2].
        actions: the best actions so far, in m, shape [16, 2].
        value: mean return of the best actions.
    """

    mean: Float[Array, "16 2"]
    deviation: Float[Array, "16 2"]
    actions: Float[Array, "16 2"]
    value: Float[Array, ""]


class Plan(struct.PyTreeNode):
    """The result of a search.

    Attributes:
        actions: displacements dx, dz of the gripper's set-point, in m, shape [16, 2].
        value: their mean return over the positions of the stack.
        history: mean returns of all sequences that were tried, shape [iterations, population]; NaN in iterations that
            were not needed.
    """

    actions: Float[Array, "16 2"]
    value: Float[Array, ""]
    history: Float[Array, "iterations population"]


class Outcome(struct.PyTreeNode):
    """The outcome of an episode.

    Attributes:
        value: its return, the sum of rewards until it ends.
        hit: cubes hit by its end, bottom-up, shape [6].
        outside: whether it ends because the gripper has left the workspace.
        failed: whether it ends because the simulation has become unstable.
        steps: its number of control steps.
    """

    value: Float[Array, ""]
    hit: Bool[Array, "6"]
    outside: Bool[Array, ""]
    failed: Bool[Array, ""]
    steps: Int[Array, ""]


def plan(
    key: jax.Array,
    engine: Engine,
    parameters: WhipParameters,
    method: CrossEntropy = CrossEntropy(),
    on_iteration: Callable[[], None] | None = None,
) -> Plan:
    """Search for actions of a high return in one scene; vmap for many.

    Args:
        key: consumed.
        engine: the physics.
        parameters: parameters of the scene.
        method: settings of the search.
        on_iteration: called on the host after each iteration, to show progress.

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
        return (i < method.iterations) & (search.value < method.target_return)

    def iterate(carry):
        i, search, history = carry
        search, values = step(jax.random.fold_in(key, i), engine, parameters, search, method)
        if on_iteration is not None:
            jax.debug.callback(on_iteration)
        return i + 1, search, history.at[i].set(values)

    history = jnp.full((method.iterations, method.population), jnp.nan)
    _, search, history = jax.lax.while_loop(unfinished, iterate, (jnp.asarray(0), init(method), history))
    return Plan(search.actions, search.value, history)


def init(method: CrossEntropy) -> Search:
    """The search before its first iteration."""
    still = jnp.zeros((rules.STEPS, 2))
    return Search(still, jnp.full_like(still, method.deviation), still, jnp.asarray(-jnp.inf))


def step(
    key: jax.Array, engine: Engine, parameters: WhipParameters, search: Search, method: CrossEntropy
) -> tuple[Search, Float[Array, " population"]]:
    """One iteration: try a population, and fit the next distribution to the best of it and the best so far.

    Returns:
        The search after the iteration, and the mean returns of its population, shape [population].
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
        deviation=jnp.maximum(blend(search.deviation, elites.std(axis=0)), method.min_deviation),
        actions=elites[0],
        value=all_values[best[0]],
    )
    return after, values


def draw(
    noise: Float[Array, "16 2"], mean: Float[Array, "16 2"], deviation: Float[Array, "16 2"], correlation: float
) -> Float[Array, "16 2"]:
    """Actions around a mean, correlated in time, that keep the set-point inside the workspace.

    Args:
        noise: independent standard normal numbers.
        mean: mean of the actions, in m.
        deviation: standard deviation of each action, in m.
        correlation: correlation of successive actions; it decays geometrically with their lag.
    """
    lag = np.subtract.outer(np.arange(rules.STEPS), np.arange(rules.STEPS))
    innovation = np.where(np.arange(rules.STEPS) == 0, 1.0, (1 - correlation**2) ** 0.5)
    mixing = jnp.asarray(np.where(lag >= 0, correlation ** np.maximum(lag, 0) * innovation, 0.0), jnp.float32)
    return inside(mean + deviation * jnp.matmul(mixing, noise, precision="highest"))


def random_walk(key: jax.Array) -> Float[Array, "16 2"]:
    """Actions of the first distribution of a search: a random walk in the workspace."""
    method = CrossEntropy()
    first = init(method)
    return draw(jax.random.normal(key, first.mean.shape), first.mean, first.deviation, method.correlation)


def inside(actions: Float[Array, "16 2"]) -> Float[Array, "16 2"]:
    """Actions clipped to their limit, and shortened if they would move the set-point out of the workspace."""

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
    """The return of actions, averaged over positions of the stack: the midpoints of equal parts of a range along x.

    Args:
        engine: the physics.
        parameters: parameters of the scene; its own position of the stack is the middle of the range.
        actions: displacements of the set-point, in m.
        stacks: number of positions.
        jitter: half the range, in m.
    """
    middles = (2 * np.arange(stacks) + 1) / stacks - 1
    shifts = jitter * jnp.asarray(np.stack([middles, np.zeros(stacks)], axis=-1), jnp.float32)
    displaced = lambda shift: parameters.replace(stack=parameters.stack + shift)
    return jnp.mean(jax.vmap(lambda shift: play(engine, displaced(shift), actions).value)(shifts))


def play(engine: Engine, parameters: WhipParameters, actions: Float[Array, "16 2"]) -> Outcome:
    """One episode of given actions, under the rules of `episode.Whip`, with cubes that are seen without error."""
    return _played(engine, parameters, actions)[1]


def left(engine: Engine, parameters: WhipParameters, actions: Float[Array, "16 2"]) -> Aftermath:
    """What an episode of given actions leaves behind."""
    state, outcome = _played(engine, parameters, actions)
    return aftermath(engine, parameters, state.replace(failed=outcome.failed))


def _played(engine: Engine, parameters: WhipParameters, actions: Float[Array, "16 2"]) -> tuple[State, Outcome]:
    """The state in which an episode ends, marked as failed by whatever ended it, and its outcome."""
    camera = side_camera(parameters)
    see = lambda state: project(camera, frames(engine.scene, parameters, state.qpos).cubes)
    first = physics.reset(engine.scene, parameters)
    start = see(first)

    def act(carry, action):
        state, over, before = carry
        state = physics.act(engine, parameters, state, action)
        now = rules.judge(before.hit, start, see(state), state.qpos[:2], state.failed)
        outcome = Outcome(before.value + now.reward, now.hit, now.outside, state.failed, before.steps + 1)
        outcome = jax.tree.map(lambda old, new: jnp.where(over, old, new), before, outcome)
        over |= now.over
        return (state.stopped(over), over, outcome), None

    no = jnp.asarray(False)
    nothing = Outcome(jnp.asarray(0.0), jnp.zeros(6, bool), no, no, jnp.asarray(0))
    state, _, outcome = jax.lax.scan(act, (first, no, nothing), actions)[0]
    return state, outcome
