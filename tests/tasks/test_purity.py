"""Simulators in JAX whose noise is no function of their key: found by tracing alone."""

import random
import time
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxlfi.distributions.support import Support
from jaxlfi.envs import gaussian_linear, mg1
from jaxlfi.tasks.errors import SimulatorError, SimulatorWarning
from jaxlfi.tasks.observation import simulator_shapes
from jaxlfi.tasks.task import Task
from jaxlfi.tasks.trials import repeated

BOX = Support([0.0, 0.0], [1.0, 1.0])
FIXED = np.random.default_rng(0).normal(size=(2, 2)).astype(np.float32)


def task(simulate) -> Task:
    return Task(simulate, ("a", "b"), {"box": BOX}, BOX)


def scanned(noise):
    """Noise within a loop's body."""
    return lambda key, theta: jax.lax.scan(lambda x, _: (x + noise(), None), theta, length=3)[0]


IMPURE = {
    "np.random": lambda key, theta: theta + np.random.normal(size=2),  # noqa: NPY002
    "a generator": lambda key, theta: theta + np.random.default_rng().normal(size=2),
    "one number": lambda key, theta: theta * np.random.default_rng().uniform(),
    "random": lambda key, theta: theta + random.gauss(0, 1),
    "seeded by the clock": lambda key, theta: theta + np.random.default_rng(time.time_ns()).normal(size=2),
    "seeded by it": lambda key, theta: theta + jax.random.normal(jax.random.key(random.getrandbits(31)), (2,)),
    "besides its key": lambda key, theta: theta + jax.random.normal(key, (2,)) + np.random.default_rng().normal(size=2),
    "jitted": jax.jit(lambda key, theta: theta + np.random.normal(size=2)),  # noqa: NPY002
    "jitted within": lambda key, theta: jax.jit(lambda x: x + np.random.default_rng().normal(size=2))(theta),
    "in a loop": scanned(lambda: np.random.default_rng().normal(size=2)),
}


@pytest.mark.parametrize("simulate", IMPURE.values(), ids=IMPURE)
def test_noise_that_is_drawn_as_jax_traces_is_refused_in_one_line(simulate):
    for made in (task(simulate), repeated(task(simulate), 2)):
        with pytest.raises(
            SimulatorError, match=r"^simulate: expected all noise by jax.random from its key, got"
        ) as error:
            simulator_shapes(made)
        assert "\n" not in str(error.value)


def test_a_jitted_one_is_found_though_it_was_traced_before():
    simulate = jax.jit(lambda key, theta: theta + np.random.default_rng().normal(size=2))
    simulate(jax.random.key(0), jnp.zeros(2))
    with pytest.raises(SimulatorError, match=r"expected all noise by jax.random from its key"):
        simulator_shapes(task(simulate))


def test_a_summary_with_other_numbers_each_time_is_refused():
    draw = lambda trajectory: np.random.default_rng().normal(size=(3, 2)) @ trajectory
    for summary in (draw, jax.jit(draw), lambda trajectory: trajectory + np.random.normal()):  # noqa: NPY002
        made = Task(lambda key, theta: theta, ("a", "b"), {"box": BOX}, BOX, summary=summary)
        for one in (made, repeated(made, 2)):
            with pytest.raises(SimulatorError, match=r"^summary: expected the same function whenever JAX traces it"):
                simulator_shapes(one)
    fixed = Task(lambda key, theta: theta, ("a", "b"), {"box": BOX}, BOX, summary=lambda trajectory: FIXED @ trajectory)
    assert simulator_shapes(fixed).summary == 2


SAME_NOISE = {
    "a key of its own": lambda key, theta: theta + jax.random.normal(jax.random.key(0), (2,)),
    "in a function": lambda key, theta: jax.jit(lambda x: x + jax.random.normal(jax.random.key(7), (2,)))(theta),
    "in a loop": scanned(lambda: jax.random.uniform(jax.random.key(1), (2,))),
    "seeded": lambda key, theta: np.random.seed(0) or theta + np.random.normal(size=2),  # noqa: NPY002
}


@pytest.mark.parametrize("simulate", SAME_NOISE.values(), ids=SAME_NOISE)
def test_the_same_noise_in_all_simulations_is_said(simulate):
    with pytest.warns(SimulatorWarning, match=r"^simulate: draws random numbers, but none of them by the key"):
        simulator_shapes(task(simulate))


PURE = {
    "by its key": lambda key, theta: theta + jax.random.normal(key, (2,)),
    "jitted": jax.jit(lambda key, theta: theta + jax.random.normal(key, (2,))),
    "none": lambda key, theta: theta,
    "none, with a constant": lambda key, theta: FIXED @ theta,
    "fixed features": lambda key, theta: (
        np.random.default_rng(0).normal(size=2) * theta + jax.random.uniform(jax.random.split(key)[1], (2,))
    ),
    "none, but a key is split": lambda key, theta: theta + 0 * jax.random.split(key)[0].size,
    "by folding": lambda key, theta: (
        theta + jax.random.normal(jax.random.fold_in(jax.random.key(3), jax.random.bits(key)), (2,))
    ),
    "in a loop": lambda key, theta: jax.lax.scan(
        lambda x, own: (x + jax.random.normal(own, (2,)), None), theta, jax.random.split(key, 3)
    )[0],
    "not a number": lambda key, theta: jnp.where(theta > 0, theta, np.nan),
}


@pytest.mark.parametrize("made", [*map(task, PURE.values()), gaussian_linear.task(), mg1.task()])
def test_others_pass_without_a_word(made):
    before = np.random.get_state()[1].tolist()  # noqa: NPY002
    with warnings.catch_warnings(), jax.debug_key_reuse(False):  # the checker takes a scan under vmap for a reuse
        warnings.simplefilter("error")
        simulator_shapes(made)
        simulator_shapes(repeated(made, 2))
    assert before == np.random.get_state()[1].tolist()  # noqa: NPY002
