"""`jaxlfi r2s2r` with small stages: the loop is the real one, and so are `jaxlfi train` and `jaxlfi infer` within it.

    python -m tests.reliability.loop --object dlo-0 --out runs/loop

A loop of the whip takes a quarter of an hour even at its smallest. Here a cart is trained on, the linear Gaussian task
is inferred, and the rollout, the policies' deployment on the object and the page are files of a line.
"""

import sys
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace

from jaxlfi.cli import parser, train
from jaxlfi.envs.whip import r2s2r, r2s2r_page
from jaxlfi.io import files
from tests.reliability.commands import CART, FAST

UNDRAWN = "--no-figures"


def trained(words: Sequence[str]) -> int:
    """In the place of a training on the whip."""
    return train.main([*(word for word in CART if word != UNDRAWN), "--out", _out(words)])


def inferred(words: Sequence[str]) -> int:
    """In the place of inference of the object; what was begun is gone on with as it is."""
    if words[0] != "infer":
        return parser.main(list(words))
    fast = [word for word in FAST if word != UNDRAWN]
    return parser.main(["infer", "gaussian_linear", *fast, "--out", _out(words)])


def deployed(words: Sequence[str]) -> int:
    """In the place of the policies on the object."""
    out = Path(_out(words))
    out.mkdir(parents=True)
    for name in ("episodes.csv", "table.csv"):
        files.write_bytes(out / name, b"policy,return\nfirst,1\n")
    return 0


def rolled(arguments: object, policy: Path, path: Path, iteration: int) -> Path:
    """In the place of a rollout, which is complete once its second file is there."""
    if not path.with_suffix(".json").exists():
        files.write_bytes(path, policy.read_bytes())
        files.write_json(path.with_suffix(".json"), {"iteration": iteration})
    return path


def page(arguments: SimpleNamespace, policies: Sequence[Path]) -> Path:
    """In the place of the page."""
    files.write_bytes(arguments.out / "page.html", f"<html>{policies}</html>".encode())
    return arguments.out / "page.html"


def _out(words: Sequence[str]) -> str:
    return words[words.index("--out") + 1]


def main(words: Sequence[str]) -> int:
    """Run the loop with these stages."""
    r2s2r.train = SimpleNamespace(main=trained, check_seeds=train.check_seeds)
    r2s2r.command_line, r2s2r.whip = SimpleNamespace(main=inferred), SimpleNamespace(main=deployed)
    r2s2r._rollout, r2s2r_page.write = rolled, page
    return r2s2r.main(list(words))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
