"""Self-describing fields: hyperparameters and options with a help text, a symbol and a range.

Checks, command-line flags, the glossary and the documentation are all generated from this metadata. The module imports
jax and numpy only when they are needed, so that the command line can use it before jax starts.
"""

import dataclasses
import math
import sys
from collections.abc import Iterable, Mapping
from typing import Any, ClassVar, Self, cast, dataclass_transform

KEY = "jaxlfi"
"""The key of a field's metadata that holds its `FieldInfo`."""
MAX_CHECKED = 4096
"""Largest number of elements of an array on a device whose values are fetched to be checked."""


@dataclasses.dataclass(frozen=True)
class FieldInfo:
    """Meaning and range of a field. None means no limit; infinity is allowed only if `low` or `high` is infinite.

    Attributes:
        help: description in one line, in lower case without a full stop.
        symbol: the paper's symbol, spelt out ("delta"); empty if there is none.
        low: smallest value.
        high: largest value.
        above: exclusive lower limit.
        below: exclusive upper limit.
        choices: the values it can take, if they are few.

    Example:
        >>> FieldInfo("mass given up", low=0, below=0.5).interval
        '[0, 0.5)'
    """

    help: str
    symbol: str = ""
    low: float | None = None
    high: float | None = None
    above: float | None = None
    below: float | None = None
    choices: tuple | None = None

    @property
    def interval(self) -> str:
        """The range in mathematical notation."""
        left = f"({self.above:g}" if self.above is not None else "(-inf" if self.low is None else f"[{self.low:g}"
        right = f"{self.below:g})" if self.below is not None else "inf)" if self.high is None else f"{self.high:g}]"
        return f"{left}, {right}"

    def contains(self, values: Any) -> bool:
        """Whether all of these numbers lie in the range in single precision, in which runs compute."""
        import numpy as np

        tests = (
            (np.greater_equal, self.low), (np.less_equal, self.high), (np.greater, self.above), (np.less, self.below),
        )  # fmt: skip
        infinite = [limit for limit in (self.low, self.high) if limit is not None and math.isinf(limit)]
        with np.errstate(over="ignore"):
            values = np.asarray(values, np.float32)
            known = np.isfinite(values) | np.isin(values, infinite)
            within = [test(values, np.float32(limit)) for test, limit in tests if limit is not None]
        return bool(np.all([known, *within]))


@dataclasses.dataclass(frozen=True)
class Declared:
    """A field as its class declares it.

    Attributes:
        name: name of the field.
        default: default value.
        info: meaning and range.
        static: whether it is a compile-time constant (`option`) rather than a leaf (`hyperparameter`).
    """

    name: str
    default: Any
    info: FieldInfo
    static: bool


def hyperparameter(
    default: Any,
    *,
    help: str,
    symbol: str = "",
    low: float | None = None,
    high: float | None = None,
    above: float | None = None,
    below: float | None = None,
) -> Any:
    """A number that is a leaf of the pytree, so that `vmap` can map over it.

    Args:
        default: default value; pass it by keyword so that type checkers notice it.
        help: description in one line.
        symbol: the paper's symbol, spelt out.
        low: smallest value.
        high: largest value; `math.inf` allows infinity, None means any finite number.
        above: exclusive lower limit, in place of `low`.
        below: exclusive upper limit, in place of `high`.

    Example:
        >>> class Step(Checked):
        ...     size: float = hyperparameter(default=0.2, help="how far to go", symbol="eta", low=0)
        >>> Step(size=-1)
        Traceback (most recent call last):
        ValueError: size: expected a number in [0, inf), got -1
    """
    return _field(default, True, FieldInfo(help, symbol, low, high, above, below))


def option(
    default: Any,
    *,
    help: str,
    symbol: str = "",
    choices: tuple | None = None,
    low: float | None = None,
    high: float | None = None,
    above: float | None = None,
    below: float | None = None,
) -> Any:
    """A value that determines shapes or structure, and so is a compile-time constant, not a leaf of the pytree.

    Its type is that of its default. The elements of a tuple are checked one by one. The arguments are those of
    `hyperparameter`, and `choices`: the values it can take, if they are few.
    """
    choices = None if choices is None else tuple(choices)
    return _field(default, False, FieldInfo(help, symbol, low, high, above, below, choices))


def _field(default: Any, leaf: bool, info: FieldInfo) -> Any:
    # Equivalent to flax.struct.field, but flax would import jax.
    return dataclasses.field(default=default, metadata={"pytree_node": leaf, KEY: info})


def declared(kind: Any) -> dict[str, Declared]:
    """The hyperparameters and options of a dataclass or of an instance, by name, in their order.

    Example:
        >>> from jaxlfi.heuristics import Truncate
        >>> declared(Truncate)["quantile"].info.interval
        '[0, 0.5)'
    """
    return described({field.name: field for field in dataclasses.fields(kind)})


def described(every: Mapping[str, dataclasses.Field]) -> dict[str, Declared]:
    """The declarations of fields, by name; fields made neither by `hyperparameter` nor by `option` are left out."""
    return {
        name: Declared(name, field.default, field.metadata[KEY], not field.metadata["pytree_node"])
        for name, field in every.items()
        if KEY in field.metadata
    }


def check_fields(value: Any) -> None:
    """Refuse invalid fields of a dataclass: out of range, not finite, not among the choices.

    Only values are checked. A leaf may also hold a tracer or a shape, whose value is not known yet, or, in a tree that
    describes another, None, a boolean (mask) or a foreign object in a value's place. Integers may be axes (`in_axes`),
    but are far more often values, and are checked.

    Raises:
        ValueError: naming the field, what was expected and what was given.
    """
    for name, field in declared(value).items():
        check_value(field, getattr(value, name))


def check_value(field: Declared, value: Any) -> None:
    """Refuse one value of a field; see `check_fields`."""
    if value is None and (not field.static or field.default is None):
        return
    if not field.static:
        if _is_known(value):
            _check_number(field, value, whole=False)
    elif field.info.choices is not None:
        if not isinstance(value, tuple({type(one) for one in field.info.choices})) or value not in field.info.choices:
            raise _wrong(field, f"one of {', '.join(map(str, field.info.choices))}", value)
    elif isinstance(field.default, tuple):
        if not isinstance(value, tuple):
            raise _wrong(field, "a tuple", value)
        element = dataclasses.replace(field, default=field.default[0] if field.default else None)
        for part in value:
            check_value(element, part)
    elif isinstance(field.default, bool | str):
        if not isinstance(value, type(field.default)):
            raise _wrong(field, "text" if isinstance(field.default, str) else "True or False", value)
    elif isinstance(field.default, int | float):
        _check_number(field, value, whole=isinstance(field.default, int))


def _check_number(field: Declared, value: Any, whole: bool) -> None:
    import numpy as np

    if isinstance(value, int) and not isinstance(value, bool):
        right = field.info.contains(min(max(value, -(10**30)), 10**30))  # NumPy has no integers of arbitrary size
    else:
        # JAX treats lists and tuples as trees of numbers, not as vectors.
        array = np.asarray(None if isinstance(value, list | tuple) else value)
        right = array.dtype.kind in ("iu" if whole else "iufV") and field.info.contains(array)
    if not right:
        raise _wrong(field, f"a {'whole ' * whole}number in {field.info.interval}", value)


def _wrong(field: Declared, expected: str, value: Any) -> ValueError:
    shown = value.tolist() if hasattr(value, "tolist") else value
    return ValueError(f"{field.name}: expected {expected}, got {shown!r}")


def _is_known(value: Any) -> bool:
    """Whether a leaf holds a value, valid or not, rather than a placeholder."""
    import numpy as np

    if isinstance(value, bool | np.bool_):
        return False
    if isinstance(value, int | float | complex | str | list | tuple | np.generic):
        return True
    if isinstance(value, np.ndarray):
        return value.dtype.kind != "b"
    jax = sys.modules.get("jax")
    if jax is None or not isinstance(value, jax.Array) or isinstance(value, jax.core.Tracer):
        return False
    # Large arrays are not waited for, and those of other processes cannot be read.
    seen = value.size <= MAX_CHECKED and value.is_fully_addressable and not value.is_deleted()
    return seen and jax.numpy.issubdtype(value.dtype, jax.numpy.number)


@dataclass_transform(frozen_default=True, field_specifiers=(hyperparameter, option, dataclasses.field))
class Checked:
    """Base class of frozen dataclasses that are pytrees and refuse invalid fields. Subclasses need no decorator.

    Fields are checked when a value is constructed or replaced, but not when JAX flattens and unflattens a tree:
    gradients, optimiser states, axes and batches are trees of the same class whose leaves are not hyperparameters.
    (`flax.struct.dataclass` would check there as well; on a subclass of this class it changes nothing.)

    Example:
        >>> import jax
        >>> class Step(Checked):
        ...     size: float = hyperparameter(default=0.2, help="how far to go", low=0, high=1)
        ...     kind: str = option(default="up", help="where to go", choices=("up", "down"))
        >>> jax.tree.map(lambda size: -size, Step())
        Step(size=-0.2, kind='up')
        >>> Step(kind="left")
        Traceback (most recent call last):
        ValueError: kind: expected one of up, down, got 'left'
    """

    _flax_dataclass: ClassVar[bool]

    def __init_subclass__(cls, **kwargs):
        super().__init_subclass__(**kwargs)
        dataclasses.dataclass(frozen=True)(cls)
        _register(cls)
        cls._flax_dataclass = True  # tells flax that this class is a dataclass already

    def __post_init__(self):
        check_fields(self)

    def replace(self, **changes: Any) -> Self:
        """A copy with some fields replaced; all fields are checked."""
        return dataclasses.replace(cast(Any, self), **changes)


def _register(kind: type) -> None:
    """Register a dataclass as a pytree that is unflattened without calling its `__init__`."""
    import jax

    every = dataclasses.fields(kind)
    leaves = [field.name for field in every if field.metadata.get("pytree_node", True)]
    static = [field.name for field in every if field.name not in leaves]

    def flatten(value: Any) -> tuple[tuple, tuple]:
        return tuple(getattr(value, name) for name in leaves), tuple(getattr(value, name) for name in static)

    def flatten_with_keys(value: Any) -> tuple[tuple, tuple]:
        parts, fixed = flatten(value)
        return tuple(zip(map(jax.tree_util.GetAttrKey, leaves), parts, strict=True)), fixed

    def unflatten(fixed: tuple, parts: Iterable[Any]) -> Any:
        value: Any = object.__new__(kind)
        for name, part in (*zip(leaves, parts, strict=True), *zip(static, fixed, strict=True)):
            object.__setattr__(value, name, part)
        return value

    jax.tree_util.register_pytree_with_keys(kind, flatten_with_keys, unflatten, flatten)
