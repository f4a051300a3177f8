"""Registry of named objects: tasks, heuristics, estimators, environments, robots, drivers and commands.

A name is an entry point of an installed package, or "module:name" in a module that can be imported from the current
folder; ours are registered in pyproject.toml like those of third parties. An object is imported only when it is
requested, so that the command line lists names without waiting for jax. If two packages register the same name, only
using that name is an error.
"""

import dataclasses
import functools
import importlib
import inspect
import os
import sys
from collections.abc import Mapping
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from types import MappingProxyType
from typing import Any, NoReturn

from jaxlfi import references


@dataclasses.dataclass(frozen=True)
class Family:
    """Objects of one kind, by name.

    Attributes:
        word: word for one of them, for errors.
        group: entry-point group; packages add to it by `[project.entry-points."GROUP"]` in pyproject.toml.
        base: their class or base class as "module:Class", imported together with the first of them.
        own: format of a reference to the user's own object, for errors.
    """

    word: str
    group: str
    base: str = ""
    own: str = "module:factory"

    def points(self) -> dict[str, list[EntryPoint]]:
        """The entry points by name, sorted: one for each name, or several that refer to different objects."""
        found: dict[str, dict[str, EntryPoint]] = {}
        for point in sorted(entry_points(group=self.group), key=lambda point: (point.name, point.value)):
            found.setdefault(point.name, {}).setdefault(point.value, point)
        return {name: list(by_value.values()) for name, by_value in found.items()}

    def names(self) -> list[str]:
        """All registered names."""
        return list(self.points())

    def find(self, reference: str) -> Any:
        """Import and return the object of that name.

        Args:
            reference: a registered name, or "module:name" in a module that can be imported from the current folder.

        Raises:
            ValueError: for unknown names, names that several packages register, and modules that cannot be imported.
        """
        if ":" in reference:
            return named(self.word, reference)
        self.require(reference)
        point, *others = self.points()[reference]
        if others:
            packages = [f"{package_of(each)} ({each.value})" for each in (point, *others)]
            self.refuse_clash(reference, packages, f": name the one that is meant as {self.own}")
        return _loaded(self.word, f"{reference!r} ({point.value})", *_place(point))

    def require(self, reference: str) -> None:
        """Refuse a name that is not registered, without importing anything.

        Raises:
            ValueError: listing the registered names.
        """
        if ":" not in reference and reference not in (registered := self.points()):
            raise ValueError(f"{self.word}: expected one of {list(registered)} or {self.own}, got {reference!r}")

    def refuse_clash(self, name: str, packages: list[str], advice: str = "") -> NoReturn:
        """Refuse a name that several packages register.

        Raises:
            ValueError: naming the packages.
        """
        raise ValueError(
            f"{self.word}: expected one package that registers {name!r}, got {' and '.join(packages)}{advice}"
        )

    @functools.cached_property
    def kind(self) -> type:
        """Their class or base class."""
        return named(self.word, self.base)


class Classes(Family):
    """Classes by name."""

    def load(self, reference: str) -> type:
        """The class of that name.

        Args:
            reference: a registered name, or "module:Class".

        Raises:
            ValueError: as in `find`, and for objects that are not such classes.

        Example:
            >>> HEURISTICS.load("jaxlfi.heuristics:Edge").__name__
            'Edge'
        """
        found = self.find(reference)
        if not (isinstance(found, type) and issubclass(found, self.kind)) or inspect.isabstract(found):
            wanted = f"a class derived from {self.kind.__name__} with all its methods"
            raise ValueError(f"{self.word}: expected {reference!r} to be {wanted}, got {' '.join(repr(found).split())}")
        return found

    def name_of(self, kind: type) -> str:
        """The registered name of a class, or else "module:Class"; `load` returns the class for either.

        Example:
            >>> HEURISTICS.name_of(dict)
            'builtins:dict'
        """
        own = f"{kind.__module__}:{kind.__qualname__}"
        for name, (point, *others) in self.points().items():
            # The entry point may name a package that re-exports the class; that package is then imported already.
            module, attribute = _place(point)
            there = module in sys.modules and getattr(sys.modules[module], attribute, None) is kind
            if not others and (point.value == own or there):
                return name
        return own


@dataclasses.dataclass(frozen=True)
class Objects(Family):
    """Objects by name, made by factories with options given as text (`jaxlfi.references`).

    Attributes:
        gives: what a factory is expected to do, for errors.
    """

    gives: str = ""

    def load(self, reference: str) -> Any:
        """The object of that name.

        Args:
            reference: a registered name, or "module:factory" for a callable that returns the object (or the object
                itself), followed by the factory's options, if any, as in "whip,object=dlo-0,detector=clean".

        Raises:
            ValueError: as in `find`, for options that the factory does not have or that have another type, and for
                results that are not such an object.
        """
        name, options = references.parse(reference, self.word)
        return self._made(reference, self.find(name), options)

    def wanted(self, name: str) -> str:
        """The reference of a name with the options that its factory requires; empty if it requires none.

        Raises:
            ValueError: if the name cannot be loaded.
        """
        return _missing(name, self.find(name))

    def _made(self, reference: str, factory: Any, options: dict[str, str]) -> Any:
        """The object that a factory makes with these options, or the object itself if it needs no factory."""
        made = factory
        if callable(factory) and (isinstance(factory, type) or not isinstance(factory, self.kind)):
            signature = _signature(factory)
            if signature is not None:
                try:
                    signature.bind_partial(**options)
                except TypeError as error:
                    known = ", ".join(signature.parameters) or "none"
                    raise ValueError(
                        f"{self.word}: expected options among {known}, got {reference!r}: {error}"
                    ) from error
                if whole := _missing(reference, factory, options):
                    raise ValueError(f"{self.word}: expected {whole}, got {reference!r}")
            try:
                made = factory(**references.converted(signature, options))
            except Exception as error:
                raise ValueError(f"{self.word}: {reference!r} failed: {type(error).__name__}: {error}") from error
        elif options:
            raise ValueError(f"{self.word}: expected no options of {reference!r}, which is not made by a function")
        if not isinstance(made, self.kind):
            raise ValueError(f"{self.word}: expected {reference!r} to {self.gives}, got {type(made).__name__}")
        return made


class Tasks(Objects):
    """Tasks by name."""

    def load(self, reference: str) -> Any:
        """The task of that name, as in `Objects.load`.

        Besides its factory's options, every task has those of `jaxlfi.repeated`, `trials` and `pooling`:
        "lotka_volterra,trials=4" is the task of four observations together. Without `trials`, `pooling` is the
        factory's own option, if it has one.

        Example:
            >>> TASKS.load("jaxlfi.envs.gaussian_linear:task").name
            'gaussian_linear'
        """
        name, options = references.parse(reference, self.word)
        factory = self.find(name)
        signature = _signature(factory)
        own_pooling = signature is not None and "pooling" in signature.parameters
        ours = ("trials", "pooling") if "trials" in options or not own_pooling else ()
        together = {option: options.pop(option) for option in ours if option in options}
        task = self._made(reference, factory, options)
        if not together:
            return task
        trials = references.convert(together.pop("trials", "1"), int, "trials")
        return named(self.word, "jaxlfi.tasks.trials:repeated")(task, trials, **together)


HEURISTICS = Classes("heuristic", "jaxlfi.heuristics", "jaxlfi.heuristics.base:Heuristic", "module:Class")
ESTIMATORS = Classes("estimator", "jaxlfi.estimators", "jaxlfi.estimators.base:Estimator", "module:Class")
TASKS = Tasks("task", "jaxlfi.tasks", "jaxlfi.tasks.task:Task", gives="give a jaxlfi.Task")
ENVIRONMENTS = Objects(
    "environment",
    "jaxlfi.environments",
    "jaxlfi.rl.environment:Environment",
    gives="give a jaxlfi.rl.environment.Environment",
)
ROBOTS = Objects("robot", "", "jaxlfi.robots.robot:Robot", gives="have observe, act and stop")
DRIVERS = Objects(
    "driver", "jaxlfi.drivers", "jaxlfi.robots.driver:Driver", gives="have connect, observe, act and stop"
)
LOOPS = Family("loop", "jaxlfi.loops", own="module:command")
COMMANDS = Family("command", "jaxlfi.commands")


def named(word: str, reference: str) -> Any:
    """The object that "module:name" refers to, in a module that can be imported from the current folder.

    Args:
        word: word for such an object, for errors.
        reference: reference to the object.

    Raises:
        ValueError: if it cannot be imported or has no such attribute.
    """
    module, _, attribute = reference.partition(":")
    if module.endswith(".py"):
        raise ValueError(
            f"{word}: expected module:name, got {reference!r}: leave out '.py' and run from the file's folder"
        )
    return _loaded(word, repr(reference), module, attribute)


def package_of(point: EntryPoint) -> str:
    """The name of the package that registers an entry point."""
    return point.dist.name if point.dist is not None else point.value.partition(":")[0].partition(".")[0]


def _signature(factory: Any) -> inspect.Signature | None:
    """The signature of a factory, or None if it has none."""
    try:
        return inspect.signature(factory, eval_str=True)
    except (TypeError, ValueError, NameError):  # not every callable has one
        return None


def _missing(reference: str, factory: Any, options: Mapping[str, str] = MappingProxyType({})) -> str:
    """The reference with the options that a factory requires and that were not given; empty if there are none.

    Example:
        >>> def arm(config: Path, mass: float, gain: float = 1.0): ...
        >>> _missing("arm", arm)
        'arm,config=FILE,mass=FLOAT'
    """
    signature = _signature(factory) if callable(factory) else None
    if signature is None:
        return ""
    several = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    wanted = [
        f"{each.name}={'FILE' if each.annotation is Path else getattr(each.annotation, '__name__', 'VALUE').upper()}"
        for each in signature.parameters.values()
        if each.default is each.empty and each.kind not in several and each.name not in options
    ]
    return ",".join([reference, *wanted]) if wanted else ""


def _place(point: EntryPoint) -> tuple[str, str]:
    """The module and the attribute that an entry point refers to; empty if it is malformed."""
    match = EntryPoint.pattern.match(point.value)
    return (match["module"], match["attr"] or "") if match else ("", "")


def _loaded(word: str, shown: str, module: str, attribute: str) -> Any:
    if not {"", os.getcwd()} & set(sys.path):  # find modules in the current folder, as `python -m` does
        sys.path.insert(0, os.getcwd())
    # A third-party module may raise any exception during import.
    try:
        found = importlib.import_module(module)
        for part in attribute.split("."):
            found = getattr(found, part)
    except Exception as error:
        text = " ".join(str(error).split())
        raise ValueError(f"{word}: cannot load {shown}: {type(error).__name__}: {text}") from error
    return found
