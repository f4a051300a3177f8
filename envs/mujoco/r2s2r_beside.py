"""Further domains that `jaxlfi r2s2r mujoco` trains on, to compare posteriors with, as `train` takes them.

| name | trained on |
|---|---|
| uniform | the first guess Theta_0, whatever was recorded |
| point | the least-squares point of `jaxlfi mujoco fit`, from draws of Phi, given all recordings |
| sysid | the point of `mujoco.sysid`, from the middle of Theta_0, given the same; needs the extra `bench` |
"""

import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jaxlfi.cli import loops
from jaxlfi.envs.mujoco import cli as mujoco_command

ARMS = ("uniform", "point", "sysid")
TITLES = {
    "uniform": "uniform box",
    "point": "point of least squares (jaxlfi mujoco fit)",
    "sysid": "point of mujoco.sysid",
}
"""Their names in tables."""


def check(arms: Sequence[str]) -> None:
    """Refuse domains that cannot be used for comparison.

    Raises:
        ValueError: for one that is named twice.
        ImportError: for the point of mujoco.sysid where that is not installed.
    """
    if len(set(arms)) < len(arms):
        raise ValueError(f"beside: expected each once, got {' '.join(arms)}")
    if "sysid" in arms:
        from jaxlfi.envs.mujoco import sysid_point

        sysid_point.require_sysid()


def domain_of(arm: str, task: str, recordings: Sequence[Path], out: Path) -> str:
    """The domain of an arm, as `jaxlfi train --domain` takes it.

    Args:
        arm: its name.
        task: as `jaxlfi infer` takes it.
        recordings: all of them.
        out: folder of the loop.
    """
    if arm == "uniform":
        return arm
    folder = out / arm / "fit"
    if not (folder / "pairs.png").exists():  # the last of its files
        shutil.rmtree(folder, ignore_errors=True)
        logs = ";".join(map(str, recordings))
        words = ["fit", f"{task},log={logs}", "--out", str(folder), *(["--sysid"] if arm == "sysid" else [])]
        loops.done(mujoco_command.main, ["mujoco"], words, TITLES[arm])
    return "point:" + ",".join(map(repr, found_point(arm, out)["theta"]))


def found_point(arm: str, out: Path) -> dict[str, Any]:
    """A point with its names and intervals, as `jaxlfi mujoco fit` left it in the folder of the loop."""
    found = json.loads((out / arm / "fit" / "fit.json").read_text())
    return found["mujoco.sysid"] if arm == "sysid" else found["points"][0]
