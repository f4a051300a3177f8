"""Which problems are held out: not looked at while settings are chosen, and the only ones used to judge aims."""

import hashlib

NAMES = (
    *("spring", "oscillator", "polynomial", "logistic_growth", "thermocouple", "decay_offset"),
    *("linear_2", "linear_8", "linear_20", "friction", "heavy_tails"),
    *("poisson_regression", "negative_binomial", "epidemic"),
    *("ar1", "ornstein_uhlenbeck", "ricker", "mg1", "lotka_volterra"),
    *("two_modes", "ridge", "circle"),
)
"""Names of all problems, in the order of tables; written down before any digest was computed."""
COUNT = 6


def held_out(names: tuple[str, ...] = NAMES) -> tuple[str, ...]:
    """The `COUNT` names whose SHA-256 digests are the smallest, in the order given.

    Example:
        >>> len(held_out())
        6
    """
    smallest = sorted(names, key=lambda name: hashlib.sha256(name.encode()).hexdigest())[:COUNT]
    return tuple(name for name in names if name in smallest)


HELD_OUT = held_out()
TUNING = tuple(name for name in NAMES if name not in HELD_OUT)
