"""Real2Sim of any MuJoCo model: its doubtful numbers, inferred from a log of controls and sensors.

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
        summary: what the network sees of them, by its name, in place of what the file says.
        engine: "native" is MuJoCo on the processor's cores; "mjx" is MuJoCo in JAX, where it can simulate the model.

    Raises:
        ImportError: where MuJoCo, or MJX for its engine, is not installed, with what to install.
        ValueError: for whatever does not fit together, in one line.
    """
    require_mujoco()
    from jaxlfi.envs.mujoco.config import read

    return read(config, log, summary, engine)


def require_mujoco() -> None:
    """Check that MuJoCo is there.

    Raises:
        ImportError: where it is not, with what to install.
    """
    try:
        import mujoco  # noqa: F401
    except ImportError as error:
        raise ImportError("tasks of MuJoCo models need MuJoCo: pip install 'jaxlfi[mujoco]'") from error
