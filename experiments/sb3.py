"""Stable-Baselines3's PPO, the paper's learner, on the vector environment, compared with our learning curves.

    python -m experiments.sb3 --out experiments/results/policies/sb3

Twelve environments have one length and modulus each, uniform in Theta_0, and redraw all else for every episode, like
those of `jaxlfi train whip --domain uniform`. PPO has its defaults except for batches of 16 transitions (section VI-H):
it updates on 2,048 steps of each environment, and in a second variant on 16, an episode of each, as in the preset
`quick`. Actions are scaled to [-1, 1]. The deterministic policies are saved for `jaxlfi evaluate` and
`jaxlfi whip deploy`. Needs the extras `whip`, `policy` and `bench`.
"""

import argparse
import csv
import dataclasses
import importlib.metadata
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
import stable_baselines3
import torch
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.wrappers.vector import RescaleAction
from matplotlib.figure import Figure
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv

from jaxlfi.envs.whip.environment import ACTIONS, OBSERVATIONS, make
from jaxlfi.envs.whip.gym import WhipVector
from jaxlfi.envs.whip.parameters import MILLIMETRES, median
from jaxlfi.figures import style
from jaxlfi.figures.learning import WINDOW, draw_curves
from jaxlfi.io import compile_cache, files
from jaxlfi.io.provenance import environment as environment_of
from jaxlfi.rl import domains
from jaxlfi.rl.evaluation import cross_evaluate
from jaxlfi.rl.policy import Policy, load

ENVIRONMENTS, BATCH, DETECTOR = 12, 16, "mask"
BIN = 192
"""Number of environment steps that returns are averaged over: that of one of our updates."""
HELD_OUT = 128
OURS = Path("experiments/results/policies/study/trainings.npz")


class OfGymnasium(VecEnv):
    """A gymnasium vector environment as one of Stable-Baselines3, which resets in the step that ends an episode.

    Raises:
        ValueError: for an environment that resets in the next step.
    """

    def __init__(self, environments: VectorEnv):
        """Nothing is reset yet."""
        if environments.metadata.get("autoreset_mode") is not AutoresetMode.SAME_STEP:
            raise ValueError("environments: expected those of AutoresetMode.SAME_STEP, got others")
        self.environments, self._actions = environments, None
        super().__init__(environments.num_envs, environments.single_observation_space, environments.single_action_space)

    def reset(self) -> np.ndarray:
        """The first observations [N, O]."""
        seed = self._seeds[0]
        self._reset_seeds()
        return self.environments.reset(seed=seed)[0]

    def step_async(self, actions: np.ndarray) -> None:
        """Remember the actions [N, A]."""
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Observations, rewards, dones, and infos, which contain the last observation in an episode's last step."""
        observations, rewards, terminated, truncated, info = self.environments.step(self._actions)
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        over = terminated | truncated
        for place in np.flatnonzero(over):
            final = info["final_info"]
            infos[place] = {name: final[name][place] for name in final if not name.startswith("_")}
            infos[place]["terminal_observation"] = info["final_obs"][place]
            infos[place]["TimeLimit.truncated"] = bool(truncated[place] and not terminated[place])
        return observations, rewards.astype(np.float32), over, infos

    def close(self) -> None:
        """Nothing is open."""
        self.environments.close()

    def get_attr(self, attr_name: str, indices=None) -> list[Any]:
        """An attribute of all environments, which are one object."""
        return [getattr(self.environments, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices=None) -> None:
        """Refused: the base class asks for it, and PPO does not call it; one compiled program has no parts to set."""
        raise NotImplementedError("set_attr: the environments are one compiled program, which has no parts to set")

    def env_method(self, method_name: str, *method_args, indices=None, **method_kwargs) -> list[Any]:
        """Refused: the base class asks for it, and PPO does not call it; one compiled program has no parts to call."""
        raise NotImplementedError("env_method: the environments are one compiled program, which has no parts to call")

    def env_is_wrapped(self, wrapper_class, indices=None) -> list[bool]:
        """None of the environments is wrapped."""
        return [False] * len(list(self._get_indices(indices)))


class Episodes(BaseCallback):
    """Keeps the return of every episode, its end in environment steps, and which cubes were hit."""

    def __init__(self):
        """Nothing has ended yet."""
        super().__init__()
        self.rows: list[tuple[int, float, bool, bool]] = []
        self._returns = np.zeros(ENVIRONMENTS)

    def _on_step(self) -> bool:
        self._returns += self.locals["rewards"]
        for place in np.flatnonzero(self.locals["dones"]):
            hit = self.locals["infos"][place]["hit"]
            self.rows.append((self.num_timesteps, self._returns[place], hit[-1], hit[-1] and not hit[:-1].any()))
            self._returns[place] = 0.0
        return True


def train(seed: int, steps: int, rollout: int) -> tuple[dict[str, np.ndarray], Policy]:
    """Train on twelve points of the uniform domain, those that `jaxlfi train` draws with this seed.

    Args:
        seed: seed of points, environments and networks.
        steps: number of steps of all environments together, rounded up to whole rollouts.
        rollout: number of steps of each environment between two updates.

    Returns:
        The learning curves of `binned`, with the `seconds` that training took, and the deterministic policy.
    """
    key_points, *_ = jax.random.split(jax.random.key(seed), 4)
    box = make().supports["initial"]
    points = np.asarray(domains.uniform(key_points, box, ENVIRONMENTS).theta) / MILLIMETRES
    scenes = WhipVector(
        ENVIRONMENTS,
        median(points[:, 0], points[:, 1]),
        DETECTOR,
        nuisances="random",
        autoreset_mode=AutoresetMode.SAME_STEP,
    )
    torch.set_num_threads(1)
    model = PPO(
        "MlpPolicy",
        OfGymnasium(RescaleAction(scenes, np.float32([-1, -1]), np.float32([1, 1]))),
        n_steps=rollout,
        batch_size=BATCH,
        seed=1000 * seed,  # the first of the seeds of twelve environments
        device="cpu",
    )
    episodes, began = Episodes(), time.monotonic()
    model.learn(steps, callback=episodes)
    curves = binned(episodes.rows, model.num_timesteps)
    return {**curves, "seconds": np.asarray(time.monotonic() - began)}, as_policy(model, seed)


def binned(rows: Sequence[tuple[int, float, bool, bool]], steps: int) -> dict[str, np.ndarray]:
    """Means over the episodes that ended in each `BIN` environment steps.

    Args:
        rows: rows of `Episodes`.
        steps: total number of steps.

    Returns:
        `value`, `hit` and `clean_hit`, shape [U], NaN without an episode, and `episodes`, their number.
    """
    bins = -(-steps // BIN)
    place = (np.array([row[0] for row in rows], int) - 1) // BIN
    count = np.bincount(place, minlength=bins)
    curves = {"episodes": count}
    for name, column in (("value", 1), ("hit", 2), ("clean_hit", 3)):
        sums = np.bincount(place, np.array([row[column] for row in rows], float), minlength=bins)
        curves[name] = np.divide(sums, count, out=np.full(bins, np.nan), where=count > 0)
    return curves


def as_policy(model: PPO, seed: int) -> Policy:
    """The mean action of a model as a `Policy`, which scales observations: the first layer undoes that."""
    parameters = {name: value.detach().numpy() for name, value in model.policy.named_parameters()}
    names = ("mlp_extractor.policy_net.0", "mlp_extractor.policy_net.2", "action_net")
    weights = [np.ascontiguousarray(parameters[f"{name}.weight"].T) for name in names]
    biases = [parameters[f"{name}.bias"] for name in names]
    centre, scale = (np.asarray(numbers, np.float32) for numbers in (OBSERVATIONS.centre, OBSERVATIONS.scale))
    biases[0] = biases[0] + centre @ weights[0]
    weights[0] = scale[:, None] * weights[0]
    signals = {"observations": dataclasses.asdict(OBSERVATIONS), "actions": dataclasses.asdict(ACTIONS)}
    learner = f"stable_baselines3 {stable_baselines3.__version__}"
    return Policy(tuple(weights), tuple(biases), {"environment": "whip", **signals, "learner": learner, "seed": seed})


def draw(figure: Figure, curves: Mapping[str, np.ndarray]) -> None:
    """Draw returns of training episodes over environment steps: the median of seeds, and a band of their quartiles.

    Args:
        figure: an empty figure.
        curves: mean returns in each `BIN` steps, shape [U, seeds], by label.
    """
    look = style.looks(list(curves))
    draw_curves(figure.subplots(), {name: (look[name], returns) for name, returns in curves.items()}, BIN)


def labelled(arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The curves of `draw`: ours, and all those of Stable-Baselines3."""
    with np.load(OURS) as ours:
        uniform = ours["uniform/curve"]
    rollouts = [name.removesuffix("/value") for name in arrays if name.endswith("/value")]
    theirs = {f"Stable-Baselines3, updates on {name}": arrays[f"{name}/value"] for name in rollouts}
    return {"jaxlfi train (quick), updates on 16 steps of each": uniform, **theirs}


def main(arguments: Sequence[str] | None = None) -> None:
    """Write curves.npz, evaluated.csv, config.json, curves.png, and a policy for each training."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rollouts", type=int, nargs="+", default=[2048, 16], metavar="N", help="n_steps (2048 16)")
    parser.add_argument("--seeds", type=int, default=2, help="of each (default: 2)")
    parser.add_argument("--steps", type=int, default=60_000, help="of each training (default: 60000)")
    parser.add_argument("--out", type=Path, default=Path("experiments/results/policies/sb3"))
    given = parser.parse_args(arguments)
    compile_cache.enable()
    given.out.mkdir(parents=True, exist_ok=True)
    arrays, policies = {}, {}
    for rollout in given.rollouts:
        made = []
        for seed in range(given.seeds):
            curves, policy = train(seed, given.steps, rollout)
            made.append(curves)
            name = f"n_steps-{rollout}-seed_{seed:03d}.npz"
            policies[name] = load(policy.save(given.out / name))
            late = np.nanmean(curves["value"][-WINDOW:])
            print(f"n_steps {rollout}, seed {seed}: return {late:.2f}, {curves['seconds']:.0f} s", flush=True)
        arrays |= {f"{rollout}/{name}": np.stack([one[name] for one in made], axis=-1) for name in made[0]}
    files.write_arrays(given.out / "curves.npz", arrays)
    environment = make(DETECTOR)
    uniform = lambda key, n: domains.uniform(key, environment.supports["initial"], n)
    rows = cross_evaluate(environment, policies, {"uniform": uniform}, HELD_OUT)
    with (given.out / "evaluated.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    for row in rows:
        print(f"{row['policy']}: return {row['return']:.2f}, clean hits {row['clean_hit']:.2f}")
    asked = {"rollouts": given.rollouts, "seeds": given.seeds, "steps": given.steps, "batch_size": BATCH}
    versions = {name: importlib.metadata.version(name) for name in ("stable_baselines3", "torch", "gymnasium")}
    described = {**asked, "environments": ENVIRONMENTS, "detector": DETECTOR, "of_sb3": versions}
    files.write_json(given.out / "config.json", {**described, **environment_of()})
    with style.context():
        figure = style.new_figure(5.0, 3.2)
        draw(figure, labelled(arrays))
        style.save(figure, given.out / "curves.png", dpi=200)


if __name__ == "__main__":
    main()
