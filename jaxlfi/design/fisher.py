"""Expected information of experiments from their Fisher information, for smooth simulators with Gaussian noise.

A measurement y = f(theta, d) + e with noise e of covariance S has the Fisher information F = J' S^-1 J, J = df/dtheta.
In the Gaussian approximation the covariance C of a belief becomes (C^-1 + F)^-1, and the information gain is half the
logarithm of det(I + C F): Bayesian D-optimality (Chaloner and Verdinelli 1995, sections 2 and 4), averaged here over
theta in each region. The information about a subset of the parameters is half the logarithm of the ratio of the
determinants of their covariance blocks; for one parameter this is c-optimality. The other criterion is A-optimality,
the mean ratio of variances.

If the noise is declared (`Design.noise`, `Task.channel_noise`), y is the whole trajectory, and S is diagonal.
Otherwise y is the summary, and its mean derivatives and S are estimated from repeated simulations with the same random
numbers for all parameters. Derivatives from two halves of the repetitions are multiplied with each other, so that their
own noise does not count as information, and S^-1 is made unbiased for normal summaries (Hartlap, Simon and Schneider
2007). In both cases, the information in how the noise depends on the parameters is left out.
"""

import dataclasses
import functools
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlfi.design.regions import Region
from jaxlfi.design.simulations import flat_noise, in_chunks, jacobian, noise_of, one_of, response
from jaxlfi.distributions.precision import single
from jaxlfi.tasks.simulation import summarised
from jaxlfi.tasks.task import Task

DRAWS, DRAWS_ON_HOST = 64, 16
"""Number of parameter vectors over which a design's information is averaged in each region; fewer outside JAX."""
LEAST_ON_HOST = 4
"""Smallest such number outside JAX, for regions of little weight."""
REPEATS = 64
"""Number of simulations at each of them if the noise is not declared."""
STEP = 0.1
"""Step of finite differences, in standard deviations of a region."""

Criterion = Literal["information", "variance"]


@dataclasses.dataclass(frozen=True, eq=False)
class FisherRater:
    """Rates designs by Fisher information.

    The evidence is a tuple with the matrices F [M, N, D, D] of each region; it adds up over experiments.

    Attributes:
        key: random key of the noise.
        task: task of one experiment, with a design.
        regions: regions to average over.
        about: parameter combinations of interest, in inference space, as rows, shape [A, D]; None for all parameters.
        criterion: "information" in bits, or "variance": minus the mean over `about` (or all parameters) of the variance
            after the experiment as a fraction of that before, which is A-optimality.
        draws: number of draws of each region. By default 64; outside JAX, 16 in the region of the largest weight, and
            in proportion to their weights in the others, but at least 4.
        repeats: number of simulations at each draw if the noise is not declared.
    """

    key: jax.Array
    task: Task
    regions: tuple[Region, ...]
    about: Float[np.ndarray, "wanted dim"] | None = None
    criterion: Criterion = "information"
    draws: int | None = None
    repeats: int = REPEATS
    _known: dict[tuple[int, bytes], np.ndarray] = dataclasses.field(default_factory=dict, init=False, repr=False)
    """Cached matrices by region and design, outside JAX: batches rate the same designs several times."""

    @property
    def ceiling(self) -> float:
        """Upper limit of the value, in bits; there is none."""
        return np.inf

    def evidence(self, designs: Float[np.ndarray, "designs k"], slot: int = 0) -> tuple[np.ndarray, ...]:
        """Fisher information of designs in each region, in inference space, zero where a simulation fails."""
        return tuple(self._matrices(place, designs) for place in range(len(self.regions)))

    def precision(
        self, designs: Float[np.ndarray, "designs k"], slot: int = 0
    ) -> Float[np.ndarray, "designs n dim dim"]:
        """Fisher information of designs in the first region, that of the posterior."""
        return self._matrices(0, designs)

    def terms(self, evidence: tuple[np.ndarray, ...]) -> list[Float[np.ndarray, "designs n"]]:
        """Values of designs at each parameter vector, region by region: bits, or minus a fraction of the variance."""
        return [
            worth(region.factor, matrices, self.about, self.criterion)
            for region, matrices in zip(self.regions, evidence, strict=True)
        ]

    def _matrices(self, place: int, designs: np.ndarray) -> np.ndarray:
        region = self.regions[place]
        theta = region.draws[: self.draws or self._usual(region)]
        steps = STEP * np.sqrt(np.diagonal(region.covariance))
        if self.task.on_host:
            for design in designs:
                if (place, design.tobytes()) not in self._known:
                    self._known[place, design.tobytes()] = _on_host(self.task, theta, steps, design)
            return np.stack([self._known[place, design.tobytes()] for design in designs])
        inner = jnp.asarray(theta, jnp.float32), jnp.asarray(steps, jnp.float32)
        if noise_of(self.task) is not None:
            return in_chunks(lambda part: _declared(self.task, jax.random.clone(self.key), *inner, part), designs)
        keys = jax.random.split(jax.random.clone(self.key), self.repeats)
        return in_chunks(lambda part: _estimated(self.task, jax.random.clone(keys), *inner, part), designs)

    def _usual(self, region: Region) -> int:
        """Default number of draws of a region."""
        if not self.task.on_host:
            return DRAWS
        return max(round(DRAWS_ON_HOST * region.weight / max(one.weight for one in self.regions)), LEAST_ON_HOST)


def worth(
    factor: Float[np.ndarray, "dim dim"],
    matrices: Float[np.ndarray, "*n dim dim"],
    about: Float[np.ndarray, "wanted dim"] | None = None,
    criterion: Criterion = "information",
) -> Float[np.ndarray, "*n"]:
    """Value of Fisher information to a Gaussian belief: bits, or minus the mean remaining fraction of the variances.

    Args:
        factor: lower Cholesky factor of the belief's covariance.
        matrices: Fisher information F.
        about: parameter combinations of interest, as rows; None for all parameters.
        criterion: "information" or "variance".

    Example:
        >>> gained = worth(np.eye(2), np.diag([3.0, 0.0]))  # a variance of 1 becomes 1/4
        >>> float(gained), float(worth(np.eye(2), np.diag([3.0, 0.0]), np.array([[0.0, 1.0]])))
        (1.0, 0.0)
    """
    inner = _inner(factor, matrices)
    if about is None and criterion == "information":
        return 0.5 * np.sum(np.log2(np.maximum(np.linalg.eigvalsh(inner), 1.0)), axis=-1)
    rows = (np.eye(len(factor)) if about is None else about) @ factor
    after = rows @ np.linalg.inv(inner) @ rows.T
    before = rows @ rows.T
    if criterion == "variance":
        return -np.mean(np.diagonal(after, axis1=-2, axis2=-1) / np.diagonal(before), axis=-1)
    return 0.5 * (np.linalg.slogdet(before)[1] - np.linalg.slogdet(after)[1]) / np.log(2)


def covariance_after(
    factor: Float[np.ndarray, "dim dim"], matrices: Float[np.ndarray, "*n dim dim"]
) -> Float[np.ndarray, "*n dim dim"]:
    """The covariance (C^-1 + F)^-1 after an experiment of a Gaussian belief with covariance C = L L'.

    Args:
        factor: Cholesky factor L.
        matrices: Fisher information F.
    """
    return factor @ np.linalg.inv(_inner(factor, matrices)) @ factor.T


def _inner(factor: np.ndarray, matrices: np.ndarray) -> np.ndarray:
    """I + L' F L, which has the determinant of I + C F."""
    return np.eye(len(factor)) + factor.T @ np.asarray(matrices, np.float64) @ factor


@functools.partial(jax.jit, static_argnums=0)
@single
def _declared(task: Task, key: jax.Array, theta: Array, steps: Array, designs: Array) -> Array:
    """Fisher information of a trajectory with known noise, shape [M, N, D, D]."""

    def one(theta: Array, design: Array) -> Array:
        flat = lambda theta: response(task, key, theta, design).ravel()
        shape = jax.eval_shape(lambda theta: response(task, key, theta, design), theta).shape
        value, slope = jacobian(flat, theta, steps)
        scaled = slope / flat_noise(_noise(task), shape)[:, None]
        fine = jnp.all(jnp.isfinite(value)) & jnp.all(jnp.isfinite(scaled))
        if task.design.response is None:
            fine &= one_of(task, key, theta, design)[1] == 0
        scaled = jnp.where(fine, scaled, 0.0)
        return jnp.matmul(scaled.T, scaled, precision="highest")

    return jax.vmap(jax.vmap(one, (0, None)), (None, 0))(theta, designs)


def _noise(task: Task) -> tuple[float, ...]:
    noise = noise_of(task)
    assert noise is not None
    return noise


@functools.partial(jax.jit, static_argnums=0)
@single
def _estimated(task: Task, keys: jax.Array, theta: Array, steps: Array, designs: Array) -> Array:
    """Fisher information of a summary with unknown noise, shape [M, N, D, D]."""
    count = len(keys)

    def one(theta: Array, design: Array) -> Array:
        def summary(key: jax.Array, theta: Array) -> tuple[Array, Array]:
            return summarised(task, *one_of(task, key, theta, design))

        x, failure = jax.vmap(summary, (0, None))(keys, theta)
        slopes = jax.vmap(lambda key: jacobian(lambda theta: summary(key, theta)[0], theta, steps)[1])(keys)
        fine = jnp.all(failure == 0) & jnp.all(jnp.isfinite(slopes))
        size = x.shape[-1]
        covariance = jnp.cov(x, rowvar=False).reshape(size, size)
        scale = jnp.sqrt(jnp.diagonal(covariance)) + 1e-12
        correlation = covariance / jnp.outer(scale, scale) + 1e-4 * jnp.eye(size)
        first, second = (jnp.mean(slopes[part::2], axis=0) / scale[:, None] for part in (0, 1))
        unbiased = max(count - size - 2, 1) / (count - 1)
        matrix = unbiased * first.T @ jnp.linalg.solve(correlation, second)
        values, axes = jnp.linalg.eigh(0.5 * (matrix + matrix.T))
        matrix = (axes * jnp.maximum(values, 0.0)) @ axes.T
        return jnp.where(fine, jnp.nan_to_num(matrix), 0.0)

    return jax.lax.map(lambda design: jax.vmap(one, (0, None))(theta, design), designs)


def _on_host(task: Task, theta: np.ndarray, steps: np.ndarray, design: np.ndarray) -> np.ndarray:
    """Fisher information of a declared response outside JAX, by one-sided differences in one batch, shape [N, D, D].

    Differences are forward at every other point and backward at the rest. So the errors from curvature nearly cancel in
    the mean over points, as with central differences, with D + 1 simulations for each point in place of 2 D.
    """
    count, dim = theta.shape
    offsets = np.concatenate([np.zeros((1, dim)), np.diag(steps)])
    sign = np.where(np.arange(count) % 2, -1.0, 1.0)[:, None, None]
    points = (theta[:, None] + sign * offsets).reshape(-1, dim)
    natural = np.asarray(task.space.to_natural(jnp.asarray(points, jnp.float32)), float)
    values = np.asarray(task.design.response(natural, np.asarray(design, float)), float)
    shape = values.shape[1:]
    values = values.reshape(count, 1 + dim, -1)
    slope = sign * (values[:, 1:] - values[:, :1]) / steps[:, None]  # [N, D, outputs]
    slope = np.where(np.isfinite(slope).all(axis=(1, 2), keepdims=True), slope, 0.0)
    scaled = slope / np.asarray(flat_noise(_noise(task), shape))
    return scaled @ np.swapaxes(scaled, -1, -2)
