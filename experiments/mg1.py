"""The M/G/1 study: errors that allow for its mirror image, sharpness of its posteriors, and pictures of its data.

    jaxlfi compare mg1 --out runs/mg1
    python -m experiments.mg1 runs/mg1 --out experiments/results/mg1

(1, 5, 0.2) and (5, 1, 0.2) are the same queue (`jaxlfi.envs.mg1.task`), and a posterior may put its mass on either or
both. The errors in a run's table count the second as wrong. Here the two bounds of the service time are sorted first.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import jax
import numpy as np
from matplotlib.figure import Figure

from jaxlfi.diagnostics.bootstrap import bootstrap_interval
from jaxlfi.envs import mg1
from jaxlfi.figures import History, density, discrepancy, legends, open_collection, style
from jaxlfi.io import files as atomic

SEEDS = 3
"""Number of simulations at the truth that are shown."""
ENTROPY_DRAWS = 10_000
"""Monte Carlo draws for the estimate of an entropy."""
MEASURES = {
    "plain": "θ error",
    "sorted": "sorted θ error",
    "min": "of min(θ_1, θ_2)",
    "max": "of max(θ_1, θ_2)",
    "rate": "of θ_3",
    "trajectory": "trajectory error",
    "entropy": "entropy [nats]",
}
"""Measures that are reported for every run, by name in errors.npz."""
PICTURED = {
    "plain": "parameters", "sorted": "parameters, sorted service times", "trajectory": "trajectory"
}  # fmt: skip
"""Measures that errors.png shows, and their titles."""


def ordered(theta: np.ndarray) -> np.ndarray:
    """(min(theta_1, theta_2), max(theta_1, theta_2), theta_3), shape [..., 3]: the same for a queue and its mirror."""
    return np.concatenate([np.sort(theta[..., :2], axis=-1), theta[..., 2:]], axis=-1)


def entropy(logits: np.ndarray, means: np.ndarray, scale_tril: np.ndarray, draws: int = ENTROPY_DRAWS) -> float:
    """Differential entropy of a mixture of Gaussians in nats, as the mean of -log p over its draws.

    Args:
        logits: logits of the components, shape [K].
        means: their means, shape [K, D].
        scale_tril: their Cholesky factors, shape [K, D, D].
        draws: number of draws; the standard error is about sqrt(D / 2 / draws).
    """
    rng = np.random.default_rng(0)
    weight = density.weights(logits.astype(float))
    component = rng.choice(len(weight), draws, p=weight)
    noise = rng.normal(size=(draws, means.shape[-1]))
    theta = means[component] + np.einsum("nij,nj->ni", scale_tril[component], noise)
    mean, covariance = density.marginal(means, scale_tril, tuple(range(means.shape[-1])))
    return float(-np.mean(np.log(density.density(theta, weight, mean, covariance))))


def measures(history: History) -> dict[str, float]:
    """All of `MEASURES` of one run, from its last round."""
    samples = atomic.read_arrays(history.folder / "history.npz")["sample_theta"][-1]
    error = np.abs(ordered(samples) - ordered(history.truth)).mean(axis=0)
    return {
        "plain": history.final_theta_error,
        "sorted": float(error.sum()),
        **{name: float(e) for name, e in zip(("min", "max", "rate"), error, strict=True)},
        "trajectory": history.final_trajectory_error,
        "entropy": entropy(history.logits[-1], history.means[-1], history.scale_tril[-1]),
    }


def table(errors: dict[str, dict[str, np.ndarray]]) -> str:
    """Markdown: mean [95 % bootstrap interval over seeds] (median) of every measure, a line for each configuration.

    Args:
        errors: errors by configuration and measure, one value per seed.
    """
    lines = [
        "| configuration | " + " | ".join(title.replace("_", r"\_") for title in MEASURES.values()) + " |",
        "|---" * (1 + len(MEASURES)) + "|",
    ]
    for configuration, own in errors.items():
        cells = [_cell(own[name]) for name in MEASURES]
        lines.append(f"| {configuration} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def _cell(values: np.ndarray) -> str:
    low, high = bootstrap_interval(values)
    return f"{np.mean(values):.2f} [{low:.2f}, {high:.2f}] ({np.median(values):.2f})"


def sample_trajectories() -> np.ndarray:
    """Inter-departure times of 50 jobs in order of departure, a row for each of three seeds."""
    task = mg1.task(order="departure")
    return np.stack([np.asarray(task.simulate(jax.random.key(seed), task.truth)) for seed in range(SEEDS)])


def draw_samples(figure: Figure, trajectories: np.ndarray) -> None:
    """Inter-departure times job by job, and in ascending order with the percentiles that inference sees.

    Args:
        figure: an empty figure.
        trajectories: inter-departure times in order of departure, shape [seeds, jobs].
    """
    by_job, by_rank = figure.subplots(1, 2, sharey=True)
    jobs = trajectories.shape[1]
    at = np.asarray(mg1.PERCENTILES) / 100 * (jobs - 1) + 1
    for seed, (times, colour) in enumerate(zip(trajectories, ("#025358", "#F5A025", "#995FDD"), strict=True)):
        by_job.plot(np.arange(1, jobs + 1), times, color=colour, linewidth=0.8, label=f"seed {seed}")
        by_rank.plot(np.arange(1, jobs + 1), np.sort(times), color=colour, linewidth=0.8)
        by_rank.plot(at, np.percentile(times, mg1.PERCENTILES), "o", color=colour, markersize=3.2)
    by_job.set(xlabel="job", ylabel="inter-departure time\n[units of time]")
    by_rank.set(xlabel="rank (dots: percentiles)")
    for axes in (by_job, by_rank):
        axes.grid(True)
    figure.legend(loc="outside upper center", ncols=SEEDS)


def draw_errors(figure: Figure, errors: dict[str, dict[str, np.ndarray]]) -> None:
    """A dot for each seed and their median: errors as they are, with the service times sorted, and of trajectories.

    Args:
        figure: an empty figure.
        errors: errors by configuration and measure, one value per seed.
    """
    look = style.looks(list(errors))
    for axes, (measure, title) in zip(figure.subplots(1, len(PICTURED)), PICTURED.items(), strict=True):
        discrepancy.draw_dots(axes, {name: own[measure] for name, own in errors.items()}, look)
        axes.set_title(title)
    figure.axes[1].set_ylim(figure.axes[0].get_ylim())  # shows that sorted errors are smaller
    figure.axes[0].set_ylabel("sum of |θ − θ$_{gt}$|")
    figure.axes[2].set_ylabel("error [observed sd]")
    seeds = len(next(iter(errors.values()))["plain"])
    legends.of_configurations(figure, look, f"one dot for each of {seeds} seeds, line: median")


def main(arguments: Sequence[str] | None = None) -> None:
    """Write table.md, errors.npz, samples.npz, samples.png and errors.png."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, help="a finished folder of `jaxlfi compare mg1`")
    parser.add_argument("--out", type=Path, default=Path("experiments/results/mg1"))
    given = parser.parse_args(arguments)
    try:
        runs = open_collection(given.runs).runs
    except ValueError as error:
        parser.error(str(error))
    if (names := next(iter(runs.values()))[0].names) != mg1.NAMES:
        parser.error(f"expected runs of mg1, got parameters {', '.join(names)}")
    every = {name: [measures(history) for history in histories] for name, histories in runs.items()}
    errors = {
        name: {measure: np.array([one[measure] for one in own]) for measure in MEASURES} for name, own in every.items()
    }
    given.out.mkdir(parents=True, exist_ok=True)
    arrays = {f"{name}/{measure}": values for name, own in errors.items() for measure, values in own.items()}
    atomic.write_arrays(given.out / "errors.npz", arrays)
    (given.out / "table.md").write_text(table(errors))
    trajectories = sample_trajectories()
    atomic.write_arrays(given.out / "samples.npz", {"trajectories": trajectories})
    with style.context():
        figure = style.new_figure(style.COLUMN_WIDTH, 1.9)
        draw_samples(figure, trajectories)
        style.save(figure, given.out / "samples.png", 300)
        figure = style.new_figure(style.TEXT_WIDTH, 2.5)
        draw_errors(figure, errors)
        style.save(figure, given.out / "errors.png", 300)
    print(table(errors))
    print(f"wrote {given.out}")


if __name__ == "__main__":
    main()
