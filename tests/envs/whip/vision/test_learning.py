"""The training loop of vision's networks, on a problem with a closed form."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from jaxlfi.envs.whip.vision import learning
from jaxlfi.envs.whip.vision.learning import Training

START = {"w": jnp.array([2.0, -1.0]), "b": jnp.asarray(0.5)}
DATA = jnp.asarray(np.random.default_rng(0).normal(size=(64, 2)), jnp.float32)
SHORT = Training(steps=70, learning_rate=0.05, warm_up=10, memory=0.9)


def loss(params, key, data):
    """Least squares towards 3 x - 2 y + 1, on a random batch."""
    x = data[jax.random.randint(key, (16,), 0, len(data))]
    return jnp.mean((x @ params["w"] + params["b"] - (x @ jnp.array([3.0, -2.0]) + 1)) ** 2)


def trained(checkpoint=None, training=SHORT, on_chunk=lambda step, losses: None, loss=loss):
    return learning.train(training, loss, START, jax.random.key(4), DATA, checkpoint, on_chunk)


def by_hand(training: Training):
    """The same steps one by one with optax, and the mean of the weights in NumPy."""
    rate = optax.warmup_cosine_decay_schedule(0.0, training.learning_rate, training.warm_up, training.steps)
    adam = optax.chain(optax.clip_by_global_norm(training.clip), optax.adam(rate))
    gradient_of, update = jax.jit(jax.value_and_grad(loss)), jax.jit(adam.update)
    params, key, losses = START, jax.random.key(4), []
    state, mean = adam.init(params), jax.tree.map(np.asarray, params)
    for step in range(training.steps):
        key, now = jax.random.split(key)
        value, gradient = gradient_of(params, now, DATA)
        updates, state = update(gradient, state, params)
        params = optax.apply_updates(params, updates)
        kept = min(training.memory, step / (step + 1))
        mean = jax.tree.map(lambda old, new, kept=kept: kept * old + (1 - kept) * np.asarray(new), mean, params)
        losses.append(float(value))
    return mean, losses


def test_its_steps_are_those_of_optax_and_its_result_the_mean_of_the_weights():
    mean, losses = trained()
    expected, expected_losses = by_hand(SHORT)
    np.testing.assert_allclose(losses, expected_losses, rtol=1e-4)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4), mean, expected)
    assert losses[-10:].mean() < 0.2 * losses[:10].mean()


def test_it_finds_the_least_squares():
    mean, _ = trained(training=Training(steps=600, learning_rate=0.1, memory=0.98))
    np.testing.assert_allclose(mean["w"], [3.0, -2.0], atol=0.01)
    np.testing.assert_allclose(mean["b"], 1.0, atol=0.01)


def test_an_interrupted_training_goes_on_to_the_same_bits(tmp_path):
    whole, losses = trained()

    def stop(step, losses):
        if step == learning.CHUNK:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        trained(tmp_path / "part.npz", on_chunk=stop)
    begun = []
    again, all_losses = trained(tmp_path / "part.npz", on_chunk=lambda step, losses: begun.append(step))
    assert begun == [50, 70]
    np.testing.assert_array_equal(all_losses, losses)
    jax.tree.map(np.testing.assert_array_equal, again, whole)


def test_the_start_is_left_as_it_was():
    trained()
    np.testing.assert_array_equal(START["w"], [2.0, -1.0])


def test_a_loss_that_is_not_finite_ends_it():
    def broken(params, key, data):
        return loss(params, key, data) + jnp.where(params["b"] > 0.55, jnp.nan, 0.0)

    with pytest.raises(FloatingPointError, match=r"the loss of step \d+ is not finite"):
        trained(loss=broken)


@pytest.mark.parametrize("content", [b"no npz", None])
def test_a_checkpoint_of_another_training_is_refused(tmp_path, content):
    path = tmp_path / "part.npz"
    if content is None:
        np.savez(path, losses=np.zeros(50), other=np.zeros(3))
    else:
        path.write_bytes(content)
    with pytest.raises(ValueError, match=r"part\.npz: expected a"):
        trained(path)


def test_it_is_compiled_once(caplog):
    import logging

    trained()
    with jax.log_compiles(), caplog.at_level(logging.WARNING):
        trained()
    assert not [record for record in caplog.records if "_step" in record.getMessage()]
