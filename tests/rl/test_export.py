"""Policies exported to other formats: they act alike, carry the schema, and are refused where they are damaged."""

import dataclasses
import itertools
import json
import subprocess
import sys

import numpy as np
import onnx
import pytest
from onnx.reference import ReferenceEvaluator

from jaxlfi.cli import export
from jaxlfi.io import files
from jaxlfi.rl import deployment, policy, stablehlo
from jaxlfi.rl.deployment import Deployment, Limits
from jaxlfi.rl.policy import Policy

DEPLOYMENT = Deployment(0.16, 16, ("c", "a"), Limits((0.3, 0.6), 2.0, (-1.0, -2.0), (1.0, 3.0)), {"name": "mask"})


@pytest.fixture(scope="module")
def trained():
    """Three layers, and signals whose centres and scales all differ."""
    rng = np.random.default_rng(0)
    sizes = (5, 7, 6, 2)
    weights = tuple(rng.normal(size=shape).astype(np.float32) / 1.5 for shape in itertools.pairwise(sizes))
    biases = tuple(rng.normal(size=size).astype(np.float32) / 4 for size in sizes[1:])
    signals = lambda names: {
        "names": list(names),
        "units": ["m"] * len(names),
        "centre": rng.normal(size=len(names)).tolist(),
        "scale": rng.uniform(0.2, 3.0, size=len(names)).tolist(),
    }
    schema = {"environment": "line", "observations": signals("abcde"), "actions": signals("uv")}
    schema["deployment"] = json.loads(json.dumps(dataclasses.asdict(DEPLOYMENT)))
    return Policy(weights, biases, schema)


@pytest.fixture(scope="module")
def saved(trained, tmp_path_factory):
    return trained.save(tmp_path_factory.mktemp("trained") / "policy.npz")


@pytest.fixture(scope="module")
def seen():
    return np.random.default_rng(1).normal(size=(1000, 5)).astype(np.float32) * 2


@pytest.fixture(scope="module")
def expected(trained, seen):
    """What the policy does, a row an observation: limited in some, and not in most."""
    actions = np.stack([trained(row) for row in seen])
    limits = np.abs(actions - trained.acted["centre"]) > 0.999 * np.array(trained.acted["scale"])
    assert 0.02 < limits.mean() < 0.7
    return actions


def exported(saved, kind, out):
    assert export.main([str(saved), "--format", kind, "--out", str(out)]) == 0
    return out


def test_stablehlo_acts_alike_for_any_batch_and_is_for_three_platforms(trained, saved, seen, expected, tmp_path):
    program = stablehlo.load(exported(saved, "stablehlo", tmp_path / "policy.npz"))
    np.testing.assert_allclose(program(seen), expected, atol=1e-5)
    np.testing.assert_allclose(program(seen[3]), expected[3], atol=1e-5)
    np.testing.assert_allclose(program(seen[:6].reshape(2, 3, 5)), expected[:6].reshape(2, 3, 2), atol=1e-5)
    assert program.exported.platforms == ("cpu", "cuda", "tpu")
    assert program.schema == trained.schema


def test_onnx_acts_alike_and_is_sound(trained, saved, seen, expected, tmp_path):
    path = exported(saved, "onnx", tmp_path / "policy.onnx")
    model = onnx.load(path)
    onnx.checker.check_model(model, full_check=True)
    (actions,) = ReferenceEvaluator(model).run(["action"], {"observation": seen})
    np.testing.assert_allclose(actions, expected, atol=1e-5)
    kinds = [node.op_type for node in model.graph.node]
    assert kinds == ["Sub", "Div", "Gemm", "Tanh", "Gemm", "Tanh", "Gemm", "Clip", "Mul", "Add"]
    assert json.loads({one.key: one.value for one in model.metadata_props}["schema"]) == trained.schema


def test_numpy_needs_no_jax_neither_for_the_command_nor_to_act(saved, seen, expected, tmp_path):
    program = f"""
import sys
for name in ("jax", "flax", "brax", "onnx", "mujoco"):
    sys.modules[name] = None
from jaxlfi.cli import export
assert export.main([{str(saved)!r}, "--format", "numpy", "--out", "alone.npz"]) == 0
import numpy as np
from jaxlfi.rl import deployment, policy
act = policy.load("alone.npz")
print(deployment.of_schema(act.schema).limits.high)
np.save("actions.npy", [act(row) for row in np.load("seen.npy")])
"""
    np.save(tmp_path / "seen.npy", seen)
    done = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "(1.0, 3.0)" in done.stdout
    np.testing.assert_allclose(np.load(tmp_path / "actions.npy"), expected, atol=1e-6)


def test_the_folder_of_a_training_has_one_policy_or_says_which(saved, tmp_path, capsys):
    for seed in (0, 1):
        folder = tmp_path / f"runs/uniform/seed_00{seed}"
        folder.mkdir(parents=True)
        (folder / "policy.npz").write_bytes(saved.read_bytes())
    runs = tmp_path / "runs"  # two levels above the policies
    for place in (runs / "uniform/seed_000", runs / "uniform/seed_001/policy.npz"):
        out = exported(place, "numpy", tmp_path / f"new/{place.stem}-out.npz")
        assert policy.load(out).schema["environment"] == "line"
    for place, got in ((runs, "uniform/seed_000/policy.npz, uniform/seed_001/policy.npz"), (tmp_path, "none")):
        assert export.main([str(place), "--out", str(tmp_path / "x.npz")]) == 2
        assert f"with {got}: name one" in capsys.readouterr().err


def test_bad_input_is_refused_in_one_line(trained, saved, tmp_path, capsys):
    broken = Policy(trained.weights, trained.biases, {**trained.schema, "deployment": {"steps": 3}})
    for words, expected in (
        ([saved, "--out", tmp_path / "x.onnx"], "out: expected a new .npz file"),
        ([saved, "--out", saved], "out: expected a new .npz file"),
        ([saved, "--format", "onnx", "--out", tmp_path / "x.npz"], "out: expected a new .onnx file"),
        ([tmp_path / "none.npz", "--out", tmp_path / "x.npz"], "expected a complete .npz file"),
        (
            [broken.save(tmp_path / "broken.npz"), "--out", tmp_path / "x.npz"],
            "deployment in its schema, got one that is",
        ),
    ):
        assert export.main(list(map(str, words))) == 2
        error = capsys.readouterr().err
        assert expected in error and error.count("\n") == 1
    assert not (tmp_path / "x.npz").exists()


def test_other_files_are_no_programs(saved, tmp_path):
    path = exported(saved, "stablehlo", tmp_path / "policy.npz")
    arrays = files.read_arrays(path)
    with pytest.raises(ValueError, match="expected jaxlfi-policy of version 1, got jaxlfi-policy-stablehlo"):
        policy.load(path)
    with pytest.raises(ValueError, match="expected jaxlfi-policy-stablehlo of version 1, got jaxlfi-policy of"):
        stablehlo.load(saved)
    for change, expected in (
        ({"schema": np.asarray("{}")}, "without its schema"),
        ({"program": arrays["program"][:300]}, "expected a program of jax.export"),
    ):
        files.write_arrays(tmp_path / "damaged.npz", arrays | change)
        with pytest.raises(ValueError, match=expected):
            stablehlo.load(tmp_path / "damaged.npz")


def test_without_the_extra_one_line_names_it(saved, tmp_path, capsys, monkeypatch):
    for kind, module, package in (("onnx", "onnx_graph", "onnx"), ("stablehlo", "stablehlo", "flatbuffers")):
        with monkeypatch.context() as patch:
            patch.setitem(sys.modules, package, None)
            patch.delitem(sys.modules, f"jaxlfi.rl.{module}", raising=False)
            suffix = export.SUFFIXES[kind]
            assert export.main([str(saved), "--format", kind, "--out", str(tmp_path / f"x{suffix}")]) == 2
        assert f"pip install 'jaxlfi[{kind}]'" in capsys.readouterr().err


# -------------------------------------------------------------------------------------------------------- deployment


def test_a_schema_says_what_a_robot_must_keep_to(trained):
    again = deployment.of_schema(json.loads(json.dumps(trained.schema)))
    assert again == DEPLOYMENT


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (None, "expected a deployment .* got none: train it again"),
        ({"moved": ["c"]}, "expected limits of"),
        ({"moved": ["c", "z"]}, "whose actions .* each move an observation"),
        ({"control_interval": 0.0}, "a positive interval"),
        ({"limits": {"step": [1.0]}}, "not whole"),
        ({"limits": {"step": [1, 1], "speed": 0, "low": [0, 0], "high": [1, 1]}}, "a positive step and speed"),
        ({"limits": {"step": [1, 1], "speed": 1, "low": [0, 1], "high": [1, 1]}}, "low below high"),
    ],
)
def test_schemas_that_say_too_little_are_refused(trained, change, expected):
    schema = dict(trained.schema)
    found = schema.pop("deployment")
    if change is not None:
        schema["deployment"] = {**found, **change}
    with pytest.raises(ValueError, match=f"(policy|deployment|limits): .*{expected}"):
        deployment.of_schema(schema)


def test_limits_are_kept_to_one_after_another():
    limits = Limits(step=(0.3, 0.6), speed=2.0, low=(-1.0, -2.0), high=(1.0, 3.0))
    cases = [  # set-point, asked for, seconds since the command before, the set-point after
        ([0, 0], [0.2, -0.5], 1.0, [0.2, -0.5]),
        ([0, 0], [0.9, -0.9], 1.0, [0.3, -0.6]),
        ([0, 0], [0.3, -0.4], 0.1, [0.12, -0.16]),  # 0.2 of the 0.5 are within the speed
        ([0.9, -1.9], [0.2, -0.5], 1.0, [1.0, -2.0]),
        ([0.9, 2.9], [-0.1, 0.5], 1.0, [0.8, 3.0]),
    ]
    for target, asked, seconds, after in cases:
        moved, reached = limits.applied(np.array(target, float), np.array(asked), seconds)
        np.testing.assert_allclose(reached, after, atol=1e-12)
        np.testing.assert_allclose(moved, np.subtract(after, target), atol=1e-12)
    free = Limits.none(2).applied(np.zeros(2), np.array([1e9, -1e9]), 1e-9)
    np.testing.assert_array_equal(free[0], [1e9, -1e9])


def test_limits_can_be_tightened_and_not_loosened():
    limits = DEPLOYMENT.limits
    tight = limits.tightened(step=0.4, speed=1.0, low=(-0.5, -2.0), high=(1.0, 2.0))
    assert tight == Limits((0.3, 0.4), 1.0, (-0.5, -2.0), (1.0, 2.0))
    assert limits.tightened() == limits
    for change in ({"step": 0.7}, {"speed": 2.1}, {"low": (-1.1, 0)}, {"high": (1, 4)}, {"low": (0,)}, {"speed": 0.0}):
        with pytest.raises(ValueError, match=f"{next(iter(change))}: expected"):
            limits.tightened(**change)
