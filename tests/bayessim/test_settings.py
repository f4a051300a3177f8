"""Settings of a run: those refused when made or replaced, or because they contradict each other; presets."""

import dataclasses

import jax
import pytest

from jaxlfi.bayessim.presets import METHODS, PAPER, PRESETS, QUICK, all_rounds
from jaxlfi.bayessim.settings import Settings
from jaxlfi.estimators.flow_estimators import MaskedFlow, SplineFlow
from jaxlfi.estimators.likelihood_estimators import MixtureLikelihood
from jaxlfi.estimators.mixture_network import MixtureNetwork


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rounds": 0}, r"^rounds: expected a whole number in \[1, 100000\], got 0"),
        ({"rounds": 3_000_000_000}, r"^rounds: expected a whole number in \[1, 100000\], got 3000000000"),
        ({"rounds": 3e9}, r"^rounds: expected a whole number in \[1, 100000\], got 3000000000.0"),
        ({"rounds": 2.0}, r"^rounds: expected a whole number in \[1, 100000\], got 2.0"),
        ({"rounds": True}, r"^rounds: expected a whole number"),
        ({"simulations_per_round": 0}, r"^simulations_per_round: expected a whole number in \[1, 1e\+08\], got 0"),
        (
            {"simulations_per_round": 1_000_000_000_000},
            r"^simulations_per_round: expected a whole number in \[1, 1e\+08\], got 1000000000000",
        ),
        ({"simulations_per_round": 1e12}, r"^simulations_per_round: expected a whole number in"),
        ({"simulation_budget": -1}, r"^simulation_budget: expected a whole number in \[1, 1e\+08\], got -1"),
        (
            {"correction": "exact"},
            r"^correction: expected one of none, paper, quotient, pooled, importance, got 'exact'",
        ),
        ({"restriction": "fold"}, r"^restriction: expected one of clip, reject, mixed, prior, got 'fold'"),
        ({"defensive": 2}, r"^defensive: expected a number in \[0, 1\], got 2"),
        ({"inflation": 0.5}, r"^inflation: expected a number in \[1, 100\], got 0.5"),
        ({"defensive": -0.1}, r"^defensive: expected a number in \[0, 1\], got -0.1"),
        ({"defensive": float("nan")}, r"^defensive: expected a number in \[0, 1\], got nan"),
        ({"predictive": "no"}, r"^predictive: expected True or False, got 'no'"),
    ],
)
def test_wrong_settings_are_refused_where_they_are_made_or_replaced(changes, message):
    with pytest.raises(ValueError, match=message) as error:
        Settings(**changes)
    assert "\n" not in str(error.value)
    with pytest.raises(ValueError, match=message):
        QUICK.replace(**changes)
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(QUICK, **changes)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (
            Settings(simulation_budget=50),
            r"^simulation_budget: expected at least the 100 simulations of a round, got 50",
        ),
        (
            Settings(restriction="prior", correction="pooled"),
            r"^correction: expected 'none' with restriction='prior', whose proposals need none, got 'pooled'",
        ),
        (Settings(estimator="mdn"), r"^estimator: expected one such as jaxlfi.MixtureNetwork\(\), got 'mdn'"),
        (Settings(estimator=MixtureNetwork), r"^estimator: expected one such as jaxlfi.MixtureNetwork\(\), got"),
        (
            Settings(estimator=MaskedFlow(), correction="paper"),
            r"^correction: expected 'none' or 'importance' for Mask",
        ),
        (
            Settings(estimator=SplineFlow(), correction="paper"),
            r"^correction: expected 'none' or 'importance' for Spli",
        ),
        (
            Settings(estimator=MixtureLikelihood(), correction="importance"),
            r"^correction: expected 'none' for MixtureLikelihood, as a likelihood does not depend",
        ),
        (Settings(estimator=MixtureNetwork(patience=3)), r"^patience: expected validation above 0 for early stopping"),
    ],
)
def test_settings_that_contradict_each_other_are_refused_by_check(settings, message):
    with pytest.raises(ValueError, match=message) as error:
        settings.check()
    assert "\n" not in str(error.value)


def test_what_stands_in_the_place_of_values_is_not_checked():
    """Gradients, axes and batches are trees of the same class; a traced value is not known yet."""
    assert jax.tree.map(lambda leaf: -1.0, QUICK).defensive == -1.0
    axes = Settings(defensive=None)
    assert axes.defensive is None
    jax.jit(lambda fraction: QUICK.replace(defensive=fraction).defensive)(2.0)


def test_presets_and_methods_are_consistent():
    assert PAPER == Settings() == PRESETS["paper"]
    for preset in PRESETS.values():
        for name, method in METHODS.items():
            settings, least = method(preset).check(), all_rounds(preset)
            budget = preset if name == "bayessim" else least  # others cannot end before all rounds are made
            assert settings.rounds * settings.simulation_budget == budget.rounds * budget.simulation_budget
            settings.estimator.check_for(4)


def test_the_defaults_are_the_papers():
    assert (PAPER.rounds, PAPER.simulations_per_round, PAPER.simulation_budget) == (10, 100, 125)
    assert (PAPER.correction, PAPER.restriction, PAPER.defensive, PAPER.predictive) == ("none", "clip", 0.0, True)
    assert PAPER.estimator == MixtureNetwork()
