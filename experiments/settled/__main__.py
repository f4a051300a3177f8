"""Does it pay to know the object? Policies of the whip, judged by the scene that they leave behind once it has settled.

    python -m experiments.settled --out experiments/results/policies/settled
    python -m experiments.settled --out experiments/results/policies/settled --arms fixed    # one more arm
    python -m experiments.settled --out experiments/results/policies/settled --tables        # only tables and figure

    python -m experiments.settled --out experiments/results/policies/settled_longer \
        --steps 60000 --points experiments/results/policies/settled      # longer, on the same points
    python -m experiments.settled --out ... --seeds 2                    # and once more, with another seed

These are the passes of experiments/policies/plan.md. All arms have the same learner, networks, steps and places:

    guess, wide                  uniform over Theta_0, or over Phi, without a recording
    posterior, fixed             the posterior of one recording, by EDGE or on the fixed Theta_0
    oracle                       the object itself
    history                      uniform over Phi, with policies that see the last six observations and five actions
    floors                       baselines: the constant action that is best on Theta_0, and random actions

    runs/            posteriors and trainings, from which an interrupted command continues
    parts/           episodes of finished arms, until the arrays hold them
    episodes.npz     results of finished arms, which are not made again: more can be added without runs/ and parts/;
                     ARM/OBJECT/NAME: values of each episode [seeds, places]
    learning.npz     ARM/curve: returns while learning [updates, policies]; ARM/trained: points [policies, 12, 2];
                     policies are ordered by seed, and for each seed by object
    config.json      settings, versions, command
    table.md, contrasts.md, objects.md, outcomes.png, from these arrays
    best.gif, median.gif: the best and the median policy on each object, if `--films` is given and runs/ exists
"""

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path

from jaxlfi.io import compile_cache

if __name__ == "__main__":  # before jax starts
    compile_cache.enable()

import numpy as np

from experiments.arms import write_config, written, written_settings
from experiments.settled import domains, films, report, training
from jaxlfi.io import files
from jaxlfi.rl.settings import PPO

TOGETHER: tuple[tuple[str, ...], ...] = (("guess", "wide"), ("posterior",), ("oracle",), ("history",), ("fixed",))
"""Arms that are trained in parallel, in the order in which they are made."""
STEPS = "steps_per_update"
"""Name of the array in learning.npz that does not belong to an arm."""
FIRST = ("guess", "wide", "posterior", "oracle", "history", "floors")
"""Arms that are made by default."""


def trainings(
    out: Path, arms: tuple[str, ...], seeds: tuple[int, ...], settings: PPO, points: Path | None = None
) -> Path:
    """The folder of the trainings of some arms, which are made if they are missing, with the inference that they need.

    Args:
        out: folder of the study.
        arms: arms that are trained in parallel.
        seeds: seeds of the trainings.
        settings: settings of PPO.
        points: folder of an earlier pass, on whose points the posteriors' policies are trained; None infers anew.
    """
    folder, draws = training_folder(out, arms, seeds), {}
    for arm in arms:
        if arm in domains.HEURISTICS and points is not None:
            draws |= domains.drawn(points, arm)
            continue
        if arm in domains.HEURISTICS:
            domains.infer(out, arm)
        draws |= domains.draws(out, training.environment(), arm)
    training.learn(folder, training.reference(arms[0]), draws, seeds, settings)
    return folder


def training_folder(out: Path, arms: tuple[str, ...], seeds: tuple[int, ...]) -> Path:
    """The folder of arms that are trained in parallel, with these seeds."""
    first = f"-{seeds[0]}" if seeds[0] else ""
    return out / "runs" / "trainings" / f"{'+'.join(arms)}{first}"


def make(out: Path, names: Sequence[str], settings: PPO, points: Path | None = None, own_seeds: int = 1) -> None:
    """Make the missing results of some arms and of the floors; each is kept once it is done.

    Args:
        out: folder of the study.
        names: names of the arms.
        settings: settings of PPO.
        points: as in `trainings`.
        own_seeds: number of trainings per object of an arm with policies for each object; others have `training.SEEDS`.
    """
    for arms in TOGETHER:
        broad = arms[0] in domains.BROAD
        for seeds in [tuple(range(training.SEEDS))] if broad else [(seed,) for seed in range(own_seeds)]:
            for arm in [arm for arm in arms if arm in names and there(out, arm) <= seeds[0]]:
                folder = trainings(out, arms, seeds, settings, points)
                keep(out, arm, training.arm(folder, arm) | training.learning(folder, arm))
    if "floors" in names and not all(there(out, arm) for arm in report.FLOORS):
        files.write_arrays(part(out, "floors"), training.floors())


def there(out: Path, arm: str) -> int:
    """Number of finished seeds of an arm."""
    return len(saved(out).get(f"{arm}/{domains.OBJECTS[0]}/{report.PRIMARY}", ()))


def keep(out: Path, arm: str, found: Mapping[str, np.ndarray]) -> None:
    """Write the part of an arm: its seeds so far, and the new ones."""
    earlier, axis = saved(out), lambda name: int(name.endswith("/curve"))
    joined = lambda name, row: np.concatenate([earlier[name], row], axis(name)) if name in earlier else row
    files.write_arrays(part(out, arm), {name: joined(name, row) for name, row in found.items()})


def saved(out: Path) -> dict[str, np.ndarray]:
    """The study's arrays so far, without the number of steps per update."""
    whole = [path for path in (out / "episodes.npz", out / "learning.npz") if path.exists()]
    paths = [*whole, *sorted((out / "parts").glob("*.npz"))]
    rows = {name: row for path in paths for name, row in files.read_arrays(path).items()}
    return {name: row for name, row in rows.items() if name != STEPS}


def part(out: Path, name: str) -> Path:
    """The file of an arm's episodes."""
    return out / "parts" / f"{name}.npz"


def gather(out: Path, settings: PPO) -> None:
    """Write the results of all arms so far as the study's arrays, which replace their parts."""
    rows = saved(out)
    learning = {name: row for name, row in rows.items() if name.endswith(training.LEARNING)}
    files.write_arrays(out / "episodes.npz", {name: row for name, row in rows.items() if name not in learning})
    files.write_arrays(out / "learning.npz", learning | {STEPS: np.asarray(settings.steps_per_update)})
    for path in (out / "parts").glob("*.npz"):  # which would hide arrays that are updated elsewhere
        path.unlink()


def main() -> None:
    """Make what is missing, then write tables and figure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of the results")
    known = [*(arm for arms in TOGETHER for arm in arms), "floors"]
    parser.add_argument("--arms", nargs="+", choices=known, default=FIRST, help=f"(default: {', '.join(FIRST)})")
    steps = training.SETTINGS.total_steps
    parser.add_argument("--steps", type=int, default=steps, help=f"environment steps of a training (default: {steps})")
    parser.add_argument("--seeds", type=int, default=1, help="policies of an arm for each object (default: 1)")
    parser.add_argument("--points", type=Path, help="folder of an earlier pass, whose posteriors' points are used")
    parser.add_argument("--tables", action="store_true", help="only tables and figure, from arrays that are there")
    parser.add_argument("--films", action="store_true", help="moving pictures, too, of policies that are there")
    arguments = parser.parse_args()
    out = arguments.out
    if arguments.seeds < 1:
        parser.error(f"--seeds: expected at least 1, got {arguments.seeds}")
    if not arguments.tables:
        settings = training.SETTINGS.replace(total_steps=arguments.steps)
        if (out / "config.json").exists() and written_settings(out) != written(settings):
            parser.error(f"--steps: {out} has arms that were trained with other settings; give another --out")
        (out / "parts").mkdir(parents=True, exist_ok=True)
        make(out, arguments.arms, settings, arguments.points, arguments.seeds)
        gather(out, settings)
        write_config(out, "experiments.settled", settings)
    report.write(out)
    if arguments.films:
        if not (out / "runs" / "trainings").exists():
            parser.error(f"--films: {out} has no runs/trainings, which films are made of")
        films.write(out, files.read_arrays(out / "episodes.npz"), out / "runs" / "trainings")


if __name__ == "__main__":
    main()
