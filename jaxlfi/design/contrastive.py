"""Expected information gain of experiments from a contrastive lower bound, for any simulator.

Prior contrastive estimation (Foster, Jankowiak, O'Meara, Teh and Rainforth 2020): given parameters theta_1..theta_n
and a simulation y_i of each, the information is at least

    E log [ p(y_i | theta_i) / (1/n sum_j p(y_i | theta_j)) ],

where the n contrasts include the theta_i that produced y_i. The bound holds for any critic in place of the likelihood
(van den Oord, Li and Vinyals 2018; Foster et al. 2021, section 3): a worse critic makes it looser, never invalid, as
long as it was not fitted to the simulations that it is evaluated on. It cannot exceed log n.

If the noise is declared and there is a noise-free response, the critic is the likelihood itself. Otherwise it is a
likelihood fitted to simulations: the summaries are normal, with a mean that is quadratic in the parameters and
variances that are log-linear in them. Simulations are divided into `FOLDS`, and the critic of each fold is fitted to
the others.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from jaxlfi.design.fisher import FisherRater
from jaxlfi.design.regions import Region
from jaxlfi.design.simulations import CHUNK, flat_noise, in_chunks, noise_of, response, simulated
from jaxlfi.distributions.precision import single
from jaxlfi.tasks.task import Task

SIMULATIONS = 1024
"""Number of simulations of each design in each region."""
FOLDS = 4
"""Number of parts that simulations are divided into, each evaluated by a critic fitted to the others."""
DIRECT = 0.02
"""Largest number of summaries, per simulation, that the critic uses directly; if there are more, it uses the best
linear predictors of the parameters."""
QUADRATIC = 6
"""Largest number of parameters for which the critic's mean has all products of two; with more, it has only squares."""
RIDGE = 1e-3
"""Ridge penalty on a critic's coefficients, per simulation."""
POINTS = 64
"""Number of parameter vectors at which a critic's Fisher information is evaluated."""
LOG_CHI_SQUARED = -1.2704
"""Mean of the logarithm of a chi-squared variable with one degree of freedom."""


class Critic(struct.PyTreeNode):
    """A likelihood fitted to simulations of one design: log q(x | theta), up to a function of x.

    Attributes:
        centre: mean of the summaries, shape [S].
        scale: standard deviation of the summaries, shape [S].
        reduce: matrix from a constant and the scaled summaries to the compared features, shape [S + 1, Q].
        mean: coefficients of the features' mean in the basis of the parameters, shape [P, Q].
        whiten: whitening matrix of the residuals, shape [Q, Q].
        spread: coefficients of the whitened residuals' log-variances, shape [1 + D, Q].
    """

    centre: Float[Array, " obs"]
    scale: Float[Array, " obs"]
    reduce: Float[Array, "obs_and_one q"]
    mean: Float[Array, "basis q"]
    whiten: Float[Array, "q q"]
    spread: Float[Array, "dim_and_one q"]

    def seen(self, x: Float[Array, "n obs"]) -> Float[Array, "n q"]:
        """The features of the summaries that are compared."""
        scaled = _squashed((x - self.centre) / self.scale)
        return jnp.matmul(_with_one(scaled), self.reduce, precision="highest")

    def __call__(self, t: Float[Array, "n dim"], x: Float[Array, "m obs"]) -> Float[Array, "m n"]:
        """The log-critic of all summaries at all whitened parameters t."""
        y = self.seen(x) @ self.whiten
        m = basis(t) @ self.mean @ self.whiten
        log_variance = self.log_variance(t)
        squared = jnp.sum((y[:, None] - m[None]) ** 2 * jnp.exp(-log_variance)[None], axis=-1)
        return -0.5 * (squared + jnp.sum(log_variance, axis=-1))

    def log_variance(self, t: Float[Array, "n dim"]) -> Float[Array, "n q"]:
        """Log-variances of the whitened residuals."""
        return jnp.clip(_with_one(t) @ self.spread, -6.0, 6.0)

    def fisher(self, t: Float[Array, " dim"]) -> Float[Array, "dim dim"]:
        """Its Fisher information about t."""
        slope = jax.jacfwd(lambda t: basis(t[None])[0] @ self.mean @ self.whiten)(t)
        own, by_variance = jnp.exp(-self.log_variance(t[None])[0]), self.spread[1:].T
        return slope.T @ (own[:, None] * slope) + 0.5 * by_variance.T @ by_variance


def basis(t: Float[Array, "n dim"]) -> Float[Array, "n basis"]:
    """One, the parameters, and their pairwise products, shape [N, P]."""
    rows, columns = np.triu_indices(t.shape[1]) if t.shape[1] <= QUADRATIC else (np.arange(t.shape[1]),) * 2
    return jnp.concatenate([_with_one(t), t[:, rows] * t[:, columns]], axis=1)


def fitted(
    t: Float[Array, "n dim"], x: Float[Array, "n obs"], weight: Float[Array, " n"], reduced: bool, targets: int
) -> Critic:
    """A critic fitted to simulations.

    Args:
        t: whitened parameters.
        x: summaries.
        weight: 1 for simulations to fit, 0 for held-out ones.
        reduced: whether the summaries are replaced by the best linear predictors of t.
        targets: number of parameters, counted from the first, that these predict: those of interest.
    """
    total = jnp.sum(weight) + 1e-6
    average = lambda values: weight @ values / total
    centre = average(x)
    scale = jnp.sqrt(average((x - centre) ** 2)) + 1e-12 * (1 + jnp.abs(centre))
    y = _with_one(_squashed((x - centre) / scale))
    size = y.shape[1] - 1
    if reduced:
        reduce = _regression(y, t[:, :targets], weight, penalty=20 * RIDGE)
    else:
        reduce = jnp.eye(size + 1)[:, 1:]
    y = jnp.matmul(y, reduce, precision="highest")
    features = basis(t)
    mean = _regression(features, y, weight)
    residual = y - features @ mean
    covariance = (residual * weight[:, None]).T @ residual / total
    deviation = jnp.sqrt(jnp.diagonal(covariance)) + 1e-6
    correlation = covariance / jnp.outer(deviation, deviation)
    correlation = 0.999 * correlation + 0.001 * jnp.eye(len(deviation))
    inverse = jax.scipy.linalg.solve_triangular(jnp.linalg.cholesky(correlation), jnp.eye(len(deviation)), lower=True)
    whiten = (inverse / deviation).T
    level = jnp.log((residual @ whiten) ** 2 + 1e-3) - LOG_CHI_SQUARED
    spread = _regression(_with_one(t), level, weight)
    # The variances are scaled to match their mean: the mean logarithm is biased if residuals are not normal.
    ratio = average((residual @ whiten) ** 2 * jnp.exp(-jnp.clip(_with_one(t) @ spread, -6.0, 6.0)))
    spread = spread.at[0].add(jnp.log(ratio + 1e-6))
    return Critic(centre, scale, reduce, mean, whiten, spread)


def bound(log_critic: Float[np.ndarray, "*n contrasts contrasts"]) -> Float[np.ndarray, "*n contrasts"]:
    """Terms of the contrastive bound, in bits: their mean is at most the information, and at most log2 n.

    Args:
        log_critic: log-critic of simulation i at parameters j, shape [..., n, n].

    Example:
        >>> float(bound(np.array([[0.0, -100.0], [-100.0, 0.0]])).mean())  # two that are told apart: one bit
        1.0
    """
    log_critic = np.asarray(log_critic, np.float64)
    highest = log_critic.max(axis=-1, keepdims=True)
    log_mean = highest[..., 0] + np.log(np.mean(np.exp(log_critic - highest), axis=-1))
    return (np.diagonal(log_critic, axis1=-2, axis2=-1) - log_mean) / np.log(2)


@dataclasses.dataclass(frozen=True, eq=False)
class ContrastiveRater:
    """Rates designs by the contrastive bound.

    For each region, the evidence is the log-critic of every simulation at every parameter vector, [M, folds, n, n].
    Simulations of several experiments are independent given the parameters, so that their evidence adds up.

    Attributes:
        key: random key of the simulations; each place in a batch has its own noise.
        task: task of one experiment, with a design.
        regions: regions to average over.
        about: parameter combinations of interest, in inference space, as rows, shape [A, D], to which the critic is
            then restricted; None for all parameters.
        simulations: number of simulations of each design in each region.
    """

    key: jax.Array
    task: Task
    regions: tuple[Region, ...]
    about: Float[np.ndarray, "wanted dim"] | None = None
    simulations: int = SIMULATIONS

    @property
    def explicit(self) -> bool:
        """Whether the likelihood serves as critic: noise and response are declared, and no combination is selected."""
        known = noise_of(self.task) is not None and self.task.design.response is not None
        return known and self.about is None and not self.task.on_host

    @property
    def ceiling(self) -> float:
        """Upper limit of the bound, in bits."""
        return float(np.log2(self.simulations // (1 if self.explicit else FOLDS)))

    def evidence(self, designs: Float[np.ndarray, "designs k"], slot: int = 0) -> tuple[np.ndarray, ...]:
        """Log-critics in each region."""
        return tuple(self._critics(place, region, designs, slot) for place, region in enumerate(self.regions))

    def terms(self, evidence: tuple[np.ndarray, ...]) -> list[Float[np.ndarray, "designs n"]]:
        """Terms of the bound in bits, region by region."""
        return [bound(one).reshape(len(one), -1) for one in evidence]

    def precision(
        self, designs: Float[np.ndarray, "designs k"], slot: int = 0
    ) -> Float[np.ndarray, "designs n dim dim"]:
        """Fisher information in inference space, of the response if it is known, or else of the fitted likelihood."""
        region = self.regions[0]
        if noise_of(self.task) is not None and self.task.design.response is not None:
            return FisherRater(self.key, self.task, (region,)).precision(designs)
        theta, t, inverse = self._whitened(region, None)
        runs = simulated(self._key(0, slot), self.task, theta, designs)
        reduced = self._reduced(runs.x.shape[-1])
        x, fine = jnp.asarray(runs.x, jnp.float32), jnp.asarray(runs.fine, jnp.float32)
        each = lambda x, fine: _fisher(t, x, fine, jnp.asarray(t[:POINTS]), reduced)
        found = np.stack([np.asarray(each(*one)) for one in zip(x, fine, strict=True)])
        return inverse.T @ found @ inverse

    def _critics(self, place: int, region: Region, designs: np.ndarray, slot: int) -> np.ndarray:
        key = self._key(place, slot)
        theta, t, _ = self._whitened(region, self.about)
        if self.explicit:
            keys = jax.random.split(key, len(theta))
            inner = jnp.asarray(theta, jnp.float32)
            return in_chunks(lambda part: _likelihoods(self.task, jax.random.clone(keys), inner, part), designs)
        found = []
        for first in range(0, len(designs), CHUNK):
            runs = simulated(key, self.task, theta, designs[first : first + CHUNK])
            reduced, targets = self._reduced(runs.x.shape[-1]), t.shape[1]
            x, fine = jnp.asarray(runs.x, jnp.float32), jnp.asarray(runs.fine, jnp.float32)
            found += [np.asarray(_folded(t, *one, reduced, targets)) for one in zip(x, fine, strict=True)]
        return np.stack(found)

    def _whitened(self, region: Region, about: np.ndarray | None) -> tuple[np.ndarray, Array, np.ndarray]:
        """Parameters [n, D], the whitened combinations of interest [n, A], and their whitening matrix."""
        theta = region.draws[: self.simulations // FOLDS * FOLDS]
        rows = np.eye(theta.shape[1]) if about is None else about
        factor = dataclasses.replace(region, covariance=rows @ region.covariance @ rows.T).factor
        inverse = np.linalg.inv(factor)
        t = (theta - region.draws.mean(axis=0)) @ rows.T @ inverse.T
        return theta, jnp.asarray(t, jnp.float32), inverse

    def _reduced(self, summaries: int) -> bool:
        return summaries > max(DIRECT * self.simulations, 2)

    def _key(self, place: int, slot: int) -> jax.Array:
        return jax.random.fold_in(jax.random.fold_in(jax.random.clone(self.key), slot), place)


@functools.partial(jax.jit, static_argnums=(3, 4))
@single
def _folded(t: Array, x: Array, fine: Array, reduced: bool, targets: int) -> Array:
    """Log-critics [folds, n / folds, n / folds]; a failed simulation carries no information."""
    size = len(t) // FOLDS
    places = jnp.arange(len(t)).reshape(size, FOLDS).T  # any order will do: draws are independent

    def one(own: Array) -> Array:
        critic = fitted(t, x, fine.at[own].set(0.0), reduced, targets)
        return jnp.nan_to_num(jnp.where(fine[own][:, None] > 0, critic(t[own], x[own]), 0.0))

    return jax.vmap(one)(places)


@functools.partial(jax.jit, static_argnums=4)
@single
def _fisher(t: Array, x: Array, fine: Array, points: Array, reduced: bool) -> Array:
    """Fisher information of a critic fitted to all simulations, at some points, [points, D, D]."""
    critic = fitted(t, x, fine, reduced, t.shape[1])
    return jax.vmap(critic.fisher)(points)


@functools.partial(jax.jit, static_argnums=0)
@single
def _likelihoods(task: Task, keys: jax.Array, theta: Array, designs: Array) -> Array:
    """Log-likelihoods, [M, 1, n, n]."""
    noise = noise_of(task)
    assert noise is not None

    def one(design: Array) -> Array:
        clean = jax.vmap(lambda key, theta: response(task, key, theta, design))(keys, theta)
        scale = flat_noise(noise, clean.shape[1:])
        mean = clean.reshape(len(theta), -1) / scale
        seen = mean + jax.vmap(lambda key: jax.random.normal(jax.random.clone(key), scale.shape))(keys)
        fine = jnp.all(jnp.isfinite(mean), axis=1)
        mean, seen = jnp.nan_to_num(mean), jnp.nan_to_num(seen)
        middle = jnp.mean(mean, axis=0)  # subtracted so that squares keep their precision
        mean, seen = mean - middle, seen - middle
        product = jnp.matmul(seen, mean.T, precision="highest")
        log = product - 0.5 * jnp.sum(mean**2, axis=1)[None, :]
        return jnp.where(fine[:, None], jnp.where(fine[None, :], log, -1e30), 0.0)[None]

    return jax.lax.map(one, designs)


def _squashed(values: Array) -> Array:
    """Large values compressed to logarithms, so that a single outlier does not distort a regression."""
    return 3.0 * jnp.arcsinh(values / 3.0)


def _with_one(values: Array) -> Array:
    return jnp.concatenate([jnp.ones((len(values), 1)), values], axis=1)


def _regression(features: Array, values: Array, weight: Array, penalty: float = RIDGE) -> Array:
    """Coefficients of weighted least squares with a small penalty on all but the constant."""
    total = jnp.sum(weight) + 1e-6
    gram = jnp.matmul((features * weight[:, None]).T, features, precision="highest") / total
    right = jnp.matmul((features * weight[:, None]).T, values, precision="highest") / total
    return jnp.linalg.solve(gram + penalty * jnp.diag(jnp.ones(len(gram)).at[0].set(1e-6)), right)
