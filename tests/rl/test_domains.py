"""Domains of a posterior whose task brings a prior."""

import distrax
import jax
import jax.numpy as jnp
import numpy as np

from jaxlfi.distributions.belief import Belief
from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.space import Space
from jaxlfi.distributions.support import Support
from jaxlfi.rl.domains import of_belief

SPACE = Space(("mass", "rate"), (False, True))
LIMITS = Support([-3.0, 0.1], [3.0, 10.0])
MIXTURE = GaussianMixture(jnp.zeros(1), jnp.array([[0.2, 0.0]]), jnp.diag(jnp.array([0.8, 2.0]))[None])
BELIEF = Belief(MIXTURE, SPACE.box_to_inference(LIMITS), jnp.asarray(True))
HALF = distrax.Independent(distrax.Uniform(jnp.array([0.0, -1.0]), jnp.array([1.0, 1.0])), 1)
"""Over inference space: a positive mass below 1, and a rate within a factor of e."""


def test_no_environment_is_where_the_prior_is_zero(key):
    draw = jax.jit(lambda key, prior=None: of_belief(key, BELIEF, SPACE, LIMITS, 400, prior).theta, static_argnums=1)
    without, theta = (np.asarray(draw(jax.random.clone(key), prior)) for prior in (None, HALF))
    assert theta.shape == (400, 2) and ((theta[:, 0] >= 0) & (theta[:, 0] <= 1)).all()
    assert (np.abs(np.log(theta[:, 1])) <= 1 + 1e-6).all()
    allowed = (without[:, 0] >= 0) & (without[:, 0] <= 1) & (np.abs(np.log(without[:, 1])) <= 1)
    assert 0.05 < allowed.mean() < 0.95
    np.testing.assert_allclose(theta[allowed], without[allowed], rtol=1e-5)  # only the others are drawn again
