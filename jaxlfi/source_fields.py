"""Hyperparameters and options of classes, read from their source without executing any of it.

The command line lists the flags of all installed heuristics in `--help`, and importing their modules would import jax,
which takes seconds. So the source of a class is found, parsed, and the calls of `hyperparameter` and `option` in its
body are evaluated where their arguments are plain: literals, arithmetic, infinity, and constants of modules that are
plain themselves. What cannot be read is left out and the result says so; the real metadata is what
`jaxlfi.fields.declared` gives of the imported class.
"""

import ast
import dataclasses
import importlib.machinery
import math
import operator
import sys
from collections.abc import Callable, Iterator
from typing import Any

import jaxlfi
from jaxlfi import fields, plugins

MAKERS: dict[str, Callable[..., Any]] = {"hyperparameter": fields.hyperparameter, "option": fields.option}
"""The calls that declare a field."""
PLAIN_FIELDS = ("field", "static")
"""Calls in a class's body that make fields which declare nothing."""
NUMBERS = {name: getattr(math, name) for name in ("inf", "nan", "pi", "e")}
"""Constants of math, numpy and jax.numpy."""
ARITHMETIC = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.FloorDiv: operator.floordiv,
}
FUNCTIONS = {"float": float, "int": int, "tuple": tuple, "list": list, "sorted": sorted}


@dataclasses.dataclass(frozen=True)
class Source:
    """What the source of a class declares.

    Attributes:
        fields: hyperparameters and options by name, as `jaxlfi.fields.declared` would give them.
        complete: whether these are all, as far as the source shows.
    """

    fields: dict[str, fields.Declared]
    complete: bool


@dataclasses.dataclass(frozen=True)
class _Imported:
    """A name that a module imports: from another module, or (without a name) the module itself."""

    module: str
    name: str | None


@dataclasses.dataclass(frozen=True)
class _Opaque:
    """A value that is not plain, inside one that is looked at for its keys."""


class _UnreadableError(Exception):
    """The source does not show it."""


def of_group(group: str) -> dict[str, Source]:
    """What all registered classes of an entry-point group declare, by the name they are registered by."""
    reader, unknown = _Reader(), Source({}, complete=False)  # of a name that several packages register
    return {
        name: unknown if others else reader.source(*plugins.place_of(point))
        for name, (point, *others) in plugins.points(group).items()
    }


def of_class(reference: str) -> Source:
    """What the class of "module:Class" declares.

    Example:
        >>> of_class("jaxlfi.heuristics:Truncate").fields["quantile"].default
        0.001
    """
    module, _, name = reference.partition(":")
    plugins.look_here()
    return _Reader().source(module, name)


def find_source(module: str) -> tuple[str, bool] | None:
    """The source of a module and whether it is a package; None where there is none. Nothing is imported.

    `importlib.util.find_spec` would import the packages that a module is in; the finders are asked directly, one
    package after the other.

    Example:
        >>> "class Edge" in find_source("jaxlfi.heuristics.edge")[0]
        True
    """
    path, spec, name = None, None, ""
    try:
        for part in module.split("."):
            name = f"{name}.{part}" if name else part
            spec = _found(name, path)
            if spec is None:
                return None
            path = list(spec.submodule_search_locations or [])
        source = spec.loader.get_source(module)
    except Exception:  # finders and loaders are anybody's, and some have no source
        return None
    return None if source is None else (source, spec.submodule_search_locations is not None)


def _found(name: str, path: list[str] | None) -> importlib.machinery.ModuleSpec | None:
    for finder in sys.meta_path:
        spec = finder.find_spec(name, path) if hasattr(finder, "find_spec") else None
        if spec is not None:
            return spec
    return None


class _Module:
    """What the names at the top of a module are bound to."""

    def __init__(self, name: str, source: str, is_package: bool):
        self.name = name
        self.package = name if is_package else name.rpartition(".")[0]
        self.names: dict[str, ast.expr | ast.ClassDef | _Imported] = {}
        self._read(ast.parse(source).body)

    def _read(self, body: list[ast.stmt]) -> None:
        for node in body:
            if isinstance(node, ast.ClassDef):
                self.names[node.name] = node
            elif isinstance(node, ast.Assign):
                self.names |= {target.id: node.value for target in node.targets if isinstance(target, ast.Name)}
            elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) and node.value is not None:
                self.names[node.target.id] = node.value
            elif isinstance(node, ast.Import):
                for alias in node.names:
                    bound = alias.asname or alias.name.partition(".")[0]
                    self.names[bound] = _Imported(alias.name if alias.asname else bound, None)
            elif isinstance(node, ast.ImportFrom):
                origin = self._origin(node)
                self.names |= {alias.asname or alias.name: _Imported(origin, alias.name) for alias in node.names}
            elif isinstance(node, ast.If | ast.Try):
                self._read([*node.body, *node.orelse])

    def _origin(self, node: ast.ImportFrom) -> str:
        if not node.level:
            return node.module or ""
        package = self.package.split(".")
        return ".".join([*package[: len(package) - node.level + 1], *([node.module] if node.module else [])])


class _Reader:
    """Reads classes, and each module once."""

    def __init__(self):
        self._modules: dict[str, _Module | None] = {}

    def source(self, module: str, name: str) -> Source:
        """What a class declares."""
        try:
            found = self._lookup(module, name.split(".")[0])
            for part in name.split(".")[1:]:
                found = found[0], _member(found[1], part)
            return self._declared(*found)
        except Exception:  # anybody's source may be anything, and help has to be shown
            return Source({}, complete=False)

    def _declared(self, module: _Module, node: Any) -> Source:
        if not isinstance(node, ast.ClassDef):
            raise _UnreadableError
        known: dict[str, fields.Declared] = {}
        complete = True
        for base in reversed(node.bases):  # later bases come first in a dataclass
            inherited = self._base(module, base)
            known |= inherited.fields
            complete &= inherited.complete
        for statement in node.body:
            if not (isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name)):
                continue
            name = statement.target.id
            known.pop(name, None)
            try:
                if isinstance(statement.value, ast.Call) and (field := self._field(module, name, statement.value)):
                    known[name] = field
            except _UnreadableError:
                complete = False
        return Source(known, complete)

    def _base(self, module: _Module, base: ast.expr) -> Source:
        if isinstance(base, ast.Subscript):  # Generic[T]
            base = base.value
        try:
            origin = self._binding(module, base)
            if isinstance(origin, _Imported) and origin.module.partition(".")[0] in sys.stdlib_module_names:
                return Source({}, complete=True)
            return self._declared(*self._resolved(module, base))
        except _UnreadableError:
            return Source({}, complete=False)

    def _field(self, module: _Module, name: str, call: ast.Call) -> fields.Declared | None:
        """What a call in a class's body declares; None if it is a field that declares nothing."""
        bound = self._binding(module, call.func)
        called = bound.name if isinstance(bound, _Imported) and bound.name else _last(call.func)
        if called not in MAKERS:
            if called in PLAIN_FIELDS:
                return None
            raise _UnreadableError
        if any(keyword.arg is None for keyword in call.keywords):
            raise _UnreadableError
        arguments = [self._value(module, argument) for argument in call.args]
        named = {keyword.arg: self._value(module, keyword.value) for keyword in call.keywords}
        try:
            return fields.describe(name, MAKERS[called](*arguments, **named))
        except (TypeError, ValueError) as error:
            raise _UnreadableError from error

    def _value(self, module: _Module, node: Any) -> Any:
        value = self._evaluated(module, node)
        if _has_opaque(value):
            raise _UnreadableError
        return value

    def _evaluated(self, module: _Module, node: Any) -> Any:
        match node:
            case ast.Constant():
                return node.value
            case ast.Tuple() | ast.List():
                items = [item for element in node.elts for item in self._elements(module, element)]
                return tuple(items) if isinstance(node, ast.Tuple) else items
            case ast.Dict():
                keys = [item for key in node.keys for item in ([self._value(module, key)] if key else [_Opaque()])]
                return dict.fromkeys(keys, _Opaque())
            case ast.UnaryOp(op=ast.USub()):
                return -self._number(module, node.operand)
            case ast.BinOp() if type(node.op) in ARITHMETIC:
                left, right = self._number(module, node.left), self._number(module, node.right)
                try:
                    return ARITHMETIC[type(node.op)](left, right)
                except ArithmeticError as error:
                    raise _UnreadableError from error
            case ast.Call(func=ast.Name(id=name), args=[argument], keywords=[]) if name in FUNCTIONS:
                try:
                    return FUNCTIONS[name](self._evaluated(module, argument))
                except (TypeError, ValueError) as error:
                    raise _UnreadableError from error
            case ast.Name() | ast.Attribute():
                bound = self._binding(module, node)
                if isinstance(bound, _Imported) and bound.module in ("math", "numpy", "jax.numpy"):
                    if bound.name in NUMBERS:
                        return NUMBERS[bound.name]
                    raise _UnreadableError
                return self._evaluated(*self._resolved(module, node))
        raise _UnreadableError

    def _elements(self, module: _Module, node: ast.expr) -> Iterator[Any]:
        if isinstance(node, ast.Starred):
            yield from _iterable(self._evaluated(module, node.value))
        else:
            yield self._value(module, node)

    def _number(self, module: _Module, node: ast.expr) -> Any:
        value = self._value(module, node)
        if not isinstance(value, int | float):
            raise _UnreadableError
        return value

    def _binding(self, module: _Module, node: ast.expr) -> Any:
        """What a name or a dotted name is bound to where it is used: a node, or an import."""
        if isinstance(node, ast.Name):
            return module.names.get(node.id)
        if isinstance(node, ast.Attribute):
            of = self._binding(module, node.value)
            if isinstance(of, _Imported):
                inner = of.module if of.name is None else f"{of.module}.{of.name}"
                return _Imported(inner, node.attr)
        return None

    def _resolved(self, module: _Module, node: ast.expr) -> tuple[_Module, Any]:
        """The module and the node that a name leads to, through any number of imports."""
        bound = self._binding(module, node)
        if bound is None or (isinstance(bound, _Imported) and bound.name is None):
            raise _UnreadableError
        return self._lookup(bound.module, bound.name) if isinstance(bound, _Imported) else (module, bound)

    def _lookup(self, module: str, name: str) -> tuple[_Module, Any]:
        if module == "jaxlfi" and name in jaxlfi._HOMES:
            module = jaxlfi._HOMES[name]
        if module not in self._modules:
            found = find_source(module)
            self._modules[module] = None if found is None else _Module(module, *found)
        read = self._modules[module]
        bound = read.names.get(name) if read is not None else None
        if bound is None:
            raise _UnreadableError
        if not isinstance(bound, _Imported):
            return read, bound
        if bound.name is None or bound == _Imported(module, name):
            raise _UnreadableError
        return self._lookup(bound.module, bound.name)


def _member(node: Any, name: str) -> Any:
    inner = {part.name: part for part in getattr(node, "body", []) if isinstance(part, ast.ClassDef)}
    if name not in inner:
        raise _UnreadableError
    return inner[name]


def _last(node: ast.expr) -> str:
    return node.attr if isinstance(node, ast.Attribute) else getattr(node, "id", "")


def _iterable(value: Any) -> Any:
    if not isinstance(value, tuple | list | dict):
        raise _UnreadableError
    return value


def _has_opaque(value: Any) -> bool:
    if isinstance(value, _Opaque):
        return True
    if isinstance(value, dict):
        return any(map(_has_opaque, (*value, *value.values())))
    return isinstance(value, tuple | list) and any(map(_has_opaque, value))
