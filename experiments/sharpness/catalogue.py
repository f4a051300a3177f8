"""All problems by name, in the order of tables."""

from experiments.sharpness import (
    counts,
    curves,
    doubtful,
    fresh,
    further,
    glitches,
    held_out,
    long,
    many,
    narrow,
    newest,
    noisy,
    recent,
    robots,
    series,
    skewed,
    stretched,
    tails,
)
from experiments.sharpness.problem import Problem

LATER: dict[str, tuple[Problem, ...]] = {
    "leaning": curves.LEANING,
    "fresh": fresh.PROBLEMS,
    "further": further.PROBLEMS,
    "glitches": glitches.PROBLEMS,
    "recent": recent.PROBLEMS,
    "newest": newest.PROBLEMS,
    "many": many.PROBLEMS,
    "skewed": skewed.PROBLEMS,
    "tails": tails.PROBLEMS,
    "stretched": stretched.PROBLEMS,
    "robots": robots.PROBLEMS,
    "noisy": noisy.PROBLEMS,
    "doubtful": doubtful.PROBLEMS,
    "long": long.PROBLEMS,
    "narrow": narrow.PROBLEMS,
}
"""Sets written down later, to which the rule of `held_out` does not apply."""
PROBLEMS: dict[str, Problem] = {
    name: problem
    for name in held_out.NAMES
    for problem in (*curves.PROBLEMS, *counts.PROBLEMS, *series.PROBLEMS)
    if problem.name == name
} | {problem.name: problem for problems in LATER.values() for problem in problems}
MODELS = ("mujoco_puck", "mujoco_arm", "mujoco_furuta", "mujoco_belt")
"""MuJoCo models."""


def chosen(words: list[str]) -> list[Problem]:
    """The problems that words name: the sets below, "mujoco", or names.

    Later ones and those of MuJoCo are not among "all": the former are not held out by the rule, the latter need an
    extra.

    Raises:
        ValueError: for a word that is none of these.
        ImportError: for problems of MuJoCo where that is not installed.
    """
    sets = {"tuning": held_out.TUNING, "held-out": held_out.HELD_OUT, "all": held_out.NAMES}
    sets |= {name: tuple(problem.name for problem in problems) for name, problems in LATER.items()}
    names = [name for word in words for name in sets.get(word, (word,))]
    models = [name for name in MODELS if name in names or "mujoco" in names]
    if unknown := [name for name in names if name not in (*PROBLEMS, *MODELS, "mujoco")]:
        known = ", ".join((*PROBLEMS, *MODELS))
        raise ValueError(f"problems: expected {', '.join(sets)}, mujoco or names of {known}, got {unknown[0]!r}")
    found = [problem for name, problem in PROBLEMS.items() if name in names]
    if models:
        from experiments.sharpness import models as of_mujoco  # needs the mujoco extra

        found += [of_mujoco.problem(name) for name in models]
    return found
