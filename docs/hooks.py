"""What the documentation's pages are made from besides their text: pictures, fields' metadata, the command line.

A page asks for them by comments of a line: `<!-- fields: module:Class -->` becomes the table of the class's fields,
`<!-- help: command -->` what `jaxlfi command --help` prints, and `<!-- examples -->` the list of examples.
"""

import ast
import importlib
import os
import re
import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent
RESULTS = "experiments/results"
SYMBOLS = {
    **{"delta": "δ", "tau": "τ", "eta": "η", "nu_TH": "ν_TH", "rho": "ρ"},
    **{"gamma": "γ", "lambda": "λ", "epsilon": "ε"},
}
DIRECTIVE = re.compile(r"^<!-- (fields|help|examples)(?:: (\S+))? -->$", re.MULTILINE)


def on_config(config):
    """Find this checkout's packages."""
    sys.path.insert(0, str(ROOT))
    return config


def on_files(files, config):
    """Pictures of the results are part of the site, at the same place: `results/demo/samples.png`."""
    from mkdocs.structure.files import File

    for path in sorted((ROOT / RESULTS).rglob("*.png")):
        name = f"results/{path.relative_to(ROOT / RESULTS).as_posix()}"
        files.append(File.generated(config, name, abs_src_path=str(path)))
    return files


def on_page_markdown(markdown, page, config, files):
    """Replace every directive by what it stands for."""
    return rendered(markdown)


def rendered(markdown: str) -> str:
    """A page's text with its directives replaced."""
    made = {"fields": fields_table, "help": help_text, "examples": lambda _: examples_list()}
    return DIRECTIVE.sub(lambda found: made[found[1]](found[2]), markdown)


def fields_table(reference: str) -> str:
    """A class's hyperparameters and options as a table."""
    from jaxlfi.fields import declared

    module, _, name = reference.partition(":")
    kind = getattr(importlib.import_module(module), name)
    lines = ["| field | symbol | default | range | meaning |", "|---|---|---|---|---|"]
    for field in declared(kind).values():
        info = field.info
        number = isinstance(field.default, int | float) and not isinstance(field.default, bool)
        values = ", ".join(map(str, info.choices)) if info.choices else info.interval if number else ""
        symbol = SYMBOLS[info.symbol] if info.symbol else ""
        lines.append(f"| `{field.name}` | {symbol} | `{_plain(field.default)}` | {values} | {info.help} |")
    return "\n".join(lines)


def help_text(command: str) -> str:
    """What a command prints about itself."""
    os.environ["COLUMNS"] = "100"
    from jaxlfi.cli.parser import foreign_command, parser

    if main := foreign_command(command):
        return f"```text\n{main.parser().format_help().strip()}\n```"
    words = [command] if command != "jaxlfi" else []
    top = parser()
    (commands,) = [action for action in top._actions if getattr(action, "choices", None) and action.dest == "command"]
    chosen = commands.choices[command] if words else top
    return f"```text\n{chosen.format_help().strip()}\n```"


def examples_list() -> str:
    """Every example: the first line it says of itself, and its source."""
    parts = []
    for path in sorted((ROOT / "examples").glob("*.py")):
        title = ast.get_docstring(ast.parse(path.read_text())).splitlines()[0]
        parts.append(f"## {path.name}\n\n{title}\n\n```python\n{path.read_text().strip()}\n```")
    return "\n\n".join(parts)


def _plain(value) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)
