"""Does it pay to know the object? Policies of a puck that is pushed, let go, and has to stop at a mark.

    python -m experiments.knowing --out experiments/results/knowing
    python -m experiments.knowing --out experiments/results/knowing --tables    # only the tables and the figure

All arms have the same learner, networks, steps and episodes. They are trained on:

    oracle                       the object's own mass and friction
    posterior                    EDGE's posterior, from one recording and a guess that excludes most objects
    least squares                the point that fits the same recording best
    SimOpt, DROPO                the Gaussians that these infer from the same recording
    guess, wide box              uniform over the guess, or over all of Phi, without a recording
    history                      the wide box, with a policy that sees the last six states and five forces
    ADR                          ranges that grow from the middle of the guess while the policy copes with them
    constant, random             baselines: the constant force that is best in the middle of the guess; random forces

    domains.npz      the points that each arm is trained on
    parts/           finished parts of the study: an interrupted command continues with the next part
    episodes.npz     returns [seeds, episodes] by arm and object: minus the distance from the mark, in m
    config.json      settings, versions, command
    table.md, contrasts.md, returns.png, from these arrays
"""

import argparse
import functools
from collections.abc import Mapping
from pathlib import Path

from jaxlfi.io import compile_cache

if __name__ == "__main__":  # before jax starts
    compile_cache.enable()

import jax
import jax.numpy as jnp
import numpy as np

from experiments import chance
from experiments.arms import write_config
from experiments.knowing import domains, report, training
from experiments.knowing.slide import FEASIBLE, GUESS, STRONGEST, Slide
from jaxlfi.io import files

HISTORY = 6
"""Number of states that the history policy sees."""
FORCES = 101
"""Number of constant forces that are tried."""


def drawn(out: Path) -> dict[str, np.ndarray]:
    """The points that each arm is trained on, by arm and object; made if they are missing."""
    path = out / "domains.npz"
    if not path.exists():
        found = {"guess": domains.broad(GUESS), "wide box": domains.broad(FEASIBLE)}
        for name in domains.OBJECTS:
            found |= {f"{arm}/{name}": make(name) for arm, make in domains.OWN.items()}
            print(name, {arm: found[f"{arm}/{name}"].mean(axis=0).round(3).tolist() for arm in domains.OWN}, flush=True)
        files.write_arrays(path, found)
    return files.read_arrays(path)


def memoryless(out: Path, seeds: int) -> dict[str, np.ndarray]:
    """Returns of policies that see only the last state, by arm and object, on their own object or on all."""
    pools, env = drawn(out), Slide()
    runs = [(name, seed) for name in pools for seed in range(seeds)]
    params = training.train(env, np.stack([pools[name] for name, _ in runs]), np.array([seed for _, seed in runs]))
    fared = training.returns(env, training.learnt(env), params)
    found = {}
    for place, name in enumerate(pools):
        arm, _, own = name.partition("/")
        for dlo in [own] if own else domains.OBJECTS:
            found[f"{arm}/{dlo}"] = fared[dlo][place * seeds : (place + 1) * seeds]
    return found


def with_history(out: Path, seeds: int) -> dict[str, np.ndarray]:
    """Returns of policies that see a history, trained on the wide box."""
    env = Slide(HISTORY)
    params = training.train(env, np.stack([drawn(out)["wide box"]] * seeds), np.arange(seeds))
    return named("history", training.returns(env, training.learnt(env), params))


def with_adr(out: Path, seeds: int) -> dict[str, np.ndarray]:
    """Returns of policies under automatic domain randomisation, and their final ranges."""
    env = Slide()
    params, ranges = training.train_with_adr(env, np.arange(seeds))
    return named("ADR", training.returns(env, training.learnt(env), params)) | {"ADR ranges": np.asarray(ranges)}


def floors(out: Path, seeds: int) -> dict[str, np.ndarray]:
    """Returns of the constant force that is best in the middle of the guess, and of random forces."""
    env, forces = Slide(), jnp.linspace(0.0, STRONGEST, FORCES)
    nominal = jax.vmap(lambda force: training.fares(env, training.constant, force, jnp.asarray(env.nominal)).mean())
    best = forces[jnp.argmax(nominal(forces))][None]
    keys = jax.vmap(jax.random.key_data)(jax.random.split(jax.random.key(8), seeds))
    constant = named("constant", training.returns(env, training.constant, best))
    return constant | named("random", training.returns(env, functools.partial(chance.policy, env.actions), keys))


def named(arm: str, returns: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Returns by arm and object."""
    return {f"{arm}/{dlo}": own for dlo, own in returns.items()}


PARTS = {"memoryless": memoryless, "history": with_history, "adr": with_adr, "floors": floors}
"""Parts of the study; each is kept once it is done."""


def played(out: Path, seeds: int) -> dict[str, np.ndarray]:
    """Returns of all policies; parts that are there are not trained again."""
    found: dict[str, np.ndarray] = {}
    for name, make in PARTS.items():
        path = out / "parts" / f"{name}-{seeds}.npz"
        if not path.exists():
            path.parent.mkdir(exist_ok=True)
            files.write_arrays(path, make(out, seeds))
        found |= files.read_arrays(path)
    return found


def main() -> None:
    """Train what is missing, then write tables and figure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of the results")
    parser.add_argument("--seeds", type=int, default=4, help="trainings of each arm and object (default: 4)")
    parser.add_argument("--tables", action="store_true", help="only tables and figure, from arrays that are there")
    arguments = parser.parse_args()
    out = arguments.out
    out.mkdir(parents=True, exist_ok=True)
    if not arguments.tables:
        files.write_arrays(out / "episodes.npz", played(out, arguments.seeds))
        write_config(out, "experiments.knowing", training.SETTINGS)
    report.write(out)


if __name__ == "__main__":
    main()
