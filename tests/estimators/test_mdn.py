"""The mixture density network: its head is a density, and its covariance agrees with its whitening."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import special, stats

from jaxlfi.estimators.mdn import ACTIVATIONS, MDN, NEAR, MixtureHead, around


def network(module, key, obs: int):
    """Fresh weights, and the jitted network."""
    return jax.jit(module.init)(key, jnp.zeros(obs)), jax.jit(module.apply)


@pytest.fixture(scope="module")
def head() -> MixtureHead:
    """Asymmetric heads for two inputs, K = 2, D = 3."""
    draw = np.random.default_rng(3)
    whitening = np.tril(draw.normal(0, 1, (2, 2, 3, 3)))
    whitening[..., np.arange(3), np.arange(3)] = draw.uniform(0.4, 4, (2, 2, 3))
    return MixtureHead(
        jnp.array([[0.3, -1.2], [2.0, 5.0]]),
        jnp.asarray(draw.normal(0, 1, (2, 2, 3)), jnp.float32),
        jnp.asarray(whitening, jnp.float32),
    )


def test_log_prob_against_scipy(head):
    theta = np.array([[0.2, -0.7, 0.5], [-1.0, 0.1, 0.9]], np.float32)
    for i in range(2):
        covariance = [np.linalg.inv(np.float64(u.T @ u)) for u in np.asarray(head.whitening[i])]
        component = [
            stats.multivariate_normal(np.asarray(head.means[i, k]), covariance[k]).logpdf(theta[i]) for k in range(2)
        ]
        expected = special.logsumexp(special.log_softmax(np.asarray(head.logits[i])) + component)
        np.testing.assert_allclose(head.log_prob(jnp.asarray(theta))[i], expected, rtol=1e-4)


def test_log_prob_is_that_of_the_mixture(head):
    theta = jnp.array([[0.2, -0.7, 0.5], [-1.0, 0.1, 0.9]])
    mixtures = head.mixture()
    by_mixture = [jax.tree.map(lambda leaf, i=i: leaf[i], mixtures).log_prob(theta[i]) for i in range(2)]
    np.testing.assert_allclose(head.log_prob(theta), by_mixture, rtol=1e-4, atol=1e-5)
    product = head.whitening @ mixtures.scale_tril
    np.testing.assert_allclose(product, np.broadcast_to(np.eye(3), (2, 2, 3, 3)), atol=2e-5)
    assert (np.triu(np.asarray(mixtures.scale_tril), 1) == 0).all()


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_shapes_and_positive_diagonals(activation, key):
    module = MDN(4, 3, (7, 5), activation)
    params, apply = network(module, key, 6)
    x = 30 * jax.random.normal(jax.random.key(1), (2, 9, 6))
    head = apply(params, x)
    assert head.logits.shape == (2, 9, 4)
    assert head.means.shape == (2, 9, 4, 3)
    assert head.whitening.shape == (2, 9, 4, 3, 3)
    diagonal = np.diagonal(np.asarray(head.whitening), axis1=-2, axis2=-1)
    assert (diagonal > 0).all() and np.isfinite(diagonal).all()
    assert (np.triu(np.asarray(head.whitening), 1) == 0).all()
    assert np.abs(np.tril(np.asarray(head.whitening), -1)).max() > 0
    assert head.log_prob(jnp.zeros((2, 9, 3))).shape == (2, 9)


def test_batches_are_rows_by_themselves(key):
    module = MDN(2, 2, (8,), "tanh")
    params, apply = network(module, key, 3)
    x = jnp.arange(12.0).reshape(4, 3) / 7
    batched = apply(params, x)
    single = jax.vmap(lambda row: apply(params, row))(x)
    np.testing.assert_allclose(batched.whitening, single.whitening, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(batched.log_prob(x[:, :2]), single.log_prob(x[:, :2]), rtol=1e-5)


def test_the_spread_has_a_floor_and_a_ceiling(key):
    """Outputs of any size give finite densities: diagonals stay within e^-7 and e^7."""
    module = MDN(1, 2, (4,), "relu")
    params, apply = network(module, key, 2)
    params = jax.tree.map(lambda leaf: 1e4 * leaf, params)
    head = apply(params, jax.random.normal(jax.random.key(0), (50, 2)))
    diagonal = np.log(np.diagonal(np.asarray(head.whitening), axis1=-2, axis2=-1))
    assert diagonal.min() >= -7.001 and diagonal.max() <= 7.001
    assert diagonal.min() < -6.9 and diagonal.max() > 6.9


def test_the_papers_network_has_its_number_of_weights():
    """Three layers of 1024 on nine summaries, four full Gaussians in four dimensions."""
    module = MDN(4, 4, (1024, 1024, 1024), "tanh")
    params = jax.eval_shape(module.init, jax.random.key(0), jnp.zeros(9))
    outputs = 4 * (1 + 4 + 4 * 5 // 2)
    expected = 1024 * (9 + 1) + 2 * 1024 * (1024 + 1) + outputs * (1024 + 1)
    assert sum(leaf.size for leaf in jax.tree.leaves(params)) == expected


def test_activations_are_what_they_are_called():
    x = np.array([-2.0, 0.0, 1.5])
    expected = {"relu": np.maximum(x, 0), "tanh": np.tanh(x), "silu": x * special.expit(x)}
    assert set(ACTIVATIONS) == set(expected)
    for name, values in expected.items():
        np.testing.assert_allclose(ACTIVATIONS[name](jnp.asarray(x)), values, rtol=1e-5, atol=1e-7)


def test_a_network_can_start_from_a_regression(key):
    """Without the rest of the random kernel, it is the Gaussian; with it, a mixture near that Gaussian."""
    module, x = MDN(3, 2, (7, 5), "tanh", linear=True), jax.random.normal(jax.random.key(1), (9, 4))
    params, apply = network(module, key, 4)
    coefficients = jnp.array([[0.5, -1.0, 0.0, 2.0], [0.1, 0.3, -0.7, 0.0]])
    intercept, whitening = jnp.array([0.2, -3.0]), jnp.array([[4.0, 0.0], [-9.0, 20.0]])
    begun = around(params["params"], 3, coefficients, intercept, whitening)
    np.testing.assert_allclose(begun["Dense_2"]["kernel"], NEAR * params["params"]["Dense_2"]["kernel"])
    begun["Dense_2"]["kernel"] *= 0
    head = apply({"params": begun}, x)
    expected = x @ coefficients.T + intercept
    np.testing.assert_allclose(head.means, np.repeat(expected[:, None], 3, axis=1), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(head.whitening, np.broadcast_to(whitening, (9, 3, 2, 2)), rtol=1e-5)
    np.testing.assert_allclose(jax.nn.softmax(head.logits), np.full((9, 3), 1 / 3), rtol=1e-6)
