"""The transporter: what it transports, where its keypoints are, and in which order."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

pytest.importorskip("mujoco")

from jaxlfi.envs.whip.vision import transporter, weights
from jaxlfi.envs.whip.vision.transporter import Pairs, Transporter

SMALL = Transporter(width=16)


@functools.cache
def params():
    return jax.jit(lambda: weights.initial(SMALL, jax.random.key(3)))()


def masks(n: int) -> jnp.ndarray:
    """A bar at n places, shape [n, 64, 64, 1]."""
    out = np.zeros((n, 64, 64, 1), np.uint8)
    for i in range(n):
        out[i, 8 : 30 + 5 * i, 20 + 4 * i : 24 + 4 * i] = 255
    return jnp.asarray(out)


def test_gaussians_are_where_the_keypoints_are():
    spots = np.asarray(transporter.around(jnp.array([[[0.28125, 0.65625], [0.9, 0.1]]])))
    row, column = np.unravel_index(np.argmax(spots[0, :, :, 0]), (16, 16))
    assert (row, column) == (10, 4)  # v is down and u to the right: 10.5 and 4.5 sixteenths
    assert spots[0, 10, 4, 0] == pytest.approx(1.0)
    assert spots[0, 10, 6, 0] == pytest.approx(np.exp(-0.5 * (2 / 16 / transporter.SPREAD) ** 2), rel=1e-5)


def test_keypoints_are_the_means_of_their_heat_maps():
    """All heat at one place, and half of it at each of two."""
    heat = np.full((1, 16, 16, 2), -1e3, np.float32)
    heat[0, 3, 12, 0] = heat[0, 3, 2, 1] = heat[0, 7, 2, 1] = 0.0
    places = transporter.means(jnp.asarray(heat))
    np.testing.assert_allclose(places[0], np.array([[12.5, 3.5], [2.5, 5.5]]) / 16, atol=1e-6)


def transported(features, others, there, here):
    """Section 3 of Kulkarni et al., 2019, keypoint by keypoint in NumPy."""
    for k in range(there.shape[-1]):
        cut, put = there[..., k : k + 1], here[..., k : k + 1]
        features = (1 - cut) * (1 - put) * features + put * others
    return features


@pytest.mark.slow
def test_it_paints_from_the_transported_features():
    first, second = masks(3)[:2] / 255, masks(3)[1:] / 255
    bound = SMALL.bind(params())
    features = transported(
        *(np.asarray(bound.appearance(image)) for image in (first, second)),
        *(np.asarray(transporter.around(bound.places(image))) for image in (first, second)),
    )
    np.testing.assert_allclose(bound(first, second), bound.painter(jnp.asarray(features)), atol=1e-4)


@pytest.mark.slow
def test_nothing_is_learnt_of_the_first_frame():
    """Its features and keypoints are constants: the gradient is that of a network of the second frame alone."""
    own, first, second = params(), masks(3)[:1] / 255, masks(3)[2:] / 255
    gradient = jax.jit(jax.grad(lambda image: SMALL.apply(own, image, second).sum()))(first)
    assert not np.any(gradient)
    assert np.any(jax.jit(jax.grad(lambda image: SMALL.apply(own, first, image).sum()))(second))


def test_pairs_are_of_one_rollout():
    """Each rollout has one shade, and a network that paints the first frame has no loss."""

    class Copies:
        """Paints what it was given first."""

        def apply(self, params, first, second):
            """The first image."""
            return first

    shades = np.arange(1, 7, dtype=np.uint8)[:, None, None, None, None] * 40
    data = Pairs(jnp.asarray(np.broadcast_to(shades, (6, 5, 64, 64, 1))))
    assert float(transporter.loss(None, jax.random.key(0), data, module=Copies(), batch=32)) == 0
    other = Pairs(jnp.asarray(np.broadcast_to(shades.swapaxes(0, 1)[:, :5], (6, 5, 64, 64, 1))))
    assert float(transporter.loss(None, jax.random.key(0), other, module=Copies(), batch=32)) > 0.01


def test_keypoints_can_be_put_in_another_order():
    order = np.array([2, 0, 3, 1])
    before = transporter.places(SMALL, params(), masks(2))
    after = transporter.places(SMALL, transporter.ordered(params(), order), masks(2))
    np.testing.assert_allclose(after, before[:, order], atol=1e-5)


def test_it_has_few_weights():
    leaves = jax.tree.leaves(jax.eval_shape(lambda: weights.initial(Transporter(), jax.random.key(0))))
    assert sum(leaf.size for leaf in leaves) < 3e5
