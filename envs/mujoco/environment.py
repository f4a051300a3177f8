"""A MuJoCo model to train policies on: the parameters that were inferred are those of its episodes.

The physics are MJX's, the models MuJoCo's own (`jaxlfi.envs.mujoco.mjx_models`). A posterior of `jaxlfi infer
mujoco,config=FILE` is a domain of `jaxlfi train mujoco,config=FILE`, with the same names, units and logarithms.
"""

import functools
from collections.abc import Mapping, Sequence
from pathlib import Path

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
from jaxlfi.envs.mujoco import starts
from jaxlfi.envs.mujoco.effects import built, effects, state_place
from jaxlfi.envs.mujoco.goal import Goal, Reading
from jaxlfi.envs.mujoco.measured import add_sensors
from jaxlfi.envs.mujoco.mjx_effects import biased, deviations, started
from jaxlfi.envs.mujoco.mjx_models import Models, mjx
from jaxlfi.envs.mujoco.mjx_physics import Physics, State, stable, state_of
from jaxlfi.envs.mujoco.model_task import box, compile_spec, specification
from jaxlfi.envs.mujoco.parameters import PATTERN, Parameter
from jaxlfi.rl.environment import EnvState


class Inner(struct.PyTreeNode):
    """A model's state, and what lasts for an episode.

    Attributes:
        state: positions and velocities.
        controls: the last ones, the latest at the end, shape [B, A].
        numbers: of the model, that depend on its parameters (`Models`).
        theta: in natural units, shape [D].
        refused: whether MuJoCo refuses the model.
        key: of noise to come.
    """

    state: State
    controls: Float[Array, "*batch before act"]
    numbers: Float[Array, "*batch numbers"]
    theta: Float[Array, "*batch dim"]
    refused: Bool[Array, "*batch"]
    key: jax.Array


class MujocoEnvironment:
    """Episodes of a model whose parameters are those of an inference task; see `mujoco_environment`.

    Attributes:
        models: MJX models of parameters.
        reading: what the policy sees, may do and is rewarded for.
    """

    def __init__(
        self,
        model: str | Path | mujoco.MjSpec,
        parameters: Sequence[Parameter],
        goal: Goal,
        noises: Mapping[str, float] | None = None,
        initial: Mapping[str, float | Sequence[float]] | None = None,
        name: str | None = None,
        begins: str | None = None,
    ):
        """An environment.

        Args:
            model: an MJCF file, its text, or a specification.
            parameters: those that were inferred, in this order.
            goal: what policies are to do.
            noises: standard deviations of the observed signals' noise; 0 of others.
            initial: numbers of the state that episodes begin in, by JOINT/qpos and JOINT/qvel; others are the model's.
            name: of the environment; by default the model's.
            begins: "keyframe NAME", for episodes that begin there; by default they begin as the model does.

        Raises:
            ValueError: for whatever does not fit together, or MJX cannot simulate, in one line.
        """
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
        self.models = Models(
            functools.partial(built, spec, self._does), self.space.names, np.asarray(self.nominal), self.feasible
        )
        self._physics = Physics(self.models, compiled, self.reading.places)

        first = {key: np.ravel(number)[:1].tolist() for key, number in (initial or {}).items()}
        self._start = starts.state_of(compiled, begins, *starts.given(compiled, first, 1))
        self._drawn = [(state_place(compiled, key, f"initial/{key}"), bounds) for key, bounds in goal.initial.items()]
        self._timestep = compiled.opt.timestep
        self._substeps = round(goal.interval / self._timestep)
        self._noise = np.array([(noises or {}).get(name, 0.0) for name in goal.signals])
        longest = 0.0 if self._does.delay is None else float(self.feasible.high[self._does.delay])
        self._before = int(np.ceil(longest / goal.interval - 1e-6)) + 1
        low, high = (np.asarray(self.actions.centre) + sign * np.asarray(self.actions.scale) for sign in (-1, 1))
        self._rest = np.tile(np.clip(np.zeros_like(low), low, high), (self._before, 1)).astype(np.float32)

    def reset(self, key: jax.Array, theta: Float[Array, " dim"]) -> EnvState:
        """The start of an episode with these parameters."""
        key_start, key_noise, key = jax.random.split(key, 3)
        start = started(self._does, theta, self._start)
        for (place, (low, high)), one in zip(
            self._drawn, jax.random.split(key_start, max(len(self._drawn), 1)), strict=False
        ):
            start = start.at[place].set(jax.random.uniform(one, minval=low, maxval=high))
        numbers, refused = self.models.numbers(theta)
        inner = Inner(self._physics.state(start), jnp.asarray(self._rest), numbers, theta, refused, key)
        values = self._physics.values(*self._loaded(inner, inner.controls[-1]))
        no = jnp.asarray(False)
        seen, reward = self._seen(key_noise, theta, values), jnp.asarray(0.0, jnp.float32)  # not of a weak type
        return EnvState(inner, seen, reward, no, no, self._facts(values, no))

    def step(self, state: EnvState, action: Float[Array, " act"]) -> EnvState:
        """One control interval. Where the simulation becomes unstable the episode ends, as it was seen last."""
        before = state.inner
        key, key_noise = jax.random.split(before.key)
        controls = jnp.concatenate([before.controls[1:], action[None]])
        model, data = self._loaded(before, action)

        def substep(data, index):
            return mjx.step(model, data.replace(ctrl=self._control(controls, before.theta, index))), None

        data, _ = jax.lax.scan(substep, data, jnp.arange(self._substeps))
        # MuJoCo's sensors are those of the state before a step: of the state after it they are read besides.
        values = self._physics.values(model, data)
        failed = before.refused | ~stable(data.qpos, data.qvel, values)
        after = before.replace(state=state_of(data), controls=controls, key=key)
        return EnvState(
            inner=after,
            observation=jnp.where(failed, state.observation, self._seen(key_noise, before.theta, values)),
            reward=jnp.where(failed, 0.0, self.reading.reward(values, action)),
            terminated=jnp.asarray(False),
            truncated=failed,
            facts=self._facts(values, failed),
        )

    def _check(self, compiled: mujoco.MjModel, goal: Goal) -> None:
        late = [goal.signals[signal] for signal, _ in self._does.lags if signal < len(goal.signals)]
        if late or self._does.jitter is not None:
            got = "clock/jitter" if not late else f"sensor/{late[0].removeprefix('sensor/')}/delay"
            raise ValueError(f"parameters: expected sensors and controls of policies that keep time, got {got}")
        ratio = goal.interval / compiled.opt.timestep
        if round(ratio) < 1 or abs(ratio - round(ratio)) > 1e-6:
            raise ValueError(
                f"policy: interval: expected a multiple of the model's time step, {compiled.opt.timestep:g} s, "
                f"got {goal.interval:g} s"
            )

    def _loaded(self, inner: Inner, control: Float[Array, " act"]) -> tuple[mjx.Model, mjx.Data]:
        """The model and its data in this state."""
        return self.models.model(inner.numbers), self._physics.data(inner.state, control)

    def _control(self, controls: Float[Array, "before act"], theta: Array, index: Array) -> Float[Array, " act"]:
        """What acts in a substep: with a delay, a control that was given before."""
        if self._does.delay is None:
            return controls[-1]
        since = (index * self._timestep - theta[self._does.delay]) / self.reading.goal.interval
        return controls[jnp.clip(self._before - 1 + jnp.floor(since + 1e-5).astype(int), 0, self._before - 1)]

    def _seen(self, key: jax.Array, theta: Float[Array, " dim"], values: Float[Array, " signals"]) -> Array:
        """An observation: with offsets and noise of the sensors."""
        noise = deviations(self._does, theta, self._noise) * jax.random.normal(key, values.shape)
        return self.reading.seen(biased(self._does, theta, values) + noise)

    def _facts(self, values: Float[Array, " signals"], failed: Array) -> dict[str, Array]:
        """How far the episode's last state is from its targets, and whether it failed."""
        return {f"{name} off": jnp.abs(off) for name, off in self.reading.off(values).items()} | {"failed": failed}


def environment(config: Path) -> MujocoEnvironment:
    """The environment that a TOML file describes, in which the inference task is described, too.

    Args:
        config: the file, with a table `policy` (`jaxlfi.envs.mujoco.goal`).

    Raises:
        ValueError: for whatever does not fit together, in one line.
    """
    table = tables.load(config)
    if "policy" not in table:
        raise ValueError(f"{config}: expected a table [policy] that says what policies are to do, got none")
    try:
        goal = goals.of_table(table["policy"])
        begins, numbers = tables.initial(table)
        noises = {name: value for name, value in tables.numbers(table, "noise").items() if name in goal.signals}
        return MujocoEnvironment(
            config.parent / table["model"],
            tables.parameters_of(table),
            goal,
            noises,
            numbers,
            table.get("name", config.stem),
            begins[0] if isinstance(begins, list) else begins,
        )
    except ValueError as error:
        raise ValueError(f"{config}: {error}") from error


def _only_inferred(names: Sequence[str], signals: Sequence[str], spec: mujoco.MjSpec) -> list[str]:
    """Signals of whose sensors something was inferred, and which policies do not see."""
    sensors = [name for name in names if name.startswith("sensor/") and not PATTERN.search(name)]
    own = [name.partition("/")[2].rpartition("/")[0] for name in sensors]
    seen = {*signals, *(signal.rpartition("[")[0] for signal in signals)}
    several = {one.name: one.get_data_size() for one in spec.sensors}
    first = lambda signal: f"{signal}[0]" if several.get(signal, 1) > 1 else signal
    return list(dict.fromkeys(first(signal) for signal in own if signal not in seen))
