"""Finding environments by name: entry points of installed packages, or `module:factory`, with options."""

from jaxlfi import factories, plugins
from jaxlfi.rl.environment import Environment

GROUP = "jaxlfi.environments"
"""The entry-point group; packages add environments by `[project.entry-points."jaxlfi.environments"]`."""


def names() -> list[str]:
    """Names of all registered environments."""
    return plugins.names(GROUP)


def load(reference: str) -> Environment:
    """The environment of that name.

    Args:
        reference: a registered name, or "module:factory" for a callable that returns an environment, in a module that
            can be imported from the current folder; then the factory's options, if any, as in "whip,detector=clean".

    Raises:
        ValueError: for unknown names, modules that cannot be imported, options that the factory does not have or of
            another type, and objects that are no environments.
    """
    name, options = factories.parse(reference, "environment")
    factory = plugins.find(GROUP, "environment", name)
    environment = factories.made("environment", reference, factory, options, Environment)
    if not isinstance(environment, Environment):
        raise ValueError(
            f"environment: expected {reference!r} to give a jaxlfi.rl.environment.Environment, "
            f"got {type(environment).__name__}"
        )
    return environment
