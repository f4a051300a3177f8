"""Makes a small folder of everything that jaxlfi writes and reads back, as this version of it writes them (a minute).

Run as `python -m tests.golden.make_formats NAME` before or after a format changes; formats/NAME is kept from then on,
and `tests/runs/test_formats.py` reads it. NAME begins with the version of run folders. Of the folders there, "1" is by
the jaxlfi of 22 November 2026, 13:50, before run folders had version 2, and "2-first" by that of 14:52, after it; the
time at which they were `started` is that of the code.
"""

import argparse
import contextlib
import shutil
import sys
import tempfile
from pathlib import Path

import jax
import numpy as np

from jaxlfi.io import files
from tests.small import FLAGS, TASK, command

PLACE = Path(__file__).with_name("formats")
SMALL = " ".join(FLAGS)
ONE = f"{SMALL} --rounds 1 --no-predictive"
FLOW = "--transforms 1 --hidden 8 --ensemble-size 1 --epochs 3 --patience 0 --validation 0 --regression 0"
ROUND = "--simulations-per-round 20 --simulation-budget 25 --no-predictive --no-figures"
COMMANDS = {
    "run": f"infer {TASK} {SMALL} --keep-network",
    "flow": f"infer {TASK} --method npe {FLOW} {ROUND}",
    "comparison": f"compare {TASK} {ONE} --configurations ok misspecified+edge --seeds 1",
    "grid": f"grid {TASK} {ONE} --vary expansion=0.1,0.3 --seeds 2",
    "flow/diagnostics": "diagnose {out}/flow --truths 20 --draws 20 --no-figures",
}
"""Commands by the folders they write, which come after them as --out."""


def make(out: Path) -> None:
    """Write all of it into a folder that is there."""
    for name, words in COMMANDS.items():
        _run(f"{words.format(out=out)} --out {out / name}")
    _stopped(out / "stopped")
    _policy(out / "policy.npz")
    _recording(out / "recording.npz")
    _weights(out / "segmenter.npz")
    for lock in out.rglob("*.lock"):
        lock.unlink()


def _run(words: str) -> None:
    if status := command(*words.split()):
        raise SystemExit(f"jaxlfi {words}: exit status {status}")


def _stopped(out: Path) -> None:
    """A run of two rounds that was interrupted after the first."""
    from jaxlfi.runs.checkpoint import Checkpoint

    write = Checkpoint.write_round

    def once(self, index, *arguments):
        if index:
            raise KeyboardInterrupt
        write(self, index, *arguments)

    Checkpoint.write_round = once
    try:
        if command(*f"infer {TASK} {SMALL} --out {out}".split()) != 130:
            raise SystemExit("expected the run to be interrupted")
    finally:
        Checkpoint.write_round = write


def _policy(path: Path) -> None:
    from jaxlfi.rl.policy import Policy

    signals = {"names": ["x", "y"], "units": ["m", ""], "centre": [1.0, 0.0], "scale": [0.5, 2.0]}
    schema = {"environment": "line", "observations": signals, "actions": signals}
    rng = np.random.default_rng(0)
    shapes = (2, 3), (3, 2)
    weights = tuple(rng.normal(size=shape).astype(np.float32) for shape in shapes)
    Policy(weights, tuple(np.ones(shape[1], np.float32) for shape in shapes), schema).save(path)


def _recording(path: Path) -> None:
    from jaxlfi.envs.whip import recording
    from tests.envs.whip.test_formats import recorded

    recording.write(path, recorded(rate=12.0))


def _weights(path: Path) -> None:
    from jaxlfi.envs.whip.vision import weights
    from jaxlfi.envs.whip.vision.segmenter import Segmenter
    from jaxlfi.io.provenance import environment

    network = Segmenter((8, 8, 8))
    weights.save(path, weights.Weights(network, weights.initial(network, jax.random.key(0)), environment()))


def main() -> None:
    """Write formats/NAME, whole or not at all."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("name", help="of the folder in tests/golden/formats")
    out = PLACE / parser.parse_args().name
    if out.exists():
        raise SystemExit(f"expected a new folder, got {out}")
    with tempfile.TemporaryDirectory() as place, contextlib.redirect_stdout(sys.stderr):
        make(Path(place))
        for path in Path(place).rglob("*.json"):
            found = files.read_json(path)
            if found.pop("platform", None):  # of no use to a reader
                files.write_json(path, found)
        shutil.copytree(place, out)
    print(out)


if __name__ == "__main__":
    main()
