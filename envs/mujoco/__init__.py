"""Real2Sim of any MuJoCo model: its uncertain parameters, inferred from a log of controls and sensors.

Needs the extra `mujoco`.
"""

from pathlib import Path
from typing import Literal


def task(
    config: Path,
    log: tuple[Path, ...] = (),
    summary: str | None = None,
    engine: Literal["native", "mjx"] = "native",
):
    """The task that a TOML file describes (`jaxlfi.envs.mujoco.config`).

    Args:
        config: the file.
        log: recordings in place of those that the file names; several are episodes of the same parameters.
        summary: name of the network's input, in place of the file's.
        engine: "native" is MuJoCo on all CPU cores; "mjx" is MuJoCo in JAX, if it can simulate the model.

    Raises:
        ImportError: if MuJoCo, or MJX for its engine, is not installed, with what to install.
        ValueError: for inconsistent input, in one line.
    """
    require_mujoco()
    from jaxlfi.envs.mujoco.config import read

    return read(config, log, summary, engine)


def require_mujoco() -> None:
    """Check that MuJoCo is installed.

    Raises:
        ImportError: if it is not, with what to install.
    """
    try:
        import mujoco  # noqa: F401
    except ImportError as error:
        raise ImportError("tasks of MuJoCo models need MuJoCo: pip install 'jaxlfi[mujoco]'") from error
