"""Domains as the command line names them."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jaxlfi.rl.environment import Environment

DOMAINS = """\
domains:
  RUN             the posterior of a finished run (jaxlfi infer): low-variance draws of its mixture, clipped to Phi, or
                  to the run's support if it was fixed
  uniform         uniform over the environment's first support, Theta_0 (PPO-U); uniform:NAME over another one
  median          the environment's nominal point (PPO-mu)
  point:X,Y,...   a single point, in natural units
"""
"""Text for `--help`."""


def domains_of(environment: "Environment", words: Sequence[str]) -> dict[str, Callable]:
    """Functions that draw from each of several domains, by distinct names.

    Folders of the same name, such as `seed_000` of two runs, are named with as many parent folders as needed to make
    the names unique; points whose coordinates agree to six digits are named with all digits.

    Raises:
        ValueError: as for `domain`, and for the same one twice.
    """
    from collections import Counter

    found = [domain(environment, word) for word in words]
    counts = Counter(name for name, _ in found)
    full = [_full_name(word) if counts[name] > 1 else (name,) for word, (name, _) in zip(words, found, strict=True)]
    names: dict[str, Callable] = {}
    for parts, (name, draw) in zip(full, found, strict=True):
        rivals = [other for other in full if other[-1] == parts[-1]]
        alike = lambda n, parts=parts, rivals=rivals: sum(other[-n:] == parts[-n:] for other in rivals) > 1
        own = "-".join(parts[-next((n for n in range(1, len(parts)) if not alike(n)), len(parts)) :])
        if own in names:
            raise ValueError(f"domain: expected distinct ones, got {name!r} twice")
        names[own] = draw
    return names


def _full_name(word: str) -> tuple[str, ...]:
    """All parts of a name: a folder with its parents, or a point with all digits."""
    kind, _, rest = word.partition(":")
    if kind == "point":
        return ("point-" + "-".join(repr(float(number)) for number in rest.split(",")),)
    return Path(word).resolve().parts[1:] if Path(word).is_dir() else (word,)


def domain(environment: "Environment", word: str) -> tuple[str, Callable]:
    """The name of a domain, and a function that draws n points of it from a key.

    Raises:
        ValueError: for an unknown domain, a point outside Phi, and a posterior over other parameters.
    """
    import numpy as np

    from jaxlfi.rl import domains

    kind, _, rest = word.partition(":")
    if kind == "uniform":
        supports = environment.supports
        if rest and rest not in supports:
            raise ValueError(f"domain: expected uniform:NAME of {', '.join(supports)}, got {word!r}")
        box = supports[rest or next(iter(supports))]
        return f"uniform-{rest}" if rest else "uniform", lambda key, n: domains.uniform(key, box, n)
    if kind == "median" and not rest:
        return "median", lambda key, n: domains.point(np.asarray(environment.nominal), n)
    if kind == "point":
        try:
            numbers = [float(number) for number in rest.split(",")]
        except ValueError:
            raise ValueError(f"domain: expected point:X,Y,... of numbers, got {word!r}") from None
        theta = domains.check_point(environment, np.asarray(numbers))
        return f"point-{'-'.join(f'{number:g}' for number in numbers)}", lambda key, n: domains.point(theta, n)
    folder = Path(word)
    if not folder.is_dir():
        raise ValueError(
            f"domain: expected the folder of a run, uniform, uniform:NAME, median or point:X,Y,..., got {word!r}"
        )
    from jaxlfi.runs.load import load

    run = load(folder)
    domains.check_belief(environment, run.space, run.space.box_to_natural(run.feasible), run.units)
    return folder.resolve().name, domains.of_run(run)
