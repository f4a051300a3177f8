"""Real2Sim of the four FEM reference objects: posteriors and their errors, on a fixed support and with EDGE.

    python -m experiments.real2sim --runs runs/real2sim --out experiments/results/real2sim
    python -m experiments.real2sim --runs runs/seen --out experiments/results/real2sim-learnt --detector learnt \
        --configurations initial+edge

Runs `jaxlfi compare whip --object dlo-K --configurations initial initial+edge` for each object (finished runs are not
repeated), reports the result of every seed in table.csv, and draws counterparts of the paper's figures from the folders
of the first seed:

    progression.png   fig:mog-n-param-space-progr: samples by iteration with their boxes, and the last mixtures
    domains.png       fig:mog-posterior-for-dr: the last mixtures and the 12 domains that policies would be trained on
    gap.png           fig:sim2real-distance-progr: distance of each iteration's best samples from the observation
    predictive-K.png  keypoints of simulations of the last posterior, over the observed ones
"""

import argparse
import csv
import dataclasses
import io
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

import jaxlfi
from jaxlfi.cli import parser as cli
from jaxlfi.envs.whip import cli as whip
from jaxlfi.envs.whip.observer import OBSERVATION
from jaxlfi.envs.whip.parameters import MILLIMETRES
from jaxlfi.envs.whip.reference_objects.objects import load as load_object
from jaxlfi.envs.whip.render import save_predictive
from jaxlfi.figures import History, legends, open_collection, samples, style
from jaxlfi.io import files as atomic
from jaxlfi.io import provenance
from jaxlfi.runs import folder as run_store

OBJECTS = ("dlo-0", "dlo-1", "dlo-2", "dlo-3")
CONFIGURATIONS = {"initial": "fixed", "initial+edge": "EDGE"}
"""Configurations that are compared, and their names in pictures."""
DOMAINS = 12
"""Number of environments that a policy is trained in at once, each with its own parameters (section VI-H)."""
BEST = 0.25
"""Fraction of an iteration's samples, the nearest ones, whose distance is reported."""
GAPS = {"summary": "distance of summaries", "pixels": "Chamfer distance [px]"}
"""Distances from the observation, and their labels."""
DOMAIN = {"marker": "o", "markersize": 3.2, "markerfacecolor": "none", "color": "black", "linestyle": "none"}
PIXELS = 256
KEYPOINTS = slice(2, 22)
"""Slice of an observation that holds the keypoints."""


def mean_keypoints(x: np.ndarray) -> np.ndarray:
    """Keypoints averaged over time, in pixels, from summaries [..., 112], shape [..., 10, 2]."""
    mean = x[..., 2 * OBSERVATION : 3 * OBSERVATION][..., KEYPOINTS]
    return PIXELS * mean.reshape(*mean.shape[:-1], 10, 2)


def chamfer(points: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Bidirectional Chamfer distance of two sets of points: mean distance to the nearest, averaged over both ways.

    Args:
        points: one set, shape [..., N, 2].
        others: the other set, shape [..., M, 2].
    """
    distance = np.linalg.norm(points[..., :, None, :] - others[..., None, :, :], axis=-1)
    return (distance.min(axis=-1).mean(axis=-1) + distance.min(axis=-2).mean(axis=-1)) / 2


def gaps(folder: Path) -> dict[str, np.ndarray]:
    """Mean and standard deviation over each iteration's best quarter of samples, shape [R, 2] each.

    Returns:
        "summary": Euclidean distance of psi; "pixels": Chamfer distance of the DLO's and the cubes' keypoints averaged
        over time.
    """
    data = atomic.read_arrays(folder / "dataset.npz")
    observed = atomic.read_arrays(folder / "observation.npz")["x"]
    seen, target = mean_keypoints(data["x"]), mean_keypoints(observed)
    dlo, cubes = slice(0, 4), slice(4, 10)
    distances = {
        "summary": np.linalg.norm(data["x"] - observed, axis=-1),
        # DLO and cubes separately: a point of the DLO never matches a cube.
        "pixels": (4 * chamfer(seen[:, dlo], target[dlo]) + 6 * chamfer(seen[:, cubes], target[cubes])) / 10,
    }
    rounds = np.unique(data["round"])
    return {name: np.array([_best(d[data["round"] == i]) for i in rounds]) for name, d in distances.items()}


def _best(distances: np.ndarray) -> tuple[float, float]:
    best = np.sort(distances)[: max(1, round(BEST * len(distances)))]
    return float(best.mean()), float(best.std())


def domains(history: History) -> np.ndarray:
    """Low-variance draws of the last posterior, clipped to its support, in inference space, shape [12, 2]."""
    belief = jaxlfi.load(history.folder).belief
    draws = belief.mixture.low_variance_sample(jax.random.key(0), DOMAINS)
    return np.asarray(jnp.clip(draws, belief.support.low, belief.support.high))


def with_truth(name: str, history: History) -> History:
    """The history with the truth of a reference object: the light DLO that hangs and swings in the same way."""
    if name not in OBJECTS:
        return history
    known = load_object(name)
    return dataclasses.replace(history, truth=np.array([known.length * MILLIMETRES[0], np.log(known.light_young)]))


def draw_progression(figure: Figure, histories: Mapping[str, Mapping[str, History]]) -> None:
    """One row per object: samples and last mixture of each configuration, with the path of the means."""
    axes = figure.subplots(len(histories), 2 * len(next(iter(histories.values()))), squeeze=False)
    for row, (name, own) in enumerate(histories.items()):
        for column, (configuration, history) in enumerate(own.items()):
            left, right = axes[row, 2 * column : 2 * column + 2]
            shown = with_truth(name, history)
            samples.draw_proposals(left, shown, (0, 1), [samples.limits([*own.values(), shown], d) for d in (0, 1)])
            _draw_mixture(right, shown, [with_truth(name, other) for other in own.values()])
            left.set_title(f"{name}, {CONFIGURATIONS[configuration]}: samples")
            right.set_title("posterior, enlarged")
    _outer_labels(axes)
    iterations = max(history.rounds for own in histories.values() for history in own.values())
    style.iteration_bar(figure, axes, iterations)
    samples.legend(figure, [shown], at_most=4)


def draw_domains(figure: Figure, histories: Mapping[str, Mapping[str, History]]) -> None:
    """One column per object, one row per configuration: the last mixture and twelve domains drawn from it."""
    axes = figure.subplots(len(next(iter(histories.values()))), len(histories), squeeze=False)
    for column, (name, own) in enumerate(histories.items()):
        every = {label: with_truth(name, history) for label, history in own.items()}
        for row, (configuration, history) in enumerate(every.items()):
            _draw_mixture(axes[row, column], history, list(every.values()))
            axes[row, column].plot(*domains(history).T, **DOMAIN, zorder=6)
            axes[row, column].set_title(f"{name}, {CONFIGURATIONS[configuration]}")
    _outer_labels(axes)
    domain = Line2D([], [], **DOMAIN, label=f"the {DOMAINS} domains of a policy")
    samples.legend(figure, [history], at_most=4, others=[domain], proposals=False)


def _draw_mixture(axes: Axes, history: History, others: Sequence[History]) -> None:
    """Draw the last mixture in the window of all configurations, without a bar for its density."""
    samples.draw_mixture(axes, history, (0, 1), [samples.closer_limits(others, d) for d in (0, 1)], bar=False)


def _outer_labels(axes: np.ndarray) -> None:
    for panel in axes[:-1].ravel():
        panel.set_xlabel("")
    for panel in axes[:, 1:].ravel():
        panel.set_ylabel("")


def draw_gaps(figure: Figure, found: Mapping[str, Mapping[str, Mapping[str, np.ndarray]]]) -> None:
    """One column per object: distance by iteration, of summaries above and of keypoints in pixels below."""
    axes = figure.subplots(len(GAPS), len(found), squeeze=False, sharex=True, sharey="row")
    look = {
        name: dataclasses.replace(own, label=CONFIGURATIONS[name])
        for name, own in style.looks(list(CONFIGURATIONS)).items()
    }
    for column, (name, own) in enumerate(found.items()):
        for row, (kind, label) in enumerate(GAPS.items()):
            panel = axes[row, column]
            for configuration, gap in own.items():
                steps, (middle, sd) = np.arange(1, len(gap[kind]) + 1), gap[kind].T
                colour = look[configuration].colour
                panel.fill_between(steps, middle - sd, middle + sd, color=colour, alpha=0.2, linewidth=0)
                panel.plot(steps, middle, **look[configuration].line)
            panel.grid(True)
            if column == 0:
                panel.set_ylabel(label)
        axes[0, column].set_title(name)
        axes[0, column].set_yscale("log")
        axes[0, column].yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes[0, column].yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axes[0, column].yaxis.set_minor_formatter(NullFormatter())
        style.iterations_axis(axes[-1, column], len(steps))
    shown = {name: look[name] for name in next(iter(found.values()))}
    legends.of_configurations(
        figure, shown, f"mean ± standard deviation of the nearest {100 * BEST:g} % of an iteration's samples"
    )


def saved_gaps(path: Path) -> dict[str, dict[str, dict[str, np.ndarray]]]:
    """The content of gaps.npz by object, configuration and kind."""
    found: dict[str, dict[str, dict[str, np.ndarray]]] = {}
    for key, gap in atomic.read_arrays(path).items():
        name, label, kind = key.partition("_")[0], *key.partition("_")[2].rsplit("_", 1)
        found.setdefault(name, {}).setdefault(label.replace("_", "+"), {})[kind] = gap
    return found


def table(runs: Mapping[str, Mapping[str, Sequence[History]]]) -> list[dict[str, object]]:
    """One row per object, configuration and seed: the final posterior, its support, and the last gaps."""
    every = [
        (name, configuration, seed, history)
        for name, own in runs.items()
        for configuration, seeds in own.items()
        for seed, history in enumerate(seeds)
    ]
    lines = []
    for name, configuration, seed, history in every:
        run = jaxlfi.load(history.folder)
        low, middle, high = np.quantile(run.posterior.sample(jax.random.key(1), 4000), [0.05, 0.5, 0.95], axis=0)
        support = run.final_support()
        gap = gaps(history.folder)
        lines.append(
            {
                "object": name,
                "configuration": configuration,
                "seed": seed,
                "length [mm]": f"{middle[0]:.0f} [{low[0]:.0f}, {high[0]:.0f}]",
                "E [kPa]": " ".join([f"{middle[1] / 1e3:.2f}", f"[{low[1] / 1e3:.2f}, {high[1] / 1e3:.2f}]"]),
                "support length [mm]": f"[{support.low[0]:.0f}, {support.high[0]:.0f}]",
                "support E [kPa]": f"[{support.low[1] / 1e3:.2g}, {support.high[1] / 1e3:.2g}]",
                "summary gap": round(float(gap["summary"][-1, 0]), 3),
                "pixel gap": round(float(gap["pixels"][-1, 0]), 2),
                "seconds": round(float(np.sum(history.seconds)), 1),
            }
        )
    return lines


def recorded(name: str, detector: str, folder: Path) -> str:
    """A rollout of an object as a detector sees it in images by MuJoCo; made if it is missing."""
    path = folder / "recordings" / f"{name}.npz"
    if not path.with_suffix(".json").exists():
        path.unlink(missing_ok=True)  # left by an interrupted recording
        if status := whip.main(["record", "--object", name, "--detector", detector, "--out", str(path)]):
            raise SystemExit(status)
    return str(path)


def main() -> None:
    """Run what is missing, then draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--runs",
        type=Path,
        help="folder of the runs, made if they are missing; without it, gap.png alone is drawn",
    )
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--objects", nargs="+", default=OBJECTS, help="names, or recorded rollouts' .npz")
    parser.add_argument("--seeds", type=int, default=3, help="runs of each configuration, in one batch")
    parser.add_argument("--configurations", nargs="+", choices=list(CONFIGURATIONS), default=list(CONFIGURATIONS))
    parser.add_argument("--detector", default="centreline", help="what sees the objects, as in `jaxlfi whip record`")
    arguments = parser.parse_args()
    if arguments.runs is None:
        found = saved_gaps(arguments.out / "gaps.npz")
        save(arguments.out / "gap.png", GAP_SIZE, lambda figure: draw_gaps(figure, found))
        return
    runs = {}
    for name in arguments.objects:
        folder, task, rollout = arguments.runs / Path(name).stem, "whip", name
        if arguments.detector != "centreline":
            task, rollout = f"whip,detector={arguments.detector}", recorded(name, arguments.detector, arguments.runs)
        words = ["compare", task, "--object", rollout, "--seeds", str(arguments.seeds)]
        words += ["--configurations", *arguments.configurations, "--out", str(folder), "--keep-network"]
        if not (folder / "config.json").exists():
            if status := cli.main(words):
                raise SystemExit(status)
        elif run_store.read_config(folder).get("status") != "finished":
            cli.main(["resume", str(folder)])
        runs[Path(name).stem] = open_collection(folder).runs
    arguments.out.mkdir(parents=True, exist_ok=True)
    lines = table(runs)
    stream = io.StringIO()
    writer = csv.DictWriter(stream, lines[0])
    writer.writeheader()
    writer.writerows(lines)
    atomic.write_bytes(arguments.out / "table.csv", stream.getvalue().encode())
    command = provenance.command_line(["python", "-m", "experiments.real2sim", *sys.argv[1:]])
    atomic.write_json(arguments.out / "config.json", provenance.environment() | {"command_line": command})
    histories = {name: {label: seeds[0] for label, seeds in own.items()} for name, own in runs.items()}
    found = {name: {label: gaps(run.folder) for label, run in own.items()} for name, own in histories.items()}
    arrays = {
        f"{name}_{label.replace('+', '_')}_{kind}": value
        for name, own in found.items()
        for label, gap in own.items()
        for kind, value in gap.items()
    }
    atomic.write_arrays(arguments.out / "gaps.npz", arrays)
    rows, kinds = len(histories), len(arguments.configurations)
    for name, size, paint in (
        ("progression", (3.58 * kinds, 0.5 + 1.5 * rows), lambda f: draw_progression(f, histories)),
        ("domains", (style.TEXT_WIDTH, 0.6 + 1.6 * kinds), lambda f: draw_domains(f, histories)),
        ("gap", GAP_SIZE, lambda f: draw_gaps(f, found)),
    ):
        save(arguments.out / f"{name}.png", size, paint)
    for name, own in histories.items():
        save_predictive(arguments.out / f"predictive-{name}.png", jaxlfi.load(own[arguments.configurations[-1]].folder))


GAP_SIZE = (style.TEXT_WIDTH, 3.4)


def save(path: Path, size: tuple[float, float], paint: Callable[[Figure], None]) -> None:
    """Draw a picture of a given size in inches."""
    with style.context():
        figure = style.new_figure(*size)
        paint(figure)
        style.save(figure, path, 200)


if __name__ == "__main__":
    main()
