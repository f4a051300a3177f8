"""Exact posteriors of cases, on Phi or on any box: made once, kept as arrays, and read by all later runs.

    python -m experiments.sharpness.references --problems all --seeds 8 --truths 40

makes those that are missing; those of problems that are `kept` are stored next to the results.
"""

import argparse
import dataclasses
import functools
from pathlib import Path

from jaxlfi.io import compile_cache, host_devices

if __name__ == "__main__":  # before jax starts
    host_devices.divide()
    compile_cache.enable()

import jax
import jax.numpy as jnp
import numpy as np

from experiments.sharpness import oracle
from experiments.sharpness.problem import Case, Problem, case_of
from jaxlfi.io import files as atomic
from jaxlfi.io.provenance import environment

KEPT = Path("experiments/results/sharpness/references")
"""Folder for problems whose references take long."""
CACHE = Path("runs/sharpness/references")
"""Folder for all others, which are made in a second or two if missing; remove it if a problem changes."""
DRAWS = 4000
DRAWS_KEPT = 2000
LEAST_DRAWS = 1000
"""Draws of the posterior on Phi that a box has to contain; if there are fewer, a new reference is made on the box."""
FEWER = oracle.Effort(particles=256, moves=3, centres=256, draws=3000)
"""Effort for likelihoods by a particle filter or MuJoCo, which cost a thousand times as much as others."""


@dataclasses.dataclass(frozen=True)
class Reference:
    """Draws of the exact posterior on a box.

    Attributes:
        draws: in inference space, shape [N, D].
        log_density: of each, up to a constant, shape [N].
        truth_log_density: of the case's truth, by the same constant; -inf outside of the box.
        size: effective size.
    """

    draws: np.ndarray
    log_density: np.ndarray
    truth_log_density: float
    size: float

    def within(self, low: np.ndarray, high: np.ndarray, truth: np.ndarray) -> "Reference":
        """The draws that lie in a box: those of the posterior that is truncated to it."""
        inside = np.all((self.draws >= low) & (self.draws <= high), axis=1)
        held = bool(np.all((truth >= low) & (truth <= high)))
        size = self.size * inside.mean()
        return Reference(
            self.draws[inside], self.log_density[inside], self.truth_log_density if held else -np.inf, size
        )


@functools.lru_cache(maxsize=16)
def _likelihoods(problem: Problem):
    """Log-likelihoods of a batch in inference space, compiled."""

    def one(key, theta, x):
        return problem.log_likelihood(key, problem.task.space.to_natural(theta), x)

    if problem.estimated:  # a thousand particles each: in parallel they would not fit into a cache
        many = lambda keys, theta, x: jax.lax.map(lambda pair: one(*pair, x), (keys, theta), batch_size=16)
    else:
        many = jax.vmap(one, in_axes=(0, 0, None))
    return jax.jit(many)


def _log_likelihood(problem: Problem, x: np.ndarray) -> oracle.LogDensity:
    if problem.host_log_likelihood is not None:
        natural = lambda theta: np.asarray(problem.task.space.to_natural(jnp.asarray(theta, jnp.float32)), float)
        return lambda theta, seed: problem.host_log_likelihood(natural(theta), x)
    many, observed = _likelihoods(problem), jnp.asarray(x)

    def log_likelihood(theta, seed):
        keys = jax.random.split(jax.random.key(seed), len(theta))
        return np.asarray(many(keys, jnp.asarray(theta, jnp.float32), observed), float)

    return log_likelihood


@functools.lru_cache(maxsize=16)
def _prior(problem: Problem):
    return jax.jit(problem.task.inference.prior.log_prob)


def _log_prior(problem: Problem, theta: np.ndarray) -> np.ndarray:
    if problem.prior is None:
        return np.zeros(len(theta))
    return np.asarray(_prior(problem)(jnp.asarray(theta, jnp.float32)), float)


def _prior_draws(problem: Problem, low: np.ndarray, high: np.ndarray, count: int, seed: int) -> np.ndarray:
    """Draws of the prior on a box; a task's own prior weights uniform draws, as the box may hold little of it."""
    rng = np.random.default_rng(seed)
    if problem.prior is None:
        return rng.uniform(low, high, (count, problem.dim))
    uniform = rng.uniform(low, high, (50 * count, problem.dim))
    weight = np.exp(_log_prior(problem, uniform))
    return uniform[rng.choice(len(uniform), count, p=weight / weight.sum())]


def made(case: Case, low: np.ndarray, high: np.ndarray, count: int = DRAWS, seed: int = 0) -> Reference:
    """The exact posterior of a case on a box in inference space.

    Raises:
        ValueError: where its effective size is too small.
    """
    problem, x = case.problem, np.asarray(case.x, float)
    held = bool(np.all((case.truth >= low) & (case.truth <= high)))
    if problem.linear is not None:
        matrix, noise = problem.linear.matrix, problem.linear.noise
        count = min(count, 2000) if problem.dim > 10 else count
        found = oracle.linear_draws(matrix, noise, x, low, high, count=count, seed=seed)
        at_truth = -0.5 * np.sum(((matrix @ case.truth - x) / noise) ** 2)
    else:
        effort = FEWER if problem.kept else oracle.Effort()
        log_likelihood = _log_likelihood(problem, case.x)
        log_prior = functools.partial(_log_prior, problem)
        start = _prior_draws(problem, low, high, effort.particles, seed)
        try:
            found = oracle.importance_draws(
                log_likelihood, log_prior, start, low, high, count=count, seed=seed, effort=effort
            )
        except ValueError as error:
            raise ValueError(f"{problem.name}, {case.label}: {error}") from None
        repeats = 64 if problem.estimated else 1
        truths = np.tile(case.truth, (repeats, 1))
        at_truth = np.median(log_likelihood(truths, seed + 1)) + log_prior(truths)[0]
    return Reference(found.theta, found.log_density, float(at_truth) if held else -np.inf, found.size)


def _path(case: Case) -> Path:
    return (KEPT if case.problem.kept else CACHE) / case.problem.name / f"{case.label}.npz"


def referenced_case(problem: Problem, kind: str, seed: int) -> Case:
    """The case of a seed, with the observation of its kept reference.

    Simulations of a chaotic model differ between machines, as rounding does.
    """
    case = case_of(problem, kind, seed)
    path = _path(case)
    return dataclasses.replace(case, x=atomic.read_arrays(path)["x"]) if problem.kept and path.exists() else case


def reference(case: Case) -> Reference:
    """The exact posterior of a case on Phi: read, or made and saved."""
    problem, path = case.problem, _path(case)
    if path.exists():
        arrays = atomic.read_arrays(path)
        if np.allclose(arrays["x"], case.x, rtol=1e-4, atol=1e-6 * np.max(np.abs(case.x))):
            return Reference(
                *(np.asarray(arrays[name], float) for name in ("draws", "log_density")),
                *(float(arrays[name]) for name in ("truth_log_density", "size")),
            )
    found = made(case, *problem.phi, count=DRAWS_KEPT if problem.kept else DRAWS, seed=case.seed)
    arrays = {
        "draws": found.draws.astype(np.float32),
        "log_density": found.log_density.astype(np.float32),
        "truth_log_density": np.float32(found.truth_log_density),
        "size": np.float32(found.size),
        "seed": np.int64(case.seed),
        "x": np.asarray(case.x, np.float32),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    atomic.write_arrays(path, arrays)
    if problem.kept:
        atomic.write_json(path.parent / "config.json", {"problem": problem.name, **environment()})
    return found


def on_box(case: Case, whole: Reference, low: np.ndarray, high: np.ndarray) -> Reference | None:
    """The exact posterior on a box, from that on Phi if enough of it lies inside.

    None if a new one would take long, or if there is none, as for a box that is far from all that the data allow.
    """
    found = whole.within(low, high, case.truth)
    if len(found.draws) >= LEAST_DRAWS:
        return found
    if case.problem.kept:
        return None
    try:
        return made(case, low, high, seed=case.seed)
    except ValueError:
        return None


def main(argv: list[str] | None = None) -> None:
    """Make the references that are missing."""
    from experiments.sharpness.catalogue import chosen

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--problems", nargs="+", default=["all"])
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--truths", type=int, default=0)
    arguments = parser.parse_args(argv)
    for problem in chosen(arguments.problems):
        for kind, count in (("own", arguments.seeds), ("near", arguments.truths)):
            for seed in range(arguments.first_seed, arguments.first_seed + count):
                case = referenced_case(problem, kind, seed)
                try:
                    print(f"{problem.name} {case.label}: effective size {reference(case).size:.0f}", flush=True)
                except ValueError as error:
                    print(error, flush=True)


if __name__ == "__main__":
    main()
