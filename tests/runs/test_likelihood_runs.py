"""Runs by a likelihood: resumed, loaded, and used without the task."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlfi
from jaxlfi.io.workfolder import StoreError
from tests.small import gaussian, settings, whole_runs  # noqa: F401 - a fixture

pytestmark = pytest.mark.slow

OBSERVED = np.array([0.8, -0.6], np.float32)
SETTINGS = settings(
    estimator=jaxlfi.MixtureLikelihood(
        hidden=(16,), components=2, learning_rate=1e-3, epochs=0, steps=100, batch_size=20, warm_start=False,
        particles=100,
    ),
    predictive=False,
)  # fmt: skip


def infer(**more) -> jaxlfi.Run:
    """The run of this file."""
    return jaxlfi.infer(jax.random.key(4), gaussian(), OBSERVED, support="misspecified", settings=SETTINGS, **more)


@pytest.fixture(scope="module")
def run(whole_runs, tmp_path_factory):  # noqa: F811 - the fixture
    """It, in a folder."""
    folder = tmp_path_factory.mktemp("likelihood") / "run"
    return infer(out=folder), folder


def test_it_ends_in_a_posterior_on_the_adapted_support(run):
    run, _ = run
    posterior = run.posterior
    draws = posterior.sample(jax.random.key(0), 500)
    assert posterior.support.contains(draws).all() and np.isfinite(posterior.log_prob(draws)).all()
    assert (np.asarray(run.history["mass_inside"]) == 1).all()
    assert float(run.belief.support.high[0]) > 0  # EDGE moved the bound that is wrong
    peak = posterior.map()
    assert posterior.log_prob(peak) >= posterior.log_prob(draws).max() - 1e-3


def test_it_resumes_to_the_same_bits(run, tmp_path):
    class Stopped(Exception):
        """In the middle."""

    def stop(index, row):
        raise Stopped

    with pytest.raises(Stopped):
        infer(out=tmp_path / "stopped", callback=stop)
    again = infer(out=tmp_path / "stopped")
    for ours, theirs in zip(
        jax.tree.leaves((again.belief, again.dataset)), jax.tree.leaves((run[0].belief, run[0].dataset)), strict=True
    ):
        np.testing.assert_array_equal(ours, theirs)


def test_it_is_loaded_without_its_task_unless_that_has_a_prior(run):
    run, folder = run
    loaded = jaxlfi.load(folder)
    assert loaded.task is None
    np.testing.assert_allclose(loaded.draws(), run.draws(), rtol=1e-4, atol=1e-4)
    theta = jnp.asarray(run.draws(20))
    np.testing.assert_allclose(loaded.posterior.log_prob(theta), run.posterior.log_prob(theta), atol=1e-3)
    config = json.loads((folder / "config.json").read_text())
    assert config["prior"] is None and config["settings"]["estimator"]["name"] == "mdn_likelihood"
    (folder / "config.json").write_text(json.dumps(config | {"prior": "MultivariateNormalDiag"}))
    with pytest.raises(StoreError, match=r"expected the task, whose prior \(MultivariateNormalDiag\).* pass task="):
        jaxlfi.load(folder)
    jaxlfi.load(folder, gaussian())
