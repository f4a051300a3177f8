"""Simulations of a model under the recorded controls by MJX, inside compiled programs."""

import dataclasses
import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxlfi.envs.mujoco.mjx_effects import Held, biased, deviations, started
from jaxlfi.envs.mujoco.mjx_models import Models, mjx, with_forces
from jaxlfi.envs.mujoco.mjx_physics import Physics, State
from jaxlfi.envs.mujoco.simulator import REFUSED, UNSTABLE, Simulator, between, simulator_of
from jaxlfi.tasks.task import Task


def by_mjx(task: Task) -> Task:
    """The task with simulations by MJX, in single precision.

    Its films and least-squares estimates are MuJoCo's own, as for any task of a MuJoCo model.

    Args:
        task: of a MuJoCo model, as `mujoco_task` makes it.

    Raises:
        ValueError: for a model or parameters that MJX cannot simulate, in one line.
        ImportError: where MJX is not installed.
    """
    native = simulator_of(task)
    nominal = np.asarray(task.space.to_natural(task.support().centre), float)
    try:
        if native.does.jitter is not None:
            raise ValueError("parameters: expected controls that act when the recording says, got clock/jitter")
        simulator = MjxSimulator(native, with_forces(native.build, native.forces, task.names, nominal, task.feasible))
    except ValueError as error:
        reason = " ".join(str(error).split())
        raise ValueError(f"engine: expected native for what MJX cannot simulate, got mjx: {reason}") from error
    return dataclasses.replace(task, simulate=simulator)


class MjxSimulator:
    """Simulates all episodes of one parameter vector, as `jaxlfi.Task` calls it.

    Episodes are simulated in parallel, for the duration of the longest. MuJoCo's own simulator determines what is
    simulated, and in which rows.

    Attributes:
        native: that simulator.
    """

    def __init__(self, native: Simulator, models: Models):
        """Nothing is simulated or compiled yet.

        Args:
            native: MuJoCo's own simulator of the same episodes.
            models: MJX models of its parameters.

        Raises:
            ValueError: for a model that MJX cannot simulate, in one line.
        """
        self.native = native
        self._physics = Physics(models, native.model, native.places)
        grids = [native.grid(times) for times in native.times]
        self._grid = max(grids, key=len)
        self._needed = np.arange(len(self._grid)) < np.array([len(grid) for grid in grids])[:, None]
        step = native.model.opt.timestep
        self._held = [[Held(log, name, step) for name in native.actuators] for log in native.logs]

    def __call__(
        self, key: jax.Array, theta: Float[Array | np.ndarray, " dim"]
    ) -> tuple[Float[Array, "rows signals"], Int[Array, ""]]:
        """Measurements with their noise and discrepancies, and 0 or why the simulation failed."""
        native = self.native
        uncertain = any(start.uncertain for start in native.starts)
        key_noise, key_forces, *keys = jax.random.split(key, 2 + len(native.discrepancies) + uncertain)
        rows, outcome = self.clean(theta, self._drawn(key_forces), self._begun(keys[len(native.discrepancies) :]))
        rows += deviations(native.does, theta, native.noise) * jax.random.normal(key_noise, rows.shape)
        for own, (signal, process) in zip(keys, native.discrepancies.items(), strict=False):
            each = zip(jax.random.split(own, len(native.times)), native.times, strict=True)
            rows = rows.at[:, signal].add(jnp.concatenate([process.draw(one, times) for one, times in each]))
        return jnp.where(native.there, native.aligned(rows), 0.0), outcome

    def clean(
        self,
        theta: Float[Array | np.ndarray, " dim"],
        lacking: Float[Array, " numbers"] | None = None,
        begun: Float[Array, "episodes dofs 2"] | None = None,
    ) -> tuple[Float[Array, "rows signals"], Int[Array, ""]]:
        """Measurements without noise, and 0 or why the simulation failed; they are zero if it failed.

        Args:
            theta: in natural units.
            lacking: coefficients of the forces that the model lacks (`UnmodelledForces.add`); by default 0.
            begun: standard normal draws for starts (`starts.Start.at`); by default starts are the most likely ones.
        """
        native, theta = self.native, jnp.asarray(theta, jnp.float32)
        if native.forces is not None and lacking is None:
            lacking = jnp.zeros(len(native.forces.deviations))
        given = theta if lacking is None else jnp.concatenate([theta, lacking])
        numbers, refused = self._physics.models.numbers(given)
        simulated = functools.partial(self._episode, self._physics.models.model(numbers))
        begun = jnp.zeros((len(native.starts), native.model.nv, 2)) if begun is None else begun
        likely = [start.at(native.does, theta, own, jnp) for start, own in zip(native.starts, begun, strict=True)]
        starts = [started(native.does, theta, start, episode) for episode, start in enumerate(likely)]
        values, stable = jax.vmap(simulated)(jnp.stack(starts), self._controls(theta))
        rows = [self._measured(own, times, theta) for own, times in zip(values, native.times, strict=True)]
        unstable = jnp.any(self._needed & ~stable)
        outcome = jnp.where(refused, REFUSED, jnp.where(unstable, UNSTABLE, 0))
        return jnp.where(outcome == 0, native.aligned(biased(native.does, theta, jnp.concatenate(rows))), 0.0), outcome

    def _measured(
        self, values: Float[Array, "steps signals"], times: np.ndarray, theta: Float[Array, " dim"]
    ) -> Float[Array, "rows signals"]:
        """Signals at the times of rows, delayed if their sensors are."""
        rows = jnp.asarray(between(self._grid, values, times))
        for signal, d in self.native.does.lags:
            late = jnp.interp(jnp.asarray(times, jnp.float32) - theta[d], self._grid, values[:, signal])
            rows = rows.at[:, signal].set(late)
        return rows

    def _begun(self, keys: Sequence[jax.Array]) -> Float[Array, "episodes dofs 2"] | None:
        """Draws of the starts of one simulation's episodes, if they are uncertain and there is a key."""
        shape = (len(self.native.starts), self.native.model.nv, 2)
        return jax.random.normal(keys[0], shape) if keys else None

    def _drawn(self, key: jax.Array) -> Float[Array, " numbers"] | None:
        """The coefficients of the forces that the model lacks, of one simulation."""
        if self.native.forces is None:
            return None
        deviations = jnp.asarray(self.native.forces.deviations, jnp.float32)
        return deviations * jax.random.normal(key, deviations.shape)

    def _episode(
        self, model: mjx.Model, start: Float[Array, " state"], controls: Float[Array, "steps act"]
    ) -> tuple[Float[Array, "steps signals"], Bool[Array, " steps"]]:
        """Signals at the beginning of each step, and whether the step is stable."""
        first = self._physics.state(start)

        def step(state: State, control: Float[Array, " act"]):
            after, values, stable = self._physics.step(model, state, control)
            # An unstable simulation is reset, as in MuJoCo: solvers would iterate on NaN for long.
            after = jax.tree.map(lambda own, anew: jnp.where(stable, own, anew), after, first)
            return after, (values, stable)

        _, measured = jax.lax.scan(step, first, controls)
        return measured

    def _controls(self, theta: Float[Array, " dim"]) -> Float[Array, "episodes steps act"]:
        """Controls of each episode over each step."""
        native = self.native
        if native.does.delay is None:  # they are the same for all
            episodes = range(len(native.logs))
            recorded = [native.controls(episode, np.zeros((1, 0)), self._grid)[0] for episode in episodes]
            return jnp.asarray(np.stack(recorded), jnp.float32)
        when = jnp.asarray(self._grid, jnp.float32) - theta[native.does.delay]
        begins = [start.time for start in native.starts]
        pairs = zip(self._held, begins, strict=True)
        return jnp.stack([jnp.stack([held(when + begin) for held in several], axis=-1) for several, begin in pairs])
