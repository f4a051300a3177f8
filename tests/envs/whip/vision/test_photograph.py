"""What a camera does to a picture, against SciPy's filters, moments of what was one point, and counts."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage, stats

from jaxlfi.envs.whip.vision import photograph
from jaxlfi.envs.whip.vision.photograph import TAPS, Shot

HEIGHT, WIDTH = 40, 60
FAULTLESS = Shot(*(np.float32(value) for value in (0, [0, 0], [1, 1, 1], 1, 0, [0, 0], 0)))
MANY = 300
"""Shots that are drawn."""


@functools.cache
def taker():
    return jax.jit(photograph.taken)


@functools.cache
def many_shots():
    return jax.jit(jax.vmap(photograph.draw))


def taken(key, picture, **faults) -> np.ndarray:
    """A picture as it was taken by a camera of no other faults than these."""
    shot = FAULTLESS.replace(**{name: np.asarray(fault, np.float32) for name, fault in faults.items()})
    return np.asarray(taker()(key, shot, jnp.asarray(picture, jnp.float32)), float)


def noise_of(seed: int) -> np.ndarray:
    """A picture each of whose pixels differs from all others."""
    return np.random.default_rng(seed).uniform(0.05, 0.95, (HEIGHT, WIDTH, 3))


def a_point(row: int, column: int) -> np.ndarray:
    """A picture that is black but for one pixel, of another brightness in each channel."""
    picture = np.zeros((HEIGHT, WIDTH, 3))
    picture[row, column] = [0.9, 0.6, 0.3]
    return picture


def moments(channel):
    """Sum, centroid (row, column) and covariance of brightness over the pixels."""
    places = np.stack(np.indices(channel.shape), axis=-1).reshape(-1, 2)
    weights = channel.ravel() / channel.sum()
    centroid = weights @ places
    return channel.sum(), centroid, (places - centroid).T @ (weights[:, None] * (places - centroid))


def test_a_faultless_shot_changes_nothing(key):
    for picture in (noise_of(0), a_point(7, 50), np.ones((HEIGHT, WIDTH, 3))):
        np.testing.assert_allclose(taken(jax.random.clone(key), picture), picture, atol=1e-6)


@pytest.mark.parametrize("defocus", [0.3, 0.9, 2.5])
def test_defocus_against_scipy(key, defocus):
    """This also holds beyond the edge, which continues the picture, and where the kernel is cut off."""
    point = a_point(31, 1) + 0.5 * a_point(4, 57)
    for picture in (point, noise_of(1)):
        found = taken(jax.random.clone(key), picture, defocus=defocus)
        axes = [ndimage.gaussian_filter(picture[..., c], defocus, mode="nearest", radius=TAPS // 2) for c in range(3)]
        np.testing.assert_allclose(found, np.stack(axes, axis=-1), atol=2e-6)


@pytest.mark.parametrize("motion", [(1.6, 0.0), (0.0, -1.2), (2.0, 0.8), (-2.0, 0.8)])
def test_motion_spreads_light_along_itself(key, motion):
    """To the right and down: the variance along an axis is the mean of the shifts' sizes, between them of products."""
    picture = a_point(25, 13)
    found = taken(key, picture, motion=motion)
    right, down = np.multiply.outer(motion, [-0.375, -0.125, 0.125, 0.375])
    spread = [[np.abs(down).mean(), (down * right).mean()], [(down * right).mean(), np.abs(right).mean()]]
    for c in range(3):
        light, centroid, covariance = moments(found[..., c])
        np.testing.assert_allclose(light, picture[..., c].sum(), rtol=1e-5)
        np.testing.assert_allclose(centroid, [25, 13], atol=1e-4)
        np.testing.assert_allclose(covariance, spread, atol=1e-4)


def test_motion_keeps_all_light_within_and_a_margin_even(key):
    """Nothing comes in from beyond the edge."""
    even = np.full((HEIGHT, WIDTH, 3), 0.4)
    even[10:-10, 15:-12] = noise_of(2)[10:-10, 15:-12]
    found = taken(key, even, motion=[1.9, -1.3])
    np.testing.assert_allclose(found.sum(axis=(0, 1)), even.sum(axis=(0, 1)), rtol=1e-5)
    np.testing.assert_allclose(np.delete(found, np.s_[8:-8], axis=0), 0.4, atol=1e-6)
    assert np.abs(found - even).max() > 0.1


def test_exposure_and_colour(key):
    """(gain picture + offset) to the power of gamma, cut to shares before and after."""
    picture, gain = noise_of(3), np.array([1.3, 0.9, 0.6])
    found = taken(key, picture, gain=gain, offset=-0.08, gamma=0.8)
    expected = np.clip(picture * gain - 0.08, 0, 1) ** 0.8
    assert (expected == 0).any() and (expected == 1).any()
    np.testing.assert_allclose(found, expected, atol=2e-6)


@pytest.mark.parametrize(("brightness", "deviation"), [(0.2, 0.8 * 0.04 + 0.2 * 0.01), (0.8, 0.2 * 0.04 + 0.8 * 0.01)])
def test_noise_is_that_of_the_brightness(key, brightness, deviation):
    """Gaussian, of each channel of each pixel by itself; four standard errors."""
    noise = taken(key, np.full((HEIGHT, WIDTH, 3), brightness), noise=[0.04, 0.01]) - brightness
    n = noise.size
    assert abs(noise.std() / deviation - 1) < 4 / np.sqrt(2 * n)
    assert abs(noise.mean()) < 4 * deviation / np.sqrt(n)
    assert stats.kstest(noise.ravel() / deviation, "norm").pvalue > 1e-3
    for one, other in ((noise[..., 0], noise[..., 1]), (noise[1:], noise[:-1]), (noise[:, 1:], noise[:, :-1])):
        assert abs(np.corrcoef(one.ravel(), other.ravel())[0, 1]) < 4 / np.sqrt(one.size)


def test_stuck_pixels_are_as_many_as_asked(key):
    """Half of them are black, in each channel by itself."""
    found = taken(key, np.full((HEIGHT, WIDTH, 3), 0.5), stuck=0.06)
    stuck = found != 0.5
    assert np.isin(found[stuck], [0, 1]).all()
    assert stats.binomtest(int(stuck.sum()), stuck.size, 0.06).pvalue > 1e-3
    assert stats.binomtest(int((found == 1).sum()), int(stuck.sum()), 0.5).pvalue > 1e-3
    together = int((stuck[..., 0] & stuck[..., 1]).sum())
    assert stats.binomtest(together, HEIGHT * WIDTH, 0.06**2).pvalue > 1e-3


def test_noise_and_stuck_pixels_are_of_the_key(key):
    one, other = jax.random.split(key)
    faults = {"noise": [0.03, 0.02], "stuck": 0.05}
    first = taken(one, noise_of(4), **faults)
    np.testing.assert_array_equal(first, taken(jax.random.clone(one), noise_of(4), **faults))
    assert np.mean(first != taken(other, noise_of(4), **faults)) > 0.9


def test_many_are_those_of_each_and_stay_shares(key):
    """Checked for random shots and an extreme one."""
    key_shots, key_taken = jax.random.split(key)
    drawn = many_shots()(jax.random.split(key_shots, MANY))
    wild = [np.float32(value) for value in (0.4, [2, -2], [3, 0.1, 9], 0.3, -0.5, [0.5, 0.5], 0.2)]
    shots = jax.tree.map(lambda leaf, last: leaf[:16].at[15].set(last), drawn, Shot(*wild))
    keys = jax.random.split(key_taken, 16)
    pictures = jnp.asarray(np.stack([noise_of(i) for i in range(16)]), jnp.float32)
    many = np.asarray(jax.jit(jax.vmap(photograph.taken))(keys, shots, pictures))
    for i in (0, 6, 15):
        one = taker()(jax.random.clone(keys)[i], jax.tree.map(lambda leaf, i=i: leaf[i], shots), pictures[i])
        np.testing.assert_allclose(many[i], one, atol=1e-5)
    assert np.isfinite(many).all() and many.min() == 0 and many.max() == 1
    assert many.dtype == np.float32


def test_shots_are_drawn_from_their_ranges(key):
    """Their faults by themselves: a moved picture is as likely to have stuck pixels as another."""
    shots = jax.device_get(many_shots()(jax.random.split(key, MANY)))
    moved, stuck = (shots.motion != 0).any(axis=-1), shots.stuck > 0
    assert stats.binomtest(int(moved.sum()), MANY, 0.3).pvalue > 1e-3
    assert stats.binomtest(int(stuck.sum()), MANY, 0.5).pvalue > 1e-3
    assert stats.fisher_exact([[np.sum(a & b) for a in (moved, ~moved)] for b in (stuck, ~stuck)]).pvalue > 1e-3
    assert stats.kstest(shots.defocus, "uniform").pvalue > 1e-3
    assert stats.kstest(shots.motion[moved].ravel() / 4 + 0.5, "uniform").pvalue > 1e-3
    assert stats.kstest(shots.offset * 10 + 0.5, "uniform").pvalue > 1e-3
    assert stats.kstest(shots.noise.ravel() / 0.04, "uniform").pvalue > 1e-3
    assert stats.kstest(shots.stuck[stuck] / 0.01, "uniform").pvalue > 1e-3
    assert stats.kstest(np.log(shots.gamma) * 2 + 0.5, "uniform").pvalue > 1e-3
    tint = np.log(shots.gain)
    assert stats.kstest(((tint - tint.mean(axis=1, keepdims=True)) @ [1, -1, 0]) / 0.06 / 2**0.5, "norm").pvalue > 1e-3
    assert -0.6 < tint.min() < -0.2 and 0.2 < tint.max() < 0.55
    numbers = [shots.defocus, *shots.gain.T, shots.gamma, shots.offset, *shots.noise.T]
    together = np.corrcoef(np.stack(numbers)) - np.eye(len(numbers))
    together[1:4, 1:4] = 0  # of one exposure
    assert np.abs(together).max() < 0.3
