"""A policy with its preparation, over the steps of an episode: as NumPy, StableHLO and ONNX run it from their files."""

import dataclasses
import json

import numpy as np
import pytest

from jaxlfi.rl import policy, preparation
from jaxlfi.rl.policy import Policy
from jaxlfi.rl.preparation import Command, Control, Preparation, Signal

CRANE = Preparation(
    signals=(Signal("swing", "rad", turning=True), Signal("cable", "m"), Signal("drum", "rad")),
    controls=(
        Control("slew", -1.5, 0.8, "rad", rate=2.0, displacing=True, begins=0),
        Control("hoist", -3.0, 5.0, "N m", rate=60.0),
    ),
    interval=0.05,
    steps=60,
    history=3,
    actions=2,
    commands=(Command("height", 0.5, 2.0, "m"),),
    observation_delay=(0.0, 0.01),
    action_delay=(0.005, 0.02),
)
FORMATS = {"numpy": ".npz", "stablehlo": ".npz", "onnx": ".onnx"}


@pytest.fixture(scope="module")
def trained():
    rng = np.random.default_rng(0)
    size = len(CRANE.names)
    shapes = ((size, 16), (16, 12), (12, 2))
    low, high = CRANE.ranges
    column = lambda names, centre, scale: {
        "names": list(names), "units": [""] * len(names), "centre": list(centre), "scale": list(scale)
    }  # fmt: skip
    schema = {
        "environment": "crane",
        "observations": column(CRANE.names, rng.normal(0, 0.3, size), rng.uniform(0.4, 3.0, size)),
        "actions": column([one.name for one in CRANE.controls], (low + high) / 2, (high - low) / 2),
        "preparation": json.loads(json.dumps(dataclasses.asdict(CRANE))),
    }
    weights = tuple(rng.normal(0, 0.5, shape).astype(np.float32) for shape in shapes)
    return Policy(weights, tuple(rng.normal(0, 0.2, shape[1]).astype(np.float32) for shape in shapes), schema)


def saved(trained, kind, path):
    """What runs a policy from its file, and the schema that is in it."""
    if kind == "numpy":
        act = policy.load(trained.save(path))
        return act, act.schema
    if kind == "stablehlo":
        pytest.importorskip("flatbuffers")
        from jaxlfi.rl import stablehlo

        stablehlo.save(trained, path)
        program = stablehlo.load(path)
        return lambda seen: np.asarray(program(seen)), program.schema
    onnx = pytest.importorskip("onnx")
    from onnx.reference import ReferenceEvaluator

    from jaxlfi.rl import onnx_graph

    onnx_graph.save(trained, path)
    model = onnx.load(path)
    session = ReferenceEvaluator(model)
    act = lambda seen: session.run(["action"], {"observation": np.asarray(seen, np.float32)[None]})[0][0]
    return act, json.loads({one.key: one.value for one in model.metadata_props}["schema"])


def episode(act, prepared):
    """Signals and controls of a crane that turns and winds as it is told, with what is asked of it changed midway."""
    values, courses = np.array([0.2, 1.4, 30.0, 0.7]), []
    memory = prepared.start(values)
    for step in range(prepared.steps):
        memory, seen = prepared.observed(memory, values)
        memory, control = prepared.commanded(memory, act(seen))
        courses.append(np.concatenate([values, control]))
        swing, cable, drum, _ = values
        pulled = cable - 0.02 * control[1]
        values = np.array([swing + 0.3 * (control[0] - swing), pulled, drum + control[1], 0.7 if step < 30 else 1.8])
    return np.array(courses)


def by_hand(act):
    """The same, from lists of all that was, with nothing of the module."""
    values, seen, controls, rows = np.array([0.2, 1.4, 30.0, 0.7]), [], [np.array([0.2, 0.0])], []
    for step in range(60):
        seen.append([np.cos(values[0]), np.sin(values[0]), values[1], values[2]])
        frames = [number for k in range(3) for number in seen[max(len(seen) - 1 - k, 0)]]
        lasts = [number for k in range(2) for number in controls[max(len(controls) - 1 - k, 0)]]
        asked = act(np.array([*frames, *lasts, values[3]]))
        slew = np.clip(controls[-1][0] + np.clip(asked[0], -0.1, 0.1), -1.5, 0.8)
        hoist = np.clip(np.clip(asked[1], controls[-1][1] - 3.0, controls[-1][1] + 3.0), -3.0, 5.0)
        controls.append(np.array([slew, hoist]))
        rows.append(np.concatenate([values, controls[-1]]))
        swing, cable, drum, _ = values
        values = np.array([swing + 0.3 * (slew - swing), cable - 0.02 * hoist, drum + hoist, 0.7 if step < 30 else 1.8])
    return np.array(rows)


@pytest.mark.parametrize("kind", FORMATS)
def test_controls_of_an_episode_are_the_same(kind, trained, tmp_path):
    act, schema = saved(trained, kind, tmp_path / f"policy{FORMATS[kind]}")
    prepared = preparation.of_schema(schema)
    assert prepared == CRANE
    course, expected = episode(act, prepared), by_hand(trained)
    np.testing.assert_allclose(course, expected, rtol=1e-5, atol=1e-5)
    slew, hoist = expected[:, 4], expected[:, 5]
    assert np.ptp(slew) > 0.3 and np.ptp(hoist) > 1.0 and np.abs(np.diff(hoist)).max() > 0.05
