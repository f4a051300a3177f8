"""All problems by name, in the order of tables."""

from experiments.sharpness import counts, curves, held_out, series
from experiments.sharpness.problem import Problem

PROBLEMS: dict[str, Problem] = {
    name: problem
    for name in held_out.NAMES
    for problem in (*curves.PROBLEMS, *counts.PROBLEMS, *series.PROBLEMS)
    if problem.name == name
}


def chosen(words: list[str]) -> list[Problem]:
    """The problems that words name: "tuning", "held-out", "all", or names.

    Raises:
        ValueError: for a word that is none of these.
    """
    sets = {"tuning": held_out.TUNING, "held-out": held_out.HELD_OUT, "all": held_out.NAMES}
    names = [name for word in words for name in sets.get(word, (word,))]
    if unknown := [name for name in names if name not in PROBLEMS]:
        raise ValueError(f"problems: expected {', '.join(sets)} or names of {', '.join(PROBLEMS)}, got {unknown[0]!r}")
    return [problem for name, problem in PROBLEMS.items() if name in names]
