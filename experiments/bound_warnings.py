"""Rules that tell a wrong bound from a right one by posterior mass: hits and false alarms where the truth is known.

    python -m experiments.bound_warnings --runs runs/bounds --out experiments/results/bound-warnings

Every support is kept fixed, by `jaxlfi compare`, over several seeds; a bound is wrong if the truth lies beyond it. The
final posteriors are saved, so that any rule can be evaluated on them later without new simulations. A set of runs whose
arrays are in the output folder is not run again, and a folder of runs that is complete is only read.
"""

import argparse
import dataclasses
import json
import subprocess
import sys
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.stats import norm
from jaxtyping import Array, Float

from jaxlfi.diagnostics.bounds import edge_mass, mass_beyond
from jaxlfi.distributions.belief import Belief
from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.support import Support
from jaxlfi.envs import gaussian_linear as gaussian
from jaxlfi.envs import lotka_volterra as predators
from jaxlfi.envs import lynx_hare as pelts
from jaxlfi.envs import mg1 as queue
from jaxlfi.io import files as atomic
from jaxlfi.tasks.task import Task

# ------------------------------------------------------------------------------------------- tasks with more supports

LOTKA_VOLTERRA = {
    "second-low": Support([-5.0, 0.0, -5.0, -5.0], [2.0, 4.0, 2.0, 2.0]),
    "third-high": Support([-5.0, -5.0, -5.0, -5.0], [2.0, 2.0, -0.8, 2.0]),
    "fourth-low": Support([-5.0, -5.0, -5.0, -3.0], [2.0, 2.0, 2.0, 2.0]),
    "slightly": Support([-4.2, -5.0, -5.0, -5.0], [2.0, 2.0, -0.4, 2.0]),
    "inside": Support([-4.9, -5.4, -0.3, -4.9], [0.1, -0.4, 3.7, 0.1]),
}
"""Supports that exclude the truth in other parameters, or in two by only 0.4; and one with bounds 0.3 beyond it."""
GAUSSIAN = {
    "first-low": Support([2.0, -3.0], [5.0, 3.0]),
    "second-low": Support([-3.0, 1.0], [3.0, 5.0]),
    "second-high": Support([-3.0, -5.0], [3.0, -2.0]),
    "inside": Support([0.3, -4.0], [4.0, 0.6]),
    "tight": Support([0.6, -1.0], [1.4, 0.0]),
}
"""The sides other than that of "misspecified"; bounds two standard deviations from the truth; and within one of it."""
MG1 = {"rate-high": Support([0.0, 0.0, 0.0], [10.0, 10.0, 0.12])}
LYNX_HARE = {"prey-low": Support([-5.5, -2.0, 0.0, -5.5], [-2.0, 1.0, 2.0, -2.0])}


def _with(task: Task, supports: Mapping[str, Support]) -> Task:
    return dataclasses.replace(task, supports=dict(task.supports) | dict(supports))


def lotka_volterra() -> Task:
    """Lotka-Volterra with more supports."""
    return _with(predators.task(), LOTKA_VOLTERRA)


def gaussian_linear() -> Task:
    """The Gaussian location model with more supports."""
    return _with(gaussian.task(), GAUSSIAN)


def mg1() -> Task:
    """The M/G/1 queue with one more support."""
    return _with(queue.task(), MG1)


def lynx_hare() -> Task:
    """Lynx and hare with one more support."""
    return _with(pelts.task(), LYNX_HARE)


# ----------------------------------------------------------------------------------------------------------- the runs


@dataclasses.dataclass(frozen=True)
class Runs:
    """Runs of one `jaxlfi compare`.

    Attributes:
        task: the task argument of `compare`.
        supports: named supports, each kept fixed.
        seeds: number of seeds, from 0.
        options: further words of the command.
        held_out: whether the runs were not looked at before the rule and its threshold were chosen.
    """

    task: str
    supports: tuple[str, ...]
    seeds: int
    options: tuple[str, ...] = ()
    held_out: bool = True

    def command(self, folder: Path) -> list[str]:
        """The words of the command that makes these runs."""
        seeds = ["--seeds", str(self.seeds)]
        words = [
            self.task,
            "--configurations",
            *self.supports,
            *seeds,
            *self.options,
            "--no-figures",
            "--out",
            str(folder),
        ]
        return ["jaxlfi", "compare", *words]


SETS = {
    "named": Runs("lotka_volterra", ("ok", "misspecified", "broad"), 25, held_out=False),
    "gaussian": Runs(
        "experiments.bound_warnings:gaussian_linear",
        ("ok", "misspecified", "broad", *GAUSSIAN),
        4,
        options=("--rounds", "3"),
    ),
    "lynx": Runs(
        "experiments.bound_warnings:lynx_hare", ("ok", "misspecified", *LYNX_HARE), 4, options=("--rounds", "4")
    ),
    "mg1": Runs(
        "experiments.bound_warnings:mg1", ("ok", "misspecified", "unmirrored", *MG1), 3, options=("--rounds", "4")
    ),
    "boxes": Runs("experiments.bound_warnings:lotka_volterra", tuple(LOTKA_VOLTERRA), 3, options=("--rounds", "6")),
}
"""The runs by the names of their files."""

FIELDS = ("logits", "means", "scale_tril", "support_low", "support_high")


def truths(task: str) -> np.ndarray:
    """The true parameters, a row for each equivalent truth; for real data, the reference posterior's mean."""
    name = task.rpartition(":")[2]
    if name == "mg1":
        one = np.asarray(queue.task().truth)
        return np.stack([one, one[[1, 0, 2]]])
    if name == "lynx_hare":
        return pelts.reference_log_rates()[0][None]
    return np.asarray(globals()[name]().truth)[None]


def wrong_bounds(truth: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Which bounds are wrong: 1 where all equivalent truths lie beyond a bound, 0 for right ones, shape [side, D].

    If the box holds one of the truths, no bound is wrong. If it holds none, a bound that excludes some of them is
    neither right nor wrong (-1): moving it is one of several remedies.

    Args:
        truth: equivalent truths, shape [M, D].
        low: lower bounds of the box, shape [D].
        high: upper bounds, shape [D].
    """
    beyond = np.stack([truth < low, truth > high])  # [side, truth, D]
    if not beyond.any(axis=(0, 2)).all():
        return np.zeros((2, truth.shape[1]), int)
    return np.where(beyond.all(axis=1), 1, np.where(beyond.any(axis=1), -1, 0))


def collect(folder: Path, runs: Runs) -> dict[str, np.ndarray]:
    """The final posteriors of a finished `compare`, by "support/array", a row for each seed."""
    arrays = {}
    for support in runs.supports:
        parts = [
            atomic.read_arrays(folder / support / f"seed_{seed:03d}" / "posterior.npz") for seed in range(runs.seeds)
        ]
        arrays |= {f"{support}/{field}": np.stack([part[field] for part in parts]) for field in FIELDS}
    return arrays


def make(name: str, runs: Runs, folder: Path, out: Path) -> None:
    """Make the runs unless they are there, and save their posteriors with their configuration."""
    if not (folder / "table.csv").exists():  # the last file that a comparison writes
        command = runs.command(folder)
        subprocess.run([sys.executable, "-m", *command], check=True)
    config = json.loads((folder / "config.json").read_text())
    kept = {key: value for key, value in config.items() if key != "runs"}
    atomic.write_json(out / f"{name}.json", {"command": " ".join(runs.command(Path("RUNS") / name)), "config": kept})
    atomic.write_arrays(out / f"{name}.npz", collect(folder, runs))


# ---------------------------------------------------------------------------------------------------------- the rules

Rule = Callable[[Belief], tuple[Float[Array, " dim"], Float[Array, " dim"]]]
"""A score for each lower and each upper bound; the greater, the more likely the bound is wrong."""


def marginal_density(mixture: GaussianMixture, theta: Float[Array, " dim"]) -> Float[Array, " dim"]:
    """Density of each marginal at its own coordinate of theta, shape [D]."""
    return jnp.sum(mixture.weights[:, None] * norm.pdf(theta, mixture.means, mixture.marginal_scales), axis=0)


def density_at(belief: Belief, points: int = 201) -> tuple[Float[Array, " dim"], Float[Array, " dim"]]:
    """The marginal density at a bound, as a fraction of its maximum in the box: 1 if it does not fall towards it."""
    box = belief.support
    grid = box.low + jnp.linspace(0.0, 1.0, points)[:, None] * box.width
    density = jax.vmap(lambda theta: marginal_density(belief.mixture, theta))(grid)
    greatest = jnp.maximum(density.max(axis=0), jnp.finfo(density.dtype).tiny)
    return density[0] / greatest, density[-1] / greatest


def centres_beyond(belief: Belief) -> tuple[Float[Array, " dim"], Float[Array, " dim"]]:
    """The weight of the components whose means lie beyond a bound: a vote of the ensemble."""
    weight, means = belief.mixture.weights[:, None], belief.mixture.means
    return jnp.sum(weight * (means < belief.support.low), axis=0), jnp.sum(
        weight * (means > belief.support.high), axis=0
    )


RULES: dict[str, tuple[str, Rule]] = {
    "along": ("mass in or beyond the outer tenth of the width", edge_mass),
    "beyond": ("mass beyond the bound", mass_beyond),
    "density": ("density at the bound / its maximum in the box", density_at),
    "centres": ("weight of the components centred beyond the bound", centres_beyond),
}
"""Candidate rules, by name: description of the score, and the function."""

FORMER = ("along", 0.2)
"""The rule before this study."""
CHOSEN = ("beyond", 0.2)
"""The best rule for these runs. The library's threshold is lower, as its posteriors have become narrower, and its rule
also uses the simulations (experiments/wrong_bounds.py)."""


@dataclasses.dataclass(frozen=True)
class Judged:
    """The runs of one support.

    Attributes:
        runs: name in SETS.
        support: name of the support.
        wrong: whether each bound is wrong, as by `wrong_bounds`, shape [side, D].
        scores: scores of the bounds by rule, shape [S, side, D].
    """

    runs: str
    support: str
    wrong: np.ndarray
    scores: Mapping[str, np.ndarray]


def judge(name: str, arrays: Mapping[str, np.ndarray]) -> list[Judged]:
    """The scores of all rules for saved posteriors."""
    judged = []
    for support in SETS[name].supports:
        own = {field: jnp.asarray(arrays[f"{support}/{field}"]) for field in FIELDS}
        mixture = GaussianMixture(own["logits"], own["means"], own["scale_tril"])
        box = Support(own["support_low"], own["support_high"])
        beliefs = Belief(mixture, box, jnp.ones(len(own["logits"]), bool))
        scores = {rule: np.stack(jax.jit(jax.vmap(function))(beliefs), axis=1) for rule, (_, function) in RULES.items()}
        wrong = wrong_bounds(truths(SETS[name].task), np.asarray(box.low[0]), np.asarray(box.high[0]))
        judged.append(Judged(name, support, wrong, scores))
    return judged


# ---------------------------------------------------------------------------------------------------------- the rates

RATES = {
    "hits": "wrong bounds named",
    "runs_hit": "runs on wrong supports that name one",
    "false": "right bounds of right supports named",
    "runs_false": "runs on right supports that name one",
    "blamed": "right bounds of wrong supports named",
}
"""Rates that are reported for a rule and a threshold."""


def counts(every: Iterable[Judged], rule: str, threshold: float) -> dict[str, np.ndarray]:
    """Numerators and denominators of the rates, by the names of RATES, shape [2] each.

    Args:
        every: supports and their runs.
        rule: name in RULES.
        threshold: score above which a bound is named.
    """
    total = {name: np.zeros(2, int) for name in RATES}
    for one in every:
        named = one.scores[rule] > threshold  # [run, side, D]
        wrong, right = named[:, one.wrong == 1], named[:, one.wrong == 0]
        remedies = named[:, one.wrong != 0]
        if np.any(one.wrong != 0):
            total["hits"] += [wrong.sum(), wrong.size]
            total["runs_hit"] += [remedies.any(axis=1).sum(), len(remedies)]
            total["blamed"] += [right.sum(), right.size]
        else:
            total["false"] += [right.sum(), right.size]
            total["runs_false"] += [right.any(axis=1).sum(), len(right)]
    return total


def wilson(hits: int, of: int, z: float = 1.96) -> tuple[float, float]:
    """The 95 % Wilson interval of a rate.

    Example:
        >>> [round(bound, 3) for bound in wilson(8, 10)]
        [0.49, 0.943]
    """
    if of == 0:
        return 0.0, 1.0
    rate = hits / of
    centre = (rate + z**2 / (2 * of)) / (1 + z**2 / of)
    half = z * np.sqrt(rate * (1 - rate) / of + z**2 / (4 * of**2)) / (1 + z**2 / of)
    return float(centre - half), float(centre + half)


def _cell(pair: np.ndarray) -> str:
    hits, of = (int(number) for number in pair)
    if of == 0:
        return ""
    low, high = wilson(hits, of)
    return f"{hits / of:.0%} [{low:.0%}, {high:.0%}] ({hits} of {of})"


def _markdown(lines: list[list[str]]) -> str:
    lines = [lines[0], ["---"] * len(lines[0]), *lines[1:]]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)


def tables(every: list[Judged], thresholds: Mapping[str, Iterable[float]]) -> str:
    """Markdown: rules and thresholds on the seen and the held-out runs, then each support separately."""
    parts = []
    for held_out, title in ((False, "Runs the rule was chosen on"), (True, "Held-out runs")):
        part = [one for one in every if SETS[one.runs].held_out == held_out]
        if not part:
            continue
        lines = [["rule", "threshold", *RATES.values()]]
        for rule, values in thresholds.items():
            for value in values:
                own = counts(part, rule, value)
                lines.append([RULES[rule][0], f"{value:g}", *(_cell(own[name]) for name in RATES)])
        parts.append(f"## {title}\n\n{_markdown(lines)}")
    head = ["runs", "support", "seeds", "wrong bounds"]
    lines = [[*head, "hits: before", "hits: now", "false alarms, runs: before", "false alarms, runs: now"]]
    for one in every:
        pairs = [counts([one], *rule) for rule in (FORMER, CHOSEN)]
        wrong = ", ".join(f"{d + 1} {('lower', 'upper')[side]}" for side, d in np.argwhere(one.wrong == 1))
        cells = [f"{p[0]} of {p[1]}" if p[1] else "" for key in ("hits", "runs_false") for p in (c[key] for c in pairs)]
        lines.append([one.runs, f"`{one.support}`", str(len(one.scores["beyond"])), wrong, *cells])
    parts.append(f"## By support, all runs\n\n{_markdown(lines)}")
    return "\n".join(parts)


THRESHOLDS = {
    "along": (0.2, 0.5, 0.9),
    "beyond": (0.05, 0.1, 0.2, 0.3, 0.4, 0.6),
    "density": (0.25, 0.5, 0.75, 0.95),
    "centres": (0.2, 0.4, 0.6),
}


def main(argv: list[str] | None = None) -> None:
    """Run what is missing, save the posteriors, and write the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=Path, default=Path("runs/bounds"), help="where runs are, or are made")
    parser.add_argument("--sets", nargs="+", choices=list(SETS), default=list(SETS), metavar="SET")
    parser.add_argument("--out", type=Path, default=Path("experiments/results/bound-warnings"))
    arguments = parser.parse_args(argv)
    arguments.out.mkdir(parents=True, exist_ok=True)
    for name in arguments.sets:
        if not (arguments.out / f"{name}.npz").exists():
            make(name, SETS[name], arguments.runs / name, arguments.out)
    saved = [name for name in SETS if (arguments.out / f"{name}.npz").exists()]
    every = [one for name in saved for one in judge(name, atomic.read_arrays(arguments.out / f"{name}.npz"))]
    text = tables(every, THRESHOLDS)
    (arguments.out / "table.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
