"""Wrong bounds: masses against SciPy, symmetries of the evidence, and warnings in words."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from jaxlfi.diagnostics import bound_evidence, bound_summary, bound_warnings, edge_mass
from jaxlfi.diagnostics.bounds import MASS_BEYOND
from jaxlfi.distributions.belief import Belief
from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.support import Support
from tests.strategies import boxes, mixtures, shapes, vectors

NAMES = ("mass", "drag")
BOX = Support([0.0, -2.0], [4.0, 6.0])
PHI = Support([-10.0, -2.0], [10.0, 10.0])
ADAPT = "The true value may lie beyond it: widen the support there, or adapt it with --heuristic edge."
WIDEN_PHI = "The bound is that of the feasible domain Phi: widen Phi if it can be."

evidence = jax.jit(bound_evidence)
mirrored = jax.jit(lambda mixture: mixture.mirror())
moved = jax.jit(lambda mixture, scale, shift: mixture.affine(scale, shift))
permuted = jax.jit(lambda mixture, order: mixture.permute(order))


def believed(means, scales, logits=None, box: Support = BOX) -> Belief:
    """A mixture of axis-parallel Gaussians on a box."""
    logits = np.zeros(len(means)) if logits is None else logits
    tril = [np.diag(each) for each in scales]
    mixture = GaussianMixture(*(jnp.asarray(np.float32(each)) for each in (logits, means, tril)))
    return Belief(mixture, box, jnp.asarray(True))


def centred(d: int, at: float, scale: float = 0.3) -> Belief:
    """A Gaussian in the middle of the box, but for parameter d."""
    mean, scales = [2.0, 2.0], [0.3, 0.3]
    mean[d], scales[d] = at, scale
    return believed([mean], [scales])


def warnings(belief: Belief, **options) -> list[str]:
    return bound_warnings(NAMES, belief, PHI, **options)


# ------------------------------------------------------------------------------------------------------ the evidence


@pytest.mark.parametrize("zone", [0.0, 0.1, 0.25])
def test_masses_against_scipy(zone):
    means, scales = ((1.0, 0.0), (3.5, 1.0)), ((0.5, 1.0), (0.4, 0.3))
    belief = believed(means, scales, (0.0, 1.0))
    low, high = edge_mass(belief, zone) if zone else evidence(belief)
    weights = np.exp([0.0, 1.0]) / np.exp([0.0, 1.0]).sum()
    for d, (bottom, top) in enumerate([(0.0, 4.0), (-2.0, 6.0)]):
        parts = [stats.norm(means[k][d], scales[k][d]) for k in range(2)]
        width = zone * (top - bottom)
        below = sum(weights[k] * parts[k].cdf(bottom + width) for k in range(2))
        above = sum(weights[k] * parts[k].sf(top - width) for k in range(2))
        np.testing.assert_allclose([low[d], high[d]], [below, above], rtol=1e-4)


@st.composite
def beliefs(draw) -> Belief:
    components, dim = draw(shapes())
    box, _ = draw(boxes(dim))
    return Belief(draw(mixtures(components, dim)), box, jnp.asarray(True))


@given(beliefs())
def test_reflection_swaps_the_sides(belief):
    low, high = evidence(belief)
    box = jax.device_get(belief.support)
    turned = Belief(mirrored(belief.mixture), Support(-box.high, -box.low), belief.informed)
    np.testing.assert_allclose(evidence(turned), (high, low), rtol=1e-5, atol=1e-7)


@given(beliefs(), st.data())
def test_units_and_origin_do_not_matter(belief, data):
    """The bounds are moved through float32 themselves, which bends masses by their conditioning."""
    dim = belief.support.dim
    scale, shift = data.draw(vectors(0.1, 10.0, dim)), data.draw(vectors(-3.0, 3.0, dim))
    low, high = jax.device_get((belief.support.low, belief.support.high))
    box = Support(scale * low + shift, scale * high + shift)
    elsewhere = Belief(moved(belief.mixture, scale, shift), box, belief.informed)
    np.testing.assert_allclose(evidence(elsewhere), evidence(belief), atol=1e-3)


@given(beliefs())
def test_the_order_of_components_does_not_matter(belief):
    order = np.arange(belief.mixture.logits.shape[0])[::-1].copy()
    reordered = dataclasses.replace(belief, mixture=permuted(belief.mixture, order))
    np.testing.assert_allclose(evidence(reordered), evidence(belief), rtol=1e-5, atol=1e-7)


def test_batches_by_vmap():
    several = [centred(0, at) for at in (-1.0, 2.0, 4.5)]
    batch = jax.tree.map(lambda *leaves: np.stack(leaves), *several)
    low, high = jax.jit(jax.vmap(bound_evidence))(batch)
    assert low.shape == high.shape == (3, 2)
    np.testing.assert_allclose(low[0], evidence(several[0])[0], atol=1e-6)
    np.testing.assert_allclose(high[2], evidence(several[2])[1], atol=1e-6)


# ------------------------------------------------------------------------------------------------------ what warns


def test_a_posterior_in_the_middle_does_not_warn():
    assert warnings(centred(0, 2.0)) == []


@pytest.mark.parametrize(
    ("d", "at", "side", "other"),
    [(0, -0.3, "lower bound 0", "upper"), (0, 4.3, "upper bound 4", "lower"), (1, 6.3, "upper bound 6", "lower")],
)
def test_a_posterior_centred_beyond_a_bound_warns_of_that_bound(d, at, side, other):
    (warning,) = warnings(centred(d, at))
    assert warning == f"{NAMES[d]}: 0.84 of the posterior mass lies beyond the {side}. {ADAPT}"


@pytest.mark.parametrize("at", [0.3, 3.7])
def test_a_posterior_along_a_bound_that_falls_towards_it_does_not_warn(at):
    """Wholly in the outer tenth of the width, two standard deviations inside."""
    belief = centred(0, at, 0.15)
    assert max(float(side[0]) for side in edge_mass(belief)) > 0.7
    assert warnings(belief) == []


def test_a_few_components_beyond_are_outvoted():
    """Of ten components, one lies beyond the upper bound: a tenth of the mass, which is below the threshold."""
    means = [[2.0, 2.0]] * 9 + [[5.0, 2.0]]
    belief = believed(means, np.full((10, 2), 0.1))
    np.testing.assert_allclose(evidence(belief)[1][0], 0.1, atol=1e-3)
    assert warnings(belief) == []
    assert len(warnings(belief, threshold=0.05)) == 1


def test_one_network_of_four_beyond_is_enough():
    """It sees no way to explain the observation from inside."""
    (warning,) = warnings(believed([[2.0, 2.0]] * 3 + [[5.0, 2.0]], np.full((4, 2), 0.1)))
    assert warning.startswith("mass: 0.25 of the posterior mass lies beyond the upper bound 4")


def test_a_marginal_that_fills_the_box_and_ends_with_it_does_not_warn():
    """Nothing is known of the parameters, and nothing speaks for values beyond."""
    centres = np.linspace(0.05, 0.95, 10)
    means = np.stack([centres * 4.0, -2 + 8 * centres], axis=1)
    belief = believed(means, np.full((10, 2), 0.02))
    np.testing.assert_allclose(edge_mass(belief), 0.1, atol=1e-3)
    assert warnings(belief) == []


def test_a_marginal_far_wider_than_the_box_warns_on_both_sides():
    """What is known of the parameter speaks as much for either side of the box as for the box itself."""
    texts = warnings(centred(0, 2.0, 20.0))
    assert [text.partition(" of ")[0] for text in texts] == ["mass: 0.46", "mass: 0.46"]
    assert "lower bound 0" in texts[0] and "upper bound 4" in texts[1]
    assert evidence(centred(0, 2.0, 2.0))[0][0] < MASS_BEYOND  # a standard deviation of half the width: none


# ------------------------------------------------------------------------------------------------------- the messages


def test_at_phis_own_bound_the_advice_is_another():
    (warning,) = warnings(centred(1, -2.3))
    assert warning == f"drag: 0.84 of the posterior mass lies beyond the lower bound -2. {WIDEN_PHI}"


def test_a_bound_beyond_phi_is_limited_by_it_too():
    """A named support may be wider than Phi, and widens it: no heuristic moves the bound further."""
    wide = dataclasses.replace(centred(1, -5.3), support=Support([0.0, -5.0], [4.0, 6.0]))
    (warning,) = warnings(wide)
    assert "widen Phi" in warning and "edge" not in warning


def test_several_runs_are_summarised():
    runs = [centred(0, at) for at in (4.3, 4.0, 2.0, 4.3)]
    (text,) = bound_summary(NAMES, runs, PHI)
    assert text == f"posterior mass lies beyond a bound: mass upper 4 (3 of 4 runs, median mass 0.67). {ADAPT}"


def test_the_summary_tells_phis_bounds_apart():
    movable, limited = bound_summary(NAMES, [believed([[-0.3, -2.3]], [[0.3, 0.3]])] * 2, PHI)
    assert "mass lower 0 (2 of 2 runs" in movable and "drag" not in movable and movable.endswith(ADAPT)
    assert "drag lower -2 (2 of 2 runs" in limited and "mass lower" not in limited and limited.endswith(WIDEN_PHI)


def test_runs_whose_bounds_differ_are_summarised_by_their_range():
    runs = [
        dataclasses.replace(centred(0, 4.3), support=Support([0.0, -2.0], [high, 6.0])) for high in (3.25, 4.0, 3.5)
    ]
    (text,) = bound_summary(NAMES, runs, PHI)
    assert "mass upper 3.25 to 4 (3 of 3 runs" in text


def test_the_summary_of_one_run_is_its_warnings():
    assert bound_summary(NAMES, [centred(0, 4.3)], PHI) == warnings(centred(0, 4.3))
    assert bound_summary(NAMES, [centred(0, 2.0)] * 3, PHI) == []


def test_of_a_support_that_grows_only_the_bounds_of_phi_are_named():
    """The other bounds move; at Phi nothing does."""
    both = believed([[4.3, -2.3]], [[0.3, 0.3]])
    assert len(warnings(both)) == 2
    (text,) = warnings(both, grows=True)
    assert text.startswith("drag: ") and text.endswith(WIDEN_PHI)
    (text,) = bound_summary(NAMES, [both, both], PHI, grows=True)
    assert "drag lower -2 (2 of 2 runs" in text and text.endswith(WIDEN_PHI) and "mass upper" not in text


def test_a_bound_near_phis_is_phis_relative_to_its_width():
    """Units do not matter: a support from 5e-9 is not at Phi's 0 where Phi is 1e-7 wide."""
    phi = Support([0.0, -2.0], [1e-7, 10.0])
    box = Support([5e-9, -2.0], [5e-8, 6.0])
    belief = believed([[4e-9, 2.0]], [[1e-10, 0.3]], box=box)
    (text,) = bound_warnings(NAMES, belief, phi)
    assert text.endswith(ADAPT)
