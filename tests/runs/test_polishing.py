"""Runs whose task sharpens their posterior: what is reported, kept, read back and said."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console

import jaxlfi
from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.estimators.flow_estimators import SplineFlow
from jaxlfi.figures import page
from jaxlfi.figures.collection import open_collection
from jaxlfi.runs import polishing
from jaxlfi.runs.account import POLISH
from jaxlfi.tasks.polish import Polished
from tests.small import SETTINGS, gaussian, whole_runs  # noqa: F401 - a fixture

SHARP = GaussianMixture(jnp.zeros(1), jnp.array([[0.5, -0.3]]), jnp.array([[[0.02, 0.0], [0.01, 0.03]]]))
SAID = "The posterior was polished by a closed form."


def sharpened(task, observed, draws, box, counted):
    """A posterior that is known, of two steps."""
    assert draws.shape == (64, 2) and np.isfinite(observed).all()
    assert np.all(np.asarray(box.contains(draws)))
    return Polished(SHARP, (SAID,), ("Go on.",), len(list(counted([0, 1]))))


@pytest.fixture(scope="module")
def polished(tmp_path_factory, whole_runs):  # noqa: F811 - the fixture
    """A polished run whose support can grow, its folder and its task."""
    own, folder = dataclasses.replace(gaussian(), polish=sharpened), tmp_path_factory.mktemp("polish") / "run"
    arguments = {"support": "misspecified", "heuristic": "edge", "settings": SETTINGS}
    return jaxlfi.infer(3, own, **arguments, polish=True, out=folder), folder, own


def test_the_sharper_posterior_is_reported(polished):
    run, _, _ = polished
    draws = np.asarray(run.posterior.sample(0, 20_000))
    covariance = np.asarray(SHARP.scale_tril[0] @ SHARP.scale_tril[0].T)
    np.testing.assert_allclose(draws.mean(axis=0), SHARP.means[0], atol=1e-3)
    np.testing.assert_allclose(np.cov(draws.T), covariance, rtol=0.05, atol=2e-5)
    assert run.belief.support.contains(SHARP.means[0])  # the first guess ended at 0
    assert np.asarray(run.history["sample_theta"])[-1].std() < np.asarray(run.history["sample_theta"])[0].std()
    assert np.abs(run.history["sample_theta"][-1].mean(axis=0) - SHARP.means[0]).max() < 0.05
    assert SAID in run.summary().sentences and "Go on." in run.summary().next_steps
    assert run.polish.simulations == 2 and len(run.unpolished.mixture.logits) == 4


def test_it_is_kept_with_the_posterior_before(polished, tmp_path):
    run, folder, own = polished
    for one in (jaxlfi.load(folder, own), jaxlfi.load(run.save(tmp_path / "copy"), own)):
        assert one.polish == run.polish
        for name in ("belief", "unpolished"):
            jax.tree.map(np.testing.assert_array_equal, getattr(one, name), getattr(run, name))
    assert page._widths(open_collection(folder)) == ""  # the rounds' corrections are not those of this posterior
    again = jaxlfi.infer(3, own, support="misspecified", heuristic="edge", settings=SETTINGS, polish=True, out=folder)
    np.testing.assert_array_equal(again.draws(), run.draws())
    damaged = tmp_path / "copy" / "polish.json"
    damaged.write_text('{"sentences": 3}')
    with pytest.raises(ValueError, match="expected how the posterior was polished"):
        jaxlfi.load(damaged.parent, own)


def test_a_posterior_that_is_not_trusted_leaves_the_runs_own(polished, tmp_path):
    """It is said why, in the summary and in the folder."""
    run, _, own = polished
    why = "The posterior was not polished. Nothing agrees."
    refusing = dataclasses.replace(own, polish=lambda *given: Polished(None, (why,), (), 3))
    before = run.replace(task=refusing, belief=run.unpolished, polish=None, unpolished=None)
    found = polishing.polished(before, Console(quiet=True))
    for one in (found, jaxlfi.load(found.save(tmp_path / "refused"), refusing)):
        jax.tree.map(np.testing.assert_array_equal, one.belief, run.unpolished)
        assert one.unpolished is None and one.polish.simulations == 3
        assert why in one.summary().sentences


def test_what_was_not_asked_for_is_named_as_a_step(polished):
    _, _, own = polished
    run = jaxlfi.infer(3, own, support="misspecified", heuristic="edge", settings=SETTINGS, polish=False)
    assert run.polish is None and POLISH in run.summary().next_steps
    plain = jaxlfi.infer(3, gaussian(), support="misspecified", heuristic="edge", settings=SETTINGS)
    assert plain.polish is None and POLISH not in plain.summary().next_steps
    np.testing.assert_allclose(plain.draws(), run.draws(), atol=1e-4)


def test_what_cannot_be_polished_is_refused(polished):
    _, _, own = polished
    with pytest.raises(ValueError, match="polish: expected a task that can be polished, such as a MuJoCo model, got g"):
        jaxlfi.infer(3, gaussian(), settings=SETTINGS, polish=True)
    flow = SETTINGS.replace(estimator=SplineFlow(hidden=(8,), transforms=1), correction="none")
    with pytest.raises(ValueError, match="polish: expected an estimator that is a mixture of Gaussians"):
        jaxlfi.infer(3, own, settings=flow, polish=True)


@pytest.mark.slow
def test_a_support_that_cannot_grow_cuts_it(polished):
    _, _, own = polished
    run = jaxlfi.infer(3, own, support="misspecified", heuristic="none", settings=SETTINGS)  # polished by default
    assert float(run.belief.support.high[0]) == 0.0 and np.asarray(run.draws()).max(axis=0)[0] <= 0.0


def test_a_posterior_that_cannot_be_sharpened_stays_and_the_run_says_why(tmp_path):
    why = "The posterior was not polished: it is not a Gaussian."
    refused = dataclasses.replace(gaussian(), polish=lambda *given: Polished(None, (why,), (), 7))
    arguments = {"support": "misspecified", "heuristic": "edge", "settings": SETTINGS}
    plain = jaxlfi.infer(3, gaussian(), **arguments)
    run = jaxlfi.infer(3, refused, **arguments)
    np.testing.assert_array_equal(run.draws(), plain.draws())
    assert run.unpolished is None and run.polish.simulations == 7
    for one in (run, jaxlfi.load(run.save(tmp_path / "run"), refused)):
        assert why in one.summary().sentences and one.polish == run.polish and one.unpolished is None
        np.testing.assert_allclose(one.draws(), plain.draws(), rtol=1e-5)
