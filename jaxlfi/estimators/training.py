"""Fitting q_phi to a masked dataset by Adam, as one loop over epochs."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from jaxlfi.estimators.base import SCHEDULES, Network, viewed
from jaxlfi.estimators.dataset import Dataset
from jaxlfi.estimators.losses import LOSSES, Rows
from jaxlfi.estimators.shuffling import shuffled
from jaxlfi.estimators.stacking import stacked

STEPS_PER_EPOCH = 50
"""Maximum gradient steps per epoch if `steps` is set; the validation loss is computed after each epoch."""


class FitInfo(struct.PyTreeNode):
    """A record of the fit, with P epochs and E networks in the ensemble.

    Attributes:
        loss: mean training loss of each epoch: the negative log-density of theta or of the summary, as the network sees
            it, or an atomic loss, shape [E, P].
        validation_loss: the same over the held-out simulations after each epoch; NaN without any, shape [E, P].
        chosen_epoch: the epoch the weights were taken from, shape [E].
        nonfinite: number of gradient steps skipped because the loss or its gradient was not finite, shape [E].
    """

    loss: Float[Array, "*batch epochs"]
    validation_loss: Float[Array, "*batch epochs"]
    chosen_epoch: Int[Array, "*batch"]
    nonfinite: Int[Array, "*batch"]


class _Training(struct.PyTreeNode):
    params: dict
    moments: optax.OptState
    nonfinite: Int[Array, ""]


class _Best(struct.PyTreeNode):
    params: dict
    loss: Float[Array, ""]
    at: Int[Array, ""]


class Lesson(struct.PyTreeNode):
    """A network that is ready to be trained, and its training data.

    Attributes:
        network: network with normalisers, and with fresh weights unless its training continues.
        rows: the simulations as the networks see them.
        order: places of the filled rows in random order, the same for all networks, so that the networks can be
            compared on the held-out ones; the places of the others follow, shape [C].
        size: number of filled rows, shape [].
        late: which rows are from the later rounds, shape [C].
        longest: largest number of rows in an epoch; if there are more, epochs take turns.
    """

    network: Network
    rows: Rows
    order: Int[Array, "*batch cap"]
    size: Int[Array, "*batch"]
    late: Bool[Array, "*batch cap"]
    longest: int = struct.field(pytree_node=False)

    def held_out(self) -> tuple[Int[Array, "*batch"], np.ndarray]:
        """The number of held-out rows, the last ones in order, and the places of as many as there can be."""
        share = self.network.estimator.validation
        places = np.arange(max(2, int(share * self.longest)))
        return jnp.minimum(jnp.floor(share * self.size).astype(jnp.int32), len(places)), places


def fit(
    key: jax.Array,
    network: Network,
    dataset: Dataset,
    weights: Float[Array, " cap"],
    expected_size: Int[Array, ""] | int,
    log_prior: Float[Array, " cap"] | None = None,
) -> tuple[Network, FitInfo]:
    """Train q_phi over the dataset (Algorithm 1, line 10).

    Args:
        key: consumed.
        network: the last round's network; with `warm_start` training continues from its weights, otherwise from fresh
            ones, and its normalisers are replaced.
        dataset: simulations; only the filled rows are used.
        weights: weight of each row in the loss, shape [C]; all ones without importance correction.
        expected_size: number of rows per epoch: of the filled rows if no simulation had failed, or fewer. It sets the
            number of minibatches of an epoch and, unlike the actual size, is the same for all runs of a batch, which
            then step together.
        log_prior: log-density of the prior at each row, up to a constant, shape [C]; None for a uniform one. Only the
            atomic losses use it.

    Returns:
        The trained network, and a record of the fit.
    """
    key_prepare, key_train = fit_keys(key)
    lesson = prepare(key_prepare, network, dataset, weights, log_prior)
    params, info = train(key_train, lesson, expected_size)
    return trained(lesson, params), info


def fit_keys(key: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The keys for preparing the training, and for training."""
    before, training = jax.random.split(key)
    return before, training


def prepare(
    key: jax.Array,
    network: Network,
    dataset: Dataset,
    weights: Float[Array, " cap"],
    log_prior: Float[Array, " cap"] | None = None,
    longest: int | None = None,
) -> Lesson:
    """Prepare the training; the arguments are those of `fit`, and the largest number of rows in an epoch.

    The default is all rows. A network that is reinitialised learns from those that are `near`.
    """
    estimator = network.estimator
    log_prior = jnp.zeros_like(weights) if log_prior is None else log_prior
    if estimator.warm_start:
        x = network.given(dataset.x)
    else:
        dataset, places = dataset.only(dataset.near)
        weights, log_prior = weights[places], log_prior[places]
        network, x = network.restarted(key, dataset)
    theta = network.to_network(dataset.theta)
    key_rows = jax.random.fold_in(jax.random.clone(key), 1)
    from_prior = (dataset.round == 0).astype(weights.dtype)
    rows = estimator.rows(key_rows, theta, x, weights, log_prior, from_prior)
    order = shuffled(jax.random.fold_in(jax.random.clone(key), 2), jnp.arange(dataset.capacity), dataset.size)
    longest = dataset.capacity if longest is None else min(longest, dataset.capacity)
    return Lesson(network, rows, order, dataset.size, dataset.late, longest)


def train(key: jax.Array, lesson: Lesson, expected_size: Int[Array, ""] | int) -> tuple[dict, FitInfo]:
    """Train the ensemble, which takes by far most of a round's time; returns its weights, and a record.

    Args:
        key: consumed.
        lesson: result of `prepare`.
        expected_size: as in `fit`.
    """
    network = lesson.network
    estimator = network.estimator

    def one(key, params, view):
        own = lesson.rows.replace(given=viewed(lesson.rows.given, view))
        return _fit_one(key, params, lesson.replace(rows=own), expected_size)

    keys = jax.random.split(key, estimator.ensemble_size)
    return jax.vmap(one)(keys, network.params, network.views)


def trained(lesson: Lesson, params: dict) -> Network:
    """The network with its trained weights, and the weights of its ensemble's members."""
    network = lesson.network.replace(params=params)
    if network.log_weights is None:
        return network
    return network.replace(log_weights=_weights(network, lesson))


def _weights(network: Network, lesson: Lesson) -> Float[Array, " member"]:
    """Log-weights of the ensemble's members, by stacking; equal without held-out rows or a likelihood loss.

    Scores are those of the held-out rows of the later rounds, which are nearer to the observation.
    """
    estimator = network.estimator
    if not estimator.validation or estimator.loss != "likelihood":
        return estimator.equal_weights
    count, places = lesson.held_out()
    held_out = jnp.take(lesson.order, jnp.maximum(lesson.size - count, 1) + places, mode="clip")
    own = lesson.rows.take(held_out)
    module: Any = estimator.embedded(network.scale.dim)
    score = lambda params, view: module.apply(params, viewed(own.given, view)).log_prob(own.value)
    counts = jnp.asarray(places < count) * lesson.late[held_out] * 1.0
    return stacked(jax.vmap(score)(network.params, network.views), counts)


def _fit_one(key_epochs, params, lesson, expected_size):
    """Train one network: epochs over the data, each a loop over minibatches."""
    estimator, data, rows, size = lesson.network.estimator, lesson.rows, lesson.order, lesson.size
    capacity, dim = data.value.shape
    module = estimator.embedded(dim)
    objective = LOSSES[estimator.loss]
    epochs = estimator.epochs or -(-estimator.steps // STEPS_PER_EPOCH)
    batches = -(-expected_size // estimator.batch_size) if estimator.epochs else -(-estimator.steps // epochs)

    def rate(count):
        return estimator.learning_rate * SCHEDULES[estimator.schedule](count / (epochs * batches))

    adam = optax.adamw(rate, weight_decay=estimator.weight_decay)

    held_out, held_out_places = lesson.held_out()
    training = jnp.maximum(size - held_out, 1)
    held_out_rows = jnp.take(rows, training + held_out_places, mode="clip")
    mean_weight = jnp.sum(jnp.where(jnp.arange(capacity) < size, data.weights, 0.0)) / jnp.maximum(size, 1)
    data = data.replace(weights=data.weights / jnp.maximum(mean_weight, 1e-30))
    held_out_data = data.take(held_out_rows)
    held_out_data = held_out_data.replace(weights=jnp.where(held_out_places < held_out, held_out_data.weights, 0.0))

    # Only as many rows as an epoch uses are shuffled, or the time would grow with the dataset.
    shared = lesson.longest < capacity
    turn = jnp.minimum(training, batches * estimator.batch_size) if shared else training

    def in_turn(index):
        return rows[(index * turn + jnp.arange(lesson.longest)) % training] if shared else rows

    key_loss, key_held_out = jax.random.fold_in(key_epochs, epochs), jax.random.fold_in(key_epochs, epochs + 1)

    def loss_of(params, key, batch):
        return objective.training(key, module.apply(params, batch.given), batch)

    def gradient_step(key, state, batch):
        loss, gradient = jax.value_and_grad(loss_of)(state.params, key, batch)
        norm = optax.tree.norm(gradient)
        finite = jnp.isfinite(loss) & jnp.isfinite(norm)
        # A single factor, whereas optax divides each entry: one pass fewer over the gradient.
        factor = jnp.minimum(1.0, estimator.clip_norm / norm)
        gradient = jax.tree.map(lambda g: jnp.where(finite, factor * g, 0.0), gradient)
        updates, moments = adam.update(gradient, state.moments, state.params)
        # A nonfinite step moves nothing, not even by earlier momentum.
        updates = jax.tree.map(lambda u: jnp.where(finite, u, 0.0), updates)
        params = optax.apply_updates(state.params, updates)
        return _Training(params, moments, state.nonfinite + ~finite), jnp.where(finite, loss, 0.0), finite

    def one_epoch(carry, index, order):
        state, best = carry

        def minibatch(b, loop):
            state, total, count = loop
            batch = data.take(order[(b * estimator.batch_size + jnp.arange(estimator.batch_size)) % turn])
            key = jax.random.fold_in(key_loss, index * batches + b)
            state, loss, finite = gradient_step(key, state, batch)
            return state, total + loss, count + finite

        state, total, count = jax.lax.fori_loop(0, batches, minibatch, (state, 0.0, 0))
        loss = total / count  # NaN if no step of the epoch was finite
        if not estimator.validation:
            return (state, best), (loss, jnp.nan)
        nothing_held_out = jnp.sum(held_out_data.weights) == 0
        # The same key for all epochs, as their losses are compared.
        q = module.apply(state.params, held_out_data.given)
        validation = objective.held_out(jax.random.clone(key_held_out), q, held_out_data)
        validation = jnp.where(nothing_held_out, jnp.nan, validation)
        # With too few simulations to hold any out, the last weights are as good as any.
        better = (validation < best.loss) | nothing_held_out
        now = _Best(state.params, validation, index)
        best = jax.tree.map(lambda new, old: jnp.where(better, new, old), now, best)
        return (state, best), (loss, validation)

    def running(carry):
        index, (_, best), _ = carry
        unfinished = index < epochs
        return unfinished & (index - best.at <= estimator.patience) if estimator.patience else unfinished

    def body(carry):
        index, training_state, curves = carry
        order = shuffled(jax.random.fold_in(key_epochs, index), in_turn(index), turn)
        training_state, seen = one_epoch(training_state, index, order)
        return index + 1, training_state, jax.tree.map(lambda curve, now: curve.at[index].set(now), curves, seen)

    state = _Training(params, adam.init(params), jnp.asarray(0))
    best = _Best(params, jnp.asarray(jnp.inf), jnp.asarray(0)) if estimator.validation else None
    unseen = jnp.full(epochs, jnp.nan)
    start = jnp.asarray(0), (state, best), (unseen, unseen)
    _, (state, best), (training_losses, validation_losses) = jax.lax.while_loop(running, body, start)
    if best is None:
        best = _Best(state.params, jnp.asarray(jnp.inf), jnp.asarray(epochs - 1))
    return best.params, FitInfo(training_losses, validation_losses, best.at, state.nonfinite)
