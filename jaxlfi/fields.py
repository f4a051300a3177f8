"""Self-describing fields: hyperparameters and options with a help text, a symbol and a range.

Checks, flags of the command line, the glossary and the documentation are all made from this metadata. The module
imports neither jax nor numpy before they are needed, so that the command line can use it before jax starts.
"""

import dataclasses
import math
import sys
from collections.abc import Iterable, Mapping
from typing import Any, ClassVar, Self, cast, dataclass_transform

KEY = "jaxlfi"
"""The key of a field's metadata that holds its `FieldInfo`."""
MAX_CHECKED = 4096
"""Elements of an array on a device up to which its values are fetched to be checked."""


@dataclasses.dataclass(frozen=True)
class FieldInfo:
    """What a field means and which values it takes. None is no limit; infinity has to be allowed by `low` or `high`.

    Attributes:
        help: one line without a full stop, in lower case.
        symbol: the paper's, spelt out ("delta"); empty without one.
        low: the least value.
        high: the greatest value.
        above: an exclusive lower limit.
        below: an exclusive upper limit.
        choices: the values it can take, where they are few.

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
        """The range as it is written in mathematics."""
        left = f"({self.above:g}" if self.above is not None else "(-inf" if self.low is None else f"[{self.low:g}"
        right = f"{self.below:g})" if self.below is not None else "inf)" if self.high is None else f"{self.high:g}]"
        return f"{left}, {right}"

    def contains(self, values: Any) -> bool:
        """Whether all of these numbers lie in the range, in single precision, which is what runs compute with."""
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
        name: of the field.
        default: its default value.
        info: what it means.
        static: whether it is part of what is compiled (`option`), or else a leaf (`hyperparameter`).
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
        default: its value where none is given; type checkers see that there is one if it is given by keyword.
        help: what it is, in one line.
        symbol: the paper's, spelt out.
        low: least value.
        high: greatest value; `math.inf` allows infinity, None means any finite number.
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
    """A value that sets shapes or structure, and so is part of what is compiled: no leaf of the pytree.

    Its type is that of its default. The elements of a tuple are checked one by one. Arguments are those of
    `hyperparameter`, and `choices`: the values it can take, where they are few.
    """
    choices = None if choices is None else tuple(choices)
    return _field(default, False, FieldInfo(help, symbol, low, high, above, below, choices))


def _field(default: Any, leaf: bool, info: FieldInfo) -> Any:
    # What flax.struct.field makes; flax itself would import jax.
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
    """What fields declare, by name; those that were made neither by `hyperparameter` nor by `option` are left out."""
    return {
        name: Declared(name, field.default, field.metadata[KEY], not field.metadata["pytree_node"])
        for name, field in every.items()
        if KEY in field.metadata
    }


def check_fields(value: Any) -> None:
    """Refuse invalid fields of a dataclass: out of range, not finite, not among the choices.

    Only what is a value is looked at. In a leaf, tracers and shapes are not known yet, and None, truth values (masks)
    and foreign objects stand in a value's place in trees that describe others. Integers may be axes (`in_axes`), but
    are far more often values, and are checked.

    Raises:
        ValueError: naming the field, what was expected and what came.
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
        right = field.info.contains(min(max(value, -(10**30)), 10**30))  # NumPy has no integers of any size
    else:
        # Lists and tuples are trees of numbers to JAX, not vectors.
        array = np.asarray(None if isinstance(value, list | tuple) else value)
        right = array.dtype.kind in ("iu" if whole else "iufV") and field.info.contains(array)
    if not right:
        raise _wrong(field, f"a {'whole ' * whole}number in {field.info.interval}", value)


def _wrong(field: Declared, expected: str, value: Any) -> ValueError:
    shown = value.tolist() if hasattr(value, "tolist") else value
    return ValueError(f"{field.name}: expected {expected}, got {shown!r}")


def _is_known(value: Any) -> bool:
    """Whether a leaf holds a value, right or wrong, and not something that stands in its place."""
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
    # Large arrays are not awaited, and other processes' cannot be seen.
    seen = value.size <= MAX_CHECKED and value.is_fully_addressable and not value.is_deleted()
    return seen and jax.numpy.issubdtype(value.dtype, jax.numpy.number)


@dataclass_transform(frozen_default=True, field_specifiers=(hyperparameter, option, dataclasses.field))
class Checked:
    """Base of frozen dataclasses that are pytrees and refuse wrong fields. A class that derives from it is one.

    Fields are checked where somebody makes or replaces a value, and not where JAX takes a tree apart and puts it
    together again: gradients, optimiser states, axes and batches are trees of the same class whose leaves are no
    hyperparameters. (`flax.struct.dataclass` would check there as well; on a class derived from this one it
    changes nothing.)

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
        """The same value with some fields replaced, which are checked."""
        return dataclasses.replace(cast(Any, self), **changes)


def _register(kind: type) -> None:
    """Make a dataclass a pytree that is put together again without its `__init__`."""
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
