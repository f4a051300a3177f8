"""Recommending experiments: choosing the most informative ones, predicting their effect, and saving the result."""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np
from jaxtyping import Float

from jaxlfi.design import choosing, played, ridge
from jaxlfi.design.choosing import Chosen, Rated, Rater
from jaxlfi.design.contrastive import FOLDS, SIMULATIONS, ContrastiveRater
from jaxlfi.design.fisher import FisherRater, covariance_after
from jaxlfi.design.regions import INFLATION, POOL, SHARE, is_number, region, regions
from jaxlfi.design.simulations import noise_of
from jaxlfi.distributions.arguments import require_count
from jaxlfi.distributions.support import Support
from jaxlfi.estimators.posterior import Posterior
from jaxlfi.io import files, text_table
from jaxlfi.tasks.experiments import require_design, single
from jaxlfi.tasks.task import Task

Method = Literal["auto", "fisher", "contrastive"]
METHODS = ("auto", "fisher", "contrastive")
RIDGE = "ridge"
"""The name in `about` that stands for the worst-determined direction."""
LISTED = 5
"""Largest number of experiments listed, the chosen one included."""
ON_HOST = 0.25
"""Default numbers of simulations and designs outside JAX, where simulators are slower, as a fraction of JAX's."""
HARDLY = 1.1
"""Smallest factor by which a ridge must become narrower for an experiment to count as acting on it."""
WIDEST = 8
"""Largest number of design variables shown in a table."""
FILE = "design.json"


@dataclasses.dataclass(frozen=True, eq=False)
class Expected:
    """The expected results of some experiments, each by itself.

    Attributes:
        rated: the experiments.
        width: width of each parameter's 90 % interval after the experiment, in natural units, shape [M, D].
        narrower: factor by which the ridge becomes narrower, shape [M].
    """

    rated: Rated
    width: Float[np.ndarray, "designs dim"]
    narrower: Float[np.ndarray, " designs"]


@dataclasses.dataclass(frozen=True, eq=False)
class Recommendation:
    """The experiments that are expected to be most informative. It prints as a table; `save` writes it.

    Attributes:
        task: task of one experiment.
        chosen: experiments to make, the one that adds most first.
        together: expected information of all of them in bits, with its Monte Carlo error.
        widths: width of each parameter's 90 % interval, now and after all of them, in natural units, shape [2, D].
        narrower: factor by which all of them together make the ridge narrower.
        alternatives: best of the other rated designs, each at some distance from the chosen one and from each other.
        nominal: expected results of the nominal experiment, shape [1].
        every: all designs rated for the first experiment.
        spread: number of these, counted from the first, that fill the bounds evenly.
        ridge: worst-determined direction.
        reach: largest factor by which any experiment tried for it makes the ridge narrower.
        about: parameters of interest; () for all.
        method: "fisher" or "contrastive".
        ceiling: upper limit of the information that the method can find, in bits.
        tolerance: largest fraction of the draws for which a chosen experiment may fail.
    """

    task: Task
    chosen: Expected
    together: tuple[float, float]
    widths: Float[np.ndarray, "2 dim"]
    narrower: float
    alternatives: Expected
    nominal: Expected
    every: Rated
    spread: int
    ridge: ridge.Ridge
    reach: float
    about: tuple[str, ...]
    method: str
    ceiling: float
    tolerance: float

    @property
    def designs(self) -> Float[np.ndarray, "experiments k"]:
        """Designs of the experiments to make; `jaxlfi.tasks.experiments.experiments(task, designs)` is their task."""
        return self.chosen.rated.designs

    def table(self) -> tuple[list[str], list[list[str]]]:
        """Headings and rows: the experiments to make, alternatives, and the nominal experiment.

        The values of designs with more than `WIDEST` variables are left out; `designs` and the files have them.
        """
        names = self.task.names
        labels = self.task.design.labels if self._narrow else ()
        head = ["experiment", *labels, "bits", *(f"{name} +-" for name in names), "ridge", "fails"]
        rows = []
        count = len(self.chosen.rated)
        for place in range(count):
            rows.append(self._row(f"{place + 1}", self.chosen, place))
        if count == 1:
            rows += [self._row("or", self.alternatives, place) for place in range(len(self.alternatives.rated))]
        rows.append(self._row("nominal", self.nominal, 0))
        return head, rows

    @property
    def _narrow(self) -> bool:
        return len(self.task.design.variables) <= WIDEST

    def _row(self, label: str, expected: Expected, place: int) -> list[str]:
        rated = expected.rated
        refused = rated.value[place] <= choosing.REFUSED
        bits = "-" if refused else f"{rated.value[place]:.2f} ({rated.error[place]:.2f})"
        widths = [f"{0.5 * width:.3g}" for width in expected.width[place]]
        numbers = [f"{value:.4g}" for value in rated.designs[place]] if self._narrow else []
        return [label, *numbers, bits, *widths, f"{expected.narrower[place]:.2g}x", f"{rated.failing[place]:.0%}"]

    def sentences(self) -> list[str]:
        """The conclusions in words."""
        some = self.every.value[1 : self.spread]
        some = some[some > choosing.REFUSED]
        count = len(self.chosen.rated)
        what = f" about {', '.join(self.about)}" if self.about else ""
        least = ", at least" if self.method == "contrastive" else ""
        bits, error = self.together
        line = f"Expected information{what}{least}: {bits:.2f} bits (error {error:.2f})"
        if count > 1:
            line += f" of {count} experiments"
        elif len(some):
            line += f"; the median of {len(some)} others is {np.median(some):.2f}"
        found = [f"{line}."]
        if bits > self.ceiling - 1:
            found.append(
                f"That is near the {self.ceiling:.1f} bits which so many simulations can show: there may be more "
                "(--simulations)."
            )
        units = [f" {unit}" if unit else "" for unit in self.task.units]
        now, after = 0.5 * self.widths
        halves = [f"{name} from +-{now[d]:.3g} to +-{after[d]:.3g}{units[d]}" for d, name in enumerate(self.task.names)]
        found.append(f"Expected 90 % intervals: {', '.join(halves)}.")
        return [*found, self._of_ridge()]

    def _of_ridge(self) -> str:
        name = self.ridge.name
        are = "are" if " and " in self.ridge.known else "is"
        known = f" (only {self.ridge.known} {are} well determined)" if self.ridge.known else ""
        if self.reach < HARDLY:
            return (
                f"Ridge: no experiment within the bounds determines {name}{known}: of all that were rated, the best "
                f"makes it {self.reach:.2f} times narrower. Measure one of its parameters by itself, or allow an "
                "experiment that changes them apart, such as one with a known load."
            )
        times = f"{self.narrower:.2g} times narrower"
        if self.narrower >= ridge.BROKEN:
            return f"Ridge: broken; {name}{known} becomes {times}."
        best = f", at best {self.reach:.2g} times (--about {RIDGE})" if self.reach > 1.05 * self.narrower else ""
        return f"Ridge: {name}{known} becomes {times}{best}."

    def __repr__(self) -> str:
        return "\n".join([text_table.as_text(*self.table()), "", *self.sentences()])

    def _repr_html_(self) -> str:
        return text_table.as_html(*self.table()) + "".join(f"<p>{line}</p>" for line in self.sentences())

    def to_json(self) -> dict[str, Any]:
        """The recommendation as plain numbers and strings."""
        expected = lambda one: {
            "designs": one.rated.designs.tolist(),
            "bits": _finite(one.rated.value),
            "error": one.rated.error.tolist(),
            "fails": one.rated.failing.tolist(),
            "interval_widths": one.width.tolist(),
            "ridge_narrower": one.narrower.tolist(),
        }
        return {
            "format": "design",
            "task": self.task.name,
            "method": self.method,
            "about": list(self.about),
            "variables": [dataclasses.asdict(one) for one in self.task.design.variables],
            "parameters": list(self.task.names),
            "units": list(self.task.units),
            "together": {"bits": self.together[0], "error": self.together[1], "ridge_narrower": self.narrower},
            "interval_widths": {"now": self.widths[0].tolist(), "after": self.widths[1].tolist()},
            "chosen": expected(self.chosen),
            "alternatives": expected(self.alternatives),
            "nominal": expected(self.nominal),
            "ridge": {"name": self.ridge.name, "known": self.ridge.known, "at_best_narrower": self.reach},
            "ceiling": self.ceiling if np.isfinite(self.ceiling) else None,
            "tolerance": self.tolerance,
            "sentences": self.sentences(),
        }

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays that the picture is drawn from."""
        return {
            "labels": np.array(self.task.design.labels),
            "names": np.array(self.task.names),
            "units": np.array(self.task.units),
            "low": self.task.design.low,
            "high": self.task.design.high,
            "designs": self.every.designs,
            "bits": np.where(self.every.value > choosing.REFUSED, self.every.value, np.nan),
            "spread": np.array(self.spread),
            "chosen": self.chosen.rated.designs,
            "chosen_bits": self.chosen.rated.value,
            "nominal_bits": np.where(self.nominal.rated.value > choosing.REFUSED, self.nominal.rated.value, np.nan),
            "widths": self.widths,
        }

    def save(self, folder: str | Path) -> Path:
        """Write design.json, designs.csv, design.npz (for the picture), and the controls of each chosen experiment.

        Controls are written as CSV, and as MCAP if the extra `robotics` is installed.

        Raises:
            ValueError: if the folder is not empty or the path is a file.
        """
        folder = Path(folder)
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise ValueError(f"out: expected a new or empty folder, got {folder}")
        folder.mkdir(parents=True, exist_ok=True)
        files.write_json(folder / FILE, self.to_json())
        head = [*self.task.design.labels, "bits", "error", "fails"]
        rows = [
            [*(f"{value:.6g}" for value in self.every.designs[place]), *self._numbers(place)]
            for place in np.argsort(-self.every.value, kind="stable")
        ]
        files.write_bytes(folder / "designs.csv", text_table.as_csv(head, rows).encode())
        files.write_arrays(folder / "design.npz", self.arrays())
        if self.task.design.controls is not None:
            for place, design in enumerate(self.designs):
                played.write(folder / f"experiment_{place + 1}", *self.task.design.controls(design))
        return folder

    def _numbers(self, place: int) -> list[str]:
        value = self.every.value[place]
        bits = "" if value <= choosing.REFUSED else f"{value:.4f}"
        return [bits, f"{self.every.error[place]:.4f}", f"{self.every.failing[place]:.4f}"]


def recommend(
    key: jax.Array,
    task: Task,
    posterior: Posterior,
    box: Support,
    feasible: Support,
    start: Support,
    experiments: int = 1,
    about: str | Sequence[str] = (),
    method: Method = "auto",
    inflation: float = INFLATION,
    share: float = SHARE,
    tolerance: float = choosing.TOLERANCE,
    rated: int | None = None,
    simulations: int | None = None,
    advanced: Callable[[int], None] = lambda designs: None,
) -> Recommendation:
    """Choose experiments; see `jaxlfi.Run.design`.

    Args:
        key: random key.
        task: task with a design, of one experiment or of several.
        posterior: current posterior.
        box: support that a heuristic has moved to, in inference space.
        feasible: limits Phi, in inference space.
        start: initial support of the inference, in inference space; ridges are measured in its widths.
        experiments: number of experiments to choose.
        about: parameters of interest, or "ridge"; all by default.
        method: "fisher", "contrastive", or "auto": Fisher information if the noise is declared.
        inflation: width of the distribution that designs are rated over, relative to the posterior.
        share: weight of the box.
        tolerance: largest fraction of draws for which an experiment may fail.
        rated: number of designs rated for each experiment; by default 300, and a quarter outside JAX.
        simulations: simulations of each design by the contrastive method; by default 1024, and a quarter outside JAX.
        advanced: called with the number of designs rated since its last call.

    Raises:
        ValueError: for a task without a design, unknown names, numbers out of range, or if all designs fail.
    """
    require_design(task)
    task = single(task)
    wanted = (about,) if isinstance(about, str) or not isinstance(about, Sequence) else tuple(about)
    if unknown := [name for name in wanted if not isinstance(name, str) or name not in (*task.names, RIDGE)]:
        raise ValueError(
            f"about: expected some of {', '.join(task.names)}, or {RIDGE}, got {', '.join(map(str, unknown))}"
        )
    rated = default(task, choosing.RATED) if rated is None else rated
    simulations = default(task, SIMULATIONS) if simulations is None else simulations
    require_effort(experiments, rated, simulations, tolerance)
    method = chosen_method(task, method)
    key_draws, key_regions, key_rater, key_search = jax.random.split(key, 4)
    draws = np.asarray(posterior.sample(key_draws, POOL, "inference"))
    natural = np.asarray(task.space.to_natural(draws))
    now = region(1.0, draws)
    widths = np.asarray(start.width, float)
    worst = ridge.ridge(task.names, task.space.log, now, natural, widths)
    rows = _rows(task, wanted, worst)
    places = regions(key_regions, posterior, box, feasible, inflation, share)
    rater: Rater
    if method == "fisher":
        rater = FisherRater(key_rater, task, places, rows)
    else:
        rater = ContrastiveRater(key_rater, task, places, rows, simulations)
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key_search)))
    found = choosing.choose(rater, rng, experiments, rated, tolerance, advanced)
    return _summed_up(task, rater, found, now, natural, worst, wanted, method, tolerance)


def require_effort(experiments: int, rated: int, simulations: int, tolerance: float) -> None:
    """Refuse arguments of `recommend` that are out of range.

    Raises:
        ValueError: naming the argument.
    """
    require_count(experiments, "experiments", most=100)
    require_count(rated, "rated", most=1_000_000)
    require_count(simulations, "simulations", most=POOL)
    for name, value, least in (("rated", rated, 2 * choosing.CHUNK), ("simulations", simulations, 16 * FOLDS)):
        if value < least:
            raise ValueError(f"{name}: expected at least {least}, got {value}")
    if not (is_number(tolerance) and 0 <= tolerance < 1):
        raise ValueError(f"tolerance: expected a share from 0 and below 1, got {tolerance!r}")


def default(task: Task, number: int) -> int:
    """The default number of designs or simulations, which is smaller for simulators outside JAX."""
    return int(number * (ON_HOST if task.on_host else 1.0))


def chosen_method(task: Task, method: str) -> Literal["fisher", "contrastive"]:
    """The method used to rate a task's designs, with "auto" resolved.

    Raises:
        ValueError: for an unknown method, or one that needs a noise or response that the task does not declare.
    """
    if not isinstance(method, str) or method not in METHODS:
        raise ValueError(f"method: expected one of {', '.join(METHODS)}, got {method!r}")
    smooth = noise_of(task) is not None and (task.design.response is not None or not task.on_host)
    if method == "fisher" and task.on_host and not smooth:
        raise ValueError("method: expected a declared noise and response for fisher outside JAX, got none: contrastive")
    if method == "auto":
        return "fisher" if smooth else "contrastive"
    return "fisher" if method == "fisher" else "contrastive"


def _rows(task: Task, about: tuple[str, ...], worst: ridge.Ridge) -> np.ndarray | None:
    identity = np.eye(task.dim)
    rows = [worst.row if name == RIDGE else identity[task.names.index(name)] for name in about]
    return np.stack(rows) if rows else None


def _summed_up(task, rater, found: Chosen, now, natural, worst, wanted, method, tolerance) -> Recommendation:
    """The expected results of the chosen designs and of the others."""
    interval = np.quantile(natural, [0.05, 0.95], axis=0)
    width = interval[1] - interval[0]
    before = np.sqrt(np.diagonal(now.covariance))

    def after(matrices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Widths of intervals [M, D], and the factors by which the ridge is narrower [M]."""
        covariance = covariance_after(now.factor, matrices)
        ratio = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1)) / before
        return width * ratio.mean(axis=1), 1 / np.mean(1 / worst.narrower(now, matrices), axis=1)

    def expected(rated: Rated) -> tuple[Expected, np.ndarray]:
        matrices = rater.precision(rated.designs)
        return Expected(rated, *after(matrices)), matrices

    rated = found.rated
    best = [place for place in choosing.distinct(task, rated, LISTED + 1) if rated.value[place] > choosing.REFUSED]
    chosen, matrices = expected(found.batch)
    alternatives, _ = expected(rated.rows(best))
    far = np.linalg.norm(
        task.design.to_unit(alternatives.rated.designs) - task.design.to_unit(chosen.rated.designs[:1]), axis=1
    )
    apart = np.flatnonzero(far > choosing.APART * np.sqrt(len(task.design.variables)))[: LISTED - 1]
    alternatives = Expected(alternatives.rated.rows(apart), alternatives.width[apart], alternatives.narrower[apart])
    nominal, _ = expected(rated.rows([0]))
    evenly = rated.rows(np.arange(found.spread))
    evenly = evenly.rows(np.flatnonzero(evenly.value > choosing.REFUSED))
    by_others = expected(evenly)[0].narrower if len(evenly) else np.zeros(0)
    reach = float(max([*by_others, *chosen.narrower]))
    together_width, together_narrower = after(matrices.sum(axis=0)[None])
    return Recommendation(
        task=task,
        chosen=chosen,
        together=found.together,
        widths=np.stack([width, together_width[0]]),
        narrower=float(together_narrower[0]),
        alternatives=alternatives,
        nominal=nominal,
        every=rated,
        spread=found.spread,
        ridge=worst,
        reach=max(reach, float(together_narrower[0])) if len(found.batch) > 1 else reach,
        about=wanted,
        method=method,
        ceiling=rater.ceiling,
        tolerance=tolerance,
    )


def _finite(values: np.ndarray) -> list[float | None]:
    return [float(value) if value > choosing.REFUSED else None for value in values]
