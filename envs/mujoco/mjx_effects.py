"""The effects of parameters inside compiled programs: on the start, the sensors and the controls."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlfi.envs.mujoco.effects import Effects
from jaxlfi.envs.mujoco.logs import Log


def started(
    does: Effects, theta: Float[Array, " dim"], start: Float[Array | np.ndarray, " state"], episode: int = -1
) -> Float[Array, " state"]:
    """An episode's initial state (`effects.STATE`), given the one that it would begin in otherwise.

    By default, the episode is none of the recorded ones.
    """
    state = jnp.asarray(start, jnp.float32)
    for place, d in does.starts_of(episode):
        state = state.at[place].set(theta[d])
    return state


def biased(
    does: Effects, theta: Float[Array, " dim"], values: Float[Array, "*rows signals"]
) -> Float[Array, "*rows signals"]:
    """Signals with the gains and offsets of their sensors; parameters of further signals are ignored."""
    for signal, d in does.gains:
        values = values.at[..., signal].multiply(theta[d]) if signal < values.shape[-1] else values
    for signal, d in does.biases:
        values = values.at[..., signal].add(theta[d]) if signal < values.shape[-1] else values
    return values


def lags(late: Sequence[tuple[int, int]], theta: Float[Array, " dim"], size: int) -> Float[Array, " signals"]:
    """The delay of each signal's measurement, in s.

    Args:
        late: signals, and the parameters that are their delays (`Effects.lags`).
        theta: in natural units.
        size: number of the signals.
    """
    seconds = jnp.zeros(size, jnp.float32)
    for signal, d in late:
        seconds = seconds.at[signal].set(theta[d]) if signal < size else seconds
    return seconds


def passed_by(trace: Float[Array, "steps signals"], ago: Float[Array, " signals"]) -> Float[Array, " signals"]:
    """The value of each signal some steps ago, linear between steps; before that, its earliest known value.

    Args:
        trace: at the end of the last steps, the latest last.
        ago: in steps, at least 0.
    """
    last = len(trace) - 1
    place = jnp.clip(last - ago, 0.0, last)
    before = jnp.floor(place + 1e-4).astype(int)  # in single precision a delay of whole steps is one
    after, columns = jnp.minimum(before + 1, last), np.arange(trace.shape[1])
    fraction = jnp.maximum(place - before, 0.0)
    return (1 - fraction) * trace[before, columns] + fraction * trace[after, columns]


def deviations(
    does: Effects, theta: Float[Array | np.ndarray, " dim"], noise: Float[np.ndarray, " signals"]
) -> Float[Array, " signals"]:
    """Standard deviations of the signals' noise, given or inferred."""
    deviation = jnp.asarray(noise, jnp.float32)
    for signal, d in does.deviations:
        deviation = deviation.at[signal].set(theta[d]) if signal < len(deviation) else deviation
    return deviation


class Held:
    """A recorded control, held from sample to sample, at times that depend on parameters.

    The numbers are those of `Log.mean_held`, computed from jumps: in single precision, differences of integrals from
    the beginning of a long recording would be inexact.
    """

    def __init__(self, log: Log, name: str, interval: float):
        """Look up the samples.

        Args:
            log: the recording.
            name: of the control.
            interval: over which means are taken, in s.
        """
        since, values = log.samples(name)
        # Only the samples within an interval matter, and the one before; after the last nothing changes.
        self._most = int(np.max(np.searchsorted(since, since + interval, side="right") - np.arange(len(since))))
        self._since = np.append(since, np.full(self._most, np.inf)).astype(np.float32)
        self._jumps = np.append(np.diff(values), np.zeros(self._most + 1)).astype(np.float32)
        self._values, self._interval = values.astype(np.float32), interval

    def __call__(self, times: Float[Array, " steps"]) -> Float[Array, " steps"]:
        """Means over the intervals that begin at these times; before the first sample, that sample is held."""
        last = jnp.maximum(jnp.searchsorted(self._since[: len(self._values)], times, side="right") - 1, 0)
        later = last[:, None] + np.arange(1, self._most + 1)
        since, jumps = jnp.asarray(self._since)[later], jnp.asarray(self._jumps)[later - 1]
        fractions = jnp.clip((times[:, None] + self._interval - since) / self._interval, 0.0, 1.0)
        return jnp.asarray(self._values)[last] + jnp.sum(jumps * fractions, axis=1)
