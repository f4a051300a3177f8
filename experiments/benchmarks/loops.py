"""Cost of a program, loop by loop: XLA's own analysis counts the body of a loop once, whatever its number of steps.

Each body is therefore compiled separately, and its cost is multiplied by its steps. XLA's analysis assigns no cost to
calls of libraries (matrix decompositions).
"""

import dataclasses
import re
from collections.abc import Iterator, Sequence
from typing import Any

import jax
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun

OPTIONS = {"xla_cpu_use_fusion_emitters": False}
"""Compiler options; the newer fusions take long to compile."""
FEW = 16
"""Largest number of equations of a body that counts as one kernel and is not compiled."""
NO_KERNELS = {"parameter", "constant", "tuple", "get-tuple-element", "bitcast", "while", "iota", "after-all"}
"""Instructions of a compiled program for which an accelerator launches no kernel."""


@dataclasses.dataclass(frozen=True)
class Part:
    """A loop's body without its inner loops, or the code outside of all loops.

    Attributes:
        steps: number of sequential runs.
        operations: number of floating-point operations in one step.
        bytes: number of bytes read and written by one step.
        kernels: number of instructions after fusion, each of which is a launch on an accelerator.
    """

    steps: float
    operations: float
    bytes: float
    kernels: float


def parts(function: Any, arguments: tuple, steps: Sequence[float] = ()) -> list[Part]:
    """The parts of a program, compiled for this machine's CPU.

    Args:
        function: the program, jitted or not.
        arguments: arrays, or their shapes.
        steps: numbers of steps of loops without a fixed length, in the order of the program, outer loops first.

    Raises:
        ValueError: for another number of such loops.
    """
    left = list(steps)
    found = list(_parts(jax.make_jaxpr(function)(*arguments), 1, left))
    if left:
        raise ValueError(f"steps: expected those of {len(steps) - len(left)} loops without a length, got {len(steps)}")
    return found


def _parts(program: ClosedJaxpr, steps: float, left: list[float]) -> Iterator[Part]:
    whole: tuple[float, ...] = _cost(program)
    for equation in _loops(program.jaxpr):
        fixed = equation.primitive.name == "scan"
        if not fixed and not left:
            raise ValueError("steps: expected those of every loop without a length, got fewer")
        body = equation.params["jaxpr" if fixed else "body_jaxpr"]
        once = _cost(body)
        whole = tuple(max(all_ - own, 0.0) for all_, own in zip(whole, once, strict=True))
        yield from _parts(body, steps * (equation.params["length"] if fixed else left.pop(0)), left)
    yield Part(steps, *whole)


def _loops(jaxpr: Any) -> Iterator[Any]:
    """Loops that are not inside of other loops."""
    for equation in jaxpr.eqns:
        if equation.primitive.name in ("scan", "while"):
            yield equation
            continue
        for value in jax.tree.leaves(list(equation.params.values()), is_leaf=lambda leaf: hasattr(leaf, "eqns")):
            if hasattr(value, "eqns"):
                yield from _loops(getattr(value, "jaxpr", value))


def _cost(program: ClosedJaxpr) -> tuple[float, float, float]:
    """Operations, bytes and kernels, where each loop's body counts once."""
    lowered = jax.jit(jaxpr_as_fun(program)).lower(*(jax.ShapeDtypeStruct(v.shape, v.dtype) for v in program.in_avals))
    if len(program.jaxpr.eqns) <= FEW and not any(_loops(program.jaxpr)):
        found, launched = lowered.cost_analysis() or {}, 1.0
    else:
        compiled = lowered.compile(compiler_options=OPTIONS)
        found, launched = compiled.cost_analysis() or {}, kernels(compiled.as_text())
    return found.get("flops", 0.0), found.get("bytes accessed", 0.0), launched


def kernels(text: str) -> float:
    r"""Instructions of a compiled module that are launches: those of its entry and of the bodies of its loops.

    Example:
        >>> kernels("%f (p: f32[]) -> f32[] { ROOT %a = f32[] add(%p, %p) }\nENTRY %m (p: f32[2]) -> f32[2] {\n"
        ...     "  %p = f32[2] parameter(0)\n  ROOT %c = f32[2] fusion(%p), kind=kLoop, calls=%f\n}")
        1.0
    """
    bodies = set(re.findall(r"body=%?([\w.-]+)", text))
    count, inside = 0, False
    for line in text.splitlines():
        if head := re.match(r"(ENTRY )?%?([\w.-]+) \(.*\{$", line):
            inside = bool(head[1]) or head[2] in bodies
        elif line.startswith("}"):
            inside = False
        elif inside and (instruction := re.search(r" = .*?[\]\})] ([\w-]+)\(", line)):
            count += instruction[1] not in NO_KERNELS
    return float(count)
