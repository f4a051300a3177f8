"""The programs that a user waits for, with their arguments; nothing is run or compiled here.

Each is lowered for accelerators in tests/system/test_accelerators.py, and its operations are counted by
`experiments.benchmarks.accelerators`.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from jaxlfi.bayessim.algorithm import State
from jaxlfi.bayessim.batch import AXIS, BatchEngine, RunSpec, round_one, stack_inputs, start_one
from jaxlfi.bayessim.presets import QUICK
from jaxlfi.bayessim.programs import program
from jaxlfi.bayessim.settings import Settings
from jaxlfi.bayessim.staged import StagedEngine, gather_one, train_one
from jaxlfi.envs import lotka_volterra, mg1
from jaxlfi.envs.mujoco import task as mujoco_task
from jaxlfi.heuristics import Edge
from jaxlfi.tasks.simulation import Simulations, trajectory_and_outcome
from jaxlfi.tasks.task import Task

ARM = Path(__file__).parents[2] / "examples/mujoco/arm.toml"


@dataclasses.dataclass(frozen=True)
class Program:
    """A jitted function and its arguments: arrays, or their shapes."""

    name: str
    function: Any
    arguments: tuple

    @property
    def holds_simulator(self) -> bool:
        """Whether it is a stage that depends on the task; the others depend only on shapes."""
        return self.name.endswith(("simulate", "compare"))


def shapes(tree: Any) -> Any:
    """The shapes of a pytree's arrays."""
    return jax.eval_shape(lambda: tree)


def inputs_of(task: Task, support: str, runs: int) -> Any:
    """The inputs of a number of runs, with different thresholds of EDGE."""
    trajectory, _ = jax.eval_shape(
        functools.partial(trajectory_and_outcome, task), jax.random.key(0), task.support(support).centre
    )
    size = jax.eval_shape(task.summary, trajectory).shape[-1]
    specs = [
        RunSpec("edge", support, task.support(support), Edge(mass_threshold=0.05 + 0.1 * run / runs), run)
        for run in range(runs)
    ]
    observed = np.ones((runs, *trajectory.shape), np.float32)
    return stack_inputs(specs, observed, np.ones((runs, size), np.float32))[0]


def started(task: Task, settings: Settings, inputs: Any) -> State:
    """Shapes of the state before the first round."""
    return jax.eval_shape(jax.vmap(functools.partial(start_one, task, None), (None, 0)), settings, inputs)


STAGES = {"posterior_after": "posterior", "_draws": "draws"}
"""Names of stages that are called differently from their functions."""


def stages(name: str, task: Task, support: str, settings: Settings = QUICK) -> Iterator[Program]:
    """The stages of a round of a single run."""
    engine = StagedEngine(task, settings, inputs_of(task, support, 1))
    inputs = (settings, engine.inputs, started(task, settings, engine.inputs), jnp.asarray(0))
    for stage, arguments, _ in engine.calls(inputs):
        yield Program(
            f"{name}: {STAGES.get(stage.__name__, stage.__name__.removesuffix('_one'))}", stage.jitted, arguments
        )


def fused(name: str, task: Task, support: str, runs: int, settings: Settings = QUICK) -> Program:
    """A round of a number of runs as one program, on one device."""
    engine = BatchEngine(task, settings, inputs_of(task, support, runs), devices=jax.local_devices()[:1])
    many = program(functools.partial(round_one, task), engine.mesh, (None, 0, 0, None))
    return Program(name, many.jitted, (settings, engine.inputs, started(task, settings, engine.inputs), jnp.asarray(0)))


def on_device(models: Any) -> None:
    """Use nominal numbers of models (`jaxlfi.envs.mujoco.mjx_models`), which MuJoCo otherwise compiles on the host."""
    nominal = models._nominal
    vars(models)["numbers"] = lambda theta: (jnp.asarray(nominal) + 0.0 * theta[0], theta[0] != theta[0])


def training(name: str, task: Task, support: str, runs: int, settings: Settings = QUICK) -> Program:
    """The training of a number of runs side by side, by far the largest part of their round."""
    inputs = inputs_of(task, support, runs)
    mesh = Mesh(np.asarray(jax.local_devices()[:1]), (AXIS,))
    given = (settings, inputs, started(task, settings, inputs), jnp.asarray(0))
    stage = lambda one, *bound: program(functools.partial(one, *bound), mesh, (None, 0, 0, None, 0))
    flags = jax.ShapeDtypeStruct((runs, settings.simulation_budget), bool)
    numbers = lambda *shape, dtype="float32": jax.ShapeDtypeStruct((runs, settings.simulation_budget, *shape), dtype)
    made = Simulations(numbers(task.dim), numbers(inputs.x.shape[-1]), numbers(dtype="int32"), flags, flags, numbers())
    gathered = jax.eval_shape(stage(gather_one, task.inference.prior), *given, made)
    return Program(name, stage(train_one).jitted, (*given, gathered.lesson))


def rollouts(name: str, batch: int) -> Program:
    """Rollouts of an arm by MJX under its recorded controls, each with its own model, which is compiled already."""
    task = mujoco_task(ARM, engine="mjx")
    on_device(task.simulate._physics.models)
    keys = jax.eval_shape(lambda key: jax.random.split(key, batch), jax.random.key(0))
    theta = jax.ShapeDtypeStruct((batch, task.dim), jnp.float32)
    return Program(name, jax.jit(jax.vmap(task.simulate)), (keys, theta))


def policy_update(name: str, settings: Any = None) -> Program:
    """An update of PPO: episodes of the arm by MJX, and the gradient steps on them."""
    from jaxlfi.envs.mujoco.environment import environment  # needs Brax
    from jaxlfi.rl import ppo
    from jaxlfi.rl.domains import Domain
    from jaxlfi.rl.settings import QUICK as QUICK_PPO

    settings, arm = settings or QUICK_PPO, environment(ARM)
    on_device(arm.models)
    theta = jax.ShapeDtypeStruct((settings.environments, arm.space.dim), jnp.float32)
    begun = jax.eval_shape(
        lambda key, theta: ppo.init(key, arm, settings, Domain(theta)), jax.eval_shape(jax.random.key, 0), theta
    )
    return Program(name, jax.jit(functools.partial(ppo.update, arm, settings)), (begun,))


GRID_RUNS = 64
"""Number of runs of the grid, side by side."""
BATCH = 1024
"""Number of rollouts side by side."""

MAKERS: dict[str, Callable[[], list[Program]]] = {
    "lotka-volterra": lambda: list(stages("Lotka-Volterra", lotka_volterra.task(), "misspecified")),
    "mg1": lambda: [one for one in stages("M/G/1", mg1.task(), "misspecified") if one.holds_simulator],
    "training": lambda: [training(f"{GRID_RUNS} runs: train", lotka_volterra.task(), "misspecified", GRID_RUNS)],
    "grid": lambda: [fused(f"{GRID_RUNS} runs: a round", lotka_volterra.task(), "misspecified", GRID_RUNS)],
    "mjx": lambda: [rollouts(f"MJX: {BATCH} rollouts of an arm", BATCH)],
    "ppo": lambda: [policy_update("PPO: an update on an arm by MJX")],
}
"""Groups of programs, by name. The grid's program is a whole round, for several runs side by side."""
