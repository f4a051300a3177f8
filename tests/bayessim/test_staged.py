"""Rounds in stages: the results of the fused round, and programs that simulators share."""

import functools

import jax
import numpy as np
import pytest

import jaxlfi
from jaxlfi.bayessim.batch import BatchEngine, RunSpec, stack_inputs
from jaxlfi.bayessim.host import engine_for
from jaxlfi.bayessim.staged import StagedEngine
from jaxlfi.heuristics import Edge
from jaxlfi.io import executables
from jaxlfi.studies.grid.chunks import program_bytes
from tests.small import SETTINGS, gaussian, settings, whole_runs  # noqa: F401 - a fixture

OBSERVED = np.array([[0.8, -0.6]], np.float32)


def stepped(make, settings):
    """The state and the records of one run's rounds."""
    spec = RunSpec("misspecified", "misspecified", gaussian().support("misspecified"), Edge(), 3)
    engine = make(gaussian(), settings, stack_inputs([spec], OBSERVED, OBSERVED)[0])
    state, rows = engine.start(), []
    for index in range(settings.rounds):
        state, row = engine.round(state, index)
        rows.append(row)
    return engine.fetch(state), rows


@pytest.mark.parametrize(
    "changes",
    [
        {},
        pytest.param(
            {"correction": "pooled", "inflation": 2.0, "restriction": "mixed", "min_rounds": 1}, marks=pytest.mark.slow
        ),
        pytest.param(
            {"estimator": SETTINGS.estimator.replace(loss="atomic"), "predictive": False}, marks=pytest.mark.slow
        ),
    ],
    ids=["plain", "pooled", "atomic"],
)
def test_stages_give_the_numbers_of_the_fused_round(whole_runs, changes):  # noqa: F811 - the fixture
    """They agree up to rounding, which training amplifies; other keys would change draws by the posterior's width."""
    fused, fused_rows = stepped(BatchEngine, settings(**changes))
    staged, staged_rows = stepped(StagedEngine, settings(**changes))
    assert jax.tree.structure(fused) == jax.tree.structure(staged)
    for ours, theirs in zip(staged_rows, fused_rows, strict=True):
        assert ours.keys() == theirs.keys()
        for name in ours:
            np.testing.assert_allclose(ours[name], theirs[name], rtol=2e-2, atol=2e-2, err_msg=name)
    for ours, theirs in zip(jax.tree.leaves(staged), jax.tree.leaves(fused), strict=True):
        if jax.dtypes.issubdtype(ours.dtype, jax.dtypes.prng_key):
            continue
        np.testing.assert_allclose(ours, theirs, rtol=2e-2, atol=2e-2)


def test_a_second_simulator_of_the_same_shapes_compiles_its_own_stages_only(whole_runs):  # noqa: F811 - the fixture
    def task(scale):
        box = jaxlfi.Support([-2.0 * scale, -2.0], [2.0 * scale, 2.0])
        simulate = lambda key, theta: scale * theta + 0.1 * jax.random.normal(key, (2,))
        return jaxlfi.Task(simulate, names=("a", "b"), supports={"ok": box}, feasible=box)

    infer = functools.partial(jaxlfi.infer, 0, observation=OBSERVED[0], heuristic=Edge(), settings=settings())
    infer(task(1.0))
    before = set(executables._EXECUTABLES)
    again = task(2.0)
    for _ in range(2):
        infer(again)
        added = [many.__name__ for many, *_ in set(executables._EXECUTABLES) - before]
        assert sorted(added) == ["compare_one", "simulate_one", "start_one"]


def test_the_posterior_of_a_finished_run_and_its_draws_compile_nothing(whole_runs):  # noqa: F811 - the fixture
    """A round ends with draws from the same programs, one of which makes any number of draws."""
    task = gaussian()
    run = jaxlfi.infer(0, task, OBSERVED[0], heuristic=Edge(), support="misspecified", settings=settings())
    before = set(executables._EXECUTABLES)
    assert run.posterior.sample(jax.random.key(1), 250).shape == (250, 2)
    assert run.draws(30).shape == (30, 2)
    assert not set(executables._EXECUTABLES) - before


def test_one_run_goes_in_stages_and_many_are_fused():
    def engine(count):
        spec = RunSpec("own", "ok", gaussian().support("ok"), Edge(), 0)
        observed = np.repeat(OBSERVED, count, axis=0)
        return engine_for(gaussian(), settings(), stack_inputs([spec] * count, observed, observed)[0])

    assert type(engine(1)) is StagedEngine and program_bytes(engine(1)) > 0  # so a grid of one run can be refused
    assert type(engine(2)) is BatchEngine
