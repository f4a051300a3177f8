"""EDGE, MODE, CENTRE and truncation: against the pseudocode, and their laws.

The contract of all heuristics is tested in `contracts/test_heuristics_contract.py`.
"""

import dataclasses
import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy import stats
from scipy.optimize import brentq, linear_sum_assignment
from scipy.special import ndtr

from jaxlfi.bayessim.algorithm import propose
from jaxlfi.bayessim.settings import Settings
from jaxlfi.distributions.belief import Belief
from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.support import Support
from jaxlfi.heuristics import Centre, Choice, Edge, Fixed, Heuristic, Matched, Mode, Truncate, paired, stretch
from jaxlfi.heuristics.matching import match
from jaxlfi.heuristics.truncate import MIN_WIDTH
from tests.oracles import heuristics as oracle
from tests.strategies import floats, problems, vectors

RULES = {
    "none": Fixed(),
    "edge": Edge(),
    "mode": Mode(),
    "centre": Centre(),
    "truncate": Truncate(),
    "matched": Matched(Mode()),
    "choice": Choice(1, (Edge(), Mode(), Centre())),
}
apply = jax.jit(lambda rule, previous, posterior, feasible: rule(previous, posterior, feasible))
apply_to_all = jax.jit(jax.vmap(lambda rule, *case: rule(*case), in_axes=(None, 0, 0, 0)))
matched = jax.jit(match)
permuted = jax.jit(lambda mixture, order: mixture.permute(order))
marginal_cdf = jax.jit(lambda mixture, at: mixture.marginal_cdf(at))


def edges(zone_width: float = 1.0) -> st.SearchStrategy[Edge]:
    """Edge with hyperparameters for which either outcome is likely."""
    hyperparameters = floats(0.02, 0.4), floats(0.001, 0.3), floats(0.01, 1.5), floats(0, zone_width), floats(0, 1)
    return st.builds(Edge, *hyperparameters, floats(1, 3))


def modes() -> st.SearchStrategy[Mode]:
    """Mode with hyperparameters for which either outcome is likely."""
    return st.builds(Mode, floats(0.0, 0.6), floats(0.1, 1.0), floats(0.0, 0.6), floats(0.01, 1.5))


def truncations() -> st.SearchStrategy[Truncate]:
    """Truncate with quantiles that cut off between hardly any and most of the mass."""
    return st.builds(Truncate, floats(1e-4, 0.4))


def any_rule() -> st.SearchStrategy[Heuristic]:
    """One of the rules that move a bound."""
    return st.one_of(edges(), modes(), st.just(Centre()), truncations())


def decided(rule, previous, posterior, feasible, margin: float = 1e-3) -> bool:
    """Whether every comparison the rule makes is decided by more than rounding, and no quantile lies in a gap."""
    evidence = {
        name: np.asarray(seen) for name, seen in apply(rule, *(previous, posterior, feasible))[1].evidence.items()
    }
    gaps = [np.ones(1)]
    if isinstance(rule, Edge):
        threshold = edge_threshold(rule, posterior, previous.support)
        gaps += [evidence[side] - threshold for side in ("mass_left", "mass_right")]
    if isinstance(rule, Mode):
        box, means = previous.support, np.asarray(posterior.means)
        z = (means - np.asarray(box.low)) / np.asarray(box.width)
        gaps += [np.abs(evidence["mode_shift"]) - rule.shift_threshold]
        gaps += [np.abs(z) - rule.proximity, np.abs(1 - z) - rule.proximity]
        gaps += [evidence[side] - rule.mass_threshold for side in ("weight_left", "weight_right")]
    if isinstance(rule, Truncate):
        for end in ("interval_low", "interval_high"):
            densities = stats.norm.pdf(evidence[end], posterior.means, posterior.marginal_scales)
            gaps += [np.maximum(np.asarray(posterior.weights) @ densities / rule.quantile - 0.1, 0)]
    return min(np.abs(gap).min() for gap in gaps) > margin


def edge_threshold(rule: Edge, posterior: GaussianMixture, box: Support) -> np.ndarray:
    """The mass threshold by the oracle, shape [D]."""
    now, box = jax.device_get((posterior, box))
    scales = np.sqrt((now.scale_tril**2).sum(-1))
    weights = np.exp(now.logits - now.logits.max())
    return oracle.edge_threshold(
        box.low, box.high, weights / weights.sum(), now.means, scales, rule.mass_threshold, rule.uninformed_factor
    )


def unchecked(rule: Heuristic, **values) -> Heuristic:
    """The rule with values that no user could give, as if JAX had put these leaves there."""
    names = [field.name for field in dataclasses.fields(rule)]
    return jax.tree.unflatten(jax.tree.structure(rule), [values.get(name, getattr(rule, name)) for name in names])


@jax.jit
def moved(belief: Belief, scale, shift) -> Belief:
    """The belief in the coordinates scale * theta + shift, scale positive."""
    box = belief.support
    mixture = belief.mixture.affine(scale, shift)
    return Belief(mixture, Support(scale * box.low + shift, scale * box.high + shift), belief.informed)


@jax.jit
def reflected(belief: Belief) -> Belief:
    """The belief about -theta."""
    mixture = belief.mixture
    return Belief(
        GaussianMixture(mixture.logits, -mixture.means, mixture.scale_tril),
        Support(-belief.support.high, -belief.support.low),
        belief.informed,
    )


def example(weights=(0.7, 0.3), before=((0.5, 3.0), (3.5, 4.0)), now=((0.1, 3.2), (3.9, 4.0))):
    """Two components in the box [0, 4] x [2, 6], whose means moved."""
    tril = jnp.asarray(np.float32([[[0.4, 0.0], [0.1, 0.3]], [[0.2, 0.0], [-0.1, 0.5]]]))
    mixture = lambda means: GaussianMixture(*(jnp.asarray(np.float32(each)) for each in (np.log(weights), means)), tril)
    box, feasible = Support([0.0, 2.0], [4.0, 6.0]), Support([-1.0, 0.0], [4.5, 20.0])
    return Belief(mixture(before), box, jnp.asarray(True)), mixture(now), feasible


# ------------------------------------------------------------------------------ the paper's pseudocode


def random_cases(seed: int, n: int = 400, components: int = 3, dim: int = 3):
    """Stacked cases with boxes that touch Phi on some sides; components are distributed differently on either side."""
    draw = np.random.default_rng(seed)
    low = draw.uniform(-3, 2, (n, dim))
    width = draw.uniform(0.5, 5, (n, dim))
    gaps = draw.uniform(0, 3, (2, n, dim)) * (draw.uniform(size=(2, n, dim)) > 0.25)
    # From 0.6 widths left of the box to as much right of it; more to the left, so that swapped sides are noticed.
    means = low[:, None] + width[:, None] * (draw.beta(1.2, 1.7, (n, components, dim)) * 2.2 - 0.6)
    before = means + draw.normal(0.1, 0.4, means.shape)
    tril = np.tril(draw.normal(0, 0.2, (n, components, dim, dim)), -1)
    tril[..., np.arange(dim), np.arange(dim)] = draw.uniform(0.02, 0.4, (n, components, dim))
    logits = draw.normal(0, 1, (2, n, components))
    as_jax = lambda value: jnp.asarray(value.astype(np.float32))
    mixtures = [
        GaussianMixture(as_jax(logits[i]), as_jax(mean), as_jax(tril)) for i, mean in enumerate((before, means))
    ]
    support = Support(as_jax(low), as_jax(low + width))
    feasible = Support(as_jax(low - gaps[0]), as_jax(low + width + gaps[1]))
    return Belief(mixtures[0], support, jnp.asarray(np.ones(n, bool))), mixtures[1], feasible


def against_oracle(rule, cases, expected, names, thresholds, margins):
    """Compare bounds and evidence case by case; return which way each bound went, [N, D] each.

    Cases in which a comparison is within `margins` of a tie are left out: float32 and float64 may differ. So may the
    quantile of a mixture between its components, by 1e-5 and more where there is little density.
    """
    belief, adaptation = jax.device_get(apply_to_all(rule, *cases))
    previous, posterior, feasible = jax.device_get(cases)
    compared = 0
    for i in range(previous.informed.shape[0]):
        pick = lambda leaf, i=i: np.asarray(leaf[i], np.float64)
        box, phi = jax.tree.map(pick, (previous.support, feasible))
        now, before = jax.tree.map(pick, (posterior, previous.mixture))
        weights = np.exp(now.logits) / np.exp(now.logits).sum()
        low, high, *evidence = expected(box, phi, weights, now, before)
        for name, value in zip(names, evidence, strict=True):
            np.testing.assert_allclose(adaptation.evidence[name][i], value, atol=1e-4, err_msg=name)
        limits = thresholds(now, box) if callable(thresholds) else thresholds
        if any((np.abs(value - limits) < margins).any() for value in evidence):
            continue
        np.testing.assert_allclose(belief.support.low[i], low, atol=1e-4)
        np.testing.assert_allclose(belief.support.high[i], high, atol=1e-4)
        compared += 1
    assert compared > 0.8 * previous.informed.shape[0]
    np.testing.assert_array_equal(adaptation.low_shift, belief.support.low - previous.support.low)
    np.testing.assert_array_equal(adaptation.high_shift, belief.support.high - previous.support.high)
    return np.asarray(adaptation.low_shift), np.asarray(adaptation.high_shift)


def every_outcome_occurs(cases, low_shift, high_shift, expansion):
    """On either side, some bounds stayed, some took the whole step, and Phi stopped some."""
    previous, _, feasible = jax.device_get(cases)
    step = expansion * np.asarray(previous.support.high - previous.support.low)
    for shift, room in (
        (-low_shift, previous.support.low - feasible.low),
        (high_shift, feasible.high - previous.support.high),
    ):
        free = room > step + 1e-4
        assert (free & (shift > 0)).sum() > 20
        assert (~free & (shift > 0) & (shift < step - 1e-4)).sum() > 10
        assert (free & (shift == 0)).sum() > 20


@pytest.mark.parametrize(
    ("rule", "seed"),
    [
        (Edge(), 0),
        (Edge(zone_fraction=0.2, mass_threshold=0.1, expansion=0.5), 1),
        (Edge(zone_fraction=0.0, zone_width=0.1, mass_threshold=0.05), 2),
        (Edge(zone_fraction=0.1, mass_threshold=0.08, tail=0.0, uninformed_factor=1.5), 3),
        (Edge(mass_threshold=0.005, uninformed_factor=1.0), 4),
    ],
    ids=["defaults", "wide", "absolute", "zone-alone", "paper"],
)
def test_edge_is_algorithm_2(rule, seed):
    def expected(box, phi, weights, now, before):
        scales = np.sqrt((now.scale_tril**2).sum(-1))
        return oracle.edge(
            box.low,
            box.high,
            phi.low,
            phi.high,
            weights,
            now.means,
            scales,
            rule.zone_fraction,
            edge_threshold(rule, now, box),
            rule.expansion,
            rule.zone_width,
            rule.tail,
        )

    cases = random_cases(seed)
    thresholds = functools.partial(edge_threshold, rule)
    shifts = against_oracle(rule, cases, expected, ("mass_left", "mass_right"), thresholds, 1e-4)
    every_outcome_occurs(cases, *shifts, rule.expansion)


@pytest.mark.parametrize(
    ("rule", "seed"),
    [(Mode(), 10), (Mode(shift_threshold=0.2, proximity=0.7, mass_threshold=0.3, expansion=0.6), 11)],
    ids=["defaults", "strict"],
)
def test_mode_is_algorithm_3(rule, seed):
    def expected(box, phi, weights, now, before):
        return oracle.mode(
            box.low,
            box.high,
            phi.low,
            phi.high,
            weights,
            now.means,
            before.means,
            rule.shift_threshold,
            rule.proximity,
            rule.mass_threshold,
            rule.expansion,
            1,
        )

    cases = random_cases(seed)
    shifts = against_oracle(rule, cases, expected, ("weight_left", "weight_right"), rule.mass_threshold, 1e-4)
    every_outcome_occurs(cases, *shifts, rule.expansion)


def test_mode_does_nothing_in_the_first_iteration_of_algorithm_3():
    box = oracle.mode([0.0], [1.0], [-1.0], [2.0], [1.0], np.array([[0.1]]), np.array([[0.9]]), 0.0, 1.0, 0.0, 0.2, 0)
    assert (box[0], box[1]) == (0.0, 1.0)


def test_centre_is_algorithm_4():
    def expected(box, phi, weights, now, before):
        return oracle.centre(box.low, box.high, phi.low, phi.high, weights, now.means)

    cases = random_cases(20)
    low_shift, high_shift = against_oracle(Centre(), cases, expected, (), 0.0, 0.0)
    previous, _, feasible = jax.device_get(cases)
    room_left, room_right = previous.support.low - feasible.low, feasible.high - previous.support.high
    for stopped in (low_shift == -room_left, high_shift == room_right):
        assert 50 < (stopped & (low_shift != 0)).sum() < 1000


def test_edge_by_hand():
    """Half of the mass left of 0.4 = 10 % of [0, 4] moves that bound by 20 %; the right one stays."""
    box, feasible = Support([0.0], [4.0]), Support([-10.0], [10.0])
    posterior = GaussianMixture(jnp.zeros(1), jnp.array([[0.4]]), jnp.array([[[1.0]]]))
    belief, adaptation = apply(Edge(), Belief(posterior, box, jnp.asarray(False)), posterior, feasible)
    np.testing.assert_allclose(adaptation.evidence["mass_left"], [0.5], rtol=1e-6)
    np.testing.assert_allclose(adaptation.evidence["mass_right"], [6.8714e-4], rtol=1e-3)
    np.testing.assert_allclose(belief.support.low, [-0.8], rtol=1e-6)
    np.testing.assert_array_equal(belief.support.high, [4.0])


@pytest.mark.parametrize(("scale", "moves"), [(0.1, True), (1.2, False)], ids=["narrow", "about uniform"])
def test_edge_asks_for_more_evidence_of_a_parameter_that_the_posterior_says_little_of(scale, moves):
    """A sixth of the mass in the zone moves the bound of a narrow posterior, not of one about as wide as the box."""
    box, feasible = Support([0.0], [4.0]), Support([-10.0], [10.0])
    mean = 0.4 - scale * stats.norm.ppf(0.16)
    posterior = GaussianMixture(jnp.zeros(1), jnp.array([[mean]]), jnp.array([[[scale]]]))
    belief, adaptation = apply(Edge(), Belief(posterior, box, jnp.asarray(False)), posterior, feasible)
    np.testing.assert_allclose(adaptation.evidence["mass_left"], [0.16], rtol=1e-4)
    assert bool(belief.support.low[0] < 0) == moves and belief.support.high[0] == 4
    before = Edge(uninformed_factor=1.0)
    assert apply(before, Belief(posterior, box, jnp.asarray(False)), posterior, feasible)[0].support.low[0] < 0


def test_mode_by_hand():
    previous, posterior, feasible = example()
    belief, adaptation = apply(Mode(), previous, posterior, feasible)
    # Dimension 0: weight 0.7 moved left next to the left bound, and 0.3 right next to the right one; Phi ends at 4.5.
    np.testing.assert_allclose(adaptation.evidence["mode_shift"], [[-0.4, 0.2], [0.4, 0.0]], atol=1e-6)
    np.testing.assert_allclose(adaptation.evidence["weight_left"], [0.7, 0.0], rtol=1e-6)
    np.testing.assert_allclose(adaptation.evidence["weight_right"], [0.3, 0.0], rtol=1e-6)
    np.testing.assert_allclose(belief.support.low, [-0.8, 2.0], rtol=1e-6)
    np.testing.assert_allclose(belief.support.high, [4.5, 6.0], rtol=1e-6)


def test_centre_by_hand():
    previous, posterior, feasible = example()
    belief, adaptation = apply(Centre(), previous, posterior, feasible)
    np.testing.assert_allclose(adaptation.evidence["weighted_mean"], [1.24, 3.44], rtol=1e-6)
    np.testing.assert_allclose(belief.support.low, [-0.76, 1.44], rtol=1e-5)
    np.testing.assert_allclose(belief.support.high, [3.24, 5.44], rtol=1e-6)


def truncated(box, phi, weights, means, scales, quantile):
    """Bounds and interval of `Truncate` in float64: roots of each marginal's CDF, and one case after the other."""

    def root(d, sign):
        return brentq(lambda x: weights @ ndtr(sign * (x - means[:, d]) / scales[:, d]) - quantile, -100, 100)

    interval_low, interval_high = (np.array([root(d, sign) for d in range(len(box.low))]) for sign in (1, -1))
    low, high = np.clip(interval_low, box.low, box.high), np.clip(interval_high, box.low, box.high)
    for d in range(len(low)):
        least = min(MIN_WIDTH * (phi.high[d] - phi.low[d]), box.high[d] - box.low[d])
        if high[d] - low[d] < least:
            middle = np.clip((low[d] + high[d]) / 2, box.low[d] + least / 2, box.high[d] - least / 2)
            low[d], high[d] = middle - least / 2, middle + least / 2
    return low, high, interval_low, interval_high


@pytest.mark.parametrize(("quantile", "seed"), [(1e-3, 30), (0.3, 31)], ids=["default", "strict"])
def test_truncate_is_the_intersection_with_the_posteriors_interval(quantile, seed):
    def expected(box, phi, weights, now, before):
        return truncated(box, phi, weights, now.means, np.sqrt((now.scale_tril**2).sum(-1)), quantile)

    cases = random_cases(seed, n=200)
    low_shift, high_shift = against_oracle(
        Truncate(quantile), cases, expected, ("interval_low", "interval_high"), 0.0, 0.0
    )
    support, feasible = jax.device_get((cases[0].support, cases[2]))
    sliver = np.isclose(support.width + high_shift - low_shift, MIN_WIDTH * feasible.width, rtol=1e-2)
    for shift in (low_shift, -high_shift):
        assert 40 < ((shift > 0) & ~sliver).sum() < 560
    if quantile == 0.3:
        assert (sliver & (low_shift == 0)).sum() > 5 < (sliver & (high_shift == 0)).sum()


def test_truncate_by_hand():
    """A tenth of N(1, 1) lies below -0.28 and a tenth above 2.28; more than that of N(2, 10) lies beyond the box."""
    box, feasible = Support([-1.0, 0.0], [3.0, 4.0]), Support([-10.0, -10.0], [10.0, 10.0])
    posterior = GaussianMixture(jnp.zeros(1), jnp.array([[1.0, 2.0]]), jnp.diag(jnp.array([1.0, 10.0]))[None])
    belief, adaptation = apply(Truncate(0.1), Belief(posterior, box, jnp.asarray(True)), posterior, feasible)
    np.testing.assert_allclose(adaptation.evidence["interval_low"], [1 - 1.2815516, 2 - 12.815516], rtol=1e-5)
    np.testing.assert_allclose(belief.support.low, [1 - 1.2815516, 0.0], rtol=1e-5)
    np.testing.assert_allclose(belief.support.high, [1 + 1.2815516, 4.0], rtol=1e-5)
    assert float(belief.support.low[1]) == 0.0 and float(adaptation.high_shift[1]) == 0.0


def test_stretch_moves_only_the_chosen_bounds_and_not_beyond_phi():
    box, feasible = Support([0.0, 0.0, 0.0], [1.0, 2.0, 1.0]), Support([-0.1, -9.0, 0.0], [5.0, 9.0, 1.2])
    left, right = jnp.array([True, False, True]), jnp.array([False, True, True])
    stretched = stretch(box, feasible, left, right, 0.3)
    np.testing.assert_allclose(stretched.low, [-0.1, 0.0, 0.0], rtol=1e-6)
    np.testing.assert_allclose(stretched.high, [1.0, 2.6, 1.2], rtol=1e-6)


# -------------------------------------------------------------------------------------------- the laws


@pytest.mark.parametrize("name", RULES)
@given(problems())
def test_the_support_stays_in_phi(name, problem):
    support, feasible = jax.device_get((apply(RULES[name], *problem)[0].support, problem[2]))
    assert (support.low >= feasible.low).all() and (support.high <= feasible.high).all()
    assert (support.low < support.high).all()


@given(st.one_of(edges(), modes()), problems())
def test_edge_and_mode_only_grow_and_by_no_more_than_a_step(rule, problem):
    old, new = jax.device_get((problem[0].support, apply(rule, *problem)[0].support))
    assert (new.low <= old.low).all() and (new.high >= old.high).all()
    step = rule.expansion * (old.high - old.low) + 1e-5
    assert (old.low - new.low <= step).all() and (new.high - old.high <= step).all()


@given(problems())
def test_centre_keeps_the_width_and_is_centred_where_phi_lets_it(problem):
    previous, posterior, feasible = jax.device_get(problem)
    new = jax.device_get(apply(Centre(), *problem)[0].support)
    np.testing.assert_allclose(new.width, previous.support.width, atol=1e-5)
    weights = np.exp(posterior.logits - posterior.logits.max())
    mean, half = weights @ posterior.means / weights.sum(), 0.5 * previous.support.width
    fits = (mean - half >= feasible.low) & (mean + half <= feasible.high)
    np.testing.assert_allclose(new.centre[fits], mean[fits], atol=1e-5)


@given(truncations(), problems())
def test_truncate_only_shrinks_and_keeps_its_least_width(rule, problem):
    old, feasible = jax.device_get((problem[0].support, problem[2]))
    new = jax.device_get(apply(rule, *problem)[0].support)
    assert (new.low >= old.low).all() and (new.high <= old.high).all()
    least = np.minimum(MIN_WIDTH * feasible.width, old.width)
    assert (new.width >= least - 1e-6).all()


def test_truncating_a_truncated_box_again_changes_nothing():
    for problem in variants():
        once, _ = apply(Truncate(0.05), *problem)
        twice, adaptation = apply(Truncate(0.05), once, *problem[1:])
        chex.assert_trees_all_equal(once, twice)
        assert not np.any(adaptation.low_shift) and not np.any(adaptation.high_shift)


@pytest.mark.parametrize("side", [-1, 1])
def test_truncate_keeps_a_sliver_at_the_bound_the_posterior_has_left_by(side):
    """However far away the posterior is, and however often: nothing is left to shrink to, and the box stays a box."""
    belief, _, feasible = example()
    box = belief.support
    means, tril = np.float32([[2.0 + side * 1e6, 4.0]]), 0.1 * np.eye(2, dtype=np.float32)[None]
    gone = GaussianMixture(jnp.zeros(1), jnp.asarray(means), jnp.asarray(tril))
    for _ in range(3):
        belief = jax.device_get(apply(Truncate(), belief, gone, feasible)[0])
        bound = box.high if side > 0 else box.low
        kept = belief.support.high if side > 0 else belief.support.low
        assert float(kept[0]) == float(bound[0])
        np.testing.assert_allclose(belief.support.width[0], 1e-3 * 5.5, rtol=1e-3)


def test_after_truncation_proposals_are_uniform_over_the_support(key):
    """They are neither from the posterior nor over the previous support."""
    belief, adaptation = apply(Truncate(0.1), *example())
    assert float(adaptation.high_shift[0]) < 0 < float(adaptation.low_shift[1])
    settings = Settings(simulations_per_round=2000, simulation_budget=2000)
    draws = np.asarray(jax.jit(propose, static_argnums=1)(key, None, settings, belief))
    for d in range(2):
        uniform = stats.uniform(belief.support.low[d], belief.support.width[d])
        assert stats.kstest(draws[:, d], uniform.cdf).pvalue > 1e-3


def test_truncating_nothing_keeps_the_support():
    belief, _ = apply(Truncate(0.0), *example())
    chex.assert_trees_all_equal(belief.support, example()[0].support)


WRONG = {
    "a quantile below 0": (Truncate, {"quantile": -1e-3}, r"quantile: expected a number in \[0, 0.5\), got -0.001"),
    "a quantile of a half": (Truncate, {"quantile": 0.5}, r"quantile: expected a number in \[0, 0.5\), got 0.5"),
    "no number": (Truncate, {"quantile": float("nan")}, r"quantile: .*, got nan"),
    "a bound that moves inwards": (Edge, {"expansion": -1}, r"expansion: expected a number in \[0, inf\), got -1"),
    "mass that counts twice": (Edge, {"tail": 2}, r"tail: expected a number in \[0, 1\], got 2"),
    "infinite": (Edge, {"zone_width": float("inf")}, r"zone_width: expected a number in \[0, inf\), got inf"),
    "in one dimension": (Mode, {"proximity": jnp.array([0.5, 1.5])}, r"proximity: .*, got \[0.5, 1.5\]"),
    "a list": (Mode, {"expansion": [0.1, 0.2]}, r"expansion: expected a number .*, got \[0.1, 0.2\]"),
    "text": (Mode, {"expansion": "0.1"}, r"expansion: expected a number .*, got '0.1'"),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_hyperparameters_are_refused_by_name(case):
    kind, values, message = WRONG[case]
    for make in (lambda: kind(**values), lambda: kind().replace(**values)):
        with pytest.raises(ValueError, match=f"^{message}$"):
            make()


def test_centre_of_a_box_wider_than_phi_is_phi():
    previous, posterior, _ = example()
    feasible = Support([1.0, 2.5], [3.0, 20.0])
    new = apply(Centre(), previous, posterior, feasible)[0].support
    np.testing.assert_array_equal(new.low, [1.0, 2.5])
    np.testing.assert_array_equal(new.high, [3.0, 6.5])


def test_centre_does_not_leave_phi_by_rounding():
    """For boxes as wide as Phi, high - (high - low) is below low in float32 for many pairs."""
    draw = np.random.default_rng(0)
    low = (draw.normal(size=1000) * 10.0 ** draw.uniform(-3, 3, 1000)).astype(np.float32)
    high = (low + 10.0 ** draw.uniform(-3, 3, 1000)).astype(np.float32)
    assert (high - (high - low) < low).any()
    feasible = Support(jnp.asarray(low), jnp.asarray(high))
    unit = jnp.asarray(np.eye(1000, dtype=np.float32)[None])
    for means in (low - np.float32(1e4), high + np.float32(1e4)):
        posterior = GaussianMixture(jnp.zeros(1), jnp.asarray(means[None]), unit)
        new = apply(Centre(), Belief(posterior, feasible, jnp.asarray(True)), posterior, feasible)[0].support
        assert (np.asarray(new.low) >= low).all() and (np.asarray(new.high) <= high).all()


@given(any_rule(), problems())
def test_reflection_swaps_left_and_right(rule, problem):
    assume(decided(rule, *problem, margin=1e-5))
    previous, posterior, feasible = problem
    belief, adaptation = apply(rule, *problem)
    turned = reflected(previous)
    mirror = reflected(Belief(posterior, feasible, previous.informed))
    mirrored, seen = apply(rule, turned, mirror.mixture, mirror.support)
    (belief, adaptation), (mirrored, seen) = jax.device_get(((belief, adaptation), (mirrored, seen)))
    np.testing.assert_allclose(mirrored.support.low, -belief.support.high, atol=1e-5)
    np.testing.assert_allclose(mirrored.support.high, -belief.support.low, atol=1e-5)
    np.testing.assert_allclose(seen.low_shift, -adaptation.high_shift, atol=2e-5)
    swapped = {
        "mass_left": "mass_right",
        "mass_right": "mass_left",
        "weight_left": "weight_right",
        "weight_right": "weight_left",
        "interval_low": "interval_high",
        "interval_high": "interval_low",
    }
    for name, value in adaptation.evidence.items():
        sign = 1.0 if name.endswith(("left", "right")) else -1.0
        np.testing.assert_allclose(seen.evidence[swapped.get(name, name)], sign * value, atol=1e-5)


@given(any_rule(), problems(), st.data())
def test_translation_and_scaling_are_followed(rule, problem, data):
    assume(decided(rule, *problem))
    previous, posterior, feasible = problem
    dim = previous.support.dim
    scale = jnp.asarray(data.draw(vectors(0.1, 10.0, dim)))
    shift = jnp.asarray(data.draw(vectors(-5.0, 5.0, dim)))
    belief, _ = apply(rule, *problem)
    if isinstance(rule, Edge):
        rule = rule.replace(zone_width=rule.zone_width * scale)
    if isinstance(rule, Mode):
        rule = rule.replace(shift_threshold=rule.shift_threshold * scale)
    phi = moved(Belief(posterior, feasible, previous.informed), scale, shift)
    elsewhere, _ = apply(rule, moved(previous, scale, shift), phi.mixture, phi.support)
    belief, elsewhere, scale, shift = jax.device_get((belief, elsewhere, scale, shift))
    tolerance = 1e-4 * scale + 1e-4
    for there, here in (
        (elsewhere.support.low, belief.support.low),
        (elsewhere.support.high, belief.support.high),
    ):
        assert (np.abs(there - (scale * here + shift)) <= tolerance).all()


@given(any_rule(), problems(components=4), st.permutations(range(4)))
def test_the_order_of_components_does_not_matter(rule, problem, order):
    """It does not matter to EDGE, CENTRE and truncation, nor to MODE if both beliefs are reordered alike."""
    assume(decided(rule, *problem, margin=1e-5))
    previous, posterior, feasible = problem
    order = jnp.asarray(order)
    belief, _ = apply(rule, *problem)
    if isinstance(rule, Mode):
        previous = Belief(permuted(previous.mixture, order), previous.support, previous.informed)
    reordered, _ = apply(rule, previous, permuted(posterior, order), feasible)
    np.testing.assert_allclose(reordered.support.low, belief.support.low, atol=1e-5)
    np.testing.assert_allclose(reordered.support.high, belief.support.high, atol=1e-5)


@given(any_rule(), problems(), st.data())
def test_the_order_of_dimensions_does_not_matter(rule, problem, data):
    dim = problem[0].support.dim
    order = np.asarray(data.draw(st.permutations(range(dim))))
    spread = 1 + 0.3 * np.arange(dim, dtype=np.float32)
    rule = jax.tree.map(lambda value: jnp.asarray(value * spread), rule)
    assume(decided(rule, *problem, margin=1e-5))

    def reorder(tree):
        def leaf(value):
            value = np.asarray(value)
            if value.ndim == 3:
                covariance = (value @ np.swapaxes(value, 1, 2))[:, order][:, :, order]
                return jnp.asarray(np.linalg.cholesky(covariance.astype(float)), jnp.float32)
            return jnp.asarray(value[..., order])

        return jax.tree.map(leaf, tree)

    def keep_logits(mixture):
        return GaussianMixture(mixture.logits, *(reorder(part) for part in (mixture.means, mixture.scale_tril)))

    previous, posterior, feasible = problem
    belief, _ = apply(rule, *problem)
    turned = Belief(keep_logits(previous.mixture), reorder(previous.support), previous.informed)
    reordered, _ = apply(reorder(rule), turned, keep_logits(posterior), reorder(feasible))
    np.testing.assert_allclose(reordered.support.low, np.asarray(belief.support.low)[order], atol=1e-4)
    np.testing.assert_allclose(reordered.support.high, np.asarray(belief.support.high)[order], atol=1e-4)


@given(st.one_of(edges(), modes(), truncations()), problems())
def test_a_scalar_hyperparameter_is_a_constant_vector(rule, problem):
    dim = problem[0].support.dim
    assume(decided(rule, *problem, margin=1e-5))  # the two programs may round differently
    as_vectors = jax.tree.map(lambda value: jnp.asarray(np.full(dim, value, np.float32)), rule)
    chex.assert_trees_all_close(apply(rule, *problem), apply(as_vectors, *problem), rtol=1e-5, atol=1e-5)


@given(problems(), vectors(0.25, 0.75, 3))
def test_no_mass_at_the_edges_is_a_fixed_point_of_edge(problem, places):
    previous, posterior, feasible = problem
    box = jax.device_get(previous.support)
    means = np.broadcast_to(box.low + box.width * places[: box.dim], posterior.means.shape)
    narrow = 0.02 * np.broadcast_to(np.diag(box.width), posterior.scale_tril.shape)
    inside = GaussianMixture(posterior.logits, jnp.asarray(means), jnp.asarray(narrow))
    belief, adaptation = apply(Edge(), previous, inside, feasible)
    chex.assert_trees_all_equal(belief.support, previous.support)
    assert not np.any(adaptation.low_shift) and not np.any(adaptation.high_shift)


@given(problems(), floats(-1.0, 0.0))
def test_mode_does_nothing_after_the_first_round(problem, shift_threshold):
    """Whatever the thresholds and wherever the modes are or moved, there is nothing to compare with."""
    previous, posterior, feasible = problem
    rule = unchecked(Mode(mass_threshold=0.0), shift_threshold=shift_threshold, proximity=2.0)
    first = Belief(previous.mixture, previous.support, jnp.asarray(False))
    for wrapped in (rule, Matched(rule)):
        belief, adaptation = apply(wrapped, first, posterior, feasible)
        chex.assert_trees_all_equal(belief.support, previous.support)
        assert not np.asarray(adaptation.evidence["mode_shift"]).any()
        assert bool(belief.informed)
        chex.assert_trees_all_equal(belief.mixture, posterior)


@given(problems(components=4))
def test_choice_is_the_rule_it_chooses(problem):
    rules = (Edge(), Mode(), Centre(), Fixed(), Truncate())
    for index, rule in enumerate(rules):
        belief, adaptation = apply(Choice(index, rules), *problem)
        expected, alone = apply(rule, *problem)
        chex.assert_trees_all_close(belief, expected, rtol=1e-6, atol=1e-6)
        chex.assert_trees_all_close(adaptation.low_shift, alone.low_shift, atol=1e-6)
        for name, value in alone.evidence.items():
            np.testing.assert_allclose(adaptation.evidence[f"{index}/{name}"], value, atol=1e-6)


def test_choice_keeps_what_every_rule_saw():
    _, adaptation = apply(RULES["choice"], *example())
    assert set(adaptation.evidence) == {
        "0/mass_left",
        "0/mass_right",
        "1/mode_shift",
        "1/weight_left",
        "1/weight_right",
        "2/weighted_mean",
    }


@pytest.mark.parametrize(
    ("rule", "hyperparameter"),
    [
        (Edge(mass_threshold=0.01), {"mass_threshold": [0.01, 1.0]}),
        (Edge(mass_threshold=0.01), {"expansion": [0.2, 0.0]}),
        (Mode(), {"shift_threshold": [0.01, 9.0]}),
        (Mode(), {"proximity": [0.4, 0.0]}),
        (Mode(), {"mass_threshold": [0.05, 1.0]}),
        (Mode(), {"expansion": [0.2, 0.0]}),
    ],
)
def test_hyperparameters_act_on_their_own_dimension(rule, hyperparameter):
    """Both dimensions adapt with the scalar; with a vector that prevents it in the second, only the first adapts."""
    problem = example(before=((0.5, 2.5), (0.6, 2.2)), now=((0.1, 2.1), (0.2, 2.2)))
    free = jax.device_get(apply(rule, *problem)[0].support)
    assert np.all(free.low < np.asarray(problem[0].support.low))
    vector = rule.replace(**{name: jnp.asarray(np.float32(value)) for name, value in hyperparameter.items()})
    held = apply(vector, *problem)[0].support
    np.testing.assert_allclose(held.low, [free.low[0], problem[0].support.low[1]], rtol=1e-6)


def test_a_quantile_of_zero_spares_its_dimension():
    box, *supports = jax.device_get(
        [example()[0].support] + [apply(Truncate(q), *example())[0].support for q in (0.3, jnp.array([0.3, 0.0]))]
    )
    free, held = supports
    assert np.all((free.low > box.low) & (free.high < box.high))
    np.testing.assert_array_equal(held.low, [free.low[0], box.low[1]])
    np.testing.assert_array_equal(held.high, [free.high[0], box.high[1]])


def test_reading_f_zone_width_is_absolute_and_zone_fraction_relative():
    previous, posterior, feasible = example()
    box = jax.device_get(previous.support)
    masses = {
        label: apply(rule, previous, posterior, feasible)[1].evidence["mass_left"]
        for label, rule in {
            "F": Edge(zone_fraction=0.0, zone_width=0.3),
            "both": Edge(zone_width=0.3),
        }.items()
    }
    np.testing.assert_allclose(masses["F"], marginal_cdf(posterior, box.low + 0.3), rtol=1e-5)
    np.testing.assert_allclose(masses["both"], marginal_cdf(posterior, box.low + 0.3 + 0.1 * box.width), rtol=1e-5)


@pytest.mark.parametrize("tail", [0.0, 0.25, 1.0])
def test_reading_g_tail_weighs_the_mass_beyond_the_bound(tail):
    previous, posterior, feasible = example()
    box = jax.device_get(previous.support)
    evidence = apply(Edge(tail=tail), previous, posterior, feasible)[1].evidence
    cdf = functools.partial(marginal_cdf, posterior)
    beyond, zone = cdf(box.low), cdf(box.low + 0.1 * box.width) - cdf(box.low)
    np.testing.assert_allclose(evidence["mass_left"], zone + tail * beyond, rtol=1e-4)
    beyond, zone = 1 - cdf(box.high), cdf(box.high) - cdf(box.high - 0.1 * box.width)
    np.testing.assert_allclose(evidence["mass_right"], zone + tail * beyond, rtol=1e-4, atol=1e-7)


def test_reading_g_keeps_edge_working_when_the_mode_has_left_the_box():
    previous, posterior, feasible = example()
    gone = GaussianMixture(posterior.logits, jnp.array([[-3.0, 4.0], [-3.5, 4.0]]), 0.1 * posterior.scale_tril)
    with_tail, zone_alone = (apply(Edge(tail=tail), previous, gone, feasible)[0].support for tail in (1.0, 0.0))
    np.testing.assert_allclose(with_tail.low, [-0.8, 2.0], rtol=1e-6)
    np.testing.assert_array_equal(zone_alone.low, [0.0, 2.0])


# -------------------------------------------------------------------------------------------- matching


def apart(components: int, seed: int) -> GaussianMixture:
    """Components that are a unit or more apart in each dimension."""
    draw = np.random.default_rng(seed)
    places = np.stack([draw.permutation(components), draw.permutation(components)], axis=1) + 0.5
    return GaussianMixture(
        jnp.asarray(draw.normal(size=components).astype(np.float32)),
        jnp.asarray(places.astype(np.float32)),
        jnp.asarray((draw.uniform(0.1, 1.0, (components, 1, 1)) * np.eye(2)).astype(np.float32)),
    )


@pytest.mark.parametrize("components", [1, 4, 8])
@given(st.data())
def test_matching_undoes_any_relabelling(components, data):
    """With up to six components every permutation is tried; eight are matched greedily."""
    before = apart(components, data.draw(st.integers(0, 1000)))
    steps = data.draw(vectors(-0.3, 0.3, components, 2))
    now = GaussianMixture(before.logits, jnp.asarray(np.asarray(before.means) + steps), before.scale_tril)
    box = Support([0.0, 0.0], [float(components), float(components)])
    previous = Belief(before, box, jnp.asarray(True))
    feasible = Support([-9.0, -9.0], [99.0, 99.0])
    relabelled = permuted(now, jnp.asarray(data.draw(st.permutations(range(components)))))
    assume(decided(Mode(), previous, now, feasible))  # the two programs may round differently
    chex.assert_trees_all_close(
        apply(Matched(Mode()), previous, relabelled, feasible), apply(Mode(), previous, now, feasible), atol=1e-5
    )


@pytest.mark.parametrize("seed", range(20))
def test_matching_is_the_cheapest_assignment(seed):
    draw = np.random.default_rng(seed)
    before, now = (
        GaussianMixture(
            *(jnp.asarray(np.float32(each)) for each in (np.zeros(5), means, np.tile(np.eye(2), (5, 1, 1))))
        )
        for means in draw.normal(size=(2, 5, 2)) * [1.0, 30.0]
    )
    # Distances are in widths of the box: the second dimension must not dominate the first.
    box = Support([0.0, 0.0], [1.0, 30.0])
    cost = (((np.asarray(before.means)[:, None] - np.asarray(now.means)[None]) / [1.0, 30.0]) ** 2).sum(-1)
    np.testing.assert_array_equal(matched(before, now, box), linear_sum_assignment(cost)[1])


# ---------------------------------------------------------------------------------------- their class


@pytest.fixture(params=RULES)
def rule(request):
    """Every heuristic by name, and the two wrappers."""
    return RULES[request.param]


def variants():
    """Three problems of one shape with different outcomes."""
    return [example(), example(weights=(0.2, 0.8)), example(now=((2.0, 2.2), (2.0, 5.9)))]


def test_heuristics_are_instances_of_the_base_class(rule):
    assert isinstance(rule, Heuristic)
    for other in (type(rule), rule.__call__, lambda previous, posterior, feasible: None):
        assert not isinstance(other, Heuristic)


def test_what_rules_say_of_themselves():
    """Only Mode compares components; a wrapper has the properties of the rules in it."""
    assert [name for name, rule in RULES.items() if not rule.grows] == ["none", "truncate"]
    assert [name for name, rule in RULES.items() if rule.compares_components] == ["mode", "choice"]
    assert not Matched(Truncate()).grows and Matched(Mode()).grows
    assert not Choice(0, (Fixed(), Truncate())).grows and Choice(0, (Fixed(), Edge())).grows
    assert paired(Mode(), warm_start=False) == Matched(Mode())
    assert paired(Mode(), warm_start=True) == Mode() and paired(Edge(), warm_start=False) == Edge()


def test_gradients_may_leave_the_range_of_what_they_are_gradients_of():
    """They are trees of the rule's class, but not hyperparameters; so are axes, masks and optimiser states."""

    def loss(rule):
        belief, _ = rule(*example())
        return -jnp.sum(belief.support.width)

    gradient = jax.jit(jax.grad(loss))(Edge())
    assert isinstance(gradient, Edge) and float(gradient.expansion) < 0
    assert jax.tree.map(lambda leaf: -3, Edge()).tail == -3
    assert jax.tree.map(np.shape, Edge()).tail == ()


def test_fixed_never_moves():
    for problem in variants():
        belief, adaptation = Fixed()(*problem)
        assert belief.support is problem[0].support
        assert adaptation.evidence == {} and not bool(jnp.any(adaptation.low_shift + adaptation.high_shift))


def test_derivatives_are_finite(rule):
    previous, posterior, feasible = example()

    def bounds(box, posterior):
        support = rule(Belief(previous.mixture, box, previous.informed), posterior, feasible)[0].support
        return jnp.sum(support.low) + 2.0 * jnp.sum(support.high)

    chex.assert_tree_all_finite(jax.jit(jax.grad(bounds, argnums=(0, 1)))(previous.support, posterior))
