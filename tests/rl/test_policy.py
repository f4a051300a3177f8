"""Policies as files: what they compute, what they refuse, and that they need no JAX."""

import itertools
import json
import math
import subprocess
import sys
from typing import NamedTuple

import numpy as np
import pytest

from jaxlfi.io import files
from jaxlfi.rl.policy import Policy, load

SIGNALS = {
    "observations": {"names": ["a", "b"], "units": ["m", ""], "centre": [1.0, -2.0], "scale": [0.5, 4.0]},
    "actions": {"names": ["u"], "units": ["m"], "centre": [0.25], "scale": [0.75]},
}


@pytest.fixture
def policy():
    rng = np.random.default_rng(0)
    sizes = (2, 3, 1)
    weights = tuple(rng.normal(size=shape).astype(np.float32) for shape in itertools.pairwise(sizes))
    return Policy(weights, (np.float32([0.1, -0.2, 0.3]), np.float32([0.4])), {"environment": "line", **SIGNALS})


def test_it_is_its_formula(policy):
    scaled = (np.array([2.0, 6.0]) - [1.0, -2.0]) / [0.5, 4.0]
    hidden = np.tanh(scaled @ policy.weights[0] + policy.biases[0])
    expected = 0.25 + 0.75 * np.clip(hidden @ policy.weights[1] + policy.biases[1], -1, 1)
    np.testing.assert_allclose(policy([2.0, 6.0]), expected, rtol=1e-6)
    np.testing.assert_allclose(policy([[2.0, 6.0]] * 3), [expected] * 3, rtol=1e-6)


def test_actions_stay_within_their_limits(policy):
    seen = 100 * np.random.default_rng(1).normal(size=(500, 2))
    strong = Policy((policy.weights[0], 50 * policy.weights[1]), policy.biases, policy.schema)
    actions = strong(seen)
    assert actions.min() == -0.5 and actions.max() == 1.0


def test_it_is_saved_and_loaded(policy, tmp_path):
    again = load(policy.save(tmp_path / "policy.npz"))
    assert again.schema == policy.schema
    np.testing.assert_array_equal(again([0.3, 0.4]), policy([0.3, 0.4]))


@pytest.mark.parametrize(
    ("damage", "expected"),
    [
        (lambda arrays: {}, "without its schema"),
        (lambda arrays: arrays | {"schema": np.asarray("[]")}, "without its schema"),
        (
            lambda arrays: arrays | {"schema": np.asarray('{"format": "jaxlfi-policy", "version": 9}')},
            "got version 9, which a newer",
        ),
        (lambda arrays: {name: one for name, one in arrays.items() if name != "bias_1"}, "expected a complete policy"),
        (lambda arrays: arrays | {"weight_0": np.zeros((5, 3))}, "expected layers from 2 observations to 1 actions"),
    ],
)
def test_other_files_are_refused(policy, tmp_path, damage, expected):
    path = policy.save(tmp_path / "policy.npz")
    files.write_arrays(path, damage(files.read_arrays(path)))
    with pytest.raises(ValueError, match=expected):
        load(path)


def test_damaged_files_are_refused(policy, tmp_path):
    path = policy.save(tmp_path / "policy.npz")
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(ValueError, match="expected a complete"):
        load(path)


def test_the_policy_of_another_environment_is_refused(policy):
    class Named(NamedTuple):
        names: tuple
        units: tuple

    seen, acted = Named(("a", "b"), ("m", "")), Named(("u",), ("m",))
    assert policy.require("line", seen, acted) is policy
    for other, expected in (
        (("whip", seen, acted), "environment 'whip', got one of 'line'"),
        (("line", Named(("a",), ("m",)), acted), r"observations \['a'\]"),
        (("line", seen, Named(("v",), ("m",))), r"actions \['v'\]"),
        (("line", seen, Named(("u",), ("mm",))), r"units of actions \['mm'\], got one of \['m'\]"),
    ):
        with pytest.raises(ValueError, match=f"policy: expected {expected}"):
            policy.require(*other)


def without(schema, *path):
    """The schema less what lies at a path in it."""
    first, *rest = path
    return {
        name: without(one, *rest) if name == first else one for name, one in schema.items() if rest or name != first
    }


@pytest.mark.parametrize(
    ("damage", "expected"),
    [
        (lambda schema: without(schema, "environment"), "environment: expected a name in the schema, got None"),
        (lambda schema: schema | {"observations": []}, r"observations: expected names, .* in the schema, got \[\]"),
        (lambda schema: without(schema, "actions", "centre"), "actions: expected names, .* in the schema, got {"),
        (lambda schema: with_scale(schema, [0.5, 4.0]), "actions: expected as many of names, .*, got .*2"),
        (lambda schema: with_scale(schema, [0.0]), r"actions: expected finite .* positive scales, got .* and \[0.0\]"),
        (lambda schema: with_scale(schema, [math.nan]), "actions: expected finite centres and positive scales"),
        (lambda schema: with_scale(schema, ["1"]), "actions: expected finite centres and positive scales"),
    ],
)
def test_a_schema_that_a_policy_cannot_act_by_is_refused(policy, tmp_path, damage, expected):
    path = policy.save(tmp_path / "policy.npz")
    schema = {"format": "jaxlfi-policy", "version": 1, **damage(policy.schema)}
    files.write_arrays(path, files.read_arrays(path) | {"schema": np.asarray(json.dumps(schema))})
    with pytest.raises(ValueError, match=f"policy.npz: expected a complete policy, got: {expected}") as caught:
        load(path)
    assert "\n" not in str(caught.value)


def with_scale(schema, scale):
    return schema | {"actions": schema["actions"] | {"scale": scale}}


def test_layers_are_finite(policy):
    with pytest.raises(ValueError, match="policy: expected layers of finite numbers"):
        Policy(policy.weights, (policy.biases[0], np.float32([np.nan])), policy.schema)


def test_it_runs_where_there_is_no_jax(policy, tmp_path):
    path = policy.save(tmp_path / "policy.npz")
    program = f"""
import sys
sys.modules["jax"] = sys.modules["flax"] = sys.modules["brax"] = None
from jaxlfi.rl import policy
print(policy.load({str(path)!r})([0.3, 0.4]).tolist()[0])
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert float(done.stdout) == pytest.approx(float(policy([0.3, 0.4])[0]), abs=1e-6)
