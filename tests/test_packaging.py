"""The contents of an installed jaxlfi, a wheel or an editable install, and what a type checker sees of it."""

import json
import os
import pathlib
import re
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import textwrap
import venv
import zipfile

import pytest

import jaxlfi
from jaxlfi import envs

pytest.importorskip("setuptools", "77")

ROOT = pathlib.Path(jaxlfi.__file__).parents[1]
PARTS = ("jaxlfi", "envs", "pyproject.toml", "README.md", "LICENSE")
"""Parts of the checkout from which a distribution is made."""
BUILD = """
import os, pathlib, shutil, sys
from setuptools import build_meta

out = pathlib.Path(sys.argv[1])
print(build_meta.build_editable(out / "editable"))
sdist = build_meta.build_sdist(out / "sdist")
shutil.unpack_archive(out / "sdist" / sdist, out / "unpacked")
os.chdir(out / "unpacked" / sdist.removesuffix(".tar.gz"))
print(build_meta.build_wheel(out / "wheel"))
"""


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> pathlib.Path:
    """A folder with a copy of the checkout, its editable install, its source distribution, and a wheel of that."""
    out = tmp_path_factory.mktemp("built")
    source = out / "source"
    source.mkdir()
    unwanted = shutil.ignore_patterns("__pycache__")
    for part in PARTS:
        if (ROOT / part).is_dir():
            shutil.copytree(ROOT / part, source / part, symlinks=True, ignore=unwanted)
        else:
            shutil.copy(ROOT / part, source)
    for kind in ("editable", "sdist", "wheel"):
        (out / kind).mkdir()
    done = subprocess.run(
        [sys.executable, "-c", BUILD, str(out)], cwd=source, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr
    return out


def only(folder: pathlib.Path) -> pathlib.Path:
    (path,) = folder.iterdir()
    return path


def wanted() -> set[str]:
    """The files of the two folders, as named in the package."""
    found = {path for folder in ("jaxlfi", "envs") for path in (ROOT / folder).rglob("*") if path.is_file()}
    names = {path.relative_to(ROOT).as_posix() for path in found if "__pycache__" not in path.parts}
    return {f"jaxlfi/{name}" if name.startswith("envs/") else name for name in names}


def test_a_wheel_has_one_top_level_name_and_every_file_once(built):
    with zipfile.ZipFile(only(built / "wheel")) as wheel:
        files = [entry for entry in wheel.infolist() if ".dist-info/" not in entry.filename]
        assert not [entry.filename for entry in files if (entry.external_attr >> 16) & 0o170000 == 0o120000]  # links
        names = [entry.filename for entry in files]
        assert wheel.read("jaxlfi/envs/mg1.py") == (ROOT / "envs/mg1.py").read_bytes()
    assert len(names) == len(set(names)) and set(names) == wanted()
    assert {"jaxlfi/py.typed", "jaxlfi/__init__.pyi", "jaxlfi/envs/data/lynx_hare.csv"} <= set(names)


def test_a_source_distribution_holds_the_tasks_as_files_inside_of_the_package(built):
    with tarfile.open(only(built / "sdist")) as archive:
        members = archive.getmembers()
    assert not [member.name for member in members if member.issym() or member.islnk()]
    names = [member.name.partition("/")[2] for member in members if member.isfile()]
    assert len(names) == len(set(names)) and wanted() <= set(names)
    assert not [name for name in names if name.startswith("envs/")]


def test_an_editable_install_is_a_path_and_no_import_hook(built):
    with zipfile.ZipFile(only(built / "editable")) as wheel:
        own = {name: wheel.read(name).decode() for name in wheel.namelist() if ".dist-info/" not in name}
    ((name, text),) = own.items()
    assert name.endswith(".pth") and text.strip() == str(built / "source")


SCRIPT = """
    import jax
    import jaxlfi
    from jaxlfi.envs.gaussian_linear import task as gaussian

    def simulate(key: jax.Array, theta: jax.Array) -> jax.Array:
        return theta + jax.random.normal(key, (2,))

    box = jaxlfi.Support([0.0, 0.1], [1.0, 2.0])
    task = jaxlfi.Task(simulate, names=("a", "b"), supports={"guess": box}, feasible=box)
    run = jaxlfi.infer(0, task, support="guess", heuristic=jaxlfi.Edge(mass_threshold=0.1))
    reveal_type(gaussian)                           # Task
    reveal_type(run.posterior.mean())               # Array
    reveal_type(run.belief.support.width)           # Array
    reveal_type(run.replace(key=jax.random.key(1))) # Run
    reveal_type(jaxlfi.QUICK.replace(rounds=3))     # Settings
    reveal_type(jaxlfi.load("run"))                 # Run
    reveal_type(jaxlfi.settings_for(task))          # Settings
    jaxlfi.infer(0, task, heuristics=None)          # error: call-arg
    jaxlfi.Edge(mass_treshold=0.1)                  # error: call-arg
    jaxlfi.Settings(round=3)                        # error: call-arg
    jaxlfi.Task(simulate, suports={}, names=("a",), feasible=box, supports={})  # error: call-arg
    jaxlfi.Support([0.0])                           # error: call-arg
    jaxlfi.Edgy                                     # error: attr-defined
"""


def installed(built: pathlib.Path, kind: str) -> pathlib.Path:
    """The Python of an environment with one of the two, unpacked as by pip, and the library's dependencies."""
    folder = built / f"with-{kind}"
    venv.create(folder, symlinks=True)
    site = next(folder.glob("lib/python*/site-packages"))
    with zipfile.ZipFile(only(built / kind)) as wheel:
        wheel.extractall(site)
    borrowed = dict.fromkeys(sysconfig.get_paths()[name] for name in ("purelib", "platlib"))
    (site / "zz_borrowed.pth").write_text("\n".join(borrowed) + "\n")  # as plain paths: its own .pth files do not count
    return folder / "bin" / "python"


# For an editable install the checker follows the path, which is tested above.
@pytest.mark.slow
@pytest.mark.parametrize("kind", ["wheel", "editable"])
def test_a_type_checker_knows_a_users_script(kind, built, tmp_path):
    pytest.importorskip("mypy")
    python, script = installed(built, kind), tmp_path / "script.py"
    script.write_text(textwrap.dedent(SCRIPT))
    alone = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "MYPYPATH")}
    where = "import jaxlfi.envs.mg1, json; print(json.dumps([jaxlfi.__file__, jaxlfi.envs.mg1.__file__]))"
    done = subprocess.run([python, "-c", where], cwd=tmp_path, env=alone, capture_output=True, text=True, timeout=120)
    home = built / "source" if kind == "editable" else python.parents[1]
    assert all(pathlib.Path(place).is_relative_to(home) for place in json.loads(done.stdout)), done.stderr
    words = ["--python-executable", str(python), "--cache-dir", str(built / "types"), "--no-pretty", script.name]
    done = subprocess.run(
        [sys.executable, "-m", "mypy", *words], cwd=tmp_path, env=alone, capture_output=True, text=True, timeout=600
    )
    said = re.findall(r"^script\.py:(\d+): (error|note): (.*)$", done.stdout, re.MULTILINE)
    told = {int(line): text for line, level, text in said if level == "error" or "Revealed" in text}
    expected = {
        number: re.search(r"# (?:error: )?([\w-]+)$", line)[1]
        for number, line in enumerate(script.read_text().splitlines(), 1)
        if re.search(r"# (error: )?[\w-]+$", line)
    }
    assert len(expected) == 13 and set(told) == set(expected), done.stdout + done.stderr
    for number, what in expected.items():
        assert re.search(rf"\[{what}\]$|\b{what}\"$", told[number]), told[number]


def test_the_tasks_are_those_of_this_checkout():
    """A clone made without symbolic links, or an editable install of another checkout, would not have them."""
    assert pathlib.Path(envs.__file__).resolve().parents[1] == ROOT.resolve()
