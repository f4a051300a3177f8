"""The contract of all registered heuristics, ours and other packages': the same laws for all.

A package can run these tests on its own heuristics: whatever is registered as `jaxlfi.heuristics` is tested.
"""

import json

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxlfi.distributions.belief import Belief, uninformed
from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.support import Support
from jaxlfi.fields import declared
from jaxlfi.heuristics import Adaptation, Choice, Heuristic, Matched
from jaxlfi.heuristics.hyperparameters import check
from jaxlfi.registry import HEURISTICS
from jaxlfi.runs import describe

RULES = {
    **{name: HEURISTICS.load(name)() for name in HEURISTICS.names()},
    **{f"matched {name}": Matched(HEURISTICS.load(name)()) for name in HEURISTICS.names()},
    "choice": Choice(1, tuple(HEURISTICS.load(name)() for name in HEURISTICS.names())),
}
DIM, COMPONENTS, PROBLEMS = 3, 4, 3
every_rule = pytest.mark.parametrize("name", RULES)


def problem(seed: int) -> tuple[Belief, GaussianMixture, Support]:
    """A belief whose components moved, on a box that the posterior crosses on some sides, and Phi."""
    rng = np.random.default_rng(seed)
    tril = np.tril(rng.normal(0, 0.2, (COMPONENTS, DIM, DIM))).astype(np.float32)
    tril[:, np.arange(DIM), np.arange(DIM)] = rng.uniform(0.1, 0.6, (COMPONENTS, DIM))
    means = rng.uniform(-2.5, 2.5, (COMPONENTS, DIM)).astype(np.float32)
    mixture = lambda means: GaussianMixture(jnp.asarray(rng.normal(size=COMPONENTS), jnp.float32), means, tril)
    box = Support((-2.0 + rng.normal(0, 0.1, DIM)).tolist(), (2.0 + rng.normal(0, 0.1, DIM)).tolist())
    before = mixture(jnp.asarray(means - rng.normal(0, 0.4, means.shape), jnp.float32))
    return Belief(before, box, jnp.asarray(True)), mixture(jnp.asarray(means)), Support([-3.0] * DIM, [3.0] * DIM)


PROBLEM = problem(0)
log_prob = jax.jit(GaussianMixture.log_prob)


TRACED = []
"""The rule of each tracing."""


@jax.jit
def applied(rule, problem):
    """The rule's belief and adaptation, compiled."""
    TRACED.append(rule)
    return rule(*problem)


def close(a, b) -> None:
    """Equality up to rounding: two programs may order their sums differently."""
    chex.assert_trees_all_close(a, b, rtol=1e-4, atol=1e-5)


def test_rules_that_have_to_be_tested_are():
    assert {"none", "edge", "mode", "centre", "truncate"} <= set(RULES)


@every_rule
def test_it_returns_a_belief_and_an_adaptation_of_their_shapes(name):
    belief, adaptation = applied(RULES[name], PROBLEM)
    assert isinstance(belief, Belief) and isinstance(adaptation, Adaptation)
    chex.assert_trees_all_equal_shapes_and_dtypes(belief, PROBLEM[0])
    assert all(np.shape(seen)[-1:] == (DIM,) for seen in adaptation.evidence.values())
    chex.assert_tree_all_finite((belief, adaptation))


@every_rule
@pytest.mark.parametrize("seed", range(3))
def test_its_support_is_a_box_within_phi_and_its_shifts_say_how_it_moved(name, seed):
    previous, posterior, feasible = problem(seed)
    belief, adaptation = applied(RULES[name], (previous, posterior, feasible))
    low, high = np.asarray(belief.support.low), np.asarray(belief.support.high)
    assert (low < high).all() and (low >= feasible.low).all() and (high <= feasible.high).all()
    np.testing.assert_allclose(adaptation.low_shift, low - previous.support.low, atol=1e-6)
    np.testing.assert_allclose(adaptation.high_shift, high - previous.support.high, atol=1e-6)
    if not RULES[name].grows:
        assert (np.asarray(adaptation.low_shift) >= 0).all() and (np.asarray(adaptation.high_shift) <= 0).all()


@every_rule
def test_its_belief_is_the_posteriors(name):
    """On any box, components may be reordered, but nothing else may change."""
    _, posterior, _ = PROBLEM
    belief, _ = applied(RULES[name], PROBLEM)
    theta = np.random.default_rng(5).uniform(-2, 2, (20, DIM)).astype(np.float32)
    np.testing.assert_allclose(log_prob(belief.mixture, theta), log_prob(posterior, theta), rtol=1e-4, atol=1e-4)
    assert bool(belief.informed) != RULES[name].proposes_from_prior


@every_rule
def test_before_the_first_round_too(name):
    """There is no posterior yet with which components could be compared."""
    _, posterior, feasible = PROBLEM
    belief, adaptation = applied(RULES[name], (uninformed(PROBLEM[0].support, COMPONENTS), posterior, feasible))
    chex.assert_tree_all_finite((belief, adaptation))


@every_rule
def test_compiled_is_eager(name):
    close(applied(RULES[name], PROBLEM), RULES[name](*PROBLEM))


@every_rule
def test_a_batch_is_a_loop(name):
    """Batches are over problems and over the leaves of the rule."""
    rule, problems = RULES[name], [problem(seed) for seed in range(PROBLEMS)]
    stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *problems)
    batch = jax.jit(jax.vmap(applied, in_axes=(None, 0)))(rule, stacked)
    close(batch, jax.tree.map(lambda *leaves: np.stack(leaves), *(applied(rule, each) for each in problems)))
    if jax.tree.leaves(rule):
        less = jax.tree.map(lambda leaf: 0.9 * leaf if isinstance(leaf, float) else leaf, rule)
        rules = jax.tree.map(lambda *leaves: np.stack(leaves), rule, less)
        twice = jax.jit(jax.vmap(applied, in_axes=(0, None)))(rules, PROBLEM)
        for place, one in enumerate((rule, less)):
            close(jax.tree.map(lambda leaf, place=place: leaf[place], twice), applied(one, PROBLEM))


@every_rule
def test_it_is_a_tree_of_its_hyperparameters(name):
    rule = RULES[name]
    leaves, structure = jax.tree.flatten(rule)
    again = jax.tree.unflatten(structure, leaves)
    assert type(again) is type(rule) and jax.tree.structure(again) == structure
    assert jax.tree.leaves(again) == leaves
    assert all(isinstance(leaf, float | int) for leaf in leaves)
    if not isinstance(rule, Matched | Choice):
        assert len(leaves) == sum(not field.static for field in declared(rule).values())


@every_rule
def test_another_value_is_the_same_program(name):
    rule = RULES[name]
    applied(rule, PROBLEM)
    before = len(TRACED)
    assert before > 0
    applied(jax.tree.map(lambda leaf: 0.9 * leaf if isinstance(leaf, float) else leaf, rule), problem(1))
    assert len(TRACED) == before


@every_rule
def test_its_leaves_can_be_one_value_for_each_parameter(name):
    vector = lambda leaf: jnp.full(DIM, leaf, jnp.float32) if isinstance(leaf, float) else leaf
    rule = jax.tree.map(vector, RULES[name])
    check(rule, DIM)
    close(applied(rule, PROBLEM), applied(RULES[name], PROBLEM))


@every_rule
def test_it_is_written_and_read_back(name):
    rule = RULES[name]
    text = json.dumps(describe.heuristic_to_json(rule), allow_nan=False)
    again = describe.heuristic_from_json(json.loads(text))
    assert again == rule and type(again) is type(rule)
    close(applied(again, PROBLEM), applied(rule, PROBLEM))


@pytest.mark.parametrize("name", HEURISTICS.names())
def test_what_it_declares_is_documented_and_its_defaults_are_accepted(name):
    kind = HEURISTICS.load(name)
    assert issubclass(kind, Heuristic) and kind.__doc__
    for field in declared(kind).values():
        assert field.info.help and not field.info.help.endswith("."), field.name
        if isinstance(field.default, float):
            assert field.info.contains(field.default)
    check(kind(), DIM)
    assert HEURISTICS.name_of(kind) == name
