"""A MuJoCo model to train policies on, whose episodes have the parameters that were inferred.

The physics are MJX's, the models MuJoCo's own (`jaxlfi.envs.mujoco.mjx_models`). A posterior of `jaxlfi infer
mujoco,config=FILE` is a domain of `jaxlfi train mujoco,config=FILE`, with the same names, units and logarithms.
"""

import functools
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float

from jaxlfi.distributions.space import Space
from jaxlfi.distributions.support import Support
from jaxlfi.envs.mujoco import config as tables
from jaxlfi.envs.mujoco import goal as goals
from jaxlfi.envs.mujoco import machine, stand_in, starts
from jaxlfi.envs.mujoco.discrepancy import Discrepancy
from jaxlfi.envs.mujoco.effects import effects, state_place
from jaxlfi.envs.mujoco.forces import UnmodelledForces
from jaxlfi.envs.mujoco.goal import Goal
from jaxlfi.envs.mujoco.measured import add_sensors
from jaxlfi.envs.mujoco.mjx_effects import biased, deviations, lags, passed_by, started
from jaxlfi.envs.mujoco.mjx_models import added, mjx, with_forces
from jaxlfi.envs.mujoco.mjx_physics import Physics, State, stable
from jaxlfi.envs.mujoco.model_task import JITTERS, box, compile_spec, specification
from jaxlfi.envs.mujoco.nuisances import Drawn, Nuisances
from jaxlfi.envs.mujoco.parameters import PATTERN, Parameter
from jaxlfi.envs.mujoco.reading import Reading, add_signals
from jaxlfi.envs.mujoco.simulator import simulator_of
from jaxlfi.rl.environment import EnvState
from jaxlfi.rl.preparation import Memory
from jaxlfi.robots import settings, velocities
from jaxlfi.robots.settings import Velocity

OF_NUISANCES, OF_FORCES, OF_ERRORS, OF_CLOCK = 1, 2, 3, 4
"""Numbers folded into the random keys of episodes."""

TRAINING: Mapping[str, Mapping[str, Any]] = {
    "quick": {
        "learning_rate": 1e-3,
        "entropy": 0.001,
        "initial_deviation": 0.5,
        "environments": 32,
        "unroll": 10,
        "segments": 8,
        "minibatches": 8,
        "epochs": 6,
    }
}
"""Settings of PPO for rewards in every step, by preset.

The preset's own settings suit the whip's one hit in 16 steps; with them, a policy for the Furuta pendulum in `examples`
was no better than none (docs/mujoco.md).
"""


class IdleParameterWarning(UserWarning):
    """An inferred parameter makes no difference to the trained policies."""


class Inner(struct.PyTreeNode):
    """A model's state, and what else an episode carries from step to step.

    Attributes:
        state: positions and velocities.
        controls: the last B controls, the latest at the end, shape [B, A].
        late: delay from when each control is given to when it acts, in s, shape [B].
        memory: of the observations (`jaxlfi.rl.preparation`).
        drawn: nuisances drawn for the episode.
        trace: the signals at the end of the last steps of the model, the latest at the end, shape [T, S].
        lacking: coefficients of the forces that the model lacks (`UnmodelledForces.add`).
        numbers: numbers of the model that depend on its parameters (`Models`).
        theta: in natural units, shape [D].
        refused: whether MuJoCo refuses the model.
        key: random key of the noise to come.
    """

    state: State
    controls: Float[Array, "*batch before act"]
    late: Float[Array, "*batch before"]
    memory: Memory
    drawn: Drawn
    trace: Float[Array, "*batch steps signals"]
    lacking: Float[Array, "*batch coefficients"]
    numbers: Float[Array, "*batch numbers"]
    theta: Float[Array, "*batch dim"]
    refused: Bool[Array, "*batch"]
    key: jax.Array


class MujocoEnvironment:
    """Episodes of a model whose parameters are those of an inference task; see `mujoco_environment`.

    Attributes:
        training: settings of PPO, in place of those of a preset.
        models: MJX models of parameters.
        reading: what the policy sees, may do and is rewarded for.
        preparation: of its observations and actions, as a robot needs it.
        memory: number of values that a policy remembers.
        robot: further settings of the robot, which policies carry (`jaxlfi.robots.settings`).
    """

    def __init__(
        self,
        model: str | Path | mujoco.MjSpec,
        parameters: Sequence[Parameter],
        goal: Goal,
        noises: Mapping[str, float] | None = None,
        initial: Mapping[str, float | Sequence[float]] | None = None,
        name: str | None = None,
        begins: str | Sequence[str] | None = None,
        forces: UnmodelledForces | None = None,
        discrepancies: Mapping[str, Discrepancy] | None = None,
        estimated: Mapping[str, Velocity] | None = None,
    ):
        """An environment.

        Args:
            model: an MJCF file, its text, or a specification.
            parameters: those that were inferred, in this order.
            goal: what policies are to do.
            noises: standard deviations of the observed signals' noise; 0 for others.
            initial: values of the initial state by JOINT/qpos and JOINT/qvel; others are the model's.
            name: of the environment; by default the model's.
            begins: "keyframe NAME", for episodes that begin there; by default they begin as the model does.
            forces: that the model lacks, redrawn for each episode.
            discrepancies: model errors of signals, likewise.
            estimated: signals that a robot estimates instead of measuring: they are as late as the signals that they
                are estimated from, plus the estimator's own lag (`jaxlfi.robots.velocities`).

        Raises:
            ValueError: for inconsistent arguments, and what MJX cannot simulate, in one line.
        """
        self.robot: Mapping[str, Any] = {}
        self.training = TRAINING
        if not parameters:
            raise ValueError("parameters: expected at least one, got none")
        spec = specification(model)
        self.name = name or spec.modelname or "mujoco"
        self.space = Space(tuple(one.name for one in parameters), tuple(one.log for one in parameters))
        self.units = tuple(one.unit for one in parameters)
        support = box([one.support for one in parameters])
        self.feasible = box([one.feasible or one.support for one in parameters])
        self.supports: Mapping[str, Support] = {"initial": support, "feasible": self.feasible}
        centre = self.space.box_to_inference(support).centre
        self.nominal = tuple(float(number) for number in np.asarray(self.space.to_natural(np.asarray(centre))))

        add_signals(spec, goal)
        signals = [*goal.signals, *_only_inferred(self.space.names, goal.signals, spec)]
        add_sensors(spec, signals)
        compiled = compile_spec(spec)
        self._does = effects(
            spec,
            compiled,
            self.space.names,
            [one.support for one in parameters],
            signals,
            [one.tie for one in parameters],
        )
        self.reading = Reading(compiled, goal)
        self._check(compiled, goal)
        self.observations, self.actions, self.steps = self.reading.observations, self.reading.actions, goal.steps
        self.preparation, self.memory = self.reading.preparation, goal.memory
        low, high = np.asarray(self.feasible.low, float), np.asarray(self.feasible.high, float)
        build, nominal = stand_in.builder(spec, self._does, low, high), np.asarray(self.nominal)
        self.models = with_forces(build, forces, self.space.names, nominal, self.feasible)
        self._forces = forces
        self._physics = Physics(self.models, compiled, self.reading.places)

        self._start = starts.first(compiled, begins, initial or {})
        self._drawn = [(state_place(compiled, key, f"initial/{key}"), bounds) for key, bounds in goal.initial.items()]
        self._warn_of_idle(goal)
        self._goal, self._ends = goal, tuple(goal.terminations)
        self._timestep = compiled.opt.timestep
        self._substeps = round(goal.interval / self._timestep)
        self._noise = np.array([({**(noises or {}), **goal.noises}).get(name, 0.0) for name in goal.signals])
        self._nuisances = Nuisances(goal, discrepancies or {})
        self._rest = np.array([min(max(0.0, one.low), one.high) for one in self.preparation.controls], np.float32)
        latest = goal.action_delay[1] + sum(
            times * float(self.feasible.high[d])
            for d, times in ((self._does.delay, 1), (self._does.jitter, JITTERS))
            if d is not None
        )
        self._before = int(np.ceil(latest / goal.interval - 1e-6)) + 1
        self._lags, self._lag = self._late(goal, estimated or {})
        longest = self._lag + lags(self._lags, jnp.asarray(self.feasible.high), len(goal.signals))
        self._kept = 1 + int(np.ceil((goal.observation_delay[1] + float(max(longest))) / self._timestep - 1e-4))

    def reset(self, key: jax.Array, theta: Float[Array, " dim"]) -> EnvState:
        """The start of an episode with these parameters."""
        key_start, key_noise, key = jax.random.split(key, 3)
        start = started(self._does, theta, self._start)
        for (place, (low, high)), one in zip(
            self._drawn, jax.random.split(key_start, max(len(self._drawn), 1)), strict=False
        ):
            start = start.at[place].set(jax.random.uniform(one, minval=low, maxval=high))
        lacking = self._lacking(key_start)
        numbers, refused = self.models.numbers(jnp.append(theta, jnp.zeros_like(lacking)))
        state, model = self._physics.state(start), self._model(numbers, lacking)
        values = self._physics.values(model, self._physics.data(state, jnp.asarray(self._rest)))
        drawn = self._nuisances.draw(
            _folded(key_start, OF_NUISANCES), self._deviations(theta)[: len(self._goal.observed)]
        )
        if any(one.begins is not None for one in self.preparation.controls):  # forces depend on the first targets
            known = self._measured(jax.random.clone(key_noise), theta, values, drawn)
            first = self.preparation.start(known, jnp).controls[0]
            values = self._physics.values(model, self._physics.data(state, first))
        measured = self._measured(key_noise, theta, values, drawn)
        memory, seen = self.preparation.observed(self.preparation.start(measured, jnp), measured, jnp)
        controls = jnp.tile(memory.controls[0], (self._before, 1))
        trace, late = jnp.tile(values, (self._kept, 1)), jnp.zeros(self._before, jnp.float32)
        inner = Inner(state, controls, late, memory, drawn, trace, lacking, numbers, theta, refused, key)
        no, reward = jnp.asarray(False), jnp.asarray(0.0, jnp.float32)  # not of a weak type
        return EnvState(inner, seen, reward, no, no, self._facts(values, drawn.commands, no))

    def step(self, state: EnvState, action: Float[Array, " act"]) -> EnvState:
        """One control interval. If the simulation becomes unstable, the episode ends with its last observation."""
        before = state.inner
        key, key_noise = jax.random.split(before.key)
        memory, control = self.preparation.commanded(before.memory, action, jnp)
        controls = jnp.concatenate([before.controls[1:], control[None]])
        late = jnp.append(before.late[1:], self._lateness(_folded(key_noise, OF_CLOCK), before))
        model = self._model(before.numbers, before.lacking)

        def substep(state, index):
            after, values, _ = self._physics.step(model, state, self._control(controls, late, index))
            return after, values

        last, passed = jax.lax.scan(substep, before.state, jnp.arange(self._substeps))
        # MuJoCo's sensors are those of the state before a step; those of the state after it are evaluated here.
        values = self._physics.values(
            model, self._physics.data(last, self._control(controls, late, self._substeps - 1))
        )
        trace = jnp.concatenate([before.trace, passed[1:], values[None]])[-self._kept :]
        failed = before.refused | ~stable(last.qpos, last.qvel, values)
        drawn = self._nuisances.later(_folded(key_noise, OF_ERRORS), before.drawn)
        ago = drawn.observation_delay + self._lag + lags(self._lags, before.theta, len(values))
        measured = self._measured(key_noise, before.theta, passed_by(trace, ago / self._timestep), drawn)
        memory, seen = self.preparation.observed(memory, measured, jnp)
        reward = self.reading.reward(values, control, before.controls[-1], drawn.commands)
        facts = self._facts(values, drawn.commands, failed)
        kept = {"controls": controls, "late": late, "memory": memory, "drawn": drawn, "trace": trace}
        after = before.replace(state=last, key=key, **kept)
        return EnvState(
            inner=after,
            observation=jnp.where(failed, state.observation, seen),
            reward=jnp.where(failed, 0.0, reward),
            terminated=functools.reduce(jnp.logical_or, (facts[name] for name in self._ends), jnp.asarray(False)),
            truncated=failed,
            facts=facts,
        )

    def _check(self, compiled: mujoco.MjModel, goal: Goal) -> None:
        for d in (*(d for _, d in self._does.lags), *(() if self._does.jitter is None else (self._does.jitter,))):
            low, high = float(self.feasible.low[d]), float(self.feasible.high[d])
            if not 0 <= low <= high <= goal.duration:
                raise ValueError(
                    f"parameters: {self.space.names[d]}: expected 0 s up to the policy's duration, "
                    f"{goal.duration:g} s, to be feasible, got {low:g} to {high:g}"
                )
        ratio = goal.interval / compiled.opt.timestep
        if round(ratio) < 1 or abs(ratio - round(ratio)) > 1e-6:
            raise ValueError(
                f"policy: interval: expected a multiple of the model's time step, {compiled.opt.timestep:g} s, "
                f"got {goal.interval:g} s"
            )

    def _warn_of_idle(self, goal: Goal) -> None:
        """Warn of parameters that make no difference here: of sensors that are not observed, and of recorded starts."""
        does = self._does
        sensors = [*does.gains, *does.biases, *does.lags, *does.deviations]
        seen = {d for signal, d in sensors if signal < len(goal.observed)}
        drawn = {place for place, _ in self._drawn}
        lines = dict.fromkeys([d for _, d in sensors if d not in seen], "policies do not observe the signal")
        lines |= dict.fromkeys([d for place, d in does.starts if place in drawn], "[policy.initial] draws that number")
        lines |= dict.fromkeys([d for _, _, d in does.own_starts], "a recorded episode begins there, and others do not")
        for d, reason in lines.items():
            text = f"parameters: {self.space.names[d]} makes no difference to policies: {reason}"
            warnings.warn(text, IdleParameterWarning, stacklevel=4)

    def _late(
        self, goal: Goal, estimated: Mapping[str, Velocity]
    ) -> tuple[tuple[tuple[int, int], ...], Float[np.ndarray, " signals"]]:
        """Observed signals with the parameters that delay them, and the additional lag of each signal in s."""
        inferred, lag = dict(self._does.lags), np.zeros(len(goal.signals), np.float32)
        observed = {name: place for place, name in enumerate(goal.observed)}
        for name, one in estimated.items():
            if name not in observed:
                continue
            place = observed[name]
            lag[place] = velocities.lag(goal.interval, goal.interval / 2 if one.filter is None else one.filter)
            if one.of in observed and (d := inferred.get(observed[one.of])) is not None:
                inferred[place] = d
        return tuple((place, d) for place, d in inferred.items() if place < len(observed)), lag

    def _lateness(self, key: jax.Array, inner: Inner) -> Float[Array, ""]:
        """The delay from when a control is given to when it acts, in s, at least 0."""
        delay, jitter = self._does.delay, self._does.jitter
        late = inner.drawn.action_delay if delay is None else inner.drawn.action_delay + inner.theta[delay]
        if jitter is not None:
            late += inner.theta[jitter] * jnp.clip(jax.random.normal(key), -JITTERS, JITTERS)
        return jnp.maximum(late, 0.0)

    def _control(
        self, controls: Float[Array, "before act"], late: Float[Array, " before"], index: Array | int
    ) -> Float[Array, " act"]:
        """The control in a substep: the last whose time has come; controls act in the order in which they are given."""
        if self._before == 1:
            return controls[-1]
        given = np.arange(1 - self._before, 1)
        acts = jax.lax.cummax(given + late / self._goal.interval)
        come = jnp.sum(acts <= index * self._timestep / self._goal.interval + 1e-5)
        return controls[jnp.maximum(come - 1, 0)]

    def _lacking(self, key: jax.Array) -> Float[Array, " coefficients"]:
        """Coefficients of the forces that the model lacks, in the episode whose first state is drawn with this key."""
        if self._forces is None:
            return jnp.zeros(0)
        deviations = jnp.asarray(self._forces.deviations, jnp.float32)
        return deviations * jax.random.normal(_folded(key, OF_FORCES), deviations.shape)

    def _model(self, numbers: Float[Array, " numbers"], lacking: Float[Array, " coefficients"]) -> mjx.Model:
        """The model of an episode."""
        model = self.models.model(numbers)
        return model if self._forces is None else added(model, self._forces, lacking)

    def _deviations(self, theta: Float[Array, " dim"]) -> Float[Array, " signals"]:
        """Standard deviations of the signals' noise."""
        return deviations(self._does, theta, self._noise)

    def _measured(self, key: jax.Array, theta: Array, values: Float[Array, " signals"], drawn: Drawn) -> Array:
        """The observed signals with offsets, errors and noise of their sensors, and the commands."""
        noise = self._deviations(theta) * jax.random.normal(key, values.shape)
        seen = (biased(self._does, theta, values) + noise)[: len(self._goal.observed)]
        return jnp.append(seen + drawn.offsets + drawn.errors, drawn.commands)

    def _facts(self, values: Float[Array, " signals"], commands: Array, failed: Array) -> dict[str, Array]:
        """How far the episode's last state is from its targets, how it ended, and whether it failed."""
        off = {f"{name} off": jnp.abs(off) for name, off in self.reading.off(values, commands).items()}
        ended = {name: holds & ~failed for name, holds in self.reading.ended(values).items()}
        return off | ended | {"failed": failed}


def _folded(key: jax.Array, number: int) -> jax.Array:
    """Another key; the first one can still be used."""
    return jax.random.fold_in(jax.random.clone(key), number)


def environment(config: Path) -> MujocoEnvironment:
    """The environment that a TOML file describes, along with the inference task.

    Args:
        config: the file, with a table `policy` (`jaxlfi.envs.mujoco.goal`).

    Raises:
        ValueError: for inconsistent input, in one line.
    """
    table = tables.load(config)
    if "policy" not in table:
        raise ValueError(f"{config}: expected a table [policy], which defines the control task, got none")
    policy = table["policy"]
    if not isinstance(wanted := policy.get(goals.MODEL_ERROR, False), bool):
        raise ValueError(f"{config}: policy: {goals.MODEL_ERROR}: expected true or false, got {wanted!r}")
    learnt = simulator_of(tables.read(config)) if wanted else None
    try:
        goal = goals.of_table(policy)
        begins, numbers = tables.initial(table)
        noises, known = tables.numbers(table, "noise"), {}
        if learnt is not None:
            noises = dict(zip(learnt.signals, np.asarray(learnt.noise).tolist(), strict=True))
            discrepancies = {learnt.signals[place]: process for place, process in learnt.discrepancies.items()}
            known = {"forces": learnt.forces, "discrepancies": discrepancies}
        made = MujocoEnvironment(
            config.parent / table["model"],
            tables.parameters_of(table),
            goal,
            {name: value for name, value in noises.items() if name in goal.signals},
            numbers,
            table.get("name", config.stem),
            begins,
            **known,
            estimated=settings.of_table(table.get("robot", {})).velocities,
        )
        if "robot" in table:
            made.robot = machine.carried(table["robot"], config.parent / table["model"], made.preparation)
        return made
    except ValueError as error:
        raise ValueError(f"{config}: {error}") from error


def _only_inferred(names: Sequence[str], signals: Sequence[str], spec: mujoco.MjSpec) -> list[str]:
    """Signals that policies do not see, but whose sensors have inferred parameters."""
    sensors = [name for name in names if name.startswith("sensor/") and not PATTERN.search(name)]
    own = [name.partition("/")[2].rpartition("/")[0] for name in sensors]
    seen = {*signals, *(signal.rpartition("[")[0] for signal in signals)}
    several = {one.name: one.get_data_size() for one in spec.sensors}
    first = lambda signal: f"{signal}[0]" if several.get(signal, 1) > 1 else signal
    return list(dict.fromkeys(first(signal) for signal in own if signal not in seen))
