"""Conclusions about a run in sentences: whether the model fits, what failed, whether it settled, what to do next.

As in `jaxlfi.runs.summarise`, they state only what was measured on this run.
"""

import jax
import numpy as np
from jaxtyping import Array, Float

from jaxlfi.bayessim.convergence import LAG, changes
from jaxlfi.diagnostics.identifiability import listed
from jaxlfi.diagnostics.misspecification import RECORDS
from jaxlfi.diagnostics.predictive import MIN_RESIDUALS, Residual, residuals
from jaxlfi.io.run_summary import UNSAVED, RunSummary
from jaxlfi.runs.result import Result
from jaxlfi.runs.summarise import summarised
from jaxlfi.runs.unlike import names_of, observation_findings

COMMONEST = 3
"""Largest number of failure reasons that are named."""
CHANNELS = 4
"""Largest number of channels that are named: those with the largest residuals."""
ALL = ""
"""Name for all numbers of an observation together."""
EDGE = "A support that can grow: `--heuristic edge`, or `heuristic=jaxlfi.Edge()`."
LOOK = "Look at the misfit: `jaxlfi report FOLDER` draws simulations from the posterior beside the observation."
POLISH = "Sharper intervals by least squares and the likelihood of simulations: `--polish`, or `polish=True`."
DIAGNOSE = "Check the widths of the intervals: `run.save(FOLDER)`, then `jaxlfi diagnose FOLDER`."
DIAGNOSE_OWN = (
    "Check the widths of the intervals: `run.save(FOLDER)`, then `jaxlfi diagnose FOLDER --task MODULE:TASK`, where "
    "TASK is the task's name in the file MODULE.py."
)
"""Advice for a task defined in Python: the command line needs its module."""


def summary(run: Result, draws: Float[Array | np.ndarray, "n dim"]) -> RunSummary:
    """Summarise a run: its parameters, from posterior draws in natural units, and the run as a whole."""
    rule = getattr(run.heuristic, "rule", run.heuristic)
    found = summarised(
        np.asarray(draws),
        run.space,
        run.units,
        (run.support, run.belief.support, run.feasible),
        None if run.task is None else run.task.truth,
        type(rule).__name__.upper(),
    )
    return account(run, found)


def account(run: Result, found: RunSummary) -> RunSummary:
    """Add sentences about the run as a whole, and all next steps, to the summary of its parameters."""
    strange = _observation(run)
    fit, fits = _fit(run, bool(strange))
    settled, more = _settled(run)
    polish, sharper = _polish(run)
    first = [LOOK] * bool(strange or not fits) + [EDGE] * _held_back(run, found) + more
    steps = (*first, *found.next_steps, *sharper, *[_diagnose(run)] * (not first and run.unpolished is None))
    sentences = (*found.sentences, *polish, strange, fit, _failures(run), settled)
    return RunSummary(found.parameters, tuple(filter(None, sentences)), steps)


def _polish(run: Result) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Sentences on how the posterior was polished, and next steps; or the step to polish it."""
    if run.polish is not None:
        return run.polish.sentences, run.polish.steps
    return (), () if run.task is None or run.task.polish is None else (POLISH,)


def _diagnose(run: Result) -> str:
    return DIAGNOSE_OWN if run.origin.reference is None else DIAGNOSE


def _held_back(run: Result, found: RunSummary) -> bool:
    """Whether the posterior leans on a bound that is not Phi's and that the heuristic cannot move."""
    box, phi = jax.device_get((run.belief.support, run.feasible))
    inside = {"lower": box.low > phi.low + 1e-5 * phi.width, "upper": box.high < phi.high - 1e-5 * phi.width}
    leans = [inside[side][d] for d, one in enumerate(found.parameters) for side in one.leans]
    return not run.heuristic.grows and any(leans)


def _observation(run: Result) -> str:
    """A sentence that names in what the observation is unlike all simulations; "" if in nothing."""
    found = [one.name for one in observation_findings(run)]
    if not found:
        return ""
    return f"The observation is unlike all simulations in {listed(found)}: its posterior cannot be relied on."


def _fit(run: Result, strange: bool) -> tuple[str, bool]:
    """Whether simulations from the posterior look like the observation: in words, and as a flag, true if unknown.

    A fit is never stated for an observation that is unlike all simulations.
    """
    count = int(np.asarray(run.history.get("predictive_simulations", [0]))[-1])
    if not count:
        return "", True
    names, simulated, observed = channels(run)
    valid = simulated[np.isfinite(simulated).all(axis=(1, 2))]
    if len(valid) < MIN_RESIDUALS:
        return (
            f"Only {len(valid)} of {count} simulations from the posterior succeeded: too few to see whether it fits.",
            True,
        )
    return fit_sentence(names, residuals(valid, observed), strange)


def channels(run: Result) -> tuple[list[str], np.ndarray, np.ndarray]:
    """Quantities by which simulations from the posterior are compared: a series' channels, or the summary's numbers.

    Returns:
        Names [C], simulations [N, T, C] and the observation [T, C].
    """
    observed, x = np.asarray(run.observed), np.asarray(run.x)
    series: tuple[str, ...]
    names, series = (run.summary_names, ()) if run.task is None else names_of(run.task, observed.shape, len(x))
    known = () if run.task is None else tuple(run.task.channels)
    if len(observed) > 1 and (observed.ndim == 2 or (observed.ndim == 1 and len(known) == 1)):
        count = observed.reshape(len(observed), -1).shape[1]
        series = known if len(known) == count else tuple(f"channel {c + 1}" for c in range(count))
    if len(series) == 1:  # a single channel needs no name
        series = (ALL,)
    if series:
        observed = observed.reshape(len(observed), -1)
        return list(series), np.asarray(run.history["final_trajectory"]).reshape(-1, *observed.shape), observed
    simulated = np.asarray(run.history["final_x"])
    named = run.task is not None and run.task.summary_names
    if named or len(x) < RECORDS:
        return list(names), simulated[:, None], x[None]
    # Many unnamed numbers with different units are taken together, in units of their scatter.
    finite = simulated[np.isfinite(simulated).all(axis=1)]
    scale = finite.std(axis=0) if len(finite) else np.ones(len(x))
    scale = np.where(scale > 0, scale, np.inf)[:, None]
    return [ALL], simulated[..., None] / scale, x[:, None] / scale


def fit_sentence(names: list[str], found: list[Residual], strange: bool = False) -> tuple[str, bool]:
    """Whether a model fits, in words.

    Args:
        names: names of the channels.
        found: residuals of the channels.
        strange: whether the observation is unlike all simulations.

    Returns:
        The sentence, "" if nothing scatters, and whether the model fits.

    Example:
        >>> fit_sentence(["arm", "pendulum"], [Residual(1.1, 1.4), Residual(9.0, 1.3)])[0]
        'Simulations from the posterior miss the observation: its residual is 9.0 times their scatter in pendulum \
(1.1 in arm). The model lacks something there.'
    """
    known = [(one, name) for one, name in zip(found, names, strict=True) if np.isfinite(one.ratio)]
    known = sorted(known, key=lambda pair: -pair[0].ratio)
    if not known:
        return "", True
    far, near = ([pair for pair in known if pair[0].far == wanted] for wanted in (True, False))
    if not far:
        rest = f", and no more in {len(known) - CHANNELS} others" if len(known) > CHANNELS else ""
        if strange:
            return f"Its residual from simulations from the posterior is {_listed(near)}{rest}.", True
        return f"Simulations from the posterior fit the observation: its residual is {_listed(near)}{rest}.", True
    rest = f" ({_listed(near, '')})" if near else ""
    there = " there" * any(name for _, name in far)
    return (
        f"Simulations from the posterior miss the observation: its residual is {_listed(far)}{rest}. The model lacks "
        f"something{there}."
    ), False


def _listed(pairs: list[tuple[Residual, str]], unit: str = " times their scatter") -> str:
    """The largest residuals with their channels, in words."""
    texts = [
        f"{one.ratio:.1f}{'' if place else unit}{f' in {name}' if name else ''}"
        for place, (one, name) in enumerate(pairs[:CHANNELS])
    ]
    return listed(texts)


def _failures(run: Result) -> str:
    """How many simulations failed, and the most common reasons."""
    found = run.failures
    if not found:
        return ""
    attempted = int(np.sum(run.history["attempted"]))
    reasons = [f"{one.count:,} {one.reason}{f' ({one.message})' if one.message else ''}" for one in found[:COMMONEST]]
    head = f"{sum(one.count for one in found):,} of {attempted:,} simulations failed"
    return (
        f"{head}, the most common reasons: {'; '.join(reasons)}."
        if len(found) > COMMONEST
        else f"{head}: {'; '.join(reasons)}."
    )


def _settled(run: Result) -> tuple[str, list[str]]:
    """A sentence on whether the posterior still changed from round to round, and the step to make more rounds.

    A polished posterior does not come from the rounds: the one that polishing began from is mentioned only if it was
    still changing.
    """
    history = {
        name: np.asarray(run.history[name])
        for name in ("moved", "rescaled", "turned", "settled")
        if name in run.history
    }
    made = 1 if "settled" not in history else int(np.count_nonzero(~history["settled"][:-1])) + 1
    if made == 1 or len(history) < 4:
        return "", []
    rounds = 2 * made
    again = f"{UNSAVED}`settings=run.settings.replace(rounds={rounds})`"
    more = [f"More rounds: `jaxlfi resume FOLDER --rounds {rounds}`{again}."]
    last = [float(history[name][-1]) for name in ("moved", "rescaled", "turned")]
    known = np.isfinite(last).all()
    if run.unpolished is not None:
        return _unsettled("The posterior that polishing began from", made, changes(*last) if known else []), []
    if not known:
        return f"{made} rounds are too few to tell whether the posterior has settled: that takes more than {LAG}.", more
    if still := _unsettled("The posterior", made, changes(*last)):
        return still, more
    return f"The posterior settled: over the last {LAG} of {made} rounds it hardly changed.", []


def _unsettled(what: str, made: int, still: list[str]) -> str:
    """A sentence on how a posterior still changed; "" if it did not."""
    if not still:
        return ""
    return f"{what} had not settled after {made} rounds: over the last {LAG}, it changed its {listed(still)}."
