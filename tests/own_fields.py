"""Writes jaxlfi/cli/own_fields.py: `python -m tests.own_fields`, after one of our fields or commands has changed."""

import math
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import jaxlfi
from jaxlfi import fields, registry
from jaxlfi.bayessim.presets import PRESETS
from jaxlfi.bayessim.settings import Settings
from jaxlfi.estimators.base import Estimator
from jaxlfi.rl.settings import PPO
from jaxlfi.rl.settings import PRESETS as POLICIES

WIDTH = 120
PLACE = Path(jaxlfi.__file__).parent / "cli" / "own_fields.py"
HEAD = '''"""What `--help` says of our classes and commands, none of which it imports; by tests/own_fields.py."""

from dataclasses import Field
from math import inf
from typing import Any

from jaxlfi.fields import Declared, described, hyperparameter, option

'''
FOOT = """
FIELDS: dict[str, dict[str, Declared]] = {{
{entries}
}}
\"\"\"Fields by the class that declares them, as "module:Class", and by their own name.\"\"\"
PRESETS: dict[str, dict[str, Any]] = {{
{presets}
}}  # fmt: skip
\"\"\"Settings of a run by the preset and the name, its estimator's among them.\"\"\"
POLICIES: dict[str, dict[str, Any]] = {{
{policies}
}}  # fmt: skip
\"\"\"Settings of a training of policies, likewise.\"\"\"
HELP = {{
{commands}
}}
\"\"\"What our commands do, by what their entry points lead to.\"\"\"
"""


def kinds() -> list[type]:
    """Our classes whose fields have flags, bases first."""
    families = (registry.HEURISTICS, registry.ESTIMATORS)
    points = [point for family in families for several in family.points().values() for point in several]
    ours = [registry.named("class", point.value) for point in points if registry.package_of(point) == "jaxlfi"]
    return [Estimator, *sorted(ours, key=lambda kind: (kind.__module__, kind.__name__)), PPO, Settings]


def commands() -> dict[str, str]:
    """Descriptions of our commands, by their entry points."""
    points = [point for several in registry.COMMANDS.points().values() for point in several]
    ours = [point.value for point in points if registry.package_of(point) == "jaxlfi"]
    return {place: registry.named("command", place).help for place in ours}


def filled(first: str, parts: list[str], last: str) -> str:
    """Parts separated by commas, in lines of the largest length, the first of which begins with `first`."""
    lines = [f"    {first}"]
    for place, part in enumerate(parts, 1):
        part += last if place == len(parts) else ", "
        if len(lines[-1] + part.rstrip()) > WIDTH:
            lines.append(" " * 8)
        lines[-1] += part
    return "\n".join(line.rstrip() for line in lines)


def entry(name: str, field: fields.Declared) -> str:
    """The one or two lines that declare a field."""
    given = {"help": field.info.help} | {
        name: value
        for name, value in vars(field.info).items()
        if name != "help" and value != getattr(fields.FieldInfo(""), name)
    }
    arguments = [f"default={shown(field.default)}", *(f"{name}={shown(value)}" for name, value in given.items())]
    return filled(f'"{name}": {"option" if field.static else "hyperparameter"}(', arguments, "),")


def shown(value: Any) -> str:
    """A value as source code."""
    if isinstance(value, tuple):
        return f"({', '.join(map(shown, value))}{',' * (len(value) == 1)})"
    text = str(value) if isinstance(value, float) and math.isinf(value) else repr(value)
    return text if not text.startswith("'") or '"' in text else f'"{text[1:-1]}"'


def source() -> str:
    """The source of the table."""
    text, entries, names = HEAD, [], {}
    for kind in kinds():
        base = next((one for one in kind.__mro__[1:] if one in names), None)
        inherited = fields.declared(base) if base else {}
        new = {name: one for name, one in fields.declared(kind).items() if inherited.get(name) != one}
        names[kind] = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", kind.__name__).upper()
        text += f"{names[kind]}: dict[str, Field[Any]] = {f'{names[base]} | ' if base else ''}{{\n"
        lines = [f"{entry(name, one)}\n" for name, one in new.items()]
        text += "".join(lines) + ("}  # fmt: skip\n" if lines else "}\n")
        entries.append(f'    "{kind.__module__}:{kind.__qualname__}": described({names[kind]}),')
    helps = "\n".join(f"    {shown(place)}: {shown(text)}," for place, text in commands().items())
    presets = entries_of({name: (one, one.estimator) for name, one in PRESETS.items()})
    policies = entries_of({name: (one,) for name, one in POLICIES.items()})
    return text + FOOT.format(entries="\n".join(entries), presets=presets, policies=policies, commands=helps)


def entries_of(presets: dict[str, tuple[Any, ...]]) -> str:
    """The values of presets, by the names of their fields."""
    lines = []
    for preset, parts in presets.items():
        values = {name: getattr(part, name) for part in parts for name in fields.declared(part)}
        listed = [f"{shown(name)}: {shown(value)}" for name, value in values.items()]
        lines.append(filled(f"{shown(preset)}: {{", listed, "},"))
    return "\n".join(lines)


if __name__ == "__main__":
    PLACE.write_text(source())
    subprocess.run([sys.executable, "-m", "ruff", "format", "--quiet", PLACE], check=True)
