"""The command `jaxlfi export`: a trained policy as one file, for a robot's computer.

This module imports neither jax nor numpy before it has to, and jax for StableHLO only.
"""

import argparse
import sys
from pathlib import Path

from jaxlfi import flags
from jaxlfi.cli.command import Command

SUFFIXES = {"numpy": ".npz", "stablehlo": ".npz", "onnx": ".onnx"}
"""Suffixes of the files of each format."""
EXAMPLES = """\
formats, each with the policy's schema (names, units, scaling, limits, control interval, detector, versions):
  numpy      an .npz that jaxlfi.rl.policy.load runs with NumPy alone
  stablehlo  an .npz that jaxlfi.rl.stablehlo.load runs with JAX on cpu, cuda or tpu, for batches of any size
  onnx       for onnxruntime and others; needs the extra onnx

examples:
  jaxlfi export runs/policies/uniform/seed_000/policy.npz --format onnx --out policy.onnx
  jaxlfi export runs/uniform --format numpy --out policy.npz      the folder of a training of one policy

"""


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("policy", type=Path, metavar="POLICY", help="a policy.npz, or the folder of its training")
    parser.add_argument("--format", choices=SUFFIXES, default="numpy", help="format of the file (default: numpy)")
    parser.add_argument("--out", type=flags.output, required=True, metavar="FILE", help="a new file")
    parser.add_argument("--debug", action="store_true", help="show the traceback of an error")


def _export(arguments: argparse.Namespace) -> None:
    from jaxlfi.rl import deployment, policy, preparation

    out, suffix = arguments.out, SUFFIXES[arguments.format]
    if out.exists() or out.suffix != suffix:
        raise ValueError(f"out: expected a new {suffix} file, got {out}")
    path = policy_of(arguments.policy)
    trained = policy.load(path)
    if deployment.KEY in trained.schema:
        deployment.of_schema(trained.schema)
    preparation.of_schema(trained.schema)
    if arguments.format == "numpy":
        save = lambda policy, path: policy.save(path)
    elif arguments.format == "stablehlo":
        from jaxlfi.rl.stablehlo import save
    else:
        from jaxlfi.rl.onnx_graph import save
    out.parent.mkdir(parents=True, exist_ok=True)
    save(trained, out)
    print(f"wrote {out}, the policy {path}")


def policy_of(path: Path) -> Path:
    """The file of a policy, or the only one in the folder of a training."""
    if not path.is_dir():
        return path
    found = sorted(path.glob("policy.npz")) + sorted(path.glob("*/policy.npz")) + sorted(path.glob("*/*/policy.npz"))
    if len(found) != 1:
        some = ", ".join(str(one.relative_to(path)) for one in found[:4]) + ", ..." * (len(found) > 4)
        raise ValueError(f"policy: expected a folder with one policy.npz, got {path} with {some or 'none'}: name one")
    return found[0]


main = Command(
    "export",
    "convert a policy to a single file for a robot's computer",
    _arguments,
    _export,
    description="Convert a trained policy to a single file for another runtime.",
    epilog=EXAMPLES,
)
parser = main.parser


if __name__ == "__main__":
    sys.exit(main())
