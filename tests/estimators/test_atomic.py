"""The losses of APT against plain loops and a posterior known in closed form."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from scipy import stats

from jaxlfi.estimators.atomic_loss import atomic, contrast, nll


def test_nll_is_the_weighted_mean():
    log_prob = jnp.array([-1.0, 2.0, jnp.nan, 0.5])
    assert nll(log_prob, jnp.array([1.0, 3.0, 0.0, 2.0])) == pytest.approx(-(-1 + 6 + 1) / 6)
    assert nll(log_prob, jnp.zeros(4)) == 0


contrasted = jax.jit(contrast, static_argnums=2)


def test_contrasts_are_distinct_other_rows_of_positive_weight_and_all_sets_are_as_likely():
    weights = jnp.array([1.0, 0.0, 2.0, 1.0, 0.5, 0.0, 1.0, 3.0])
    usable = np.flatnonzero(weights)
    keys = jax.random.split(jax.random.key(0), 2500)
    drawn = jax.jit(jax.vmap(lambda key: contrast(key, weights, 3)))(keys)
    rows, present = np.asarray(drawn.rows), np.asarray(drawn.present)
    assert rows.shape == (2500, 2, 8)
    np.testing.assert_array_equal(present, np.broadcast_to(weights > 0, present.shape))
    for b in usable:
        pairs = np.sort(rows[:, :, b], axis=1)
        assert (pairs[:, 0] != pairs[:, 1]).all()
        assert set(pairs.ravel()) == set(usable) - {b}
        _, counts = np.unique(pairs @ [8, 1], return_counts=True)
        assert counts.size == 10
        assert stats.chisquare(counts).pvalue > 1e-3


def test_contrasts_that_are_not_there_are_absent():
    """Three rows have weight: each has two contrasts, for any number of atoms."""
    drawn = contrasted(jax.random.key(1), jnp.array([1.0, 0.0, 1.0, 0.0, 1.0]), 5)
    for b, others in {0: {2, 4}, 2: {0, 4}, 4: {0, 2}}.items():
        there = np.asarray(drawn.present[:, b])
        assert there.sum() == 2
        assert set(np.asarray(drawn.rows[:, b])[there].tolist()) == others


@pytest.mark.parametrize("atoms", [1, 6])
def test_contrasts_refuse_numbers_of_atoms_that_do_not_fit(atoms):
    with pytest.raises(ValueError, match=f"atoms: expected 2 up to the 5 rows of a minibatch, got {atoms}"):
        contrast(jax.random.key(0), jnp.ones(5), atoms)


def squares(theta):
    """Some log q(theta | x) for five rows, which depends on x and is not normalised."""
    x = jnp.array([0.3, -1.0, 2.0, 0.0, 0.7])
    return -jnp.sum((theta - x[:, None]) ** 2, axis=-1) + 0.2 * theta[..., 0] * x


@functools.partial(jax.jit, static_argnums=4)
def atomic_of_squares(key, theta, log_prior, weights, atoms, combined=None):
    """The loss of five rows."""
    return atomic(key, squares, theta, log_prior, weights, atoms, *(() if combined is None else (combined,)))


def test_atomic_is_what_a_plain_loop_says():
    draw = np.random.default_rng(0)
    theta = draw.normal(size=(5, 2)).astype(np.float32)
    log_prior = draw.normal(size=5).astype(np.float32)
    weights = np.array([1.0, 2.0, 0.0, 0.5, 1.5], np.float32)
    combined = np.array([1.0, 0.0, 1.0, 2.0, 0.0], np.float32)
    key = jax.random.key(4)
    drawn = contrasted(key, jnp.asarray(weights), 3)
    log_q = np.asarray(squares(jnp.broadcast_to(theta[:, None], (5, 5, 2))))
    total = 0.0
    for b in np.flatnonzero(weights):
        atoms = [b, *np.asarray(drawn.rows[:, b])]
        ratios = [np.exp(log_q[j, b]) / np.exp(log_prior[j]) for j in atoms]
        total -= weights[b] * (np.log(ratios[0] / np.sum(ratios)) + combined[b] * log_q[b, b])
    given = [jnp.asarray(part) for part in (theta, log_prior, weights)]
    loss = atomic_of_squares(jax.random.clone(key), *given, 3, jnp.asarray(combined))
    assert loss == pytest.approx(total / weights.sum(), rel=1e-5)


def test_equal_atoms_under_a_uniform_prior_are_distinguished_by_chance():
    theta = jnp.full((5, 2), 0.7)
    loss = atomic_of_squares(jax.random.key(0), theta, jnp.zeros(5), jnp.ones(5), 4)
    assert loss == pytest.approx(np.log(4), rel=1e-6)


def test_rows_without_weight_contribute_nothing_whatever_they_hold():
    weights = jnp.array([1.0, 0.0, 1.0, 1.0, 0.0])
    theta = jnp.arange(10.0).reshape(5, 2) / 7
    dirty = theta.at[1].set(jnp.nan).at[4].set(1e30)
    log_prior = jnp.array([0.1, jnp.nan, 0.2, 0.4, -jnp.inf])

    @jax.jit
    @jax.value_and_grad
    def loss(scale, theta, log_prior, weights):
        return atomic(jax.random.key(2), lambda t: scale * squares(t), theta, log_prior, weights, 3)

    clean = loss(1.5, theta, jnp.where(weights > 0, log_prior, 0.0), weights)
    unclean = loss(1.5, dirty, log_prior, weights)
    assert np.isfinite(clean).all()
    np.testing.assert_array_equal(unclean, clean)
    assert loss(1.0, dirty, log_prior, jnp.zeros(5))[0] == 0


# x ~ N(theta, 1), with theta proposed from N(1.5, 0.7^2). Under any Gaussian prior the posterior is
# N(gain x + offset, exp(2 log_scale)); a plain fit to the proposals finds the posterior whose prior is the proposal.
PROPOSAL = (1.5, 0.7)


def posterior(prior_mean, prior_scale):
    """The posterior's gain, offset and log-scale, in closed form."""
    precision = prior_scale**-2 + 1
    return np.array([1 / precision, prior_mean * prior_scale**-2 / precision, -0.5 * np.log(precision)])


PRIORS = {"normal": (0.5, 2.0), "uniform": (0.0, np.inf)}


def minibatch(key, n):
    key_theta, key_x = jax.random.split(key)
    theta = PROPOSAL[0] + PROPOSAL[1] * jax.random.normal(key_theta, (n, 1))
    return theta, theta + jax.random.normal(key_x, (n, 1))


def log_density(params, x):
    gain, offset, log_scale = params
    return lambda theta: jax.scipy.stats.norm.logpdf(theta - gain * x - offset, 0, jnp.exp(log_scale))[..., 0]


def atomic_of(params, key, prior, n=500):
    key_batch, key_atoms = jax.random.split(key)
    theta, x = minibatch(key_batch, n)
    mean, scale = prior
    normal = jax.scipy.stats.norm.logpdf(theta[:, 0], mean, jnp.where(jnp.isinf(scale), 1.0, scale))
    log_prior = jnp.where(jnp.isinf(scale), 0.0, normal)
    return atomic(key_atoms, log_density(params, x), theta, log_prior, jnp.ones(n))


def plain_of(params, key, prior, n=500):
    theta, x = minibatch(key, n)
    return nll(log_density(params, x)(theta), jnp.ones(n))


@functools.partial(jax.jit, static_argnums=0)
def gradients(loss, params, keys, prior):
    """The gradients of a loss on one minibatch per key."""
    return jax.vmap(lambda key: jax.grad(loss)(params, key, prior))(keys)


@functools.partial(jax.jit, static_argnums=0)
def fitted(loss, prior):
    """The parameters that minimise a loss."""
    steps = 500
    adam = optax.adam(optax.cosine_decay_schedule(4e-2, steps))

    def step(i, carry):
        params, moments = carry
        gradient = jax.grad(loss)(params, jax.random.fold_in(jax.random.key(6), i), prior, 300)
        updates, moments = adam.update(gradient, moments)
        return optax.apply_updates(params, updates), moments

    start = jnp.array([0.2, -0.5, 0.3])
    return jax.lax.fori_loop(0, steps, step, (start, adam.init(start)))[0]


@pytest.mark.parametrize("prior", PRIORS)
def test_the_expected_gradient_is_zero_at_the_posterior_whatever_the_proposal(prior):
    truth = jnp.asarray(posterior(*PRIORS[prior]), jnp.float32)

    def errors(loss, seed):
        """The mean gradient in standard errors."""
        drawn = np.asarray(gradients(loss, truth, jax.random.split(jax.random.key(seed), 200), PRIORS[prior]))
        return drawn.mean(0) / (drawn.std(0) / np.sqrt(200))

    assert np.abs(errors(atomic_of, 5)).max() < 4
    assert np.abs(errors(plain_of, 6)).max() > 30


@pytest.mark.parametrize("prior", PRIORS)
def test_the_least_loss_is_that_of_the_posterior_not_of_the_proposal(prior):
    truth, proposal = posterior(*PRIORS[prior]), posterior(*PROPOSAL)
    assert np.abs(truth - proposal).max() > 0.4
    np.testing.assert_allclose(fitted(plain_of, PRIORS[prior]), proposal, atol=0.05)
    np.testing.assert_allclose(fitted(atomic_of, PRIORS[prior]), truth, atol=0.08)
