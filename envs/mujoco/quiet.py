"""MuJoCo without its warnings."""

import contextlib
from collections.abc import Iterator

import mujoco


@contextlib.contextmanager
def quietly() -> Iterator[None]:
    """Suppress MuJoCo's warnings, which it prints and appends to a file: simulators count failures instead."""
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda message: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)
