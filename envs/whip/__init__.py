"""The DLO whipping task: physics, camera, rules and Real2Sim (section VI).

Needs the extra `whip` (MuJoCo and MJX).
"""

from typing import Literal


def task(
    object: tuple[str, ...] | str | None = None,
    detector: Literal["clean", "mask", "noisy", "transporter", "learnt", "learnt-transporter"] = "mask",
    nuisances: Literal["fixed", "random"] = "fixed",
    engine: Literal["auto", "native", "mjx", "warp"] = "auto",
    pooling: Literal["mean", "all", "moments"] = "mean",
    stack: Literal["clear", "any"] = "clear",
):
    """The Real2Sim task; its options are those of `jaxlfi.envs.whip.real2sim.task`.

    Raises:
        ImportError: if MuJoCo is not installed, with what to install.
    """
    require_mujoco()
    from jaxlfi.envs.whip.real2sim import task as make

    return make(object=object, detector=detector, nuisances=nuisances, engine=engine, pooling=pooling, stack=stack)


def require_mujoco() -> None:
    """Check that the extra `whip` is installed.

    Raises:
        ImportError: if it is not, with what to install.
    """
    try:
        import mujoco  # noqa: F401
    except ImportError as error:
        raise ImportError("the whipping task needs MuJoCo and MJX: pip install 'jaxlfi[whip]'") from error
