"""Orientations as rotations, against SciPy's."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("mujoco")

import jax.numpy as jnp

from jaxlfi.envs.mujoco.orientations import aligned, angle, continuous

RANDOM = np.random.default_rng(0)


def test_the_angle_between_two_orientations():
    one, other = RANDOM.normal(size=(2, 50, 4))
    roll = lambda quaternions: Rotation.from_quat(np.roll(quaternions, -1, axis=1))
    expected = (roll(one).inv() * roll(other)).magnitude()
    np.testing.assert_allclose([angle(a, b) for a, b in zip(one, other, strict=True)], expected, atol=1e-6)
    np.testing.assert_allclose([angle(a, -2 * a) for a in one], 0, atol=1e-6)


def test_simulations_have_the_sign_of_the_recording_and_norm_1():
    """In NumPy and in JAX; what is no orientation stays as it is."""
    rows, recorded = RANDOM.normal(size=(3, 20, 6)), RANDOM.normal(size=(20, 6))
    rows[1, 4, 1:5] = 0.0
    found = aligned(rows, recorded, [(1, 2, 3, 4)])
    np.testing.assert_array_equal(found[..., [0, 5]], rows[..., [0, 5]])
    for own, given in zip(found[..., 1:5].reshape(-1, 4), rows[..., 1:5].reshape(-1, 4), strict=True):
        np.testing.assert_allclose(own * np.linalg.norm(given), given * np.sign(own @ given), atol=1e-12)
    assert (np.sum(found[..., 1:5] * recorded[:, 1:5], axis=-1) >= 0).all()
    np.testing.assert_allclose(aligned(jnp.asarray(rows), recorded, [(1, 2, 3, 4)]), found, atol=1e-5)
    assert aligned(rows, recorded, []) is rows


def test_changes_of_sign_and_missing_samples():
    turns = np.roll(Rotation.from_rotvec(np.outer(np.linspace(0, 9, 60), [0.3, -0.5, 0.8])).as_quat(), 1, axis=1)
    for k in range(1, 60):
        turns[k] *= np.sign(turns[k] @ turns[k - 1])
    changed = turns * RANDOM.choice([-1.3, 0.7], size=(60, 1))
    changed[[5, 6]], changed[20, 2], changed[30] = np.nan, np.nan, 0.0
    found = continuous(changed, -turns[0])
    missing = np.isin(np.arange(60), [5, 6, 20, 30])
    assert np.isnan(found[missing]).all()
    np.testing.assert_allclose(found[~missing], -turns[~missing], atol=1e-12)
