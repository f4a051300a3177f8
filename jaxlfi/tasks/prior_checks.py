"""Checks of a task's own prior: a continuous distribution whose draws and densities agree, or one line of why not."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxlfi.distributions.arguments import is_concrete
from jaxlfi.distributions.space import Space
from jaxlfi.distributions.support import Support

DRAWS = 1024
"""Draws that a prior is judged by: this many draws of a continuous prior contain hardly any number twice."""
REPEATS = 0.02
"""Share of repeated values among the draws that no continuous distribution has."""
SPACINGS = 1e5
"""Range of the draws, in spacings of float32, below which rounding alone makes draws equal."""
WHOLE = 2.0**20
"""Size up to which nearly all numbers of float32 are not whole."""
IMPOSSIBLE = 0.3
"""Largest share of a prior's own draws at which its density may be zero or NaN."""
LINES, PLACES = 64, 128
"""Lines through draws along each parameter, and places on each line, inside and outside the range of all draws."""
ELSEWHERE = 0.1
"""Largest fraction of the mass on such a line that the density may have where nothing is ever drawn."""


def check_prior(prior: Any, dim: int) -> None:
    """Refuse a prior that is not a distribution over D parameters.

    Raises:
        ValueError: naming what was given.
    """
    expected = f"prior: expected a distrax distribution over vectors of {dim} parameters"
    if not callable(getattr(prior, "sample", None)) or not callable(getattr(prior, "log_prob", None)):
        raise ValueError(f"{expected}, got {type(prior).__name__}")
    try:  # a distribution is foreign code: report what it raises in one line
        draws = jax.eval_shape(lambda key: prior.sample(seed=key, sample_shape=2), jax.random.key(0))
        density = jax.eval_shape(prior.log_prob, jax.ShapeDtypeStruct((2, dim), jnp.float32))
    except Exception as error:
        raise ValueError(f"{expected}, got {type(prior).__name__}: {str(error).splitlines()[0]}") from error
    if draws.shape != (2, dim) or density.shape != (2,):
        raise ValueError(
            f"{expected}, got draws of shape {list(draws.shape[1:])} with log-densities of shape "
            f"{list(density.shape[1:])} (distrax.Independent makes one distribution of several)"
        )


def check_density(prior: Any, space: Space, box: Support) -> None:
    """Refuse a prior that has no density over the parameters, or one that does not match its draws.

    Args:
        prior: `Task.inference.prior`.
        space: of the parameters.
        box: Phi, or a support that is wider, in inference space.

    Raises:
        ValueError: for a distribution of whole numbers, steps or single values, one whose log-density at its own draws
            is NaN, and one that has density where nothing is ever drawn.
    """
    own = jax.jit(lambda key: prior.distribution.sample(seed=key, sample_shape=DRAWS))(jax.random.key(0))
    if not is_concrete(own):  # the task is created inside a traced function
        return
    draws = np.asarray(own if prior.space is None else prior.space.to_inference(own), np.float32)
    finite = np.isfinite(draws).all(axis=1)
    if not finite.any():
        raise ValueError(f"prior: expected finite draws, got {np.asarray(own)[0].tolist()}")
    places, cells = zip(*(_places(draws[finite, d], box.low[d], box.high[d]) for d in range(space.dim)), strict=True)
    lines = np.stack([_moved(draws[finite], d, places[d]) for d in range(space.dim)])
    rows = np.concatenate([draws, lines.reshape(-1, space.dim)])
    density, along = np.split(np.asarray(jax.jit(prior.log_prob)(rows), float), [DRAWS])
    along = along.reshape(lines.shape[:3])
    possible = finite & (density > -np.inf)
    if possible.sum() < (1 - IMPOSSIBLE) * finite.sum():
        place = ", ".join(f"{value:.4g}" for value in draws[finite & ~possible][0])
        raise ValueError(
            f"prior: expected a finite log-density at its own draws, got none at ({place}), nor at "
            f"{100 * (1 - possible.sum() / finite.sum()):.0f} % of them"
        )
    names = space.labels if prior.space is None else space.names
    for d in range(space.dim):
        _require_continuous(names[d], np.asarray(own)[possible, d])
        _require_nothing_elsewhere(space.labels[d], places[d], cells[d], along[d])


def _require_continuous(name: str, values: np.ndarray) -> None:
    """Refuse draws of one parameter that cannot be those of a density."""
    wanted = "prior: expected a continuous distribution, got one"
    reason = "what is learnt is a density"
    low, high = float(values.min()), float(values.max())
    if low == high:
        raise ValueError(
            f"{wanted} that always draws {low:g} for {name}: fix this parameter in the simulator, and leave it out"
        )
    whole = np.max(np.abs(values)) < WHOLE and bool(np.all(values == np.rint(values)))
    if values.dtype.kind in "biu" or whole:
        raise ValueError(
            f"{wanted} over whole numbers for {name}: {reason}; round inside the simulator instead, on the box "
            f"[{low - 0.5:g}, {high + 0.5:g}] of {name}"
        )
    if high - low < SPACINGS * np.spacing(np.float32(max(abs(low), abs(high)))):
        return
    levels, counts = np.unique(values, return_counts=True)
    if np.max(counts) > 2 or len(levels) < (1 - REPEATS) * len(values):
        raise ValueError(
            f"{wanted} that draws {levels[np.argmax(counts)]:g} again and again for {name}: {reason}; make the steps "
            "or single values inside the simulator, from a continuous parameter"
        )


def _places(draws: np.ndarray, box_low: Any, box_high: Any) -> tuple[np.ndarray, np.ndarray]:
    """`PLACES` inside the range of some numbers, as many of a box outside it, and the length that each stands for."""
    low, high = draws.min(), draws.max()
    below, above = max(low - float(box_low), 0.0), max(float(box_high) - high, 0.0)
    step = (np.arange(PLACES) + 0.5) / PLACES
    outside = step * (below + above)
    outside = np.where(outside < below, low - outside, high + outside - below)
    lengths = np.repeat([high - low, below + above], PLACES) / PLACES
    return np.concatenate([low + step * (high - low), outside]).astype(np.float32), lengths


def _moved(draws: np.ndarray, d: int, places: np.ndarray) -> np.ndarray:
    """`LINES` of the draws, moved to all places along a dimension."""
    lines = np.repeat(np.resize(draws, (LINES, draws.shape[1]))[:, None], len(places), axis=1)
    lines[:, :, d] = places
    return lines


def _require_nothing_elsewhere(label: str, places: np.ndarray, lengths: np.ndarray, log_density: np.ndarray) -> None:
    """Refuse a density along lines [L, 2 P] of which much lies at the outer places, where nothing is drawn."""
    log_density = log_density - np.max(log_density, axis=1, keepdims=True, initial=-1e300)
    mass = np.exp(log_density) * lengths
    if np.median(mass[:, PLACES:].sum(axis=1) / np.maximum(mass.sum(axis=1), 1e-300)) > ELSEWHERE:
        worst = places[PLACES + np.argmax(np.median(log_density[:, PLACES:], axis=0))]
        inner = places[:PLACES]
        raise ValueError(
            f"prior: expected a log-density of -inf where it never draws, got a finite one at {label} = {worst:.4g}, "
            f"where draws are from {inner.min():.4g} to {inner.max():.4g}: check log_prob and sample, or narrow the box"
        )
