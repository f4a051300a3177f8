"""Engines by name."""

import contextlib
import functools
import io

import jax

from jaxlfi.envs.whip.physics.engine import Engine
from jaxlfi.envs.whip.physics.scene import Scene

NAMES = ("auto", "native", "mjx", "warp")
"""Names that `pick` accepts."""


def pick(name: str = "auto", scene: Scene = Scene()) -> Engine:
    """The engine of a name.

    Args:
        name: "native" is MuJoCo on the processor's cores, the fastest without an accelerator; "mjx" is MuJoCo
            in JAX, "warp" its kernels in Warp; "auto" is native if JAX's default platform is the processor, else mjx.
        scene: settings that all scenes of the engine share.

    Raises:
        ValueError: for an unknown name.
        ImportError: if a library that the engine needs is not installed.

    Example:
        >>> type(pick("native")).__name__
        'NativeEngine'
    """
    if name not in NAMES:
        raise ValueError(f"engine: expected one of {', '.join(NAMES)}, got {name!r}")
    if name == "auto":
        name = "native" if jax.default_backend() == "cpu" else "mjx"
    return _made(name, scene)


@functools.lru_cache(maxsize=16)  # programs are compiled for an engine object
def _made(name: str, scene: Scene) -> Engine:
    if name == "native":
        from jaxlfi.envs.whip.physics.native import NativeEngine

        return NativeEngine(scene)
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # MJX prints there that Warp is not installed
            from jaxlfi.envs.whip.physics.mjx_engine import MjxEngine
    except ImportError as error:
        raise ImportError(f"engine: {name!r} needs MJX: pip install 'jaxlfi[whip]'") from error
    return MjxEngine(scene, "jax" if name == "mjx" else "warp")
