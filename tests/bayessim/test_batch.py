"""Batches: many runs in one program give the results of single runs, on one device and on two."""

import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxlfi.bayessim import algorithm
from jaxlfi.bayessim.batch import (
    BatchEngine,
    RunSpec,
    given_round_one,
    round_one,
    stack,
    stack_heuristics,
    stack_inputs,
)
from jaxlfi.bayessim.keys import run_keys
from jaxlfi.bayessim.record import own_evidence
from jaxlfi.heuristics import Centre, Choice, Edge, Fixed, Matched, Mode
from jaxlfi.tasks.presimulated import presimulated
from tests.small import gaussian, settings, whole_runs  # noqa: F401 - a fixture

OBSERVED = np.array([0.8, -0.6], np.float32)
SETTINGS = settings(predictive=False)


def spec(support: str, heuristic, seed: int) -> RunSpec:
    """A run of the Gaussian task."""
    return RunSpec(support, support, gaussian().support(support), heuristic, seed)


SPECS = [
    spec("ok", Fixed(), 0),
    spec("misspecified", Edge(), 0),
    spec("misspecified", Matched(Mode()), 1),
    spec("broad", Edge(expansion=0.5), 1),
    spec("misspecified", Centre(), 2),
]


def step_batch(devices=None):
    """The five runs after two rounds, with the records of both rounds."""
    observed = np.tile(OBSERVED, (len(SPECS), 1))
    inputs, places = stack_inputs(SPECS, observed, observed)
    engine = BatchEngine(gaussian(), SETTINGS, inputs, devices)
    state, rows = engine.start(), []
    for index in range(SETTINGS.rounds):
        state, row = engine.round(state, index)
        rows.append(row)
    return engine.fetch(state), rows, places, inputs


# With every rule; a batch of two rules is compared with single runs in cli/test_cli.py, one of many in test_grid.py.
whole = pytest.mark.slow


@pytest.fixture(scope="module")
def stepped(whole_runs):  # noqa: F811 - the fixture
    """The result of `step_batch` on one device."""
    return step_batch(jax.local_devices()[:1])


@jax.jit
def run_alone(key, heuristic, support):
    """A single run, as one program."""
    state, _ = algorithm.run(key, gaussian(), SETTINGS, heuristic, jnp.asarray(OBSERVED), support)
    return state


@whole
@pytest.mark.parametrize("index", range(len(SPECS)))
def test_each_run_of_a_batch_is_the_pure_run_of_its_seed(stepped, index):
    """One program chooses among all rules; the heuristics' tests check that a choice equals its rule."""
    state, _, _, inputs = stepped
    own, heuristic = SPECS[index], jax.tree.map(lambda leaf: leaf[index], inputs.heuristic)
    alone = run_alone(run_keys(jax.random.key(own.seed)).run, heuristic, own.support)
    for ours, theirs in zip(jax.tree.leaves(state), jax.tree.leaves(alone), strict=True):
        np.testing.assert_allclose(ours[index], theirs, rtol=2e-3, atol=2e-3)


@whole
def test_runs_of_one_seed_share_their_first_draws(stepped):
    _, rows, _, _ = stepped
    theta = rows[0]["theta"]
    unit = [(t - np.asarray(x.support.low)) / np.asarray(x.support.width) for t, x in zip(theta, SPECS, strict=True)]
    np.testing.assert_allclose(unit[0], unit[1], atol=1e-5)
    assert not np.allclose(unit[1], unit[2], atol=1e-2)


def test_evidence_of_other_rules_is_left_out():
    row = {"evidence/0/mass_left": 1, "evidence/1/mass_left": 2, "evidence/1/shift": 3, "theta": 4}
    assert own_evidence(row, 1) == {"evidence/mass_left": 2, "evidence/shift": 3, "theta": 4}
    assert own_evidence(row, 2) == {"theta": 4} and own_evidence(row, None) == row


@whole
def test_evidence_is_the_runs_own(stepped):
    _, rows, places, _ = stepped
    seen = [{name for name in own_evidence(rows[0], place) if name.startswith("evidence/")} for place in places]
    assert seen[0] == set()
    assert seen[1] == seen[3] == {"evidence/mass_left", "evidence/mass_right"}
    assert seen[2] == {"evidence/mode_shift", "evidence/weight_left", "evidence/weight_right"}
    assert seen[4] == {"evidence/weighted_mean"}


def test_one_kind_of_rule_needs_no_choice():
    stacked, places = stack_heuristics([Edge(), Edge(mass_threshold=0.5)])
    assert isinstance(stacked, Edge) and places == [None, None]
    np.testing.assert_allclose(stacked.mass_threshold, [0.12, 0.5])


def test_rules_of_one_structure_share_a_place_in_the_choice():
    stacked, places = stack_heuristics([Edge(), Fixed(), Edge(expansion=0.3)])
    assert isinstance(stacked, Choice) and places == [0, 1, 0]
    np.testing.assert_allclose(stacked.rules[0].expansion[jnp.array([0, 2])], [0.2, 0.3])


def test_inputs_are_padded_to_the_devices():
    observed = np.tile(OBSERVED, (3, 1))
    inputs, _ = stack_inputs(SPECS[:3], observed, observed)
    engine = BatchEngine(gaussian(), SETTINGS, inputs)
    assert engine.place(jnp.arange(3)).tolist() == [0, 1, 2]  # one device: nothing to pad
    assert engine.fetch(jnp.arange(4)).tolist() == [0, 1, 2]


TWO_DEVICES = """
import jax, numpy as np, sys
from tests.bayessim.test_batch import step_batch
assert jax.local_device_count() == 2
state, _, _, _ = step_batch()
np.savez(sys.argv[1], *map(np.asarray, jax.tree.leaves(state)))
"""


@pytest.mark.slow
def test_two_devices_give_what_one_gives(stepped, tmp_path):
    """Five runs on two devices need one run as padding."""
    flags = f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count=2"
    environment = os.environ | {"XLA_FLAGS": flags}
    command = [sys.executable, "-c", TWO_DEVICES, str(tmp_path / "two.npz")]
    subprocess.run(command, env=environment, check=True, capture_output=True)
    leaves = jax.tree.leaves(stepped[0])
    two = np.load(tmp_path / "two.npz")
    assert len(two.files) == len(leaves)
    for i, leaf in enumerate(leaves):
        np.testing.assert_allclose(two[f"arr_{i}"], leaf, rtol=2e-3, atol=2e-3)


def test_stacking_makes_a_leading_axis():
    stacked = stack([Edge(mass_threshold=0.1), Edge(mass_threshold=np.float32(0.2))])
    assert all(leaf.shape == (2,) and leaf.dtype == jnp.float32 for leaf in jax.tree.leaves(stacked))


def test_what_is_compiled_ahead_is_what_a_round_runs(monkeypatch):
    """Given simulations need another program for the first round; no unused program is compiled."""
    observed = OBSERVED[None]
    first = presimulated(gaussian(), {"theta": np.eye(20, 2), "x": np.eye(20, 2)}, gaussian().support("ok"))[0]
    inputs, _ = stack_inputs(SPECS[:1], observed, observed)
    seen = []
    monkeypatch.setattr(BatchEngine, "_compiled", lambda self, one, *_: seen.append(one))
    for given in (None, first):
        engine = BatchEngine(gaussian(), SETTINGS, inputs, first=given)
        engine.compile(None, 0)
        engine.compile(None, 1)
    assert seen == [round_one, round_one, given_round_one, round_one]
