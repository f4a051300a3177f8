"""Runs the tutorials: each block is followed by its printed output and the pictures that it saves.

A block with a title, such as ```` ```python title="sir.py" ````, is written to that file; blocks of Python run in one
process, and blocks of sh in a shell. Pages cannot become outdated: a block that fails stops the build.
"""

import contextlib
import io
import json
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parent.parent
BLOCK = re.compile(r'^```(\w+)(?: title="([\w.]+)")?\n(.*?)^```$', re.MULTILINE | re.DOTALL)
PICTURES = (".png", ".gif")
OUTPUTS = ".outputs.json"


def executed(markdown: str) -> tuple[str, dict[str, bytes]]:
    """A tutorial with its outputs, and its pictures by name.

    Raises:
        RuntimeError: if a block fails.
    """
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        (folder / "examples").symlink_to(ROOT / "examples")
        blocks = [match.groups() for match in BLOCK.finditer(markdown)]
        search = [str(folder), str(ROOT)]
        environment = os.environ | {
            "PYTHONPATH": os.pathsep.join(search),
            "PATH": os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]]),
            "COLUMNS": "100",
            "TF_CPP_MIN_LOG_LEVEL": "3",
        }
        done = subprocess.run(
            [sys.executable, __file__],
            input=json.dumps(blocks),
            cwd=folder,
            env=environment,
            text=True,
            capture_output=True,
        )
        if done.returncode:
            raise RuntimeError(f"tutorial: a block failed:\n{done.stderr}")
        outputs = iter(json.loads((folder / OUTPUTS).read_text()))
        pictures = {path.name: path.read_bytes() for path in folder.iterdir() if path.suffix in PICTURES}
    return BLOCK.sub(lambda block: block[0] + _shown(*next(outputs)), markdown), pictures


def _shown(printed: str, pictures: list[str]) -> str:
    parts = [f'```text title="Output"\n{printed.rstrip()}\n```'] if printed.strip() else []
    return "".join(f"\n\n{part}" for part in [*parts, *(f"![{Path(name).stem}]({name})" for name in pictures)])


def run(blocks: list[tuple[str, str | None, str]]) -> list[tuple[str, list[str]]]:
    """The printed output and the saved pictures of each block, run in the current folder and this process."""
    namespace: dict = {"__name__": "__main__"}
    outputs, seen = [], set()
    for kind, title, body in blocks:
        printed = ""
        if title:
            Path(title).write_text(body)
        elif kind == "python":
            with contextlib.redirect_stdout(io.StringIO()) as stream:
                exec(compile(body, "block", "exec"), namespace)
            printed = stream.getvalue()
        elif kind == "sh":
            done = subprocess.run(["sh", "-ec", body], stdout=subprocess.PIPE, text=True, check=True)
            printed = done.stdout
        new = sorted(path.name for path in Path().iterdir() if path.suffix in PICTURES and path.name not in seen)
        seen.update(new)
        outputs.append((printed, new))
    return outputs


if __name__ == "__main__":
    sys.path[0] = ""  # this folder has modules with the names of other packages
    Path(OUTPUTS).write_text(json.dumps(run(json.load(sys.stdin))))
