"""Policies for a MuJoCo model, trained on several domains and evaluated on the simulator that made its recording.

    python -m experiments.mujoco_policies --runs runs/mujoco-policies --out experiments/results/mujoco-policies
    python -m experiments.mujoco_policies --runs runs/quick --out runs/quick/results --quick

PPO learns to turn the arm of a Furuta pendulum to zero with the pendulum hanging still. It is trained on:

    posterior    the posterior of `jaxlfi infer` with EDGE, from the first guess Theta_0 and the recording
    uniform      Theta_0, which excludes the pendulum's true damping
    fit          the least-squares point within Theta_0
    fit-phi      the least-squares point within Phi
    truth        the parameters of the simulator that made the recording, without the forces that only it has

All are evaluated on that simulator, which has another integrator, a tenth of the time step, stiction and a cable that
no model has, and encoder noise. All policies begin the same episodes. Finished runs and trainings are not repeated.

    table.csv       a row for each policy: mean return, standard error, final distances of angles from their targets
    episodes.npz    the returns of all episodes, and the least-squares points
    config.json     settings, versions
"""

import argparse
import csv
import io
import runpy
import sys
import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float
from rich.console import Console
from scipy.optimize import least_squares

from jaxlfi.cli import parser as cli
from jaxlfi.cli import train as training_cli
from jaxlfi.cli.domains import domain
from jaxlfi.cli.tables import Output
from jaxlfi.envs.mujoco import task as mujoco_task
from jaxlfi.envs.mujoco.effects import STATE, built, effects, initial_state, state_place
from jaxlfi.envs.mujoco.environment import MujocoEnvironment, environment
from jaxlfi.envs.mujoco.measured import add_sensors
from jaxlfi.envs.mujoco.model_task import specification
from jaxlfi.io import files, formats, provenance, serialise
from jaxlfi.io.progress import RoundProgress
from jaxlfi.rl import training
from jaxlfi.rl.policy import Policy, load
from jaxlfi.rl.settings import PPO
from jaxlfi.runs import folder as run_store

FOLDER = Path("examples/mujoco")
EXAMPLE = "furuta"
SETTINGS = PPO(
    learning_rate=1e-3,
    entropy=0.001,
    initial_deviation=0.5,
    environments=32,
    unroll=10,
    segments=8,
    minibatches=8,
    epochs=6,
    total_steps=64_000,
)
QUICK_STEPS = 19_200
STARTS = 4
"""Number of least-squares searches, from the centre of the box and from random points; the best counts."""
LEVEL = 0.95
RESAMPLED = 2000


def fitted(config: Path, box: str) -> tuple[Float[np.ndarray, " dim"], float]:
    """The least-squares point on the recording, and its root mean square residual in standard deviations of the noise.

    Args:
        config: file of the task.
        box: "initial" or "feasible": the search's bounds.
    """
    task = mujoco_task(config)
    simulator = task.simulate.function
    low, high = (np.asarray(side, float) for side in vars(task.space.box_to_inference(task.supports[box])).values())

    def residuals(unit: np.ndarray) -> np.ndarray:
        theta = np.asarray(task.space.to_natural(low + unit * (high - low)), float)
        rows, _ = simulator.clean(theta[None])
        return (np.where(simulator.there, rows[0] - simulator.observation, 0.0) / simulator.noise).ravel()

    rng = np.random.default_rng(0)
    starts = [np.full(task.space.dim, 0.5), *rng.uniform(0.05, 0.95, (STARTS - 1, task.space.dim))]
    # Parameters are in single precision, so finite differences have to be coarser than by default.
    found = [least_squares(residuals, start, bounds=(0, 1), diff_step=1e-3, x_scale=0.1) for start in starts]
    best = min(found, key=lambda one: one.cost)
    theta = np.asarray(task.space.to_natural(low + best.x * (high - low)), float)
    box_ = task.supports[box]
    return np.clip(theta, np.asarray(box_.low, float), np.asarray(box_.high, float)), float(
        np.sqrt(2 * best.cost / simulator.there.sum())
    )


class Reality:
    """The simulator that made an example's recording, as a machine that a policy controls."""

    def __init__(self, example: str, env: MujocoEnvironment):
        """The machine with its true parameters.

        Args:
            example: name of the example.
            env: environment that the policies were trained in.
        """
        made_by = runpy.run_path(str(FOLDER / "record.py"))
        config = tomllib.loads((FOLDER / f"{example}.toml").read_text())
        self._act, self._reading, self._goal = made_by["EXAMPLES"][example]().act, env.reading, env.reading.goal
        spec = specification(FOLDER / config["model"])
        add_sensors(spec, self._goal.signals)
        nominal = spec.compile()
        tables = config["parameters"]
        truth = np.array([tables[name]["truth"] for name in env.space.names])
        supports = [tuple(tables[name]["support"]) for name in env.space.names]
        does = effects(spec, nominal, env.space.names, supports, self._goal.signals)
        self._model = built(spec, does, truth)
        self._model.opt.timestep, self._model.opt.integrator = made_by["STEP"], mujoco.mjtIntegrator.mjINT_RK4
        self._start = initial_state(nominal, config.get("initial", {}))
        self._drawn = {state_place(nominal, key, key): bounds for key, bounds in self._goal.initial.items()}
        self._noise = np.array([config["noise"].get(name, 0.0) for name in self._goal.signals])

    def play(self, policy: Policy, seed: int) -> tuple[float, dict[str, float]]:
        """Play an episode: its return, and the distances of signals from their targets at its end."""
        rng, model, data = np.random.default_rng(seed), self._model, mujoco.MjData(self._model)
        state = self._start.copy()
        for place, bounds in self._drawn.items():
            state[place] = rng.uniform(*bounds)
        mujoco.mj_setState(model, data, state, STATE)
        value = 0.0
        mujoco.mj_forward(model, data)
        signals = data.sensordata[self._reading.places].copy()
        for _ in range(self._goal.steps):
            control = policy(self._reading.seen(signals + self._noise * rng.standard_normal(len(signals)), np))
            for _ in range(round(self._goal.interval / model.opt.timestep)):
                self._act(model, data, control)
                mujoco.mj_step(model, data)
            mujoco.mj_forward(model, data)
            signals = data.sensordata[self._reading.places].copy()
            value += float(self._reading.reward(signals, control, np))
        return value, {name: abs(float(off)) for name, off in self._reading.off(signals, np).items()}


def domains_of(env: MujocoEnvironment, config: Path, runs: Path) -> tuple[dict[str, Callable], dict[str, np.ndarray]]:
    """Functions that draw from each domain, and those domains that are points."""
    posterior = runs / "posterior"
    if not (posterior / "config.json").exists():
        words = ["infer", f"mujoco,config={config}", "--heuristic", "edge", "--out", str(posterior)]
        if status := cli.main([*words, "--keep-network"]):
            raise SystemExit(status)
    elif run_store.read_config(posterior).get("status") != "finished":
        cli.main(["resume", str(posterior)])
    points = {"fit": fitted(config, "initial"), "fit-phi": fitted(config, "feasible")}
    for name, (theta, misfit) in points.items():
        print(f"{name}: {', '.join(f'{x:.4g}' for x in theta)}; residuals of {misfit:.2f} standard deviations")
    truth = tomllib.loads(config.read_text())["parameters"]
    points = {name: theta for name, (theta, _) in points.items()}
    points["truth"] = np.array([truth[name]["truth"] for name in env.space.names])
    words = {"posterior": str(posterior), "uniform": "uniform"}
    words |= {name: "point:" + ",".join(repr(float(x)) for x in theta) for name, theta in points.items()}
    return {name: domain(env, word)[1] for name, word in words.items()}, points


def trained(
    reference: str, env: MujocoEnvironment, draws: Mapping[str, Callable], settings: PPO, seeds: int, out: Path
):
    """Train all policies in parallel, unless they are there."""
    if not formats.recorded(out).get("format") == formats.TRAINING:
        training.begin(training.Plan(reference, env, settings, None, draws, tuple(range(seeds))), out)
    if not training.finished(out):
        training_cli.run(out, env, Output.of(), figures=True)


def played(reality: Reality, policies: Mapping[tuple[str, int], Policy], episodes: int) -> dict[tuple[str, int], Any]:
    """Returns [E] and final distances [E] by policy."""
    found = {}
    with RoundProgress(Console(), len(policies), 0, "on the recording's simulator", unit="evaluation") as progress:
        for name, policy in policies.items():
            own = [reality.play(policy, seed) for seed in range(episodes)]
            off = {f"{signal} off": np.array([last[signal] for _, last in own]) for signal in own[0][1]}
            found[name] = {"value": np.array([value for value, _ in own])} | off
            progress.advance()
    return found


def difference(one: Float[np.ndarray, "seeds episodes"], other: Float[np.ndarray, "seeds episodes"]) -> list[float]:
    """The mean of one minus that of the other, with a bootstrap interval that resamples seeds and episodes."""
    rng, seeds, episodes = np.random.default_rng(0), one.shape[0], one.shape[1]
    means = []
    for _ in range(RESAMPLED):
        at = rng.integers(episodes, size=episodes)
        own = [values[rng.integers(seeds, size=seeds)][:, at].mean() for values in (one, other)]
        means.append(own[0] - own[1])
    low, high = np.quantile(means, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return [float(one.mean() - other.mean()), float(low), float(high)]


def main() -> None:
    """Infer, fit, train and evaluate what is missing; then write the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=Path, required=True, help="folder of the run and the trainings")
    parser.add_argument("--out", type=Path, required=True, help="folder of the results")
    parser.add_argument("--quick", action="store_true", help="one seed, a third of the steps: minutes on two cores")
    parser.add_argument("--seeds", type=int, default=3, help="trainings on each domain (default: 3)")
    parser.add_argument("--total-steps", type=int, default=SETTINGS.total_steps, help="of each training")
    parser.add_argument("--episodes", type=int, default=32, help="of each policy's evaluation (default: 32)")
    arguments = parser.parse_args()
    steps, seeds = (QUICK_STEPS, 1) if arguments.quick else (arguments.total_steps, arguments.seeds)
    config = FOLDER / f"{EXAMPLE}.toml"
    env, settings = environment(config), SETTINGS.replace(total_steps=steps)
    draws, points = domains_of(env, config, arguments.runs)
    folder = arguments.runs / "policies"
    trained(f"mujoco,config={config}", env, draws, settings, seeds, folder)
    names = [(one["domain"], one["seed"]) for one in training.read_config(folder)["trainings"]]
    policies = {(name, seed): load(folder / name / f"seed_{seed:03d}" / "policy.npz") for name, seed in names}
    found = played(Reality(EXAMPLE, env), policies, arguments.episodes)

    rows = []
    for (name, seed), values in found.items():
        value = values["value"]
        error = float(value.std(ddof=1) / len(value) ** 0.5)
        last = {key: round(float(own.mean()), 4) for key, own in values.items() if key != "value"}
        rows.append(
            {"domain": name, "seed": seed, "return": round(float(value.mean()), 4), "error": round(error, 4)} | last
        )
    arguments.out.mkdir(parents=True, exist_ok=True)
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    files.write_bytes(arguments.out / "table.csv", text.getvalue().encode())
    returns = {name: np.stack([found[key]["value"] for key in names if key[0] == name]) for name in draws}
    files.write_arrays(
        arguments.out / "episodes.npz",
        {f"return/{name}": values for name, values in returns.items()}
        | {f"point/{name}": theta for name, theta in points.items()},
    )
    command = provenance.command_line(["python", "-m", "experiments.mujoco_policies", *sys.argv[1:]])
    used = serialise.fields_to_json(training.settings_of(training.read_config(folder)), serialise.class_name)
    recorded = {"command_line": command, "settings": used, "episodes": arguments.episodes}
    files.write_json(arguments.out / "config.json", provenance.environment() | recorded)
    for row in rows:
        print(row)
    for name, values in returns.items():
        if name != "posterior":
            own = "{:.4f} [{:.4f}, {:.4f}]".format(*difference(returns["posterior"], values))
            print(f"posterior less {name}: {own}; {name} itself {values.mean():.4f}")


if __name__ == "__main__":
    main()
