"""Units of recorded numbers as text, such as "deg/s", "mN m" and "°C", and their conversion to SI units and radians.

A unit is a product of powers of symbols, some with prefixes: "N m", "N*m", "Nm", "m/s^2", "m s-2", "µm", "kg m^2". By
itself "g" is the acceleration of gravity, as accelerometers use it; in a product it is the gram.
"""

import math
import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple


class Unit(NamedTuple):
    """Conversion of a unit to SI units and radians.

    Attributes:
        factor: factor by which a number is multiplied.
        name: name of the SI unit, such as "rad/s" and "N m"; "1" for a pure number, and "" if the text names none.
        offset: number added after the multiplication, as for temperatures.
    """

    factor: float
    name: str
    offset: float = 0.0


TIMES = ("s", "ms", "us", "ns", "min", "h")
"""Units in which times are recorded."""
_G, _TURN = 9.80665, 2 * math.pi
_BASES = ("N", "kg", "m", "A", "K", "rad", "count", "px", "s")
"""The newton stands for itself, so that forces and torques keep their names; masses are the ones in kg."""
_SYMBOLS: Mapping[str, tuple[float, Mapping[str, int]]] = {
    **{"1": (1.0, {}), "%": (0.01, {}), "count": (1.0, {"count": 1}), "px": (1.0, {"px": 1})},
    **{"s": (1.0, {"s": 1}), "min": (60.0, {"s": 1}), "h": (3600.0, {"s": 1}), "Hz": (1.0, {"s": -1})},
    **{"m": (1.0, {"m": 1}), "in": (0.0254, {"m": 1}), "ft": (0.3048, {"m": 1}), "mph": (0.44704, {"m": 1, "s": -1})},
    **{"rad": (1.0, {"rad": 1}), "deg": (_TURN / 360, {"rad": 1}), "rev": (_TURN, {"rad": 1})},
    **{"arcmin": (_TURN / 21600, {"rad": 1}), "arcsec": (_TURN / 1296000, {"rad": 1})},
    **{"rpm": (_TURN / 60, {"rad": 1, "s": -1}), "rps": (_TURN, {"rad": 1, "s": -1})},
    **{"dps": (_TURN / 360, {"rad": 1, "s": -1})},
    **{"g": (1e-3, {"kg": 1}), "lb": (0.45359237, {"kg": 1}), "K": (1.0, {"K": 1})},
    **{"N": (1.0, {"N": 1}), "kgf": (_G, {"N": 1}), "gf": (1e-3 * _G, {"N": 1}), "lbf": (0.45359237 * _G, {"N": 1})},
    **{"Pa": (1.0, {"N": 1, "m": -2}), "bar": (1e5, {"N": 1, "m": -2}), "J": (1.0, {"N": 1, "m": 1})},
    **{"W": (1.0, {"N": 1, "m": 1, "s": -1}), "V": (1.0, {"N": 1, "m": 1, "A": -1, "s": -1}), "A": (1.0, {"A": 1})},
    "T": (1.0, {"N": 1, "A": -1, "m": -1}),
}
_PREFIXES = {"n": 1e-9, "u": 1e-6, "m": 1e-3, "c": 1e-2, "k": 1e3, "M": 1e6}
_PREFIXED = ("s", "m", "g", "N", "rad", "rpm", "A", "V", "Hz", "Pa", "bar", "J", "W", "T")
_WORDS = {
    **{"second": "s", "sec": "s", "minute": "min", "hour": "h", "hr": "h", "hertz": "Hz"},
    **{"metre": "m", "meter": "m", "inch": "in", "inches": "in", "foot": "ft", "feet": "ft"},
    **{"radian": "rad", "degree": "deg", "turn": "rev", "revolution": "rev", "rotation": "rev", "r": "rev"},
    **{"newton": "N", "gram": "g", "pascal": "Pa", "joule": "J", "watt": "W", "kelvin": "K"},
    **{"volt": "V", "amp": "A", "ampere": "A", "tesla": "T"},
    **{"percent": "%", "pixel": "px", "tick": "count", "pulse": "count", "lsb": "count"},
}
_WORD_PREFIXES = {"": "", "nano": "n", "micro": "u", "milli": "m", "centi": "c", "kilo": "k", "mega": "M"}
_NAMES = {"N m/A s": "V", "N m/s": "W", "N/m^2": "Pa", "N/m A": "T", "kg m/s^2": "N", "kg m^2/s^2": "N m", "1/s": "Hz"}
_WHOLE = {
    **dict.fromkeys(("", "-", "none", "unitless", "dimensionless", "bool", "boolean"), Unit(1.0, "")),
    **{"g": Unit(_G, "m/s^2"), "mg": Unit(1e-3 * _G, "m/s^2"), "ug": Unit(1e-6 * _G, "m/s^2")},
    **dict.fromkeys(("degC", "celsius", "Celsius"), Unit(1.0, "K", 273.15)),
    "degF": Unit(5 / 9, "K", 459.67 * 5 / 9),
    **dict.fromkeys(("normalised", "normalized", "normalisedpixels", "normalizedpixels"), Unit(1.0, "1")),
}
"""Units that are not products of powers."""
_SPELLINGS = str.maketrans(
    {"µ": "u", "μ": "u", "·": " ", "⋅": " ", "×": " ", "*": " ", "(": " ", ")": " ", "\u00a0": " "}
    | {"²": "^2", "³": "^3", "⁻": "^-", "¹": "1", "−": "-", "°": "deg", "º": "deg"}
)
_JOINED = re.compile(r"(?<=[^\W\d])[-.](?=[^\W\d])")
"""A hyphen or dot between letters, as in N-m; a hyphen before a digit is a sign, as in s-1."""
_FACTOR = re.compile(r"(?P<symbol>[^\W\d_]+|%|1)(?:\^?(?P<power>[+-]?\d+))?")
_TORQUE = re.compile(r"([numckM]?N)([mc]?m)")


def parse(text: str) -> Unit:
    """The conversion of a unit to SI units and radians.

    Raises:
        ValueError: for an unknown unit, in one line.

    Example:
        >>> parse("mm/s"), parse("N*m").name, round(parse("rpm").factor, 4)
        (Unit(factor=0.001, name='m/s', offset=0.0), 'N m', 0.1047)
    """
    plain = " ".join(text.translate(_SPELLINGS).replace("^-^", "^-").split())
    if (whole := plain.replace(" ", "")) in _WHOLE:
        return _WHOLE[whole]
    size, powers = 1.0, dict.fromkeys(_BASES, 0)
    for place, part in enumerate(re.split(r"/|\bper\b", plain)):
        for token in _JOINED.sub(" ", part).split() or [""]:
            match = _FACTOR.fullmatch(token)
            factors = _factors(match["symbol"]) if match else []
            if not match or not factors:
                raise ValueError(f"expected a unit such as rad, deg/s, mm, N m or ms, got {text!r}")
            power = (-1 if place else 1) * int(match["power"] or 1)
            for factor, base in factors:
                size *= factor**power
                for name, exponent in base.items():
                    powers[name] += power * exponent
    return Unit(size, _name(powers))


def is_unit(text: str) -> bool:
    """Whether a text is a unit that can be converted."""
    try:
        parse(text)
    except ValueError:
        return False
    return True


def looks_like(number: float, expected: float, among: Sequence[str] = TIMES) -> str:
    """The unit of time in which a number is nearest to an expected number of seconds, in orders of magnitude.

    Args:
        number: a time without a unit.
        expected: the expected time in s.
        among: the units that it may be in.

    Example:
        >>> looks_like(10.0, 0.01), looks_like(1e7, 0.02)
        ('ms', 'ns')
    """
    return min(among, key=lambda unit: abs(math.log(number * parse(unit).factor / expected)))


def _factors(symbol: str) -> list[tuple[float, Mapping[str, int]]]:
    """Sizes and powers of the units that a symbol stands for: two for symbols such as Nm, none for unknown ones."""
    if symbol in _SYMBOLS:
        return [_SYMBOLS[symbol]]
    if symbol[0] in _PREFIXES and symbol[1:] in _PREFIXED:
        size, base = _SYMBOLS[symbol[1:]]
        return [(_PREFIXES[symbol[0]] * size, base)]
    if match := _TORQUE.fullmatch(symbol):
        return _factors(match[1]) + _factors(match[2])
    for word in (symbol.casefold(), symbol.casefold().removesuffix("s")):
        if word in ("msec", "usec", "nsec"):
            return _factors(word[:2])
        for long, short in _WORD_PREFIXES.items():
            rest = word.removeprefix(long)
            # Words only: for single letters the case distinguishes m from M.
            if word.startswith(long) and (rest in _WORDS or (len(rest) > 2 and rest in _SYMBOLS)):
                return _factors(short + _WORDS.get(rest, rest))
    return []


def _name(powers: Mapping[str, int]) -> str:
    """The SI unit of powers of base units, as it is usually written."""
    parts = [
        " ".join(
            name if abs(power) == 1 else f"{name}^{abs(power)}" for name, power in powers.items() if sign * power > 0
        )
        for sign in (1, -1)
    ]
    written = f"{parts[0] or '1'}/{parts[1]}" if parts[1] else parts[0] or "1"
    return _NAMES.get(written, written)
