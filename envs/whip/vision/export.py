"""The segmenter for computers that do not run JAX, or not Python: as ONNX, and as StableHLO."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxlfi.envs.whip.vision.pictures import LABELS, SIZE
from jaxlfi.envs.whip.vision.segmenter import BLOCK, segment
from jaxlfi.envs.whip.vision.weights import Weights
from jaxlfi.io import files

FORMAT, VERSION = "jaxlfi-whip-segmenter", 1


def schema(weights: Weights) -> dict[str, Any]:
    """What a file says of itself: what goes in and comes out, and how the weights were made."""
    return {
        "format": FORMAT,
        "version": VERSION,
        "picture": f"uint8 [{SIZE}, {SIZE}, 3], red, green and blue",
        "labels": list(LABELS),
        "about": dict(weights.about),
    }


def save_stablehlo(weights: Weights, path: Path) -> None:
    """Write an .npz: the program that `jax.export` serialised, as bytes, from pictures to labels, and its schema.

    Raises:
        ImportError: without the extra `stablehlo`.
    """
    from jaxlfi.rl import stablehlo

    program = lambda picture: segment(weights.module, weights.params, picture)
    stablehlo.write(path, program, jax.ShapeDtypeStruct((SIZE, SIZE, 3), jnp.uint8), schema(weights))


def save_onnx(weights: Weights, path: Path) -> None:
    """Write a graph from `picture` uint8 [256, 256, 3] to `labels` int64 [256, 256]; its schema is in its metadata.

    Raises:
        ImportError: without the extra `onnx`.
    """
    files.write_bytes(path, graph(weights).SerializeToString(), durable=True)


def graph(weights: Weights, size: int = SIZE):
    """The segmenter as an `onnx.ModelProto`, for pictures of some size, a multiple of 16."""
    from jaxlfi.rl.onnx_graph import TensorProto, finished, helper, numpy_helper

    params = jax.device_get(weights.params)["params"]
    nodes: list[Any] = []
    constants: list[Any] = []

    def constant(array, kind=np.float32) -> str:
        name = f"constant_{len(constants)}"
        constants.append(numpy_helper.from_array(np.asarray(array, kind), name))
        return name

    def apply(operation: str, *inputs: str, **attributes) -> str:
        name = f"{operation.lower()}_{len(nodes)}"
        nodes.append(helper.make_node(operation, list(inputs), [name], name=name, **attributes))
        return name

    convolutions = iter(range(len(params)))

    def conv(x: str, stride: int = 1, side: int = 3) -> str:
        layer = params[f"Conv_{next(convolutions)}"]
        kernel, bias = constant(layer["kernel"].transpose(3, 2, 0, 1)), constant(layer["bias"])
        # As Flax pads: with stride 2, the missing row is the last.
        first = side // 2 if stride == 1 else 0
        pads = [first, first, side // 2, side // 2]
        return apply("Conv", x, kernel, bias, pads=pads, strides=[stride] * 2, kernel_shape=[side] * 2)

    def enlarged(x: str) -> str:
        scales = constant([1, 1, 2, 2])
        how = {"mode": "nearest", "nearest_mode": "floor", "coordinate_transformation_mode": "asymmetric"}
        return apply("Resize", x, "", scales, **how)

    x = apply("Cast", "picture", to=TensorProto.FLOAT)
    x = apply("Sub", apply("Mul", x, constant(2 / 255)), constant(1.0))
    x = apply("Transpose", apply("Unsqueeze", x, constant([0], np.int64)), perm=[0, 3, 1, 2])
    x = apply("SpaceToDepth", x, blocksize=BLOCK)
    skipped = []
    for depth in range(len(weights.module.widths)):
        if depth:
            skipped.append(x)
        x = apply("Relu", conv(x, 2 if depth else 1))
        if depth < 2:
            x = apply("Relu", conv(x))
        else:
            x = apply("Add", x, apply("Relu", conv(apply("Relu", conv(x)))))
    for skip in reversed(skipped):
        x = apply("Relu", conv(apply("Concat", enlarged(x), skip, axis=1)))
    x = apply("DepthToSpace", conv(x, side=1), blocksize=BLOCK, mode="DCR")
    x = apply("Squeeze", apply("ArgMax", x, axis=1, keepdims=0), constant([0], np.int64))
    nodes[-1].output[0] = "labels"

    given = helper.make_tensor_value_info("picture", TensorProto.UINT8, [size, size, 3])
    made = helper.make_tensor_value_info("labels", TensorProto.INT64, [size, size])
    return finished("segmenter", nodes, constants, given, made, schema(weights))
