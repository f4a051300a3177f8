"""Posterior: q_phi(theta | x^r) truncated to a support, for mixture density networks and flows alike."""

import functools
import html
from collections.abc import Callable, Mapping, Sequence
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct
from jaxtyping import Array, ArrayLike, Float

from jaxlfi.distributions.arguments import as_key, is_concrete, require_count
from jaxlfi.distributions.mass import log_mass_inside, rare_draws
from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.precision import single
from jaxlfi.distributions.region import Region, region
from jaxlfi.distributions.space import Space, SpaceName, is_natural
from jaxlfi.distributions.support import Support
from jaxlfi.distributions.truncated_mixture import log_mass, truncated_quantiles, weighted_points
from jaxlfi.distributions.truncation import rejection_sample, truncated_log_prob
from jaxlfi.estimators.density import Density
from jaxlfi.io import text_table
from jaxlfi.io.executables import QUICK, QUICKEST, Options, quickly
from jaxlfi.io.lowered import Program
from jaxlfi.tasks import priors

Names = str | int | Sequence[str] | Sequence[int]
"""One or several parameters, by their names or their places from 0."""

MAX_DRAWS = 10_000_000
"""Largest number of draws made at once."""
FEW_DRAWS, PORTION = 20_000, 100
"""Largest number of draws of a mixture made in portions, and their size: one program serves all these numbers."""
STATISTICS_DRAWS = 4096
"""Number of draws for statistics without a closed form (the mean to 1.6 % of a standard deviation)."""
SHOWN = 20
"""Largest number of parameters listed in a posterior's text."""
MAP_DRAWS = 1000
"""Number of draws from which the starts of the ascents towards the mode are chosen."""
MAP_STARTS = 16
"""Number of gradient ascents towards the mode, each from one of the draws of highest density."""
MAP_STEPS = 300
"""Steps of Adam in each ascent."""
MAP_RATE = 0.02
"""Adam's initial step size, as a fraction of half the support's width; it decays to zero."""
ROUNDING = 4 * float(jnp.finfo(jnp.float32).eps)
"""Largest rounding error of a bound in natural units, relative to its size."""


class Posterior(struct.PyTreeNode):
    """The posterior of an observation: a density on a box, as a pytree.

    The density is always truncated to the support, and zero where the task's own prior is zero. Draws outside are
    rejected, never moved inside; if almost no mass is inside, draws are resampled by weight from points inside
    (`jaxlfi.distributions.mass`). Arguments and results are in natural units, or in inference space (logarithms of log
    parameters) with `space="inference"`. Statistics of a Gaussian mixture are computed by numerical integration; those
    of other densities, or under the task's own prior, from draws with a fixed seed. For statistics of some parameters
    use a marginal: `posterior.marginal("mass").std()`.

    Attributes:
        density: q before truncation, over inference space: a `GaussianMixture`, or a flow's density.
        mixture: the mixture of Gaussians that heuristics and proposals use: the density itself, or one fitted to draws.
        support: the box, in inference space.
        log_mass_inside: logarithm of `mass_inside`, which itself may underflow. Shape [].
        space: the map between natural units and inference space.
        prior: the task's own prior over inference space, or None; where it is zero, so is the posterior.
    """

    density: Density
    mixture: GaussianMixture
    support: Support
    log_mass_inside: Float[Array, "*batch"]
    space: Space = struct.field(pytree_node=False)
    prior: Any = struct.field(pytree_node=False, default=None)

    @property
    def mass_inside(self) -> Float[Array, "*batch"]:
        """Mass of q inside the support, where the prior is not zero; the rest has leaked. Shape []."""
        return jnp.exp(self.log_mass_inside)

    @property
    def region(self) -> Support | Region:
        """Where the posterior is not zero: the support without the places where the prior is zero."""
        return region(self.support, self.prior)

    def sample(self, key: jax.Array, n: int, space: SpaceName = "natural") -> Float[Array, "n dim"]:
        """`n` independent draws, shape [n, D]. With the same key, up to 20,000 of a mixture begin with those of fewer.

        Args:
            key: consumed; or a seed.
            n: number of draws.
            space: "natural" units, or "inference" space.

        Raises:
            ValueError: if `key` is not a key or seed, or n not a whole number from 1 to `MAX_DRAWS`.
        """
        require_count(n, "n", most=MAX_DRAWS)
        natural = is_natural(space)
        draws = self._drawn(as_key(key), int(n))
        return self.space.to_natural(draws) if natural else draws

    @property
    def quick(self) -> Options:
        """Compiler options for programs of this posterior: other densities take far longer to run than a mixture."""
        return QUICKEST if isinstance(self.density, GaussianMixture) else QUICK

    def _drawn(self, key: jax.Array, n: int) -> Array:
        """`n` draws in inference space; one program serves all small n."""
        if n > (FEW_DRAWS if self.quick == QUICKEST else PORTION):
            return quickly(sampler(n), key, self, options=QUICK)
        count, traced = -(-n // PORTION), not is_concrete((key, self))
        # Random numbers do not depend on how many follow: a smaller portion has the first draws of a whole one.
        portion = sampler(n if traced and count == 1 else PORTION)
        one = lambda number: quickly(portion, jax.random.fold_in(key, number), self, options=self.quick)
        if traced:
            return jax.lax.map(one, jnp.arange(count)).reshape(-1, self.support.dim)[:n]
        return jnp.asarray(np.concatenate([np.asarray(one(number)) for number in range(count)])[:n])

    def log_prob(self, theta: ArrayLike | Sequence, space: SpaceName = "natural") -> Float[Array, "*n"]:
        """Log-density at theta, numbers of shape [..., D]; -inf outside the support.

        Raises:
            ValueError: if theta is not of this shape.
        """
        try:
            theta = jnp.asarray(theta, jnp.float32)
        except (ValueError, TypeError, OverflowError) as error:
            raise ValueError(f"theta: expected numbers of shape [..., {self.space.dim}], got {theta!r}") from error
        if theta.ndim == 0 or theta.shape[-1] != self.space.dim:
            raise ValueError(f"theta: expected shape [..., {self.space.dim}], got {list(theta.shape)}")
        return _log_prob(self, theta, is_natural(space))

    def mean(self, space: SpaceName = "natural") -> Float[Array, " dim"]:
        """The mean of each parameter, shape [D].

        For a mixture, it is a numerical integral, exact to a few thousandths of a standard deviation; for other
        densities, and under the task's own prior, the mean of `STATISTICS_DRAWS` draws that are the same each time.
        """
        return self._moments(is_natural(space))[0]

    def std(self, space: SpaceName = "natural") -> Float[Array, " dim"]:
        """The standard deviation of each parameter, shape [D]; computed like `mean`."""
        return jnp.sqrt(jnp.diagonal(self.covariance(space)))

    def covariance(self, space: SpaceName = "natural") -> Float[Array, "dim dim"]:
        """The covariance of the parameters, shape [D, D]; computed like `mean`."""
        return self._moments(is_natural(space))[1]

    def quantile(self, level: ArrayLike | Sequence[float], space: SpaceName = "natural") -> Float[Array, "*levels dim"]:
        """Quantiles of each parameter's marginal, shape [D] or [..., D].

        For a mixture, the marginal distribution function is integrated and inverted: to the last digit for one or two
        parameters, and to some thousandths of the level for more. For other densities, and under the task's own prior,
        they are quantiles of `STATISTICS_DRAWS` draws that are the same each time; levels within a hundredth of 0 or 1
        are rough.

        Args:
            level: a number in [0, 1], or an array of any shape.
            space: units of the result.

        Raises:
            ValueError: for levels outside [0, 1].

        Example:
            >>> box, one = Support([0.0], [9.0]), GaussianMixture(jnp.zeros(1), jnp.zeros((1, 1)), jnp.ones((1, 1, 1)))
            >>> f"{float(truncated(one, one, box, Space(('mass',), (False,))).quantile(0.95)[0]):.2f}"
            '1.96'
        """
        natural = is_natural(space)
        try:
            levels = jnp.asarray(level, jnp.float32)
        except (ValueError, TypeError, OverflowError) as error:
            raise ValueError(f"level: expected numbers from 0 to 1, got {level!r}") from error
        if is_concrete(levels) and not bool(jnp.all((levels >= 0) & (levels <= 1))):
            raise ValueError(f"level: expected numbers from 0 to 1, got {level!r}")
        inner = self._quantiles(levels.ravel()).reshape(*levels.shape, self.space.dim)
        return self.space.to_natural(inner) if natural else inner

    def interval(self, mass: float = 0.9, space: SpaceName = "natural") -> Float[Array, "2 dim"]:
        """The central credible interval of each parameter: lower and upper ends, shape [2, D].

        Args:
            mass: probability mass of the interval; the rest is split equally between the tails.
            space: units of the result.

        Raises:
            ValueError: for a mass that is not between 0 and 1.
        """
        if is_concrete(mass) and not (np.ndim(mass) == 0 and 0 < mass < 1):
            raise ValueError(f"mass: expected a number between 0 and 1, got {mass!r}")
        return self.quantile(jnp.stack([0.5 - 0.5 * jnp.asarray(mass), 0.5 + 0.5 * jnp.asarray(mass)]), space)

    def marginal(self, names: Names) -> "Marginal":
        """The marginal posterior of some parameters.

        Draws and statistics are those of the whole posterior. The density of a mixture is exact as well: each
        component's marginal, times the conditional mass of the other parameters inside their box. That is a closed form
        if at most one parameter is left out, and otherwise a sum over a lattice. The parameters left out stay truncated
        to their bounds, so the marginal is not a mixture of Gaussians unless nothing has leaked.

        Args:
            names: names or places of one or several parameters, in the desired order.

        Raises:
            ValueError: for unknown names. The density of a marginal raises it if it has no closed form: for a flow or a
                likelihood, or if the task's prior is zero in places.

        Example:
            >>> box = Support([-9.0, -9.0], [9.0, 0.0])
            >>> one = GaussianMixture(jnp.zeros(1), jnp.zeros((1, 2)), jnp.array([[[1.0, 0.0], [0.8, 0.6]]]))
            >>> mass = truncated(one, one, box, Space(("mass", "length"), (False, False))).marginal("mass")
            >>> f"{float(mass.mean()[0]):.2f}, {float(mass.log_prob([0.0])):.2f}"
            '-0.64, -0.92'
        """
        return _marginal(self._plain(), self._places(names))

    def conditional(self, values: Mapping[str, float] | None = None, /, **named: float) -> "Posterior":
        """The posterior of the other parameters given values of some; exact.

        It is the mixture's conditional, a closed form, truncated to the bounds of the other parameters. The density of
        the given values is not part of it.

        Args:
            values: values in natural units, by name; for names that are not Python identifiers.
            **named: the same.

        Raises:
            ValueError: for unknown names, for all names or none, for a value outside the support, and for posteriors
                that are not mixtures of Gaussians on a box: those of flows and likelihoods, and those with a prior that
                is zero in places.

        Example:
            >>> box = Support([-9.0, -9.0], [9.0, 9.0])
            >>> one = GaussianMixture(jnp.zeros(1), jnp.zeros((1, 2)), jnp.array([[[1.0, 0.0], [0.8, 0.6]]]))
            >>> both = truncated(one, one, box, Space(("mass", "length"), (False, False)))
            >>> f"{float(both.conditional(mass=2.0).mean()[0]):.2f}"
            '1.60'
        """
        plain, known = self._plain(), {**(values or {}), **named}
        given = plain._places(list(known))
        inner = plain.space.to_inference(jnp.ones(plain.space.dim).at[np.array(given)].set(_numbers(known)))
        box = plain.support
        for d, name in zip(given, known, strict=True):
            inside = (inner[d] >= box.low[d]) & (inner[d] <= box.high[d])
            if is_concrete(inside) and not inside:
                low, high = (float(plain.space.to_natural(bound)[d]) for bound in (box.low, box.high))
                raise ValueError(
                    f"{name}: expected a value inside the support, {low:.6g} to {high:.6g}, got {known[name]!r}"
                )
        return plain._given(given, inner[np.array(given)])

    def _given(self, given: tuple[int, ...], values: Array) -> "Posterior":
        """The posterior where some parameters have values in inference space."""
        if not self._closed:
            raise ValueError(f"conditional: expected {_CLOSED}, got {_kind(self)}")
        others = tuple(d for d in range(self.space.dim) if d not in given)
        if not others or not given:
            raise ValueError(f"conditional: expected some of {list(self.space.names)}, not all, got {len(given)}")
        return _conditional(self, given, others, values)

    @property
    def _closed(self) -> bool:
        """Whether it is a mixture of Gaussians truncated to a box."""
        return isinstance(self.density, GaussianMixture) and self.prior is None

    def _plain(self) -> "Posterior":
        """The same posterior without its prior, if that is zero nowhere in the support and so has no effect."""
        mixture = isinstance(self.density, GaussianMixture) and is_concrete(self)
        if not mixture or self.prior is None or priors.is_bounded(self.prior, self.support):
            return self
        return _without_prior(self)

    def _places(self, names: Names) -> tuple[int, ...]:
        """Places of the named parameters, from 0."""
        known: dict[Any, int] = {name: d for d, name in enumerate(self.space.names)}
        known |= {d: d for d in range(self.space.dim)}
        several = [names] if isinstance(names, str | int | np.integer) else list(names)
        if not several or len(set(several)) < len(several) or not set(several) <= set(known):
            raise ValueError(f"names: expected some of {list(self.space.names)}, each once, got {names!r}")
        return tuple(known[one] for one in several)

    def _moments(self, natural: bool) -> tuple[Array, Array]:
        """Mean and covariance."""
        if self._closed:
            return _mixture_moments(self, natural)
        return _draws_moments(self.sample(jax.random.key(0), STATISTICS_DRAWS, "natural" if natural else "inference"))

    def _quantiles(self, levels: Array) -> Array:
        """Quantiles of each parameter in inference space, shape [levels, D]."""
        if self._closed:
            return quickly(_mixture_quantiles, self, levels, options=QUICK)
        return _draws_quantiles(self.sample(jax.random.key(0), STATISTICS_DRAWS, "inference"), levels)

    def __repr__(self) -> str:
        if not is_concrete(self) or self.support.low.ndim != 1:
            return f"{type(self).__name__} of {', '.join(self.space.names)}; bounds {list(self.support.low.shape)}"
        return f"{self._headline()}\n{text_table.as_text(*self._table())}"

    def _repr_html_(self) -> str | None:
        if not is_concrete(self) or self.support.low.ndim != 1:
            return None
        return f"<p>{html.escape(self._headline())}</p>{text_table.as_html(*self._table())}"

    def _headline(self) -> str:
        names = self.space.names
        count = f"{len(names)} parameters" if len(names) > 1 else names[0]
        more = f"; the first {SHOWN}:" if len(names) > SHOWN else ""
        inside = f"{mass:.2g}" if (mass := float(self.mass_inside)) < 0.995 else "all"
        return f"{type(self).__name__} of {count}: {_kind(self)}, {inside} of it inside{more}"

    def _table(self) -> tuple[list[str], list[list[str]]]:
        middle, low, high = np.asarray(self.quantile([0.5, 0.05, 0.95]))
        box, number = self.space.box_to_natural(self.support), "{:.4g}".format
        rows = [
            [name, number(middle[d]), f"[{low[d]:.4g}, {high[d]:.4g}]", f"[{box.low[d]:.4g}, {box.high[d]:.4g}]"]
            for d, name in enumerate(self.space.names[:SHOWN])
        ]
        return ["parameter", "median", "90 %", "support"], rows

    def map(self, space: SpaceName = "natural") -> Float[Array, " dim"]:
        """The point of highest density inside the support (maximum a posteriori), shape [D].

        Found by gradient ascent from the draws of highest density. The densities over natural units and over inference
        space have different maxima if a parameter is inferred as its logarithm: `space` chooses the density, and the
        units of the result.
        """
        draws = self.sample(jax.random.key(0), MAP_DRAWS, space="inference")
        return _maximum(self, draws, is_natural(space))

    def inner_draws(self, key: jax.Array, n: int) -> Float[Array, "n dim"]:
        """`n` draws in inference space, by rejection; pure, whereas `sample` checks its arguments and compiles."""
        fallback = rare_draws(self.density, self.mixture, self.region)
        return rejection_sample(key, self.density.sample, self.region, n, fallback)

    def on(self, support: Support) -> "Posterior":
        """The same density truncated to another support, in inference space."""
        return truncated(self.density, self.mixture, support, self.space, self.prior)


class MarginalDensity(struct.PyTreeNode):
    """The density of some parameters of a posterior, integrated over the others inside their bounds.

    Attributes:
        full: the posterior of all parameters.
        kept: places of the marginal's parameters.
    """

    full: Posterior
    kept: tuple[int, ...] = struct.field(pytree_node=False)

    def log_prob(self, theta: Float[Array, "*n dim"]) -> Float[Array, "*n"]:
        """Log-density at theta.

        Raises:
            ValueError: if there is no closed form.
        """
        if not self.full._closed:
            raise ValueError(f"log_prob: expected the marginal of {_CLOSED}, got that of {_kind(self.full)}")
        mixture, box = _mixture_of(self.full), self.full.support
        others = np.setdiff1d(np.arange(box.dim), self.kept)
        if not len(others):
            return mixture.marginal(self.kept).log_prob(theta)
        rest = Support(box.low[others], box.high[others])

        def one(theta: Array) -> Array:
            given = mixture.conditional(self.kept, theta)
            return jax.nn.logsumexp(given.logits) + log_mass(given, rest)

        points = theta.reshape(-1, len(self.kept))
        return jax.lax.map(one, points, batch_size=64).reshape(theta.shape[:-1])

    def sample(self, key: jax.Array, n: int) -> Float[Array, "n dim"]:
        """`n` independent draws."""
        return self.full.inner_draws(key, n)[:, np.array(self.kept)]


class Marginal(Posterior, repr=False):
    """The marginal posterior of some parameters, as returned by `Posterior.marginal`.

    `mass_inside` is that of the whole posterior, inside the bounds of all parameters.
    """

    density: MarginalDensity

    def inner_draws(self, key: jax.Array, n: int) -> Float[Array, "n dim"]:
        """`n` draws in inference space."""
        return self.density.sample(key, n)

    def on(self, support: Support) -> "Marginal":
        """The marginal of the posterior on another box of these parameters, in inference space."""
        full, kept = self.density.full, np.array(self.density.kept)
        box = jax.tree.map(jnp.asarray, full.support)
        box = Support(box.low.at[kept].set(support.low), box.high.at[kept].set(support.high))
        return _marginal(full.on(box), self.density.kept)

    def marginal(self, names: Names) -> "Marginal":
        """The marginal of some of these parameters."""
        return _marginal(self.density.full, tuple(self.density.kept[d] for d in self._places(names)))

    def _given(self, given: tuple[int, ...], values: Array) -> Posterior:
        full, kept = self.density.full, self.density.kept
        known = tuple(kept[d] for d in given)
        left = [d for d in kept if d not in known]
        if not left or not given:
            raise ValueError(f"conditional: expected some of {list(self.space.names)}, not all, got {len(given)}")
        return full._given(known, values).marginal([full.space.names[d] for d in left])

    def _moments(self, natural: bool) -> tuple[Array, Array]:
        mean, covariance = self.density.full._moments(natural)
        kept = np.array(self.density.kept)
        return mean[kept], covariance[np.ix_(kept, kept)]

    def _quantiles(self, levels: Array) -> Array:
        return self.density.full._quantiles(levels)[:, np.array(self.density.kept)]


_CLOSED = "a mixture of Gaussians on a box, with a prior that is zero nowhere in there"


def _kind(posterior: Posterior) -> str:
    """A posterior's kind, in a few words."""
    if isinstance(posterior, Marginal):
        return f"a marginal of {_kind(posterior.density.full)}"
    density = posterior.density
    if isinstance(density, GaussianMixture):
        kind = f"a mixture of {density.logits.shape[-1]} Gaussians"
    else:
        kind = f"a {type(density).__name__}"
    return kind + " under a prior" * (posterior.prior is not None)


def _mixture_of(posterior: Posterior) -> GaussianMixture:
    """The density of a posterior that has a closed form."""
    return cast(GaussianMixture, posterior.density)


def _sub_space(space: Space, kept: Sequence[int]) -> Space:
    return Space(tuple(space.names[d] for d in kept), tuple(space.log[d] for d in kept))


def _marginal(full: Posterior, kept: tuple[int, ...]) -> Marginal:
    rows = np.array(kept)
    box = Support(jnp.asarray(full.support.low)[rows], jnp.asarray(full.support.high)[rows])
    return Marginal(
        density=MarginalDensity(full, kept),
        mixture=full.mixture.marginal(kept),
        support=box,
        log_mass_inside=full.log_mass_inside,
        space=_sub_space(full.space, kept),
    )


def _numbers(values: Mapping[str, Any]) -> Array:
    """Values of parameters as an array."""
    try:
        return jnp.stack([jnp.asarray(value, jnp.float32).reshape(()) for value in values.values()])
    except (TypeError, ValueError) as error:
        raise ValueError(f"conditional: expected one number for each name, got {dict(values)!r}") from error


def truncated(
    density: Density, mixture: GaussianMixture, support: Support, space: Space, prior: Any = None
) -> Posterior:
    """A density truncated to a support and to where the prior is not zero, with its mass there."""
    log_mass = log_mass_inside(density, mixture, region(support, prior))
    return Posterior(density, mixture, support, log_mass, space, prior)


# Compiled as wholes: operation by operation, a flow's density alone would be hundreds of small programs.
_without_prior = jax.jit(single(lambda posterior: posterior.replace(prior=None).on(posterior.support)))
_draws_moments = jax.jit(single(lambda draws: _weighted_moments(draws, jnp.full(len(draws), 1 / len(draws)))))
_draws_quantiles = jax.jit(single(lambda draws, levels: jnp.quantile(draws, levels, axis=0)))


def _quantiles(posterior: Posterior, levels: Array) -> Array:
    return truncated_quantiles(_mixture_of(posterior), posterior.support, levels)


_mixture_quantiles = Program(single(_quantiles), _quantiles, ())


@functools.lru_cache(maxsize=64)
def sampler(n: int) -> Any:
    """A program that makes `n` draws of a posterior in inference space, with a key."""
    return Program(single(functools.partial(_draws, n)), _draws, n)


def _draws(n: int, key: jax.Array, posterior: Posterior) -> Array:
    return posterior.inner_draws(key, n)


@functools.partial(jax.jit, static_argnums=(1, 2))
@single
def _conditional(posterior: Posterior, given: tuple[int, ...], others: tuple[int, ...], values: Array) -> Posterior:
    mixture, box, rows = _mixture_of(posterior).conditional(given, values), posterior.support, np.array(others)
    return truncated(mixture, mixture, Support(box.low[rows], box.high[rows]), _sub_space(posterior.space, others))


@functools.partial(jax.jit, static_argnums=1)
@single
def _mixture_moments(posterior: Posterior, natural: bool) -> tuple[Array, Array]:
    points, log_weight = weighted_points(_mixture_of(posterior), posterior.support)
    return _weighted_moments(posterior.space.to_natural(points) if natural else points, jnp.exp(log_weight))


def _weighted_moments(points: Array, weights: Array) -> tuple[Array, Array]:
    start = points[0]  # subtracted, so that a large offset costs no precision
    offset = weights @ (points - start)
    centred = points - start - offset
    return start + offset, (weights[:, None] * centred).T @ centred


@functools.partial(jax.jit, static_argnums=2)
@single
def _log_prob(posterior: Posterior, theta: Array, natural: bool) -> Array:
    """Log-density over natural units or over inference space, at a point in the same units."""
    box, space = posterior.support, posterior.space
    inner = space.to_inference(theta) if natural else theta
    if natural:  # a logarithm's rounding takes no point on a bound out of the support
        low, high = space.to_natural(box.low), space.to_natural(box.high)
        low, high = low - ROUNDING * jnp.abs(low), high + ROUNDING * jnp.abs(high)
        inside = jnp.all((theta >= low) & (theta <= high), axis=-1, keepdims=True)
        inner = jnp.where(inside, box.clip(inner), inner)
    finite = jnp.all(jnp.isfinite(inner), axis=-1)
    inner = jnp.where(finite[..., None], inner, posterior.support.centre)
    log_prob = posterior.density.log_prob(inner)
    log_prob = truncated_log_prob(log_prob, inner, posterior.region, posterior.log_mass_inside)
    log_jacobian = posterior.space.log_jacobian(inner) if natural else 0.0
    return jnp.where(finite, log_prob - log_jacobian, -jnp.inf)


@functools.partial(jax.jit, static_argnums=2)
@single
def _maximum(posterior: Posterior, draws: Array, natural: bool) -> Array:
    """The maximum of the density over natural units or over inference space, by ascent from the best of some draws."""
    box = posterior.support

    def objective(unit: Array) -> Array:
        theta = _of_unit(box, unit)
        return posterior.density.log_prob(theta) - (posterior.space.log_jacobian(theta) if natural else 0.0)

    draws = box.to_unit(draws)
    _, best = jax.lax.top_k(jax.vmap(objective)(draws), MAP_STARTS)
    adam = optax.adam(optax.cosine_decay_schedule(MAP_RATE, MAP_STEPS))
    moved = lambda unit, step: jnp.clip(unit + step, -1.0, 1.0)
    if posterior.prior is not None:
        moved = functools.partial(_moved_inside, lambda unit: posterior.region.contains(_of_unit(box, unit)))

    def ascend(start: Array) -> tuple[Array, Array]:
        def step(carry, _):
            unit, moments = carry
            updates, moments = adam.update(-jax.grad(objective)(unit), moments)
            return (moved(unit, updates), moments), None

        (unit, _), _ = jax.lax.scan(step, (start, adam.init(start)), length=MAP_STEPS)
        return unit, objective(unit)

    units, heights = jax.vmap(ascend)(draws[best])
    point = box.clip(_of_unit(box, units[jnp.argmax(heights)]))
    return posterior.space.to_natural(point) if natural else point


def _of_unit(box: Support, unit: Array) -> Array:
    """From [-1, 1]^D to the box."""
    return box.centre + 0.5 * box.width * unit


def _moved_inside(inside: Callable[[Array], Array], unit: Array, step: Array) -> Array:
    """Take a step one dimension at a time, leaving out those that lead to zero density."""

    def along(d: Array, unit: Array) -> Array:
        tried = unit.at[d].set(jnp.clip(unit[d] + jnp.nan_to_num(step[d]), -1.0, 1.0))
        return jnp.where(inside(tried), tried, unit)

    return jax.lax.fori_loop(0, unit.shape[-1], along, unit)
