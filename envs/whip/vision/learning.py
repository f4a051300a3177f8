"""Training of a network of vision: a compiled step, a checkpoint every some steps, a mean of the last weights."""

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct
from jaxtyping import Array, Float, Int

from jaxlfi.io import files, trees

CHUNK = 50
"""Steps between two checkpoints."""


class Loss(Protocol):
    """The loss; it draws its own batch."""

    def __call__(self, params: Any, key: jax.Array, data: Any) -> Float[Array, ""]:
        """The loss of a batch."""


@dataclasses.dataclass(frozen=True)
class Training:
    """How a network is trained: Adam, with a learning rate that falls to nothing along a cosine.

    Attributes:
        steps: of the training.
        learning_rate: its highest, after the warm-up.
        warm_up: steps in which the learning rate rises.
        memory: of the mean of the weights: how much of it each step keeps.
        clip: greatest norm of a gradient.
    """

    steps: int
    learning_rate: float
    warm_up: int = 100
    memory: float = 0.995
    clip: float = 1.0

    def optimiser(self) -> optax.GradientTransformation:
        """Adam with the schedule."""
        rate = optax.warmup_cosine_decay_schedule(
            0.0, self.learning_rate, min(self.warm_up, self.steps // 2), self.steps
        )
        return optax.chain(optax.clip_by_global_norm(self.clip), optax.adam(rate))


class Trained(struct.PyTreeNode):
    """State of a training.

    Attributes:
        key: of the next step.
        step: number of steps that are done.
        params: of the network.
        mean: of the weights, which is what is used in the end.
        optimiser: its state.
    """

    key: jax.Array
    step: Int[Array, ""]
    params: Any
    mean: Any
    optimiser: Any


def train(
    training: Training,
    loss: Loss,
    params: Any,
    key: jax.Array,
    data: Any,
    checkpoint: Path | None = None,
    on_chunk: Callable[[int, np.ndarray], Any] = lambda step, losses: None,
) -> tuple[Any, np.ndarray]:
    """Train, from the beginning or from the checkpoint, if there is one.

    Args:
        training: how.
        loss: of a batch.
        params: of the network, at the start.
        key: of all batches.
        data: what the loss draws batches from; a pytree of arrays.
        checkpoint: file that the training is kept in while it runs.
        on_chunk: called with the number of steps done, and all losses so far.

    Returns:
        The mean of the weights, and the loss of each step, shape [steps].

    Raises:
        ValueError: for a checkpoint of another training.
        FloatingPointError: where the loss is not finite any more.
    """
    # Copies, as each step overwrites the state of the last.
    mean = jax.tree.map(jnp.copy, params)
    state = Trained(
        jax.random.clone(key), jnp.asarray(0), jax.tree.map(jnp.copy, params), mean, training.optimiser().init(params)
    )
    losses = np.zeros(0, np.float32)
    if checkpoint is not None and checkpoint.exists():
        arrays = files.read_arrays(checkpoint)
        try:
            state, losses = trees.from_arrays(arrays, state, "state"), arrays["losses"]
        except (KeyError, ValueError) as error:
            raise ValueError(f"{checkpoint}: expected a checkpoint of this training, got another: {error}") from error
    on_chunk(len(losses), losses)
    while len(losses) < training.steps:
        made = []
        for _ in range(min(CHUNK, training.steps - len(losses))):
            state, value = _step(training, loss, state, data)
            made.append(value)
        losses = np.concatenate([losses, np.asarray(made)])
        if not np.isfinite(losses).all():
            raise FloatingPointError(f"the loss of step {int(np.argmin(np.isfinite(losses)))} is not finite")
        if checkpoint is not None:
            arrays = trees.to_arrays(state, "state") | {"losses": losses}
            files.write_arrays(checkpoint, arrays, compress=False, durable=True)
        on_chunk(len(losses), losses)
    return state.mean, losses


# One program per step, not a loop of many: XLA for CPU runs convolutions in loops ten times slower.
@functools.partial(jax.jit, static_argnums=(0, 1), donate_argnums=2)
def _step(training: Training, loss: Loss, state: Trained, data: Any) -> tuple[Trained, Array]:
    optimiser = training.optimiser()
    key, key_batch = jax.random.split(state.key)
    value, gradient = jax.value_and_grad(loss)(state.params, key_batch, data)
    updates, optimiser_state = optimiser.update(gradient, state.optimiser, state.params)
    params = optax.apply_updates(state.params, updates)
    # Early on, the mean covers all steps so far.
    kept = jnp.minimum(training.memory, state.step / (state.step + 1))
    mean = optax.incremental_update(params, state.mean, 1 - kept)
    return Trained(key, state.step + 1, params, mean, optimiser_state), value
