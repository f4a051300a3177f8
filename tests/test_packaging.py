"""What an installed jaxlfi consists of."""

import json
import pathlib
import subprocess
import sys

import pytest

import jaxlfi
from jaxlfi import envs

pytest.importorskip("setuptools")

ROOT = pathlib.Path(jaxlfi.__file__).parents[1]
LIST = """
import json, os, runpy, setuptools, tomllib
arguments = {}
setuptools.setup = arguments.update
runpy.run_path("setup.py")
with open("pyproject.toml", "rb") as file:
    data = tomllib.load(file)["tool"]["setuptools"]["package-data"]
distribution = setuptools.Distribution({**arguments, "package_data": data, "script_name": "setup.py"})
build = distribution.get_command_obj("build_py")
build.ensure_finalized()
files = [os.path.relpath(name, build.build_lib) for name in build.get_outputs(include_bytecode=False)]
print(json.dumps([name.replace(os.sep, "/") for name in files]))
"""


def test_a_wheel_has_one_top_level_name_and_all_modules_and_data():
    done = subprocess.run([sys.executable, "-c", LIST], cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    files = set(json.loads(done.stdout.splitlines()[-1]))
    assert {name.split("/")[0] for name in files} == {"jaxlfi"}
    modules = {str(path.relative_to(ROOT)) for folder in ("jaxlfi", "envs") for path in (ROOT / folder).rglob("*.py")}
    assert {name for name in files if name.endswith(".py")} == {
        f"jaxlfi/{name}" if name.startswith("envs/") else name for name in modules
    }
    data = [path for path in (ROOT / "envs").rglob("data/*") if path.is_file()]
    assert len(data) >= 11
    expected = {f"jaxlfi/{path.relative_to(ROOT)}" for path in data} | {"jaxlfi/py.typed"}
    expected |= {str(path.relative_to(ROOT)) for path in (ROOT / "jaxlfi").rglob("*.pyi")}
    assert {name for name in files if not name.endswith(".py")} == expected


def test_the_tasks_are_those_of_this_checkout():
    """An editable install of another one would give its tasks to these tests."""
    assert pathlib.Path(envs.__file__).parents[1] == ROOT
