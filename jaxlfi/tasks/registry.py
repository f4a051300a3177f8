"""Finding tasks by name: entry points of installed packages, or `module:factory`, with options for the factory."""

from jaxlfi import factories, plugins
from jaxlfi.tasks.task import Task
from jaxlfi.tasks.trials import repeated

GROUP = "jaxlfi.tasks"
"""The entry-point group; packages add tasks by `[project.entry-points."jaxlfi.tasks"]` in pyproject.toml."""


def names() -> list[str]:
    """Names of all registered tasks."""
    return plugins.names(GROUP)


def wanted(name: str) -> str:
    """The reference of a registered task with the options that it cannot do without; empty where it needs none.

    Raises:
        ValueError: where the name cannot be loaded.
    """
    return factories.wanted(name, plugins.find(GROUP, "task", name))


def load(reference: str) -> Task:
    """The task of that name.

    Args:
        reference: a registered name, or "module:factory" for a callable that returns a `Task` (or a `Task`
            itself) in a module that can be imported from the current folder; then the factory's options, if any,
            as in "whip,object=dlo-0,detector=clean". Every task has those of `jaxlfi.repeated` besides, `trials` and
            `pooling`: "lotka_volterra,trials=4" is the task of four observations together. A factory's own `pooling` is
            meant where `trials` is not given.

    Options are converted to the types that the factory's signature declares: int, float, bool, str, Path, Literal,
    unions of them, and tuples of any number of one of them, whose items ";" separates, as in
    "whip,object=dlo-0;mine.npz". A value with separators can be put in quotation marks: whip,object="a;b.npz".

    Raises:
        ValueError: for unknown names, modules that cannot be imported, options that the factory does not have or of
            another type, and objects that are no tasks.

    Example:
        >>> load("jaxlfi.envs.gaussian_linear:task").name
        'gaussian_linear'
    """
    name, options = factories.parse(reference)
    factory = plugins.find(GROUP, "task", name)
    own = () if isinstance(factory, Task) else factories.parameters(factory)
    ours = ("trials", "pooling") if "trials" in options or "pooling" not in own else ()
    together = {option: options.pop(option) for option in ours if option in options}
    made = factories.made("task", reference, factory, options, Task)
    if not isinstance(made, Task):
        raise ValueError(f"task: expected {reference!r} to give a jaxlfi.Task, got {type(made).__name__}")
    if not together:
        return made
    return repeated(made, factories.convert(together.pop("trials", "1"), int, "trials"), **together)
