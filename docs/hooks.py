"""What the site shows besides docs/: studies, fields' metadata, the command line's help, tutorials' outputs.

A page requests some of it with a comment on a line of its own: `<!-- fields: module:Class -->` becomes the table of the
class's fields, `<!-- help: command -->` the output of `jaxlfi command --help`, and `<!-- examples -->` the list of
examples. Tutorials are run (`docs/tutorials.py`). Links are written for the repository and translated for the site, in
which the folder experiments/ lies beside the pages of docs/.
"""

import ast
import importlib
import os
import posixpath
import re
import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent
DOCS, EXPERIMENTS = ROOT / "docs", ROOT / "experiments"
PICTURES = (".png", ".gif")
LINK = re.compile(r"(!?)\[([^\]]*)\]\(([^)#\s]+)(#[^)\s]*)?\)")
SYMBOLS = {
    **{"delta": "δ", "tau": "τ", "eta": "η", "nu_TH": "ν_TH", "rho": "ρ"},
    **{"gamma": "γ", "lambda": "λ", "epsilon": "ε"},
}
DIRECTIVE = re.compile(r"^<!-- (fields|help|examples)(?:: (\S+))? -->$", re.MULTILINE)


def on_config(config):
    """Make this checkout's packages importable."""
    sys.path.insert(0, str(ROOT))
    return config


def on_files(files, config):
    """Add the studies' pages and figures to the site."""
    from mkdocs.structure.files import File

    for path in sorted(EXPERIMENTS.rglob("*")):
        if name := site_name(path):
            files.append(File.generated(config, name, abs_src_path=str(path)))
    return files


def on_page_markdown(markdown, page, config, files):
    """Run a tutorial, and expand directives and links."""
    from mkdocs.structure.files import File

    source = Path(page.file.abs_src_path)
    if source.parent == DOCS / "tutorials":
        sys.path.insert(0, str(DOCS))
        import tutorials

        markdown, pictures = tutorials.executed(markdown)
        for name, content in pictures.items():
            files.append(File.generated(config, f"tutorials/{name}", content=content))
    return rendered(linked(markdown, source))


def site_name(path: Path) -> str | None:
    """Where a file of the repository lies in the site; None for one that is not part of it."""
    if path.is_relative_to(DOCS):
        return path.relative_to(DOCS).as_posix()
    if path == EXPERIMENTS / "README.md":
        return "experiments.md"
    study = path.parent == EXPERIMENTS / "studies"
    picture = path.is_relative_to(EXPERIMENTS / "results") and path.suffix in PICTURES
    return path.relative_to(EXPERIMENTS).as_posix() if study or picture else None


def linked(markdown: str, source: Path) -> str:
    """A page's text with links to files of the repository translated for the site, or replaced by plain text."""

    def replaced(found: re.Match) -> str:
        mark, text, target, anchor = found[1], found[2], found[3], found[4] or ""
        path = Path(os.path.normpath(source.parent / target))
        if ":" in target or not path.exists():
            return found[0]
        if (name := site_name(path)) is None:
            return text
        return f"{mark}[{text}]({posixpath.relpath(name, posixpath.dirname(site_name(source)))}{anchor})"

    return LINK.sub(replaced, markdown)


def rendered(markdown: str) -> str:
    """A page's text with its directives expanded."""
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
    """The help of a command."""
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
    """All examples, each with the first line of its docstring and its source."""
    parts = []
    for path in sorted((ROOT / "examples").glob("*.py")):
        title = ast.get_docstring(ast.parse(path.read_text())).splitlines()[0]
        parts.append(f"## {path.name}\n\n{title}\n\n```python\n{path.read_text().strip()}\n```")
    return "\n\n".join(parts)


def _plain(value) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)
