"""Hypothesis strategies for boxes, mixtures and beliefs: values vary, shapes come from a tiny set."""

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from jaxlfi.distributions.belief import Belief
from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.support import Support

DIMS = (2, 3)
SHAPES = ((1, 2), (4, 3))
"""Shapes (K, D): only a few, as each needs its own compiled programs."""
MANY = SHAPES[-1]
"""Shape on which laws are tested; if a single Gaussian is a special case, it is tested by hand."""


def floats(low: float, high: float) -> st.SearchStrategy[float]:
    """Float32 values in [low, high], none of them subnormal."""
    low, high = float(np.float32(low)), float(np.float32(high))
    return st.floats(low, high, width=32, allow_nan=False, allow_subnormal=False)


def vectors(low: float, high: float, *shape: int) -> st.SearchStrategy[np.ndarray]:
    """Float32 arrays of the given shape with values in [low, high]."""
    return arrays(np.float32, shape, elements=floats(low, high), fill=st.nothing())


def shapes() -> st.SearchStrategy[tuple[int, int]]:
    """Shapes of mixtures of several Gaussians."""
    return st.just(MANY)


def keys() -> st.SearchStrategy[jax.Array]:
    """Typed keys."""
    return st.integers(0, 2**32 - 1).map(jax.random.key)


@st.composite
def mixtures(draw, components: int, dim: int, spread: float = 4.0) -> GaussianMixture:
    """Mixtures with means within `spread` of 0 and standard deviations between 0.05 and 2.1."""
    tril = np.zeros((components, dim, dim), np.float32)
    rows, columns = np.tril_indices(dim, -1)
    tril[:, rows, columns] = draw(vectors(-1.0, 1.0, components, rows.size))
    tril[:, np.arange(dim), np.arange(dim)] = draw(vectors(0.05, 1.5, components, dim))
    return GaussianMixture(
        logits=jnp.asarray(draw(vectors(-3.0, 3.0, components))),
        means=jnp.asarray(draw(vectors(-spread, spread, components, dim))),
        scale_tril=jnp.asarray(tril),
    )


@st.composite
def boxes(draw, dim: int) -> tuple[Support, Support]:
    """A box and a feasible domain around it, which it touches on some sides."""
    low = draw(vectors(-3.0, 2.0, dim))
    high = low + draw(vectors(0.25, 5.0, dim))
    gaps = draw(vectors(0.0, 2.0, 2, dim)) * draw(arrays(np.bool_, (2, dim)))
    support = Support(jnp.asarray(low), jnp.asarray(high))
    return support, Support(jnp.asarray(low - gaps[0]), jnp.asarray(high + gaps[1]))


@st.composite
def problems(draw, components: int | None = None) -> tuple[Belief, GaussianMixture, Support]:
    """Inputs of a heuristic: an informed belief, a posterior whose means moved, and Phi."""
    components, dim = draw(shapes()) if components is None else (components, dict(SHAPES)[components])
    support, feasible = draw(boxes(dim))
    now = draw(mixtures(components, dim))
    steps = draw(vectors(-1.0, 1.0, components, dim))
    before = GaussianMixture(now.logits, jnp.asarray(np.asarray(now.means) - steps), now.scale_tril)
    return Belief(before, support, jnp.asarray(True)), now, feasible
