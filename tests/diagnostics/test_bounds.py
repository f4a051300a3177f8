"""Wrong bounds: masses against SciPy, symmetries, whom the simulations blame, and warnings in words."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from jaxlfi.diagnostics import BoundEvidence, bound_evidence, bound_warnings, edge_mass, mass_beyond
from jaxlfi.diagnostics.bounds import GAIN, MASS_BEYOND, gains, judged
from jaxlfi.diagnostics.local_model import LocalModel, local_model
from jaxlfi.distributions.belief import Belief
from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.space import Space
from jaxlfi.distributions.support import Support
from tests.strategies import boxes, mixtures, shapes, vectors

SPACE = Space(("mass", "drag"), (False, False))
UNITS = ("kg", "")
BOX = Support([0.0, -2.0], [4.0, 6.0])
PHI = Support([-10.0, -2.0], [10.0, 10.0])
ADAPT = "The true value may lie beyond it: widen the support there, or adapt it with --heuristic edge."
WIDEN_PHI = "The bound is that of the feasible domain Phi: widen Phi if it can be."

evidence = jax.jit(mass_beyond)
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


def by_mass(belief: Belief) -> BoundEvidence:
    """What the posterior alone says, without simulations."""
    box = jax.device_get(belief.support)
    return judged(np.stack([box.low, box.high]), np.stack(evidence(belief)), None)


def warnings(*beliefs: Belief, phi: Support = PHI, grows: bool = False) -> list[str]:
    return bound_warnings(SPACE, UNITS, [by_mass(belief) for belief in beliefs], phi, grows)


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
    low, high = jax.jit(jax.vmap(mass_beyond))(batch)
    assert low.shape == high.shape == (3, 2)
    np.testing.assert_allclose(low[0], evidence(several[0])[0], atol=1e-6)
    np.testing.assert_allclose(high[2], evidence(several[2])[1], atol=1e-6)


# -------------------------------------------------------------------------------------------- whom simulations blame

UNIT = Support([-1.0, -1.0, -1.0], [1.0, 1.0, 1.0])
DESIGN = np.array([[1.0, 0.9, 0.0], [0.9, 1.0, 0.5], [0.0, 0.5, 1.0], [1.0, 1.0, 1.0], [1.0, -1.0, 0.0]])
"""Of five summaries that are linear in three parameters, of which the first two do nearly the same."""


def linear(theta: np.ndarray, rng: np.random.Generator, noise: float = 0.1) -> np.ndarray:
    return theta @ DESIGN.T + noise * rng.normal(size=(len(theta), len(DESIGN)))


def curved(theta: np.ndarray, rng: np.random.Generator, noise: float = 0.1) -> np.ndarray:
    """Summaries on scales from 1e-6 to 1e6, one that never varies, and a fourth power of the first parameter."""
    x = linear(theta + 0.3 * theta**2 * [1, 0, 0], rng, noise)
    return np.concatenate([x * 10.0 ** np.arange(-6, 7, 3) + 1e3, np.full((len(x), 1), 7.0)], axis=1)


def blamed(truth, simulator=linear, seed: int = 0, n: int = 1000, mass=None) -> set[tuple[int, int]]:
    """(side, parameter) of the bounds that look wrong; the mass blames all of them by default."""
    rng = np.random.default_rng(seed)
    theta = rng.uniform(-1, 1, (n, 3))
    observed = simulator(np.array([truth]), rng)[0]
    model = local_model(theta, simulator(theta, rng), observed, UNIT)
    mass = np.full((2, 3), 0.1) if mass is None else mass
    found = judged(np.stack([UNIT.low, UNIT.high]), mass, model)
    return {(int(side), int(d)) for side, d in np.argwhere(found.wrong)}


@pytest.mark.parametrize("simulator", [linear, curved])
@pytest.mark.parametrize(
    ("truth", "wrong"),
    [
        ((1.8, 0.9, 0.0), {(1, 0)}),  # what the first lacks, the second would make up for, beyond its own bound
        ((-1.8, -0.9, 0.0), {(0, 0)}),
        ((0.5, -2.0, 0.5), {(0, 1)}),
        ((0.9, 0.9, 1.7), {(1, 2)}),
        ((0.0, 0.0, 0.0), set()),
        ((0.95, -0.95, 0.95), set()),  # just inside all of its bounds
    ],
)
def test_the_bound_that_excludes_the_truth_is_blamed_and_no_other(truth, wrong, simulator):
    """Whatever mass the posterior has beyond, up to what speaks against a bound by itself, as the local model holds."""
    found = [blamed(truth, simulator, seed) for seed in range(5)]
    assert found.count(wrong) >= 4, found


def test_two_bounds_that_exclude_the_truth_are_blamed():
    assert [blamed((1.9, 0.0, -1.9), seed=seed) for seed in range(3)] == [{(1, 0), (0, 2)}] * 3


def test_right_bounds_are_rarely_blamed_by_simulations():
    """Truths all over the box: without mass beyond, fewer than one run in fifty names a bound."""
    rng = np.random.default_rng(1)
    found = [blamed(rng.uniform(-1, 1, 3), seed=seed, n=300, mass=np.zeros((2, 3))) for seed in range(150)]
    assert sum(map(bool, found)) <= 3


def test_a_parameter_that_does_nothing_is_not_blamed():
    def simulator(theta, rng):
        return linear(theta * [1, 0, 1], rng)

    for seed in range(5):
        assert blamed((2.2, 0.0, 0.0), simulator, seed) == {(1, 0)}


def test_without_a_local_model_the_mass_decides():
    mass = np.array([[0.0, 0.3, 0.1], [0.9, 0.0, 0.0]])
    assert blamed((0.0, 0.0, 0.0), n=9, mass=mass) == {(0, 1), (1, 0)}


def test_where_the_local_model_explains_nothing_mass_and_simulations_count_alike():
    """An observation that is far from everything, and along no slope; a mass less than half of the greatest is left."""
    residual, slopes = np.array([30.0, 4.0, 0.0]), np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 1e-3]])
    mass = np.array([[0.0, 0.8, 0.0], [0.0, 0.3, 0.5]])
    model = LocalModel(np.array([1.0, 0.0, 0.0]), residual, slopes)
    found = judged(np.zeros((2, 3)), mass, model)
    assert found.wrong.tolist() == [[False, True, False], [True, False, True]]
    mass[1, 0] = 0.9  # both point there first
    assert judged(np.zeros((2, 3)), mass, model).wrong.tolist() == [[False] * 3, [True, False, False]]
    assert found.gain[1, 0] == pytest.approx(4.0**2 - 2.0**2)  # the bound is at the centre, and moves by two


def test_gains_are_those_of_bounds_one_after_another():
    """Two parameters move one summary alike: without one of the bounds, the other is not needed."""
    model = LocalModel(np.ones(2), np.array([3.0]), np.array([[2.0, 1.9]]))
    gain, before, after = gains(model)
    assert (before, after) == pytest.approx((9.0, 0.0)) and gain.round(6).tolist() == [[0, 0], [9.0, 0]]
    assert gain[1, 0] > GAIN


def test_evidence_of_a_run_puts_both_together():
    rng = np.random.default_rng(2)
    theta = rng.uniform(UNIT.low, UNIT.high, (500, 3))
    x, observed = linear(theta, rng), linear(np.array([[0.0, 0.0, 2.0]]), rng)[0]
    mixture = GaussianMixture(jnp.zeros(1), jnp.array([[0.0, 1.2, 1.2]]), 0.1 * jnp.eye(3)[None])
    found = bound_evidence(Belief(mixture, UNIT, jnp.asarray(True)), theta, x, observed)
    assert np.argwhere(found.wrong).tolist() == [[1, 2]]  # the mass beyond the second's is what the third lacks
    np.testing.assert_allclose(found.mass[1], [0.0, stats.norm.sf(-2), stats.norm.sf(-2)], atol=1e-4)


# ------------------------------------------------------------------------------------------------------ what warns


def test_a_posterior_in_the_middle_does_not_warn():
    assert warnings(centred(0, 2.0)) == []


@pytest.mark.parametrize(
    ("d", "at", "begin"),
    [
        (0, -0.3, "mass reaches its lower bound 0 kg"),
        (0, 4.3, "mass reaches its upper bound 4 kg"),
        (1, 6.3, "drag reaches its upper bound 6"),
    ],
)
def test_a_posterior_centred_beyond_a_bound_warns_of_that_bound(d, at, begin):
    (warning,) = warnings(centred(d, at))
    assert warning == f"{begin} (0.84 of the posterior mass lies beyond it). {ADAPT}"


def test_a_bound_that_only_the_simulations_speak_against_is_said_to_be_so():
    bounds, wrong = np.array([[0.0, -2.0], [4.0, 6.0]]), np.array([[False, False], [True, False]])
    one = BoundEvidence(bounds, np.full((2, 2), 0.02), 20.0 * wrong, wrong)
    (text,) = bound_warnings(SPACE, UNITS, [one], PHI)
    assert text == f"mass reaches its upper bound 4 kg (the run's simulations say so, not its posterior). {ADAPT}"
    (text,) = bound_warnings(SPACE, UNITS, [one, one], PHI)
    assert text == f"mass reaches its upper bound 4 kg (in 2 of 2 runs). {ADAPT}"


def test_bounds_are_in_natural_units():
    """This also holds for a parameter that is inferred as its logarithm."""
    box = Support(np.log([0.5, 0.1]), np.log([4.0, 10.0]))
    belief = believed([[np.log(5.0), 0.0]], [[0.1, 0.1]], box=box)
    space, phi = Space(("stiffness", "damping"), (True, True)), Support([-5.0, -5.0], [5.0, 5.0])
    (warning,) = bound_warnings(space, ("N/m", "N s/m"), [by_mass(belief)], phi)
    assert warning == f"stiffness reaches its upper bound 4 N/m (0.99 of the posterior mass lies beyond it). {ADAPT}"
    (warning,) = bound_warnings(space, None, [by_mass(belief)] * 2, phi)
    assert warning.startswith("stiffness reaches its upper bound 4 (in 2 of 2 runs; in the median 0.99 of the post")


@pytest.mark.parametrize("at", [0.3, 3.7])
def test_a_posterior_along_a_bound_that_falls_towards_it_does_not_warn(at):
    """All of it lies in the outer tenth of the width, two standard deviations inside the bound."""
    belief = centred(0, at, 0.15)
    assert max(float(side[0]) for side in edge_mass(belief)) > 0.7
    assert warnings(belief) == []


def test_a_few_components_beyond_are_outvoted():
    """One of ten components lies beyond the upper bound: a tenth of the mass, which is below the threshold."""
    means = [[2.0, 2.0]] * 9 + [[5.0, 2.0]]
    belief = believed(means, np.full((10, 2), 0.1))
    np.testing.assert_allclose(evidence(belief)[1][0], 0.1, atol=1e-3)
    assert warnings(belief) == []


def test_one_network_of_four_beyond_is_enough():
    """It sees no way to explain the observation from inside."""
    (warning,) = warnings(believed([[2.0, 2.0]] * 3 + [[5.0, 2.0]], np.full((4, 2), 0.1)))
    assert warning.startswith("mass reaches its upper bound 4 kg (0.25 of the posterior mass lies beyond it)")


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
    assert texts[0].startswith("mass reaches its lower bound 0 kg (0.46 of")
    assert texts[1].startswith("mass reaches its upper bound 4 kg (0.46 of")
    assert evidence(centred(0, 2.0, 4 / np.sqrt(12)))[0][0] < MASS_BEYOND  # as wide as the uniform distribution: none


# ------------------------------------------------------------------------------------------------------- the messages


def test_at_phis_own_bound_the_advice_is_another():
    (warning,) = warnings(centred(1, -2.3))
    assert warning == f"drag reaches its lower bound -2 (0.84 of the posterior mass lies beyond it). {WIDEN_PHI}"


def test_a_bound_beyond_phi_is_limited_by_it_too():
    """A named support may be wider than Phi, and widens it: no heuristic moves the bound further."""
    wide = dataclasses.replace(centred(1, -5.3), support=Support([0.0, -5.0], [4.0, 6.0]))
    (warning,) = warnings(wide)
    assert "widen Phi" in warning and "edge" not in warning


def test_several_runs_are_summarised():
    runs = [centred(0, at) for at in (4.3, 4.0, 2.0, 4.3)]
    (text,) = warnings(*runs)
    place = (
        "mass reaches its upper bound 4 kg (in 3 of 4 runs; in the median 0.67 of the posterior mass lies beyond it)"
    )
    assert text == f"{place}. {ADAPT}"


def test_the_summary_tells_phis_bounds_apart():
    movable, limited = warnings(*[believed([[-0.3, -2.3]], [[0.3, 0.3]])] * 2)
    assert movable.startswith("mass reaches its lower bound 0 kg (in 2 of 2 runs") and movable.endswith(ADAPT)
    assert limited.startswith("drag reaches its lower bound -2 (in 2 of 2 runs") and limited.endswith(WIDEN_PHI)


def test_runs_whose_bounds_differ_are_summarised_by_their_range():
    runs = [
        dataclasses.replace(centred(0, 4.3), support=Support([0.0, -2.0], [high, 6.0])) for high in (3.25, 4.0, 3.5)
    ]
    (text,) = warnings(*runs)
    assert text.startswith("mass reaches its upper bound 3.25 to 4 kg (in 3 of 3 runs")


def test_several_runs_of_which_none_names_a_bound():
    assert warnings(*[centred(0, 2.0)] * 3) == []


def test_of_a_support_that_grows_only_the_bounds_of_phi_are_named():
    """The other bounds move; at Phi nothing does."""
    both = believed([[4.3, -2.3]], [[0.3, 0.3]])
    assert len(warnings(both)) == 2
    (text,) = warnings(both, grows=True)
    assert text.startswith("drag reaches its lower bound -2 (0.84") and text.endswith(WIDEN_PHI)
    (text,) = warnings(both, both, grows=True)
    assert text.startswith("drag reaches its lower bound -2 (in 2 of 2 runs") and text.endswith(WIDEN_PHI)


def test_a_bound_near_phis_is_phis_relative_to_its_width():
    """Units do not matter: a support from 5e-9 is not at Phi's 0 where Phi is 1e-7 wide."""
    phi = Support([0.0, -2.0], [1e-7, 10.0])
    box = Support([5e-9, -2.0], [5e-8, 6.0])
    belief = believed([[4e-9, 2.0]], [[1e-10, 0.3]], box=box)
    (text,) = warnings(belief, phi=phi)
    assert text.endswith(ADAPT)
