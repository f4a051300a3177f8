"""OpenGL contexts without a display, for MuJoCo's renderer: EGL, or OSMesa, which renders in memory."""

import contextlib
import os
from collections.abc import Iterator


def context(width: int, height: int):
    """A context for rendering images of this size, with the methods `make_current` and `free`.

    The environment variable MUJOCO_GL chooses one of egl and osmesa; otherwise EGL is tried first.

    Raises:
        RuntimeError: if neither is available, with what to install.
    """
    wanted = os.environ.get("MUJOCO_GL", "").lower()
    reasons = []
    for kind in (wanted,) if wanted in ("egl", "osmesa") else ("egl", "osmesa"):
        with _platform(kind):
            try:
                if kind == "egl":
                    from mujoco.egl import GLContext
                else:
                    from mujoco.osmesa import GLContext
                return GLContext(width, height)
            except Exception as error:  # a library, a driver or a device is missing
                reasons.append(f"{kind}: {str(error).splitlines()[0] if str(error) else type(error).__name__}")
    raise RuntimeError(
        f"MuJoCo's renderer needs EGL or OSMesa (on Debian: apt install libosmesa6), got {'; '.join(reasons)}"
    )


@contextlib.contextmanager
def _platform(kind: str) -> Iterator[None]:
    """Choose PyOpenGL's platform, which it reads only once, when it is first imported."""
    before = os.environ.get("PYOPENGL_PLATFORM")
    os.environ["PYOPENGL_PLATFORM"] = kind
    try:
        yield
    finally:
        if before is None:
            os.environ.pop("PYOPENGL_PLATFORM")
        else:
            os.environ["PYOPENGL_PLATFORM"] = before
