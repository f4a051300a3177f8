"""Space: conversion between natural units and inference space, and of densities."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given

from jaxlfi.distributions.space import Space, is_natural
from jaxlfi.distributions.support import Support
from tests.strategies import vectors

SPACE = Space(("mass", "offset", "drag"), (True, False, True))
PLAIN = Space(("a", "b"), (False, False))


def test_labels_say_which_axes_are_logarithms():
    assert SPACE.dim == 3
    assert SPACE.labels == ("ln mass", "offset", "ln drag")
    assert PLAIN.labels == PLAIN.names
    assert Space(("ln k", "c,d"), (False, True)).labels == ("ln k", "ln c,d")


@given(vectors(-8.0, 8.0, 4, 3))
def test_from_inference_space_and_back(theta):
    natural = np.asarray(SPACE.to_natural(jnp.asarray(theta)))
    expected = np.stack([np.exp(theta[:, 0]), theta[:, 1], np.exp(theta[:, 2])], axis=1)
    np.testing.assert_allclose(natural, expected, rtol=1e-5)
    np.testing.assert_allclose(SPACE.to_inference(natural), theta, rtol=1e-5, atol=2e-6)


@given(vectors(0.01, 500.0, 4, 3))
def test_from_natural_units_and_back(theta):
    inner = SPACE.to_inference(theta)
    np.testing.assert_allclose(inner[:, 0], np.log(theta[:, 0]), rtol=1e-5, atol=2e-6)
    np.testing.assert_allclose(SPACE.to_natural(inner), theta, rtol=1e-5)


def test_without_logarithms_nothing_changes():
    theta = jnp.array([[-1.0, -2.0], [0.0, 3.0]])
    np.testing.assert_array_equal(PLAIN.to_natural(theta), theta)
    np.testing.assert_array_equal(PLAIN.to_inference(theta), theta)
    np.testing.assert_array_equal(PLAIN.log_jacobian(theta), [0.0, 0.0])


def test_a_logarithm_that_does_not_exist_is_not_finite():
    inner = np.asarray(SPACE.to_inference(jnp.array([[-1.0, -1.0, 1.0], [1.0, -1.0, 0.0]])))
    assert np.isnan(inner[0, 0]) and np.isneginf(inner[1, 2])
    assert np.isfinite(inner[:, 1]).all() and inner[0, 2] == 0


@given(vectors(-4.0, 4.0, 3))
def test_the_jacobian_is_that_of_automatic_differentiation(theta):
    sign, expected = np.linalg.slogdet(np.asarray(jax.jacfwd(SPACE.to_natural)(jnp.asarray(theta)), np.float64))
    assert sign == 1
    np.testing.assert_allclose(SPACE.log_jacobian(jnp.asarray(theta)), expected, rtol=1e-5, atol=1e-5)
    several = jnp.stack([jnp.asarray(theta), jnp.zeros(3)])[None]
    np.testing.assert_allclose(SPACE.log_jacobian(several)[0], [expected, 0.0], rtol=1e-5, atol=1e-5)


def test_gradients_pass_without_nan():
    """A plain parameter, which may be negative, is neither exponentiated nor passed to a logarithm."""
    theta, natural = jnp.array([0.5, 1000.0, 1.0]), jnp.array([0.5, -2.0, 3.0])
    np.testing.assert_allclose(jax.grad(lambda t: SPACE.to_inference(t).sum())(natural), [2.0, 1.0, 1 / 3], rtol=1e-6)
    np.testing.assert_array_equal(jax.grad(lambda t: SPACE.to_natural(t)[1])(theta), [0.0, 1.0, 0.0])


def test_boxes_go_there_and_back():
    box = Support([0.1, -5.0, 0.25], [10.0, 5.0, 16.0])
    inner = SPACE.box_to_inference(box)
    np.testing.assert_allclose(inner.low, [np.log(0.1), -5.0, np.log(0.25)], rtol=1e-6)
    np.testing.assert_allclose(inner.high, [np.log(10.0), 5.0, np.log(16.0)], rtol=1e-6)
    back = SPACE.box_to_natural(inner)
    np.testing.assert_allclose(back.low, box.low, rtol=1e-5)
    np.testing.assert_allclose(back.high, box.high, rtol=1e-5)


def test_spaces_of_equal_content_are_equal():
    """A space is static in posteriors and networks: equal ones must not compile anew."""
    again = Space(("mass", "offset", "drag"), (True, False, True))
    assert again == SPACE and hash(again) == hash(SPACE)
    assert Space(SPACE.names, (True, False, False)) != SPACE


def test_other_spaces_are_refused():
    assert is_natural("natural") and not is_natural("inference")
    for wrong in ("log", "", None, True):
        with pytest.raises(ValueError, match=r"^space: expected 'natural' or 'inference', got"):
            is_natural(wrong)
