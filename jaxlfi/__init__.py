"""Likelihood-free inference in JAX that notices when its prior's support is wrong, and moves it.

The public names are those in `__init__.pyi`, which type checkers read as well. They are loaded on first use, so that
the command line responds at once.
"""

import ast
import importlib
import pathlib
from typing import Any

__version__ = "0.1.0"

_HOMES: dict[str, str] = {
    alias.name: f"jaxlfi.{alias.name}" if node.module == "jaxlfi" else str(node.module)
    for node in ast.parse(pathlib.Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8")).body
    if isinstance(node, ast.ImportFrom)
    for alias in node.names
}
"""The module in which each public name lives; a public module is its own home."""

__all__ = sorted(name for name, home in _HOMES.items() if home != f"jaxlfi.{name}")


def __getattr__(name: str) -> Any:
    """Load a public name from the module it lives in."""
    if name not in _HOMES:
        raise AttributeError(f"module 'jaxlfi' has no attribute {name!r}")
    home = importlib.import_module(_HOMES[name])
    value = getattr(home, name) if name in __all__ else home
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOMES})
