"""What a run says of itself: each sentence on a run for which it must be said, and on one for which it must not."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlfi
from jaxlfi.diagnostics.predictive import FAR, Residual, residuals
from jaxlfi.io.run_summary import ParameterSummary, RunSummary
from jaxlfi.runs.account import DIAGNOSE, DIAGNOSE_OWN, EDGE, LOOK, account, fit_sentence
from jaxlfi.tasks.failures import FailureLog, Message
from jaxlfi.tasks.gaps import with_gaps
from tests.small import settings, whole_runs  # noqa: F401

TIMES = np.linspace(0.0, 3.0, 12)
CHANNELS = ("arm angle", "pendulum angle")


def simulate(key, theta):
    """Two channels, each a line of its own slope with noise."""
    return theta * jnp.asarray(TIMES)[:, None] + 0.1 * jax.random.normal(key, (len(TIMES), 2))


def task(channels=CHANNELS, **changes):
    box = jaxlfi.Support([-1.0, -1.0], [1.0, 1.0])
    return jaxlfi.Task(
        simulate, ("slope", "drift"), {"box": box}, jaxlfi.Support([-4.0] * 2, [4.0] * 2), channels=channels, **changes
    )


@pytest.fixture(scope="module")
def run():
    """A run whose posterior fits: its simulations are replaced in some tests."""
    observed = np.asarray(simulate(jax.random.key(5), jnp.array([0.3, -0.2])))
    return jaxlfi.infer(jax.random.key(0), task(), observed, settings=settings(rounds=4))


def summarised(run, **history) -> RunSummary:
    """The summary of the run with other numbers in its history."""
    changed = {name: jnp.asarray(value) for name, value in history.items()}
    return account(run.replace(history=run.history | changed), RunSummary(parameters(), ()))


def parameters(**changes):
    """Two that are identified."""
    one = {"unit": "", "median": 0.0, "central_50": (-0.1, 0.1), "central_90": (-0.2, 0.2), "truth": None}
    one |= {"narrower": 5.0, "narrower_than_phi": 20.0, "verdict": "identified", "leans": (), "decimals": 2}
    return tuple(ParameterSummary(name=name, **(one | changes)) for name in ("slope", "drift"))


STILL = {"moved": [np.inf, np.inf, np.inf, 0.1], "rescaled": [np.inf] * 3 + [1.1], "turned": [np.inf] * 3 + [0.1]}
"""A posterior that has settled after four rounds."""


def around(run, misses=(0.0, 0.0)):
    """Simulations about the observation, off it by so many times their scatter in each channel."""
    noise = np.random.default_rng(0).normal(0.0, 0.1, (20, len(TIMES), 2))
    return np.asarray(run.observed) + 0.1 * np.asarray(misses) + noise


def begins(found: RunSummary, *words: str) -> list[bool]:
    return [any(sentence.startswith(one) for sentence in found.sentences) for one in words]


@pytest.mark.slow
def test_a_model_that_fits_is_said_to_do_so(run):
    found = summarised(run, final_trajectory=around(run), **STILL)
    (sentence,) = [one for one in found.sentences if one.startswith("Simulations from the posterior fit")]
    assert "times their scatter in" in sentence and all(channel in sentence for channel in CHANNELS)
    assert found.next_steps == (DIAGNOSE_OWN,)


def test_a_channel_that_the_model_misses_is_named(run):
    found = summarised(run, final_trajectory=around(run, (0.0, 9.0)), **STILL)
    assert begins(found, "Simulations from the posterior fit", "Simulations from the posterior miss") == [False, True]
    (sentence,) = [one for one in found.sentences if "miss the observation" in one]
    ratio = residuals(around(run, (0.0, 9.0)), run.observed)[1].ratio
    assert f"its residual is {ratio:.1f} times their scatter in pendulum angle (" in sentence and 8 < ratio < 10
    assert sentence.endswith("in arm angle). The model lacks something there.") and found.next_steps == (LOOK,)


def test_the_only_channel_needs_no_name(run):
    observed, x = np.asarray(run.observed)[:, :1], run.dataset.x[:, ::2]
    alone = run.replace(task=task(channels=("in bed",)), observed=observed, x=observed.ravel())
    found = summarised(alone.replace(dataset=run.dataset.replace(x=x)), final_trajectory=around(run)[..., :1], **STILL)
    (sentence,) = [one for one in found.sentences if one.startswith("Simulations from the posterior fit")]
    assert sentence.endswith(" times their scatter.")
    vector = alone.replace(observed=np.where(np.arange(len(TIMES)) == 3, np.nan, observed[:, 0]))
    gappy = with_gaps(vector.task, np.isnan(vector.observed))
    x = x[:, np.arange(len(TIMES)) != 3]
    vector = vector.replace(task=gappy, x=vector.observed[~np.isnan(vector.observed)])
    found = summarised(vector.replace(dataset=run.dataset.replace(x=x)), final_trajectory=around(run)[..., 0], **STILL)
    (sentence,) = [one for one in found.sentences if one.startswith("Simulations from the posterior fit")]
    assert sentence.endswith(" times their scatter.")


def test_where_nothing_was_simulated_nothing_is_said_of_the_fit(run):
    failed = np.full((20, len(TIMES), 2), np.nan)
    failed[:3] = around(run)[:3]
    found = summarised(run, final_trajectory=failed)
    assert begins(found, "Only 3 of 20 simulations from the posterior succeeded") == [True]
    found = summarised(run, final_trajectory=np.full_like(failed, np.nan), predictive_simulations=[0] * 4)
    assert not any("simulations from the posterior" in one.lower() for one in found.sentences)


def test_residuals_are_those_of_the_channels():
    rng = np.random.default_rng(1)
    simulated, observed = rng.normal(3.0, [1.0, 10.0], (20, 400, 2)), rng.normal(3.0, [2.0, 10.0], (400, 2))
    two, one = residuals(simulated, observed)
    assert two.ratio == pytest.approx(2.0, rel=0.1) and one.ratio == pytest.approx(1.0, rel=0.1)
    assert one.usual == two.usual == pytest.approx(1.0, abs=0.2) and not one.far and not two.far
    constant = np.concatenate([simulated, np.zeros((20, 400, 1))], axis=2)
    assert np.isnan(residuals(constant, np.concatenate([observed, observed[:, :1]], axis=1))[2].ratio)
    with pytest.raises(ValueError, match=r"^simulated, observed: expected shapes \[N, T, C\] with N of at least 8"):
        residuals(simulated[:7], observed)


def test_a_model_is_compared_with_what_there_is_of_an_observation(run):
    """Missing values, and what the simulations are in their places, have no say."""
    observed = np.array(run.observed)
    observed[3], observed[5:9, 0] = np.nan, np.nan
    simulated = around(run, (0.0, 9.0))
    simulated[:, 5:9, 0] += 1e3
    found = summarised(run.replace(observed=observed), final_trajectory=simulated, **STILL)
    (sentence,) = [one for one in found.sentences if "miss the observation" in one]
    assert "in pendulum angle (" in sentence and sentence.endswith("in arm angle). The model lacks something there.")
    kept = ~np.isnan(observed).any(axis=1)
    expected = residuals(simulated[:, kept], observed[kept])[0].ratio
    assert residuals(simulated, observed)[0].ratio == pytest.approx(expected)
    assert np.isnan(residuals(simulated, np.where([True, False], np.nan, observed))[0].ratio)


@pytest.mark.parametrize("shape", [(1, 40), (50, 2), (1, 3)], ids=["summaries", "series", "few"])
def test_a_model_that_is_right_is_hardly_ever_said_to_miss(shape):
    """The 300 observations are simulations like the others: smooth in time, and with tails."""
    rng, alarms = np.random.default_rng(2), 0
    for _ in range(300):
        both = rng.standard_t(4, (21, 1, shape[1])) + 0.1 * rng.normal(size=(21, *shape))
        alarms += any(one.far for one in residuals(both[1:], both[0]))
    assert alarms <= 6


def test_many_channels_are_cut_short():
    names, near = [f"c{d}" for d in range(9)], Residual(1.0, 1.5)
    assert fit_sentence(names, [near] * 9)[0].endswith("1.0 in c1, 1.0 in c2 and 1.0 in c3, and no more in 5 others.")
    assert fit_sentence(["a"], [Residual(np.nan, 1.0)]) == ("", True)
    assert not Residual(FAR, FAR).far and not Residual(0.9 * FAR, 0.1).far and Residual(FAR, 1.0).far


def test_summaries_are_compared_where_there_is_no_series(run):
    """They are compared by name, and all together if there are many without names."""
    vector = task(channels=(), summary=lambda trajectory: trajectory[-1], summary_names=("end", "swing"))
    x = np.asarray(run.observed)[-1]
    near = np.random.default_rng(0).normal(0.0, 0.1, (20, 2)) + x
    flat = run.replace(task=vector, observed=x, x=x, dataset=run.dataset.replace(x=run.dataset.x[:, -2:]))
    found = summarised(flat, final_x=near, **STILL)
    assert any("their scatter in" in one and "end" in one and "swing" in one for one in found.sentences)
    found = summarised(flat, final_x=near + np.array([0.0, 2.0]), **STILL)
    assert any("miss the observation" in one and "their scatter in swing" in one for one in found.sentences)
    many = np.asarray(run.observed).ravel()
    unnamed = run.replace(task=task(channels=()), observed=many, x=many)
    found = summarised(unnamed, final_x=around(run).reshape(20, -1), **STILL)
    assert any(one.endswith("times their scatter.") for one in found.sentences)


def test_an_observation_unlike_the_simulations_is_said_to_be_so(run):
    assert begins(summarised(run), "The observation is unlike") == [False]
    found = summarised(run.replace(x=np.asarray(run.x) + np.tile([0.0, 50.0], len(TIMES))))
    (sentence,) = [one for one in found.sentences if "unlike" in one]
    assert sentence == (
        "The observation is unlike all simulations in pendulum angle: its posterior cannot be relied on."
    )
    assert LOOK in found.next_steps
    strange = run.replace(x=np.asarray(run.x) + np.tile([0.0, 50.0], len(TIMES)))
    found = summarised(strange, final_trajectory=around(run), **STILL)
    assert begins(found, "Simulations from the posterior fit", "Its residual from simulations") == [False, True]


def test_failures_are_counted_with_their_commonest_reasons(run):
    assert not any("failed" in one for one in summarised(run).sentences)
    reasons, counts = run.task.reasons, np.zeros(run.history["failed"].shape, int)
    counts[0, 0], counts[1, -1] = 3, 2
    log = FailureLog(reasons, [Message(0, reasons[0], "mesh inverted at a=2.31", 3)])
    found = summarised(run.replace(failure_log=log), failed=counts)
    (sentence,) = [one for one in found.sentences if "failed" in one]
    total = int(np.sum(run.history["attempted"]))
    assert sentence == f"5 of {total} simulations failed: 3 {reasons[0]} (mesh inverted at a=2.31); 2 {reasons[-1]}."


def test_whether_a_run_had_settled_is_said(run):
    assert summarised(run, **STILL).sentences[-1] == (
        "The posterior settled: over the last 3 of 4 rounds it hardly changed."
    )
    found = summarised(run, **(STILL | {"moved": [np.inf] * 3 + [1.26]}))
    assert found.sentences[-1] == (
        "The posterior had not settled after 4 rounds: over the last 3, it changed its means by up to 1.3 standard "
        "deviations."
    )
    assert found.next_steps[-1] == (
        "More rounds: `jaxlfi resume FOLDER --rounds 8`; for a run without a folder, `jaxlfi.infer` again with "
        "`settings=run.settings.replace(rounds=8)`."
    )
    assert found.at("runs/a").next_steps[-1] == "More rounds: `jaxlfi resume runs/a --rounds 8`."
    found = summarised(run, **{name: [np.inf] * 4 for name in STILL})
    assert found.sentences[-1].startswith("4 rounds are too few to tell whether the posterior has settled")
    polished = run.replace(unpolished=run.belief)
    found = summarised(polished, **(STILL | {"moved": [np.inf] * 3 + [1.26]}))
    assert found.sentences[-1].startswith("The posterior that polishing began from had not settled after 4 rounds:")
    assert not any("More rounds" in step for step in found.next_steps)
    for history in (STILL, {name: [np.inf] * 4 for name in STILL}):
        assert not any("settled" in text for text in summarised(polished, **history).sentences)
    one = run.replace(history={name: value[:1] for name, value in run.history.items()})
    assert not any("settled" in text for text in account(one, RunSummary(parameters(), ())).sentences)


def test_what_to_do_next_follows_from_what_was_found(run):
    leaning = RunSummary(parameters(leans=("upper",)), (), ("A wider Phi: ...",))
    history = run.history | {name: jnp.asarray(value) for name, value in STILL.items()}
    fixed = run.replace(history=history | {"final_trajectory": jnp.asarray(around(run))}, heuristic=jaxlfi.Fixed())
    assert account(fixed, leaning).next_steps == (EDGE, "A wider Phi: ...")
    assert account(fixed.replace(heuristic=jaxlfi.Edge()), leaning).next_steps == ("A wider Phi: ...", DIAGNOSE_OWN)
    at_phi = fixed.replace(feasible=run.belief.support)
    assert EDGE not in account(at_phi, leaning).next_steps
    assert account(fixed, RunSummary(parameters(), ())).next_steps == (DIAGNOSE_OWN,)
    by_name = fixed.replace(origin=dataclasses.replace(fixed.origin, reference="lotka_volterra"))
    assert account(by_name, RunSummary(parameters(), ())).next_steps == (DIAGNOSE,)


def test_a_run_shows_a_few_lines_and_a_table(run):
    lines = repr(run).splitlines()
    assert lines[0] == "Run of task: 4 rounds, EDGE" and len(lines) == 6 and len(repr(run)) < 1000
    assert lines[1].startswith("Posterior of 2 parameters: ") and lines[3].startswith("slope")
    page = run._repr_html_()
    assert page.startswith("<p>Run of task: 4 rounds, EDGE</p>") and run.summary().to_html() in page
    both = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), run)
    assert repr(both).endswith("; arrays have leading axes") and both._repr_html_() is None
