"""Embeddings: what their features depend on and what not, and that they are trained with the density."""

import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxlfi.distributions.space import Space
from jaxlfi.distributions.support import Support
from jaxlfi.estimators import dataset as datasets
from jaxlfi.estimators.base import untrained
from jaxlfi.estimators.embeddings import CHANNELS, EMBEDDINGS, PLACES, STRIDE, windows
from jaxlfi.estimators.flow_estimators import MaskedFlow, SplineFlow
from jaxlfi.estimators.mdn import MDN
from jaxlfi.estimators.mixture_network import MixtureNetwork
from jaxlfi.estimators.normaliser import fit_normaliser
from jaxlfi.estimators.training import fit

SMALL = MixtureNetwork(hidden=(8,), components=1)
ONE = Space(("frequency",), (False,))
PHI = Support([1.0], [5.0])
normaliser = jax.jit(fit_normaliser, static_argnums=(0, 3))


@functools.partial(jax.jit, static_argnums=0)
def features(name: str, x: jax.Array) -> jax.Array:
    """Features of records, from an embedding with fixed random weights."""
    module = EMBEDDINGS[name].module(5)
    return module.apply(module.init(jax.random.key(1), x), x)


def test_windows_are_those_of_a_strided_convolution(key):
    draw = np.random.default_rng(0)
    x, kernel = draw.normal(size=(7, 2)).astype(np.float32), draw.normal(size=(4, 2, 3)).astype(np.float32)
    padded = np.concatenate([np.zeros((2, 2)), x, np.zeros((1, 2))])
    expected = [np.einsum("wc,wcf->f", padded[start : start + 4], kernel) for start in (0, 2, 4, 6)]
    np.testing.assert_allclose(windows(jnp.asarray(x), 2) @ kernel.reshape(8, 3), expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("name", EMBEDDINGS)
@pytest.mark.parametrize("records", [1, 8, 40, 4000])
def test_any_number_of_records_makes_as_many_features(name, records):
    assert jax.eval_shape(functools.partial(features, name), jnp.zeros((6, records, 3))).shape == (6, 5)


def test_convolutions_leave_a_few_records():
    """Otherwise the last layer for a long series would be as large as a perceptron's."""
    for records in (8, 151, 4000):
        module = EMBEDDINGS["series"].module(5)
        weights = jax.eval_shape(module.init, jax.random.key(0), jnp.zeros((records, 2)))["params"]
        last = weights[f"Dense_{len(weights) - 1}"]["kernel"].shape
        assert last[0] == 5 and PLACES / STRIDE * CHANNELS <= last[1] <= PLACES * CHANNELS
        assert all(leaf["kernel"].shape[0] == CHANNELS for name, leaf in list(weights.items())[:-1])


@pytest.mark.parametrize("name", EMBEDDINGS)
def test_features_are_bounded_and_the_same_mapped_and_one_by_one(name, key):
    x = 100 * jax.random.normal(key, (3, 9, 2))
    together = np.asarray(features(name, x))
    assert (np.abs(together) <= 1).all() and together.std() > 0.1
    np.testing.assert_allclose([features(name, one) for one in x], together, atol=2e-5)
    np.testing.assert_allclose(jax.vmap(functools.partial(features, name))(x), together, atol=2e-5)


def test_only_trials_are_the_same_in_any_order(key):
    x = jax.random.normal(key, (9, 2))
    for name in EMBEDDINGS:
        difference = np.abs(features(name, x[::-1]) - features(name, x)).max()
        assert (difference < 1e-5) == (name == "trials")
    other = x.at[4].add(1.0)
    assert np.abs(features("trials", other) - features("trials", x)).max() > 1e-3  # but it depends on every one


# -------------------------------------------------------------------------------------------- as part of an estimator


@pytest.mark.parametrize(
    ("embedding", "layout", "size"),
    [
        ("mlp", (151, 2), 302),
        ("series", (151, 2), 2),
        ("series", (9, 1), 1),
        ("series", (4, 151, 2), 2),
        ("trials", (4, 9, 1), 9),
        ("trials", (4, 151, 2), 302),
        ("trials", (50, 3), 3),
    ],
)
def test_records_are_the_task_s(embedding, layout, size):
    read = SMALL.replace(embedding=embedding).for_layout(layout)
    assert read.record_size == size
    assert read.for_layout(layout) == read == SMALL.replace(embedding=embedding, record_size=size)


def test_what_is_refused():
    series = SMALL.replace(embedding="series", record_size=4)
    with pytest.raises(ValueError, match=r"^record_size: expected a divisor of the summary's 302 numbers, got 4$"):
        series.for_layout((151, 2))
    with pytest.raises(ValueError, match=r"^record_size: expected 0 without an embedding or a reduction, got 4$"):
        series.replace(embedding="none").check()
    with pytest.raises(ValueError, match=r"^embedding: expected one of none, mlp, series, trials, got 'rnn'$"):
        SMALL.replace(embedding="rnn")


@pytest.mark.parametrize("estimator", [SMALL, MaskedFlow(hidden=(4,)), SplineFlow(hidden=(4,), transforms=1)])
def test_without_an_embedding_nothing_is_changed(estimator, key):
    """Names and shapes of the weights are those of the family's own network, so that saved networks can be read."""
    assert estimator.for_layout((151, 2)) is estimator
    weights = estimator.initialise(key, 2, 6)
    own = jax.vmap(lambda key: estimator.module(2).init(key, jnp.zeros(6)))(jax.random.split(jax.random.clone(key), 1))
    chex.assert_trees_all_equal_shapes_and_dtypes(weights, own)
    if estimator is SMALL:
        assert list(weights["params"]) == ["Dense_0", "Dense_1"] and isinstance(estimator.embedded(2), MDN)
        assert weights["params"]["Dense_0"]["kernel"].shape == (1, 8, 6)


@pytest.mark.slow
def test_the_same_numbers_of_all_records_are_normalised_alike():
    draw = np.random.default_rng(2)
    x = (draw.normal(size=(30, 5, 2)) * [1.0, 40.0] + [3.0, -7.0] + np.arange(5)[:, None]).astype(np.float32)
    rows, valid = jnp.asarray(x.reshape(30, 10)), jnp.arange(30) < 20
    found = normaliser("zscore", rows, valid, 2)
    mean = found.origin + found.unit * found.mean
    np.testing.assert_allclose(mean, np.tile(x[:20].mean(axis=(0, 1)), 5), rtol=1e-4)
    np.testing.assert_allclose(found.unit * found.scale, np.tile(x[:20].std(axis=(0, 1)), 5), rtol=1e-4)
    whole = normaliser("zscore", rows, valid, 10)
    mean = whole.origin + whole.unit * whole.mean
    np.testing.assert_allclose(mean, x[:20].mean(axis=0).ravel(), rtol=1e-4, atol=1e-4)
    assert normaliser("none", rows, valid, 2).mean.shape == (10,)


@pytest.fixture(scope="module")
def vibrations() -> tuple[np.ndarray, np.ndarray]:
    """Frequencies [N, 1] and series [N, 40] of unknown phase: on average over it, every number of a series is zero."""
    draw = np.random.default_rng(5)
    frequency, phase = draw.uniform(1.0, 5.0, (700, 1)), draw.uniform(0.0, 2 * np.pi, (700, 1))
    clean = np.sin(frequency * np.linspace(0.0, 6.0, 40) + phase)
    return frequency.astype(np.float32), (3.0 * clean + 0.3 * draw.normal(size=clean.shape)).astype(np.float32)


@pytest.mark.slow
def test_a_frequency_is_found_that_no_number_of_the_series_shows_by_itself(vibrations):
    theta, x = vibrations
    design = np.column_stack([np.ones(500), x[:500]])
    linear = np.column_stack([np.ones(200), x[500:]]) @ np.linalg.lstsq(design, theta[:500], rcond=None)[0]
    spread = theta[500:].std()
    assert np.sqrt(np.mean((linear - theta[500:]) ** 2)) > 0.9 * spread
    dataset = datasets.empty(500, 1, 40).replace(
        theta=jnp.asarray(theta[:500]), x=jnp.asarray(x[:500]), size=jnp.asarray(500)
    )
    estimator = SMALL.replace(
        embedding="series", features=4, learning_rate=3e-3, epochs=0, steps=400, batch_size=50, warm_start=False
    )

    @jax.jit
    def trained(key):
        network = untrained(key, estimator.for_layout((40, 1)), 40, PHI, ONE)
        network, info = fit(jax.random.fold_in(key, 1), network, dataset, jnp.ones(500), 500)
        density = jax.vmap(lambda x: estimator.for_layout((40, 1)).density(network, x))
        return network, density(jnp.asarray(x[500:])).means[:, 0], info

    with jax.debug_key_reuse(False):
        network, found, info = trained(jax.random.key(3))
    assert int(info.nonfinite.sum()) == 0
    assert np.sqrt(np.mean((np.asarray(found) - theta[500:]) ** 2)) < 0.25 * spread
    eager = network.estimator.density(network, jnp.asarray(x[500])).means[0]
    np.testing.assert_allclose(eager, found[0], atol=2e-3)
