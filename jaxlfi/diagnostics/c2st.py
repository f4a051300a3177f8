"""The classifier two-sample test: how often a classifier can tell which of two samples a row is from."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct
from jaxtyping import Array, Float, Int

from jaxlfi.diagnostics.arguments import numbers
from jaxlfi.distributions.arguments import is_concrete
from jaxlfi.distributions.precision import single

FOLDS = 5
UNITS_A_DIMENSION = 10
BATCH = 200
LEARNING_RATE = 1e-3
WEIGHT_PENALTY = 1e-4
"""Strength of the L2 penalty: half of it times the sum of squared weights, divided by the rows of a minibatch."""
TOLERANCE = 1e-4
PATIENCE = 10
"""Training ends after this many epochs that did not lower the smallest loss by more than `TOLERANCE`."""
MIN_EPOCHS, MAX_EPOCHS = 50, 10_000


class _Training(struct.PyTreeNode):
    params: list
    moments: optax.OptState
    epochs: Int[Array, ""]
    least: Float[Array, ""]
    idle: Int[Array, ""]


def c2st(
    key: jax.Array, first: Float[Array | np.ndarray, "n dim"], second: Float[Array | np.ndarray, "n dim"]
) -> Float[Array, ""]:
    """Accuracy of a classifier on held-out rows of two samples: 0.5 if it cannot tell them apart, 1 if it can.

    As benchmarks of likelihood-free inference define it (Lueckmann et al. 2021): a multilayer perceptron of two ReLU
    layers of 10 D units, trained by Adam until its loss no longer falls; five folds; both samples centred and scaled by
    the moments of the first. Adam's settings, the penalty and the stopping rule are those of scikit-learn, on which
    that definition relies.

    Two points depart from that definition. Training does not end in the first 50 epochs: if samples are hard to
    tell apart, the loss is on a plateau at first, where the definition's classifier stops from some starts, as if the
    samples were alike. Longer plateaus still end it, so a small accuracy is weaker evidence than a large one. And the
    folds have as many rows of either sample, row i of both in the same fold: rows that belong together, such as two
    parameters of one observation, are then held out together. Up to four rows are left out.

    All folds are trained together. The same key gives the same folds, starts and so the same number. Under jit,
    where values are not known, numbers that are not finite give NaN; else samples are scaled in double precision.

    Args:
        key: consumed.
        first: shape [N, D].
        second: shape [N, D].

    Raises:
        ValueError: for shapes that differ, fewer than ten rows, numbers that are not finite, or a sample of which no
            column varies.
    """
    first, second = numbers("first", first, "ND"), numbers("second", second, "ND")
    if first.shape != second.shape or len(first) < 2 * FOLDS:
        raise ValueError(
            f"first, second: expected two samples of the same shape [N, D], N at least {2 * FOLDS}, "
            f"got {list(first.shape)} and {list(second.shape)}"
        )
    concrete = is_concrete((first, second))
    for name, sample in {"first": first, "second": second}.items() if concrete else ():
        if not np.ptp(sample, axis=0).any():
            raise ValueError(f"{name}: expected rows that vary, got {len(sample)} that are all the same")
    xp = np if concrete else jnp
    scale = xp.std(first, axis=0, ddof=1)
    scale = xp.where(scale > 0, scale, 1.0)
    scaled = [jnp.asarray((sample - first.mean(axis=0)) / scale, jnp.float32) for sample in (first, second)]
    accuracy = _held_out(key, *scaled)
    finite = jnp.isfinite(scaled[0]).all() & jnp.isfinite(scaled[1]).all()
    return jnp.where(finite, accuracy, jnp.nan)


@jax.jit
@single
def _held_out(key: jax.Array, *scaled: Float[Array, "n dim"]) -> Float[Array, ""]:
    """Accuracy on the rows of each fold, by a classifier that was trained on the others."""
    key_folds, key_train = jax.random.split(key)
    first, _ = scaled
    size = len(first) // FOLDS
    folds = jax.random.permutation(key_folds, len(first))[: FOLDS * size].reshape(FOLDS, size)

    def one(fold):
        held_out, others = folds[fold], jnp.delete(folds, fold, axis=0, assume_unique_indices=True).ravel()
        rows = lambda places: jnp.concatenate([sample[places] for sample in scaled])
        params = _train(jax.random.fold_in(key_train, fold), rows(others), _labels(len(others)))
        return jnp.mean((_logit(params, rows(held_out)) > 0) == _labels(size))

    return jnp.mean(jax.vmap(one)(jnp.arange(FOLDS)))


def _labels(size: int) -> Array:
    return jnp.repeat(jnp.array([False, True]), size)


def _train(key: jax.Array, rows: Array, labels: Array) -> list:
    """Weights after training by minibatches until it ends."""
    key_start, key_epochs = jax.random.split(key)
    count, dim = rows.shape
    params = _start(key_start, (dim, UNITS_A_DIMENSION * dim, UNITS_A_DIMENSION * dim, 1))
    adam = optax.adam(LEARNING_RATE)
    batches = -(-count // BATCH)
    batch = -(-count // batches)

    def step(carry, places):
        params, moments = carry
        loss, gradient = jax.value_and_grad(_loss)(params, rows[places], labels[places])
        updates, moments = adam.update(gradient, moments)
        return (optax.apply_updates(params, updates), moments), loss

    def one_epoch(state: _Training) -> _Training:
        order = jnp.argsort(jax.random.uniform(jax.random.fold_in(key_epochs, state.epochs), (count,)))
        # If minibatches of one length need more rows than there are, the first ones are used twice.
        places = jnp.resize(order, (batches, batch))
        (params, moments), losses = jax.lax.scan(step, (state.params, state.moments), places)
        loss = jnp.mean(losses)
        idle = jnp.where(loss <= state.least - TOLERANCE, 0, state.idle + 1)  # NaN counts as no progress
        return _Training(params, moments, state.epochs + 1, jnp.minimum(loss, state.least), idle)

    start = _Training(params, adam.init(params), jnp.asarray(0), jnp.asarray(jnp.inf), jnp.asarray(0))
    unfinished = lambda s: (s.epochs < MIN_EPOCHS) | (s.idle <= PATIENCE) & (s.epochs < MAX_EPOCHS)
    return jax.lax.while_loop(unfinished, one_epoch, start).params


def _start(key: jax.Array, sizes: tuple[int, ...]) -> list:
    """Weights and biases, uniform with the variance of Glorot and Bengio (2010)."""
    params = []
    for layer, (fan_in, fan_out) in enumerate(itertools.pairwise(sizes)):
        reach = jnp.sqrt(6.0 / (fan_in + fan_out))
        both = jax.random.uniform(jax.random.fold_in(key, layer), (fan_in + 1, fan_out), minval=-reach, maxval=reach)
        params.append((both[:-1], both[-1]))
    return params


def _logit(params: list, rows: Array) -> Array:
    for weights, bias in params[:-1]:
        rows = jax.nn.relu(rows @ weights + bias)
    weights, bias = params[-1]
    return (rows @ weights + bias)[:, 0]


def _loss(params: list, rows: Array, labels: Array) -> Array:
    penalty = sum(jnp.sum(weights**2) for weights, _ in params)
    entropy = jnp.mean(optax.sigmoid_binary_cross_entropy(_logit(params, rows), labels))
    return entropy + 0.5 * WEIGHT_PENALTY * penalty / len(rows)
