"""Whether simulators and summaries in JAX are pure: numbers drawn by NumPy or Python are frozen when JAX traces them.

Tracing alone finds them: such numbers are constants of the traced program, and change when it is traced again.
"""

import functools
import random
import time
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import jax
import numpy as np

from jaxlfi.tasks.errors import SimulatorError, SimulatorWarning

PATIENCE = 1.0
"""Seconds of tracing beyond which a function is traced again only if numbers were drawn meanwhile."""
RANDOM = ("random_", "threefry", "rng_")
"""Prefixes of the names of JAX's operations that draw numbers or make keys."""


def shapes(simulate: Callable[..., Any], key: Any, theta: Any) -> Any:
    """The shapes of a simulator's results, as from `jax.eval_shape`, after a check of where its noise comes from.

    Args:
        simulate: `simulate(key, theta)`.
        key: its shape.
        theta: its shape.

    Raises:
        SimulatorError: if it takes random numbers, or a time, from elsewhere than its key.
    """
    program, result, drawn = _traced(
        simulate,
        (key, theta),
        "simulate: expected all noise by jax.random from its key, got numbers of NumPy's or Python's (random, time) "
        "that JAX draws once for all simulations: use the key, or jaxlfi.HostSimulator for a simulator of NumPy's",
    )
    given = {program.jaxpr.invars[0]}
    if not _depends(program.jaxpr, given) and (drawn or _draws_apart(program.jaxpr, given)):
        warnings.warn(
            "simulate: draws random numbers, but none of them by the key it is given: all simulations have the same "
            "noise",
            SimulatorWarning,
            stacklevel=2,
        )
    return result


def summary_shape(summary: Callable[..., Any], trajectory: Any) -> Any:
    """The shape of a summary, given that of a trajectory.

    Raises:
        SimulatorError: if its constants differ each time, so that observation and simulations would not match.
    """
    _, result, _ = _traced(
        summary,
        (trajectory,),
        "summary: expected the same function whenever JAX traces it, got numbers of NumPy's or Python's (random, time) "
        "that are others each time: draw them once, outside of it",
    )
    return result


def _traced(function: Callable[..., Any], given: tuple, refused: str) -> tuple[Any, Any, bool]:
    """A traced function, the shapes of its results, and whether it drew from NumPy's global generator."""
    function, start = _unwrapped(function), _state()
    began = time.perf_counter()
    program, result = jax.make_jaxpr(lambda *given: function(*given), return_shape=True)(*given)
    drawn = _state() != start
    if time.perf_counter() - began < PATIENCE or drawn:
        # From another state, as the function may set it. Imports of the first trace may have drawn numbers, too.
        other = np.random.random(), random.random(), _state()  # noqa: NPY002
        again = jax.make_jaxpr(lambda *given: function(*given))(*given)
        drawn = _state()[0] != other[-1][0]  # type checkers draw from Python's own, too
        _restore(start)
        if not _same(list(_constants(program)), list(_constants(again))):
            raise SimulatorError(refused)
    return program, result, drawn


def _unwrapped(function: Any) -> Any:
    """The function itself if it is jitted, as it may have been traced before."""
    if isinstance(function, functools.partial):
        named = {name: _unwrapped(value) for name, value in function.keywords.items()}
        return functools.partial(_unwrapped(function.func), *map(_unwrapped, function.args), **named)
    return function.__wrapped__ if isinstance(function, _JITTED) else function


_JITTED: Any = type(jax.jit(lambda: None))


def _state() -> tuple[tuple, tuple]:
    """The state of NumPy's and Python's global generators, which a simulator may draw from."""
    state: Any = np.random.get_state()  # noqa: NPY002
    kind, words, *rest = state
    return (kind, words.tobytes(), *rest), random.getstate()


def _restore(state: tuple[tuple, tuple]) -> None:
    (kind, words, *rest), own = state
    np.random.set_state((kind, np.frombuffer(words, np.uint32), *rest))  # noqa: NPY002
    random.setstate(own)


def _depends(jaxpr: Any, on: set) -> bool:
    """Whether any result of a traced function depends on some of its variables."""
    return bool(_reached(jaxpr, on) & {out for out in jaxpr.outvars if not _is_literal(out)})


def _reached(jaxpr: Any, on: set) -> set:
    """The variables that depend on others."""
    reached = set(on)
    for equation in jaxpr.eqns:
        hit = [not _is_literal(variable) and variable in reached for variable in equation.invars]
        if not any(hit):
            continue
        inner = getattr(equation.params.get("jaxpr"), "jaxpr", None)
        if equation.primitive.name in ("jit", "pjit") and inner is not None:
            within = _reached(inner, {variable for variable, is_hit in zip(inner.invars, hit, strict=True) if is_hit})
            outs = zip(equation.outvars, inner.outvars, strict=True)
            reached |= {out for out, source in outs if not _is_literal(source) and source in within}
        else:
            reached |= set(equation.outvars)
    return reached


def _draws_apart(jaxpr: Any, key: set) -> bool:
    """Whether random numbers are drawn by a key that does not come from the given one."""
    reached = _reached(jaxpr, key)
    for equation in jaxpr.eqns:
        inner = [getattr(one, "jaxpr", one) for one in _inner(equation.params.values())]
        if not reached.isdisjoint(variable for variable in equation.invars if not _is_literal(variable)):
            continue
        names = {equation.primitive.name, *(name for one in inner for name in _operations(one))}
        if any(name.startswith(RANDOM) for name in names):
            return True
    return False


def _operations(jaxpr: Any) -> Iterator[str]:
    """Names of all operations of a traced function."""
    for equation in jaxpr.eqns:
        yield equation.primitive.name
        for inner in _inner(equation.params.values()):
            yield from _operations(getattr(inner, "jaxpr", inner))


def _constants(program: Any) -> Iterator[Any]:
    """All constants of a traced function."""
    yield from getattr(program, "consts", ())
    for equation in getattr(program, "jaxpr", program).eqns:
        yield from (variable.val for variable in equation.invars if _is_literal(variable))
        for inner in _inner(equation.params.values()):
            yield from _constants(inner)


def _inner(values: Any) -> Iterator[Any]:
    """Traced functions among the parameters of an operation."""
    for value in values:
        if isinstance(value, tuple | list):
            yield from _inner(value)
        elif hasattr(value, "eqns"):
            yield value


def _is_literal(variable: Any) -> bool:
    """Whether a variable is a literal number; the class of literals is in a package that is slow to import."""
    return hasattr(variable, "val")


def _same(first: list[Any], second: list[Any]) -> bool:
    """Whether two traces have the same constants; constants that are traced themselves count as equal."""
    return len(first) == len(second) and all(map(_equal, first, second))


def _equal(a: Any, b: Any) -> bool:
    if a is b or isinstance(a, jax.core.Tracer) or isinstance(b, jax.core.Tracer):
        return True
    if jax.dtypes.issubdtype(getattr(a, "dtype", np.float32), jax.dtypes.prng_key):
        a, b = jax.random.key_data(a), jax.random.key_data(b)
    a, b = np.asarray(a), np.asarray(b)
    return a.shape == b.shape and a.tobytes() == b.tobytes()
