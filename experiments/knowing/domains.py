"""Domains of each arm: draws of an object's mass and friction to train on, from one recording or from none."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

import jaxlfi
from experiments.knowing.slide import EXPLORING, FEASIBLE, GUESS, NOISE, SPACE, moved, recorded, trajectory
from jaxlfi.rl.domains import limits_of, of_belief
from jaxlfi.rl.randomisation import dropo, simopt
from jaxlfi.rl.randomisation.gaussian import Gaussian

OBJECTS: dict[str, tuple[float, float]] = {
    "inside": (0.9, 0.3),
    "slippery": (1.2, 0.12),
    "heavy": (1.7, 0.35),
    "light": (0.4, 0.1),
}
"""Mass (kg) and friction: the first is inside of the guess, the others outside in friction, in mass, and in both."""
POOL = 512
"""Number of points of a domain."""
STEPS, DRAWS = 15, 100
"""Number of steps of SimOpt, and of simulations in each."""
DROPO = dropo.Dropo(lookahead=4, epsilon=2.0)
"""Settings of DROPO. States are in standard deviations of their noise, which both ends of a transition have."""
STARTS = 5
"""Number of least-squares searches."""


def recording(name: str) -> Float[np.ndarray, "after 2"]:
    """The recording of an object."""
    key = jax.random.key(100 + list(OBJECTS).index(name))
    return np.asarray(recorded(key, jnp.asarray(OBJECTS[name]), jnp.asarray(EXPLORING)))


def _scaled(states: jax.Array) -> jax.Array:
    return states / jnp.asarray(NOISE)


def _seen(key: jax.Array, theta: jax.Array) -> jax.Array:
    return _scaled(recorded(key, theta, jnp.asarray(EXPLORING))[1:]).ravel()


@functools.cache
def task() -> jaxlfi.Task:
    """The task of inferring mass and friction from a recording."""
    return jaxlfi.Task(
        _seen,
        names=SPACE.names,
        units=("kg", ""),
        log=SPACE.names,
        supports={"guess": GUESS},
        feasible=FEASIBLE,
    )


def posterior(name: str) -> Float[np.ndarray, "pool 2"]:
    """Draws of EDGE's posterior, from the guess."""
    run = jaxlfi.infer(0, task(), _scaled(recording(name)[1:]).ravel(), heuristic=jaxlfi.Edge())
    return np.asarray(of_belief(jax.random.key(1), run.belief, run.space, limits_of(run), POOL).theta)


def fitted(name: str) -> Float[np.ndarray, "pool 2"]:
    """The least-squares point within Phi, repeated."""
    measured = recording(name)
    low, high = (np.log(np.asarray(side, float)) for side in (FEASIBLE.low, FEASIBLE.high))
    clean = jax.jit(lambda log: trajectory(jnp.exp(log), jnp.asarray(EXPLORING)))
    residuals = lambda log: np.asarray(_scaled(clean(jnp.asarray(log)) - measured)).ravel()
    starts = np.random.default_rng(0).uniform(low, high, (STARTS, 2))
    found = [least_squares(residuals, start, bounds=(low, high), diff_step=1e-3) for start in starts]
    return np.tile(np.exp(min(found, key=lambda one: one.cost).x), (POOL, 1)).astype(np.float32)


def by_simopt(name: str) -> Float[np.ndarray, "pool 2"]:
    """Draws of the Gaussian that SimOpt reaches from one as wide as the guess."""
    box, settings, measured = SPACE.box_to_inference(GUESS), simopt.SimOpt(), jnp.asarray(recording(name))
    simulated = lambda log: trajectory(SPACE.to_natural(log), jnp.asarray(EXPLORING))

    @jax.jit
    def step(now: Gaussian, key: jax.Array) -> Gaussian:
        theta = now.sample(key, DRAWS)
        costs = simopt.discrepancy(settings, jax.vmap(simulated)(theta), measured, 1 / jnp.asarray(NOISE))
        return simopt.step(settings, now, theta, costs)

    now = Gaussian(box.centre, jnp.diag(box.width**2 / 12))
    for key in jax.random.split(jax.random.key(2), STEPS):
        now = step(now, key)
    return np.asarray(now.domain(jax.random.key(3), SPACE, FEASIBLE, POOL).theta)


def by_dropo(name: str) -> Float[np.ndarray, "pool 2"]:
    """Draws of the Gaussian that DROPO finds within Phi."""

    def simulate(theta, state, actions):
        position, velocity = state * jnp.asarray(NOISE)
        for (force,) in actions:
            position, velocity = moved(theta, position, velocity, force)
        return _scaled(jnp.stack([position, velocity]))

    states = np.maximum(recording(name), 0.0)  # states that the simulator can start from
    logged = dropo.transitions(_scaled(states), EXPLORING[:, None], DROPO.lookahead)
    found = dropo.fit(4, simulate, logged, SPACE, FEASIBLE, DROPO)
    return np.asarray(found.domain(jax.random.key(5), SPACE, FEASIBLE, POOL).theta)


def truth(name: str) -> Float[np.ndarray, "pool 2"]:
    """The object itself, repeated."""
    return np.tile(np.asarray(OBJECTS[name], np.float32), (POOL, 1))


OWN = {"oracle": truth, "posterior": posterior, "least squares": fitted, "SimOpt": by_simopt, "DROPO": by_dropo}
"""Arms that use information about the object."""


def broad(box: jaxlfi.Support) -> Float[np.ndarray, "pool 2"]:
    """Draws from a box, uniform in the logarithms."""
    return np.asarray(SPACE.to_natural(SPACE.box_to_inference(box).sample(jax.random.key(6), POOL)))
