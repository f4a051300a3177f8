"""The classifier two-sample test: closed forms, scikit-learn's, and the contracts of a pure function."""

import importlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm

from experiments.sbibm.c2st import c2st as reference
from jaxlfi.diagnostics import c2st

OPTIMISED = True
"""Its program runs for longer than it is compiled."""

compiled = jax.jit(c2st)
N = 400


def samples(shift: float, scale: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Two Gaussians in units that are a thousand times apart, off by a shift along the second axis."""
    rng = np.random.default_rng(3)
    units = np.array([1000.0, 1.0])
    first, second = rng.normal(size=(2, N, 2))
    return (units * first).astype(np.float32), (units * (scale * second + [0, shift])).astype(np.float32)


@pytest.mark.slow
@pytest.mark.parametrize("shift", [0.0, 1.0, 3.0])
def test_shifted_gaussians_are_distinguished_as_well_as_can_be(shift):
    """The best accuracy is Phi(d / 2); three standard errors of 800 rows, and what a trained classifier loses."""
    accuracy = float(compiled(jax.random.key(0), *samples(shift)))
    assert norm.cdf(shift / 2) - 0.07 < accuracy < norm.cdf(shift / 2) + 0.055


def test_a_difference_in_width_alone_is_seen():
    accuracy = float(compiled(jax.random.key(0), *samples(0.0, scale=2.5)))
    # Of radii with squares chi2 and 6.25 chi2, two degrees of freedom, the best threshold is where densities cross.
    threshold = 2 * np.log(6.25) / (1 - 1 / 6.25)
    best = 0.5 + 0.5 * (np.exp(-threshold / 2 / 6.25) - np.exp(-threshold / 2))
    assert accuracy == pytest.approx(best, abs=0.06)


def test_it_is_seen_as_well_as_by_scikit_learn():
    first, second = samples(0.0, scale=2.5)
    accuracy = float(compiled(jax.random.key(0), first, second))
    assert accuracy == pytest.approx(reference(first, second), abs=0.04)


def test_rows_that_belong_together_are_held_out_together():
    """The same parameters beside the same simulations: a classifier that had seen a row's twin would be below 0.5."""
    first, _ = samples(0.0)
    assert float(compiled(jax.random.key(0), first, first)) == pytest.approx(0.5, abs=1e-6)


def test_a_constant_column_and_the_order_of_rows_do_no_harm():
    first, second = samples(3.0)
    first[:, 0] = second[:, 0] = 7.0
    shuffled = second[np.random.default_rng(0).permutation(N)]
    assert float(compiled(jax.random.key(1), first, shuffled)) == pytest.approx(norm.cdf(1.5), abs=0.06)


@pytest.mark.slow
def test_the_same_key_gives_the_same_number():
    """Other keys give other numbers; the accuracy is a fraction of 800 rows, so two of them may coincide."""
    first, second = samples(1.0)
    one, again, *others = (float(compiled(jax.random.key(seed), first, second)) for seed in (0, 0, 7, 8))
    assert one == again and len({one, *others}) > 1


@pytest.mark.parametrize(("first", "second"), [((9, 2), (9, 2)), ((20, 2), (19, 2)), ((20, 2), (20, 3))])
def test_samples_that_cannot_be_compared_are_refused(first, second):
    with pytest.raises(Exception, match=r"same shape \[N, D\], N at least 10|dim|n"):
        c2st(jax.random.key(0), jnp.zeros(first), jnp.zeros(second))


def test_samples_that_say_nothing_are_refused():
    """Under jit, where numbers are not known, there is no number."""
    first, second = samples(1.0)
    for wrong in (np.nan, np.inf):
        spoilt = second.copy()
        spoilt[3, 1] = wrong
        with pytest.raises(ValueError, match="second: expected finite numbers, got 1 others of 800"):
            c2st(jax.random.key(0), first, spoilt)
    assert np.isnan(compiled(jax.random.key(0), first, spoilt))
    for one, other in ((first, np.ones_like(first)), (np.ones_like(first), first), (np.ones_like(first),) * 2):
        with pytest.raises(ValueError, match="expected rows that vary"):
            c2st(jax.random.key(0), one, other)


def test_samples_far_from_zero_are_scaled_as_at_zero(monkeypatch):
    """In single precision, columns of such an offset would be constant."""
    module = importlib.import_module("jaxlfi.diagnostics.c2st")
    monkeypatch.setattr(module, "_held_out", lambda key, first, second: second.mean() + first.std())
    first, second = (sample.astype(float) for sample in samples(3.0))
    here, there = (float(c2st(jax.random.key(0), offset + first, offset + second)) for offset in (0.0, 1e9))
    assert here == pytest.approx(there, rel=1e-3) and here > 2
