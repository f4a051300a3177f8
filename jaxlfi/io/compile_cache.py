"""A cache of compiled programs on disk, so that only the first run of a kind waits for the compiler.

Measured with jax 0.9.2 on two CPU cores (one round of inference, `quick`): compiling took 8 s of processor time,
loading from the cache 0.4 s; the file has half a megabyte.

On every load XLA logs that "+prefer-no-gather" and the like are not features of the machine. They never are: they are
the compiler's own preferences, listed as if they were features. The log is silenced before jax starts, or filtered if
it has started. To keep apart programs of machines that really differ, the folder is named by a hash of the processor's
model and features.
"""

import contextlib
import hashlib
import importlib.metadata
import os
import platform
import tempfile
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

SWITCH = "JAXLFI_COMPILE_CACHE"
"""Environment variable that turns the cache off if it is 0."""
LEAST_SECONDS = 0.5
"""Compilation time in s below which programs are not kept."""
NOISE = (
    b"PjRt-IFRT does not track XLA executable versions",
    b"Loading XLA:CPU AOT result. Target machine feature +prefer",
)
"""Messages that XLA logs for every program that it loads."""
FEATURE_LINES = ("model name", "flags", "Features", "CPU implementer", "CPU part")
"""Lines of /proc/cpuinfo that identify which machine code a processor runs, on x86 and on Arm."""


def enable() -> Path | None:
    """Switch the cache on; call this before jax is imported. A folder named by the user is kept.

    Returns:
        The cache's folder, or None if it cannot be written and the cache stays off.
    """
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", str(LEAST_SECONDS))
    if "JAX_COMPILATION_CACHE_DIR" in os.environ:
        return Path(os.environ["JAX_COMPILATION_CACHE_DIR"])
    folder = default_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return None
    os.environ["JAX_COMPILATION_CACHE_DIR"] = str(folder)
    return folder


@contextlib.contextmanager
def used() -> Iterator[None]:
    """Use the cache within this context, unless the process has its own cache or `SWITCH` turns it off.

    In a process whose jax has started, only jaxlfi's programs are kept; the process's own functions are left alone.
    """
    import jax  # here, as the command line enables the cache before jax is imported

    if (folder := _folder()) is None:
        yield
        return
    wanted = {
        "jax_compilation_cache_dir": str(folder),
        "jax_persistent_cache_min_compile_time_secs": LEAST_SECONDS,
    }
    before = {name: getattr(jax.config, name) for name in wanted}
    _configure(wanted)
    try:
        with _without_noise():
            yield
    finally:
        _configure(before)


def kept_in() -> Path | None:
    """The folder of kept programs, whoever named it; None if nothing is kept."""
    import jax

    if os.environ.get(SWITCH) == "0" or not jax.config.jax_enable_compilation_cache:  # type: ignore[attr-defined]
        return None
    given = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    return _folder() if given is None else Path(given)


def _configure(values: Mapping[str, Any]) -> None:
    import jax
    from jax.experimental.compilation_cache import compilation_cache

    for name, value in values.items():
        jax.config.update(name, value)
    compilation_cache.reset_cache()  # jax looks for a folder once


def _folder() -> Path | None:
    """The folder to use in a process whose jax has started; None if there is none, or another one is used."""
    import jax

    # jax defines both at run time
    given = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    enabled = jax.config.jax_enable_compilation_cache  # type: ignore[attr-defined]
    if given is not None or not enabled or os.environ.get(SWITCH) == "0":
        return None
    folder = default_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        warnings.warn(f"programs are not kept for the next process: {error}", stacklevel=2)
        os.environ[SWITCH] = "0"  # to warn only once
        return None
    return folder


@contextlib.contextmanager
def _without_noise() -> Iterator[None]:
    """Keep `NOISE` off the terminal; all other output to it appears once the programs are ready."""
    try:
        terminal = os.dup(2)
    except OSError:  # there is none
        yield
        return
    with tempfile.TemporaryFile() as caught:
        os.dup2(caught.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(terminal, 2)
            os.close(terminal)
            caught.seek(0)
            for line in caught:
                if not any(noise in line for noise in NOISE):
                    os.write(2, line)


def default_folder() -> Path:
    """The folder for programs of this processor and this jaxlib."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    identity = f"{_processor_features()}\n{importlib.metadata.version('jaxlib')}"
    return Path(base) / "jaxlfi" / "xla" / hashlib.sha256(identity.encode()).hexdigest()[:16]


def _processor_features() -> str:
    """A text that distinguishes processors that cannot run each other's programs."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return f"{platform.machine()} {platform.processor()}"
    return "\n".join(sorted({line for line in lines if line.startswith(FEATURE_LINES)}))
