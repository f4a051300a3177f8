"""The keys of a run: one seed, split by what the numbers are for."""

import jax
from flax import struct


@struct.dataclass
class RunKeys:
    """Independent keys derived from one.

    Attributes:
        observe: simulates the observation, where the truth is known and none was given.
        run: the inference itself.
        diagnose: draws and simulations by which posteriors are compared with the truth.
    """

    observe: jax.Array
    run: jax.Array
    diagnose: jax.Array


def run_keys(key: jax.Array) -> RunKeys:
    """The keys of the run that `key` stands for. Runs of the same key share their observation."""
    return RunKeys(*(jax.random.fold_in(key, purpose) for purpose in range(3)))
