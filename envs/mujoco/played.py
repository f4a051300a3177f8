"""Candidate experiments on a MuJoCo model: what its actuators play, and the state that an episode begins in.

The table `design` of the TOML file defines them; defaults are those of the model and of the first recording.

[design]
duration = 3.0                      # s, and an interval of 0.02 s between samples
interval = 0.02

[design.controls.motor]             # for one actuator; the others rest
kind = "sines"                      # or "chirp", or "moves"
count = 2                           # sines that are added, or moves one after another
frequency = [0.2, 3.0]              # Hz

[design.initial]                    # numbers of an episode's initial state
"pendulum/qpos" = [-1.0, 1.0]

[design.limits]                     # on measured signals: beyond them an experiment is unsafe
"arm angle" = [-2.0, 2.0]
"""

import copy
import dataclasses
import functools
import math
import warnings
from collections.abc import Callable, Mapping
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float

from jaxlfi.envs.mujoco.effects import sizes, state_place
from jaxlfi.envs.mujoco.logs import Log
from jaxlfi.envs.mujoco.simulator import Simulator
from jaxlfi.envs.mujoco.starts import certain
from jaxlfi.tasks.design import Design
from jaxlfi.tasks.host import HostSimulator
from jaxlfi.tasks.task import Task

KEYS = ("duration", "interval", "controls", "initial", "limits")
CONTROL = ("kind", "count", "amplitude", "frequency")
FREQUENCIES = (0.2, 3.0)
"""Default frequencies in Hz, as far as samples of a control can follow."""
MODELS = 4096
"""Number of models of parameter vectors that are cached for the next design."""


@dataclasses.dataclass(frozen=True)
class Played:
    """What an actuator plays, given some numbers of a design.

    Attributes:
        actuator: its name.
        kind: a name in `KINDS`.
        count: sines that are added, or moves one after another.
        low, high: range of the control.
        amplitude: bounds on the deviation of sines and chirps from the middle, or on the end points of moves.
        frequency: bounds on the frequency, in Hz.
    """

    actuator: str
    kind: str
    count: int
    low: float
    high: float
    amplitude: tuple[float, float]
    frequency: tuple[float, float]

    @property
    def variables(self) -> dict[str, tuple]:
        """Names and bounds of its numbers."""
        number = lambda i: f" {i + 1}" if self.count > 1 else ""
        each = range(self.count)
        if self.kind == "moves":
            return {f"{self.actuator} to{number(i)}": self.amplitude for i in each}
        if self.kind == "chirp":
            ends = {f"{self.actuator} frequency {end}": (*self.frequency, "Hz") for end in ("first", "last")}
            return {f"{self.actuator} amplitude": self.amplitude} | ends
        amplitudes = {f"{self.actuator} amplitude{number(i)}": self.amplitude for i in each}
        return amplitudes | {f"{self.actuator} frequency{number(i)}": (*self.frequency, "Hz") for i in each}

    def samples(self, numbers: Float[np.ndarray, " k"], times: Float[np.ndarray, " time"]) -> np.ndarray:
        """The control at some times from 0, within its range.

        Example:
            >>> chirp = Played("motor", "chirp", 1, -1.0, 1.0, (0.0, 1.0), (0.1, 9.0))
            >>> chirp.samples(np.array([0.5, 1.0, 1.0]), np.array([0.0, 0.25, 1.0])).round(3).tolist()
            [0.0, 0.5, -0.0]
        """
        middle = _centre(self.low, self.high)
        return np.clip(KINDS[self.kind](self, np.asarray(numbers, float), times, middle), self.low, self.high)


def _sines(one: Played, numbers: np.ndarray, times: np.ndarray, middle: float) -> np.ndarray:
    amplitudes, frequencies = numbers[: one.count], numbers[one.count :]
    return middle + np.sin(2 * np.pi * times[:, None] * frequencies) @ amplitudes


def _chirp(one: Played, numbers: np.ndarray, times: np.ndarray, middle: float) -> np.ndarray:
    amplitude, first, last = numbers
    turns = first * times + 0.5 * (last - first) * times**2 / times[-1]
    return middle + amplitude * np.sin(2 * np.pi * turns)


def _moves(one: Played, numbers: np.ndarray, times: np.ndarray, middle: float) -> np.ndarray:
    """From the middle to one value after another, each move of minimum jerk (Flash and Hogan 1985)."""
    corners = np.concatenate([[middle], numbers])
    place = np.clip(times / times[-1] * len(numbers), 0.0, len(numbers) * (1 - 1e-12))
    move = place.astype(int)
    s = place - move
    return corners[move] + (corners[move + 1] - corners[move]) * s**3 * (10 - 15 * s + 6 * s**2)


KINDS: dict[str, Callable[[Played, np.ndarray, np.ndarray, float], np.ndarray]] = {
    "sines": _sines,
    "chirp": _chirp,
    "moves": _moves,
}
"""What can be played, by name."""


class Experiment:
    """Simulates the episode of a design; `jaxlfi.HostSimulator` calls it.

    Attributes:
        played: what actuators play.
        starts: names of the numbers of the initial state that a design chooses.
        times: of an episode's samples, in s.
    """

    def __init__(
        self,
        recorded: Simulator,
        played: tuple[Played, ...],
        starts: tuple[str, ...],
        own: Float[np.ndarray, " state"],
        times: Float[np.ndarray, " time"],
    ):
        """Nothing is simulated yet.

        Args:
            recorded: the simulator of the recordings, whose model, noise and forces are the same.
            played: what actuators play; others rest in the middle of their range.
            starts: names of the numbers of the initial state that a design chooses.
            own: initial state otherwise.
            times: of an episode's samples.
        """
        self.played, self.starts, self.times = played, starts, times
        self._own, self._model = own, recorded.model
        rest = {name: np.full(len(times), _middle(recorded.model, name)) for name in recorded.actuators}
        signals = rest | {name: np.zeros(len(times)) for name in recorded.signals}
        known = functools.lru_cache(MODELS)(lambda numbers: recorded.build(np.frombuffer(numbers)))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the recording does not exist yet
            self._base = Simulator(
                recorded.model,
                lambda theta: known(np.ascontiguousarray(theta, float).tobytes()),
                [Log(times, signals, "design")],
                recorded.signals,
                dict(zip(recorded.signals, recorded.noise, strict=True)),
                [own],
                recorded.does,
                {recorded.signals[place]: one for place, one in recorded.discrepancies.items()},
            )
        self._base.forces = recorded.forces

    def controls(self, design: Float[np.ndarray, " k"]) -> dict[str, np.ndarray]:
        """Samples of each actuator that plays something."""
        found, used = {}, 0
        for one in self.played:
            size = len(one.variables)
            found[one.actuator] = one.samples(np.asarray(design)[used : used + size], self.times)
            used += size
        return found

    def at(self, design: Float[np.ndarray, " k"]) -> Simulator:
        """The simulator of the episode of a design."""
        other = copy.copy(self._base)
        (log,) = other.logs
        other.logs = (dataclasses.replace(log, signals=dict(log.signals) | self.controls(design)),)
        if self.starts:
            chosen = zip(self.starts, map(float, design[len(design) - len(self.starts) :]), strict=True)
            places = {state_place(self._model, name, f"initial/{name}"): number for name, number in chosen}
            other.starts = (certain(self._model, self._own, places),)
        return other

    def __call__(self, rng: np.random.Generator, theta: Float[np.ndarray, "n dim"], design: np.ndarray) -> Any:
        """Measurements [N, T, C] with noise, and 0 or why each simulation failed."""
        return self.at(design)(rng, theta)

    def response(self, theta: Float[np.ndarray, "n dim"], design: np.ndarray) -> np.ndarray:
        """Measurements without noise; NaN where a simulation fails."""
        rows, outcome = self.at(design).clean(theta)
        return np.where((outcome == 0)[:, None, None], rows, np.nan)

    def table(self, design: Float[np.ndarray, " k"]) -> tuple[list[str], np.ndarray]:
        """Headings and rows of the controls, as they are played and as a recording has them."""
        controls = {name: np.full(len(self.times), _middle(self._model, name)) for name in self._base.actuators}
        controls |= self.controls(design)
        return ["time [s]", *controls], np.column_stack([self.times, *controls.values()])


def with_design(task: Task, recorded: Simulator, table: Mapping[str, Any], begins: Float[np.ndarray, " state"]) -> Task:
    """The task of recordings with the experiments that a table `design` allows.

    Args:
        task: of the recordings.
        recorded: their simulator.
        table: of the TOML file.
        begins: initial state of experiments, except for the numbers that a design chooses.

    Raises:
        ValueError: for what the model does not allow, in one line.
    """
    if unknown := [key for key in table if key not in KEYS]:
        raise ValueError(f"design: expected keys among {', '.join(KEYS)}, got {', '.join(unknown)}")
    own = recorded.times[0]
    duration = _positive(table.get("duration", float(own[-1])), "duration")
    interval = _positive(table.get("interval", float(np.median(np.diff(own)))), "interval")
    if interval < recorded.model.opt.timestep or duration < 2 * interval:
        raise ValueError(
            f"design: expected an interval of at least the model's step, {recorded.model.opt.timestep:g} s, and a "
            f"duration of several, got {interval:g} s and {duration:g} s"
        )
    times = np.arange(round(duration / interval) + 1) * interval
    given = table.get("controls", {name: {} for name in recorded.actuators})
    played = tuple(_played(recorded, name, one, interval) for name, one in given.items())
    starts = {name: _start(recorded.model, name, bounds) for name, bounds in table.get("initial", {}).items()}
    limits = {name: _bounds(bounds, f"limits: {name}") for name, bounds in table.get("limits", {}).items()}
    if unknown := [name for name in limits if name not in recorded.signals]:
        raise ValueError(f"design: limits: expected some of {', '.join(recorded.signals)}, got {', '.join(unknown)}")
    variables = {name: bounds for one in played for name, bounds in one.variables.items()} | {
        f"start {name}": bounds for name, bounds in starts.items()
    }
    if not variables:
        raise ValueError("design: expected controls or an initial state to choose, got none")
    experiment = Experiment(recorded, played, tuple(starts), begins, times)
    design = Design(
        variables,
        response=experiment.response,
        noise=_noise(recorded, interval),
        safe=functools.partial(_within, tuple(recorded.signals), tuple(limits.items())) if limits else None,
        controls=experiment.table,
    )
    one = dataclasses.replace(
        task,
        simulate=HostSimulator(experiment),
        observation=None,
        times=times,
        record_label="time [s]",
        summary="identity",
        summary_names=(),
        design=design,
        settings={},
    )
    return dataclasses.replace(task, design=dataclasses.replace(design, of=one))


def _start(model: mujoco.MjModel, name: str, value: Any) -> tuple[float, float]:
    """Bounds of a number of the initial state, within the range of its joint."""
    bounds = _bounds(value, f"initial: {name}")
    state_place(model, name, f"initial/{name}")  # refuses unknown names
    joint, _, what = name.rpartition("/")
    place, plain = model.joint(joint).id, sizes(model.joint(joint)) == (1, 1)
    low, high = model.jnt_range[place]
    limited = what.startswith("qpos") and plain and model.jnt_limited[place]
    if limited and not (low <= bounds[0] and bounds[1] <= high):
        raise ValueError(
            f"design: initial: {name}: expected bounds within the joint's range, {low:g} to {high:g}, got "
            f"{bounds[0]:g} to {bounds[1]:g}"
        )
    return bounds


def _frequency(value: Any, where: str, interval: float) -> tuple[float, float]:
    """Bounds on a frequency, up to the Nyquist limit of samples at an interval in s."""
    fastest = 0.5 / interval
    if value is None:
        low, high = FREQUENCIES
        return min(low, fastest * low / high), min(high, fastest)
    bounds = _bounds(value, where)
    if not 0 <= bounds[0] < bounds[1] <= fastest * (1 + 1e-9):
        raise ValueError(
            f"{where}: expected 0 to at most {fastest:g} Hz, as controls are played every {interval:g} s, got "
            f"{bounds[0]:g} to {bounds[1]:g} Hz"
        )
    return bounds


def _played(recorded: Simulator, name: str, table: Any, interval: float) -> Played:
    where = f"design: controls: {name}"
    if name not in recorded.actuators:
        raise ValueError(f"{where}: expected one of {', '.join(recorded.actuators) or 'no actuators'}, got {name!r}")
    if not isinstance(table, Mapping) or (set(table) - set(CONTROL)):
        raise ValueError(f"{where}: expected a table with keys among {', '.join(CONTROL)}, got {table!r}")
    kind, count = table.get("kind", "sines"), table.get("count", 1)
    if kind not in KINDS:
        raise ValueError(f"{where}: kind: expected one of {', '.join(KINDS)}, got {kind!r}")
    if isinstance(count, bool) or not isinstance(count, int) or not 1 <= count <= 20 or (kind == "chirp" and count > 1):
        raise ValueError(f"{where}: count: expected {'1' if kind == 'chirp' else '1 to 20'}, got {count!r}")
    low, high = _range(recorded.model, name)
    if not math.isfinite(low) and "amplitude" not in table:
        raise ValueError(f"{where}: amplitude: expected bounds, as the actuator has no ctrlrange, got none")
    half = 0.5 * (high - low)
    usual = (low, high) if kind == "moves" else (0.0, half / count)
    amplitude = _bounds(table["amplitude"], f"{where}: amplitude") if "amplitude" in table else usual
    far = max(map(abs, amplitude)) * (count if kind == "sines" else 1)
    allowed = (low <= amplitude[0] and amplitude[1] <= high) if kind == "moves" else far <= half * (1 + 1e-9)
    if math.isfinite(low) and not allowed:
        raise ValueError(f"{where}: amplitude: expected controls within ctrlrange, {low:g} to {high:g}, got more")
    frequency = _frequency(table.get("frequency"), f"{where}: frequency", interval)
    return Played(name, kind, count, low, high, amplitude, frequency)


def _range(model: mujoco.MjModel, name: str) -> tuple[float, float]:
    place = _place(model, name)
    if not model.actuator_ctrllimited[place]:
        return -math.inf, math.inf
    low, high = model.actuator_ctrlrange[place]
    return float(low), float(high)


def _middle(model: mujoco.MjModel, name: str) -> float:
    return _centre(*_range(model, name))


def _centre(low: float, high: float) -> float:
    """The centre of a control's range; 0 without one."""
    return 0.5 * (low + high) if math.isfinite(low) else 0.0


def _place(model: mujoco.MjModel, name: str) -> int:
    plain = name.removeprefix("actuator/")
    return int(plain) if plain.isdigit() else model.actuator(plain).id


def _noise(recorded: Simulator, interval: float) -> list[float] | None:
    """The noise of each signal, None if unknown; discrepancies, which last, count for as many samples as they last."""
    noise = recorded.noise**2
    for place, one in recorded.discrepancies.items():
        noise[place] += one.deviation**2 * max(1.0, 2 * one.time / interval)
    return np.sqrt(noise).tolist() if (noise > 0).all() else None


def _within(signals: tuple[str, ...], limits: tuple, trajectory: np.ndarray) -> bool:
    columns = {name: np.asarray(trajectory)[:, place] for place, name in enumerate(signals)}
    return all(bool(((columns[name] >= low) & (columns[name] <= high)).all()) for name, (low, high) in limits)


def _bounds(value: Any, where: str) -> tuple[float, float]:
    number = lambda one: isinstance(one, int | float) and not isinstance(one, bool) and math.isfinite(one)
    if not isinstance(value, list | tuple) or len(value) != 2 or not all(map(number, value)) or value[0] >= value[1]:
        where = where if where.startswith("design") else f"design: {where}"
        raise ValueError(f"{where}: expected [LOW, HIGH], got {value!r}")
    return float(value[0]), float(value[1])


def _positive(value: Any, name: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < math.inf:
        raise ValueError(f"design: {name}: expected seconds above 0, got {value!r}")
    return float(value)
