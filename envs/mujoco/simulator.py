"""Simulations of a model under the recorded controls, by MuJoCo's threaded rollouts."""

import copy
import dataclasses
import threading
from collections.abc import Callable, Mapping, Sequence

import mujoco
import mujoco.rollout
import numpy as np
from jaxtyping import Array, Float, Int

from jaxlfi.envs.mujoco import measured, orientations
from jaxlfi.envs.mujoco.columns import controls_of
from jaxlfi.envs.mujoco.discrepancy import Discrepancy
from jaxlfi.envs.mujoco.effects import STATE, Effects
from jaxlfi.envs.mujoco.forces import UnmodelledForces, typical
from jaxlfi.envs.mujoco.logs import Log
from jaxlfi.envs.mujoco.plausible import check
from jaxlfi.envs.mujoco.quiet import quietly
from jaxlfi.envs.mujoco.starts import Start, certain
from jaxlfi.io.host_devices import processors
from jaxlfi.tasks.task import Task
from jaxlfi.tasks.worker import OneOfBatch

CHUNK = 128
"""Largest number of models that are rolled out in one call."""
MEMORY = 2**27
"""Bytes that states, sensors and controls of one call may take: fewer models are rolled out for long episodes."""
LARGEST = 2**33
"""Bytes that those of a single simulation may take."""
UNSTABLE, REFUSED = 1, 2
"""Why a simulation fails, as `FAILURES` numbers it."""
FAILURES = ("unstable", "refused by MuJoCo")
_LOCK = threading.Lock()
"""Held while a pool of threads is in use, which does one rollout at a time."""


@dataclasses.dataclass(frozen=True)
class Drawn:
    """Random draws of N simulations besides their noise, episode by episode.

    Attributes:
        late: delays of each row's controls, in s, shape [N, T] each; None without jitter.
        starts: draws of a standard normal distribution that `Start.at` takes, shape [N, V, 2] each; None for certain
            starts.
    """

    late: Sequence[Float[np.ndarray, "n time"]] | None
    starts: Sequence[Float[np.ndarray, "n dofs 2"] | None]

    def part(self, rows: slice | np.ndarray) -> "Drawn":
        """The draws of some of the simulations."""
        late = None if self.late is None else [own[rows] for own in self.late]
        return Drawn(late, [None if own is None else own[rows] for own in self.starts])

    def of(self, episode: int) -> tuple[np.ndarray | None, np.ndarray | None]:
        """Both for an episode."""
        return None if self.late is None else self.late[episode], self.starts[episode]


class Simulator:
    """Simulates all episodes of parameter vectors; `jaxlfi.HostSimulator` calls it.

    Attributes:
        times: of the rows of each episode, in s.
        observation: what was recorded, episodes one after another, shape [sum T, C]; 0 where there is no sample.
        there: whether there is a sample, shape [sum T, C].
        signals: that are measured, C of them.
        units: of the signals; "" where the sensor does not say.
        noise: standard deviation of each signal's noise, shape [C]; 0 where it is inferred.
        actuators: names of the controls (`columns`).
        places: of the signals among the model's sensor data, C of them.
        orientations: among the signals, whose quaternions are compared as rotations (`aligned`).
        discrepancies: model errors, by the signal's number.
        forces: forces that the model lacks, if any are drawn (`lacking`).
        look: makes the model of a parameter vector that is drawn in films.
        starts: where each episode begins.
        model, build, does, logs: as given to `__init__`.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        build: Callable[[np.ndarray], mujoco.MjModel],
        logs: Sequence[Log],
        signals: Sequence[str],
        noise: Mapping[str, float],
        starts: Sequence[np.ndarray | Start],
        does: Effects = Effects(),
        discrepancies: Mapping[str, Discrepancy] | None = None,
        threads: int | None = None,
    ):
        """Recordings are checked; nothing is simulated yet.

        Args:
            model: the nominal model, with a sensor for each signal.
            build: makes the model of a parameter vector [D], of the same sizes; raises ValueError where it cannot.
            logs: one for each episode, with the model's actuators and the measured signals.
            signals: that are measured (`measured`).
            noise: standard deviation of each signal's noise.
            starts: where each episode begins, or its known initial state (`effects.STATE`).
            does: effects of the parameters besides those of `build`.
            discrepancies: model errors of signals; none for others.
            threads: number of threads; by default one per processor.

        Raises:
            ValueError: for recordings that do not fit the model, in one line.
        """
        self.model, self.build, self.does, self.look = model, build, does, build
        self.logs, self.signals = tuple(logs), tuple(signals)
        self.starts = tuple(one if isinstance(one, Start) else certain(model, np.asarray(one)) for one in starts)
        self.places = measured.places(model, signals)
        self.units = tuple(measured.unit(model, name).removeprefix("1") for name in signals)
        self.noise = np.array([noise[name] for name in signals])
        self.discrepancies = {signals.index(name): one for name, one in (discrepancies or {}).items()}
        self.forces: UnmodelledForces | None = None
        self.actuators = controls_of(model)
        rows = [self._measured_rows(log, start.time) for log, start in zip(logs, self.starts, strict=True)]
        several = zip(logs, rows, self.starts, strict=True)
        self.times = [log.times[own] - start.time for log, own, start in several]
        recorded = np.concatenate(
            [
                np.stack([log.signals[name] for name in signals], axis=1)[own]
                for log, own in zip(logs, rows, strict=True)
            ]
        )
        self.orientations = tuple(orientations.groups(model, self.places).values())
        self.there = np.isfinite(recorded)
        self.observation = np.where(self.there, recorded, 0.0).astype(np.float32)
        self._chunk = int(np.clip(MEMORY // self._bytes(), 1, CHUNK))
        self._threads = threads or processors()
        self._pool: mujoco.rollout.Rollout | None = None

    def held(self, episode: int, times: Float[np.ndarray, " moments"]) -> Float[np.ndarray, "moments controls"]:
        """The recorded controls of an episode at some times, held from sample to sample."""
        times = times + self.starts[episode].time
        columns = [self.logs[episode].held(name, times) for name in self.actuators]
        return np.stack(columns, axis=-1) if columns else np.zeros((len(times), 0))

    def under(self, change: Callable[[np.ndarray], np.ndarray]) -> "Simulator":
        """The same under other controls.

        Args:
            change: function of the samples of each control, shape [T].
        """
        other = copy.copy(self)
        other.logs = tuple(
            dataclasses.replace(
                log, signals=dict(log.signals) | {name: change(log.signals[name]) for name in self.actuators}
            )
            for log in self.logs
        )
        return other

    def finer(self, factor: int = 10) -> "Simulator":
        """The same, integrated by Runge-Kutta in steps that are shorter by a factor."""
        finer, build = copy.copy(self), self.build

        def sharpened(model: mujoco.MjModel) -> mujoco.MjModel:
            model.opt.timestep, model.opt.integrator = self.model.opt.timestep / factor, mujoco.mjtIntegrator.mjINT_RK4
            return model

        finer._chunk = max(self._chunk // factor, 1)
        finer.model, finer.build = sharpened(copy.copy(self.model)), lambda theta: sharpened(build(theta))
        return finer

    def typical_forces(self, theta: Float[np.ndarray, " dim"]) -> UnmodelledForces:
        """Springs, dampers and dry friction as strong as the forces on each joint in the simulated episodes.

        Raises:
            ValueError: for parameters whose model is unstable or refused.
        """
        _, failed = self.clean(theta[None])
        if failed[0]:
            raise ValueError(
                "unmodelled_force: expected a model that can be simulated at the centre of its first guess, "
                f"got {FAILURES[failed[0] - 1]}"
            )
        episodes = [self.states(theta[None], episode)[2][0] for episode in range(len(self.logs))]
        with _LOCK, quietly():
            return typical(self.build(theta), np.concatenate(episodes), STATE)

    def lacking(self, forces: UnmodelledForces) -> "Simulator":
        """The same, with forces that the model lacks in every simulation."""
        other = copy.copy(self)
        other.forces = forces
        return other

    def _bytes(self) -> int:
        """Bytes of the states, sensors and controls of a simulation of the longest episode."""
        step, size = self.model.opt.timestep, mujoco.mj_stateSize(self.model, STATE)
        longest = int(np.argmax([times[-1] for times in self.times]))
        steps = self.times[longest][-1] / step + 2
        if (taken := 8 * steps * (size + self.model.nsensordata + self.model.nu)) > LARGEST:
            raise ValueError(
                f"{self.logs[longest].name}: expected an episode whose simulation fits into memory, got one of "
                f"{self.times[longest][-1]:.6g} s, {steps:.3g} steps of {step:g} s"
            )
        return int(taken)

    def _measured_rows(self, log: Log, begin: float) -> Int[np.ndarray, " rows"]:
        """Rows of a log with a sample of any measured signal, from the start of its episode on."""
        known = ", ".join(log.signals)
        if missing := [name for name in self.actuators if name not in log.signals]:
            raise ValueError(
                f"{log.name}: expected a control for each actuator of the model, got none of {', '.join(missing)} "
                f"among {known}"
            )
        if missing := [name for name in self.signals if name not in log.signals]:
            raise ValueError(f"{log.name}: expected signals {', '.join(missing)}, got {known}")
        if log.times[-1] - begin < self.model.opt.timestep:
            raise ValueError(
                f"{log.name}: expected more than a step of the model, {self.model.opt.timestep:g} s, "
                f"got {log.times[-1] - begin:g} s"
            )
        if begin == 0.0 or log is self.logs[0]:  # other windows of a recording share the first one's
            check(self.model, log, self.signals)
        there = np.isfinite([log.signals[name] for name in self.signals]).any(axis=0)
        return np.flatnonzero(there & (log.times >= begin - 1e-9))

    def __call__(
        self, rng: np.random.Generator, theta: Float[np.ndarray, "n dim"]
    ) -> tuple[Float[np.ndarray, "n rows signals"], Int[np.ndarray, " n"]]:
        """Measurements with their noise and discrepancies, and 0 or why each simulation failed."""
        theta = np.asarray(theta, float)
        lacking = None if self.forces is None else self.forces.draws(rng, len(theta))
        clean, outcome = self.clean(theta, lacking, self._drawn(rng, theta))
        deviation = np.tile(self.noise, (len(theta), 1))
        for signal, d in self.does.deviations:
            deviation[:, signal] = theta[:, d]
        noisy = clean + deviation[:, None] * rng.standard_normal(clean.shape)
        for signal, process in self.discrepancies.items():
            noisy[:, :, signal] += np.concatenate([process.draws(rng, len(theta), own) for own in self.times], axis=1)
        return np.where(self.there, self.aligned(noisy), 0.0), outcome

    def aligned(
        self, rows: Float[np.ndarray | Array, "*n rows signals"]
    ) -> Float[np.ndarray | Array, "*n rows signals"]:
        """Measurements with orientations of norm 1 and of the sign that is nearer to the recorded ones."""
        return orientations.aligned(rows, self.observation, self.orientations)

    def clean(
        self,
        theta: Float[np.ndarray, "n dim"],
        lacking: Float[np.ndarray, "n numbers"] | None = None,
        drawn: Drawn | None = None,
    ) -> tuple[Float[np.ndarray, "n rows signals"], Int[np.ndarray, " n"]]:
        """Measurements without noise, and 0 or why each simulation failed; those that failed are zero.

        Args:
            theta: in natural units.
            lacking: coefficients of the forces that the model lacks (`UnmodelledForces.add`); none by default.
            drawn: further random draws; by default controls act on time, and starts are the most likely ones.
        """
        theta = np.asarray(theta, float)
        lacking = np.zeros((len(theta), 0)) if lacking is None else lacking
        rows, outcome = np.zeros((len(theta), *self.observation.shape)), np.zeros(len(theta), int)
        with _LOCK, quietly():
            for first in range(0, len(theta), self._chunk):
                part = slice(first, first + self._chunk)
                own = None if drawn is None else drawn.part(part)
                rows[part], outcome[part] = self._rolled(theta[part], lacking[part], own)
        for signal, d in self.does.gains:
            rows[:, :, signal] *= theta[:, d, None]
        for signal, d in self.does.biases:
            rows[:, :, signal] += theta[:, d, None]
        rows = self.aligned(rows)
        rows[outcome != 0] = 0.0
        return rows, outcome

    def states(
        self, theta: Float[np.ndarray, "n dim"], episode: int = 0
    ) -> tuple[list[mujoco.MjModel], Float[np.ndarray, " steps"], Float[np.ndarray, "n steps state"]]:
        """Models of parameter vectors, times of their steps in an episode, and their states (`effects.STATE`) then.

        Simulations that become unstable, which `clean` counts, begin anew.

        Raises:
            ValueError: for models that MuJoCo refuses.
        """
        theta = np.asarray(theta, float)
        models, grid = [self.build(row) for row in theta], self.grid(self.times[episode])
        start = self.begun(episode, theta)
        controls = self.controls(episode, theta, grid)
        with _LOCK, quietly():
            states, _ = mujoco.rollout.rollout(models, mujoco.MjData(self.model), start, controls)
        return models, grid, np.concatenate([start[:, None], states[:, :-1]], axis=1)

    def begun(
        self, episode: int, theta: Float[np.ndarray, "*n dim"], draws: Float[np.ndarray, "*n dofs 2"] | None = None
    ) -> Float[np.ndarray, "*n state"]:
        """Initial states of an episode for parameter vectors; by default the most likely ones."""
        draws = np.zeros((*theta.shape[:-1], self.model.nv, 2)) if draws is None else draws
        return self.does.started(self.starts[episode].at(self.does, theta, draws), theta, episode)

    def _rolled(self, theta: np.ndarray, lacking: np.ndarray, drawn: Drawn | None) -> tuple[np.ndarray, np.ndarray]:
        models = [self._made(*rows) for rows in zip(theta, lacking, strict=True)]
        outcome = np.array([0 if model else REFUSED for model in models])
        good = np.flatnonzero(outcome == 0)
        rows = np.zeros((len(theta), *self.observation.shape))
        if not len(good):
            return rows, outcome
        if self._pool is None:
            self._pool = mujoco.rollout.Rollout(nthread=self._threads)
        data = [mujoco.MjData(self.model) for _ in range(self._threads)]
        drawn = None if drawn is None else drawn.part(good)
        begin = 0
        for episode, times in enumerate(self.times):
            late, moved = (None, None) if drawn is None else drawn.of(episode)
            start, grid = self.begun(episode, theta[good], moved), self.grid(times)
            states, sensors = self._pool.rollout(
                [models[row] for row in good], data, start, self.controls(episode, theta[good], grid, late)
            )
            # MuJoCo resets an unstable simulation, clock included.
            step = self.model.opt.timestep
            stopped = np.abs(states[:, -1, 0] - start[:, 0] - len(grid) * step) > step / 2
            values = sensors[:, :, self.places]
            stopped |= ~np.isfinite(values).all(axis=(1, 2)) | ~np.isfinite(states[:, -1]).all(axis=1)
            outcome[good[stopped]] = UNSTABLE
            own = between(grid, values, times)
            for signal, d in self.does.lags:
                for row, delay in enumerate(theta[good, d]):
                    own[row, :, signal] = np.interp(times - delay, grid, values[row, :, signal])
            rows[good, begin : begin + len(times)] = own
            begin += len(times)
        return rows, outcome

    def grid(self, times: np.ndarray) -> np.ndarray:
        """Times of the model's steps that reach beyond an episode's last measurement."""
        step = self.model.opt.timestep
        return step * np.arange(max(int(np.ceil(times[-1] / step - 1e-9)), 1) + 1)

    def controls(self, episode: int, theta: np.ndarray, grid: np.ndarray, late: np.ndarray | None = None) -> np.ndarray:
        """Controls of each model over each step, shape [N, steps, actuators].

        Args:
            episode: its number.
            theta: in natural units, shape [N, D].
            grid: times of the steps.
            late: delay of each row of the log, in s, shape [N, T]; none by default.
        """
        delays = np.zeros(len(theta)) if self.does.delay is None else theta[:, self.does.delay]
        log, step = self.logs[episode], self.model.opt.timestep
        when = self.starts[episode].time + grid - delays[:, None]
        held = [
            log.mean_held(name, when, step)
            if late is None
            else np.stack([log.mean_held(name, *own, step, off) for *own, off in zip(when, late, strict=True)])
            for name in self.actuators
        ]
        return np.stack(held, axis=-1) if held else np.zeros((len(theta), len(grid), 0))

    def _drawn(self, rng: np.random.Generator, theta: np.ndarray) -> Drawn | None:
        jitter, late = self.does.jitter, None
        if jitter is None and not any(start.uncertain for start in self.starts):
            return None
        if jitter is not None:
            late = [theta[:, [jitter]] * rng.standard_normal((len(theta), len(log.times))) for log in self.logs]
        shape = (len(theta), self.model.nv, 2)
        return Drawn(late, [rng.standard_normal(shape) if start.uncertain else None for start in self.starts])

    def made(self, theta: Float[np.ndarray, " dim"], lacking: Float[np.ndarray, " numbers"]) -> mujoco.MjModel:
        """The model of a parameter vector, with the forces that it lacks, if any are given.

        Raises:
            ValueError: where MuJoCo refuses it, as for a body of negative mass.
        """
        model = self.build(theta)
        return self.forces.add(model, lacking) if len(lacking) else model

    def _made(self, theta: np.ndarray, lacking: np.ndarray) -> mujoco.MjModel | None:
        """The same; None if MuJoCo refuses it."""
        try:
            return self.made(theta, lacking)
        except ValueError:
            return None


def simulator_of(task: Task) -> Simulator:
    """MuJoCo's own simulator of a task, which a task that MJX simulates has, too.

    Raises:
        ValueError: for a task that is not of a MuJoCo model.
    """
    function = getattr(task.simulate, "function", task.simulate)
    if isinstance(function, OneOfBatch):  # a run simulated one by one, as with --workers
        function = function.function
    function = getattr(function, "native", function)  # beside simulations by MJX
    if not isinstance(function, Simulator):
        raise ValueError(f"task: expected one of a MuJoCo model, got {task.name}")
    return function


def between(grid: np.ndarray, values: Array | np.ndarray, times: np.ndarray) -> Array | np.ndarray:
    """Values [..., steps, C] at other times, linear between steps. Works on JAX's arrays and on NumPy's."""
    after = np.clip(np.searchsorted(grid, times - 1e-9), 1, len(grid) - 1)
    fraction = np.clip((times - grid[after - 1]) / (grid[after] - grid[after - 1]), 0.0, 1.0)[:, None]
    return (1 - fraction) * values[..., after - 1, :] + fraction * values[..., after, :]
