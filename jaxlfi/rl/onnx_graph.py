"""Policies as ONNX: graphs with few kinds of operations, for the runtimes on robots."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxlfi.io import files
from jaxlfi.rl.policy import Policy, Unit

try:
    import onnx
    from onnx import TensorProto, helper, numpy_helper
except ImportError as error:
    raise ImportError("an ONNX file needs the package onnx: pip install 'jaxlfi[onnx]'") from error

REMEMBERED = "remembered"
OPSET, IR_VERSION = 17, 8
"""Versions of 2022, so that older runtimes can also read the file."""


def graph(policy: Policy) -> onnx.ModelProto:
    """The graph of a policy, from `observation` float32 [batch, O] to `action` float32 [batch, A], both in their units.

    The policy's schema is the JSON text under "schema" in `metadata_props`.
    """
    nodes, constants, last = [], [], "observation"

    def apply(operation: str, **inputs: np.ndarray) -> None:
        """Append an operation on the last result and these constants."""
        nonlocal last
        constants.extend(numpy_helper.from_array(np.asarray(value, np.float32), name) for name, value in inputs.items())
        before, last = last, f"{operation.lower()}_{len(nodes)}"
        nodes.append(helper.make_node(operation, [before, *inputs], [last], name=last))

    apply("Sub", observation_centre=policy.observed["centre"])
    apply("Div", observation_scale=policy.observed["scale"])
    if policy.unit is not None:
        last = _remembered(policy.unit, last, nodes, constants)
    for index, (weight, bias) in enumerate(zip(policy.weights, policy.biases, strict=True)):
        if index:
            apply("Tanh")
        apply("Gemm", **{f"weight_{index}": weight, f"bias_{index}": bias})
    apply("Clip", action_low=np.float32(-1), action_high=np.float32(1))
    if policy.unit is not None:
        nodes.append(helper.make_node("Concat", [last, REMEMBERED], ["with_memory"], axis=1))
        last = "with_memory"
    apply("Mul", action_scale=policy.acted["scale"])
    apply("Add", action_centre=policy.acted["centre"])
    nodes[-1].output[0] = "action"

    signal = lambda name, size: helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", size])
    given = signal("observation", len(policy.observed["names"]))
    made = signal("action", len(policy.acted["names"]))
    return finished("policy", nodes, constants, given, made, policy.schema)


def _remembered(unit: Unit, seen: str, nodes: list, constants: list) -> str:
    """Append a recurrent unit (`jaxlfi.rl.policy.Unit`); returns the name of the observation with the next memory."""

    def add(operation: str, inputs: Sequence[str], outputs: Sequence[str], **more: int) -> None:
        nodes.append(helper.make_node(operation, [*inputs], [*outputs], **more))

    constants += [numpy_helper.from_array(np.asarray(array, np.float32), name) for name, array in unit.arrays.items()]
    sizes = {"parts": [len(unit.weight), unit.size], "gates": [unit.size] * 3}
    constants += [numpy_helper.from_array(np.asarray(value, np.int64), name) for name, value in sizes.items()]
    add("Split", [seen, "parts"], ["seen", "memory"], axis=1)
    add("Gemm", ["seen", "weight", "bias"], ["given"])
    add("MatMul", ["memory", "memory_weight"], ["kept"])
    for side in ("given", "kept"):
        add("Split", [side, "gates"], [f"{side}_{gate}" for gate in "rzn"], axis=1)
    for gate in "rz":
        add("Add", [f"given_{gate}", f"kept_{gate}"], [f"sum_{gate}"])
        add("Sigmoid", [f"sum_{gate}"], [gate])
    add("Add", ["kept_n", "memory_bias"], ["offset"])
    add("Mul", ["r", "offset"], ["let"])
    add("Add", ["given_n", "let"], ["sum_n"])
    add("Tanh", ["sum_n"], ["n"])
    add("Sub", ["memory", "n"], ["change"])
    add("Mul", ["z", "change"], ["stays"])
    add("Add", ["n", "stays"], [REMEMBERED])
    add("Concat", ["seen", REMEMBERED], ["seen_and_remembered"], axis=1)
    return "seen_and_remembered"


def finished(
    name: str,
    nodes: Sequence[onnx.NodeProto],
    constants: Sequence[TensorProto],
    given: onnx.ValueInfoProto,
    made: onnx.ValueInfoProto,
    schema: Mapping[str, Any],
) -> onnx.ModelProto:
    """A checked graph from one input to one output, with a schema in its `metadata_props`."""
    graph = helper.make_graph(nodes, name, [given], [made], constants)
    opset = helper.make_opsetid("", OPSET)
    model = helper.make_model(graph, opset_imports=[opset], ir_version=IR_VERSION, producer_name="jaxlfi")
    helper.set_model_props(model, {"schema": json.dumps(dict(schema))})
    onnx.checker.check_model(model, full_check=True)
    return model


def save(policy: Policy, path: str | Path) -> None:
    """Write a policy as an .onnx file."""
    files.write_bytes(Path(path), graph(policy).SerializeToString(), durable=True)
