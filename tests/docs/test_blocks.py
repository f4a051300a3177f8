"""Blocks of README and of the pages run in their order, in a fresh process for each page, or are listed with a reason.

Commands are run with flags that make them quick; those that are not run are read by the real parsers.
"""

import json
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from jaxlfi.cli import parser as cli
from jaxlfi.cli.r2s2r import Loops

ROOT = Path(__file__).parents[2]
PAGES = {path.name: path for path in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))}
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
SMALL = (
    "--rounds 2 --simulations-per-round 60 --simulation-budget 80 --epochs 5 --hidden 16 --validation 0 --patience 0 "
    "--no-predictive --no-figures"
)
RUN = {
    "jaxlfi tasks": "",
    "jaxlfi infer decay:task": f"{SMALL} --transforms 1",
    "jaxlfi infer lynx_hare": SMALL,
    "jaxlfi infer lotka_volterra --support": SMALL,
    "jaxlfi infer gaussian_linear --method npe": f"{SMALL} --rounds 1 --transforms 1",
    "jaxlfi infer gaussian_linear --support": SMALL.replace("--epochs 5", "--steps 20"),
    "jaxlfi infer mujoco,config=examples/mujoco/furuta.toml": f"{SMALL} --no-polish",
    "jaxlfi compare lotka_volterra": f"{SMALL} --seeds 1 --configurations ok misspecified+edge",
    "jaxlfi grid lotka_volterra --support": f"{SMALL} --seeds 1",
    "jaxlfi sample": "",
    "jaxlfi diagnose": "--truths 20 --draws 20 --no-figures",
    "jaxlfi report": "",
    "jaxlfi resume runs/compare": "",
}
"""Commands that are run, by how they begin, and what is appended."""
ELSEWHERE = {
    "jaxlfi whip": "minutes of physics, or a robot: run by tests/envs/whip",
    "jaxlfi infer whip": "minutes of physics: run by tests/envs/whip",
    "jaxlfi infer mujoco,config=examples/mujoco/arm.toml,engine=mjx": "minutes of compiling: run by tests/envs/mujoco",
    "jaxlfi design runs/whip": "minutes of physics: run by tests/envs/whip",
    "jaxlfi mujoco": "needs a posterior of more than two rounds: run by tests/envs/mujoco",
    "jaxlfi train": "minutes of training: run by tests/rl",
    "jaxlfi evaluate": "needs trained policies: run by tests/rl",
    "jaxlfi control": "needs a robot: run by tests/robots",
    "jaxlfi infer mujoco,config=examples/mujoco/furuta.toml,log=runs/real.csv": "needs a recording: tests/envs/mujoco",
    "jaxlfi export": "needs trained policies: run by tests/rl",
    "jaxlfi r2s2r": "an hour: run by tests/envs/whip",
    "jaxlfi infer my_task": "the reader's own task",
    "jaxlfi resume runs/arm": "the reader's own task",
    "jaxlfi resume runs/lynx": "more rounds: run by tests/runs/test_resume.py",
    "jaxlfi infer examples.command.spring:task": "needs a C compiler: run by tests/tasks/test_command.py",
    "jaxlfi grid lotka_volterra --seeds 100": "needs several hosts: run by tests/runs/test_several_processes.py",
    "srun": "needs Slurm",
    "dask": "needs a cluster",
    "cc": "needs a C compiler: run by tests/tasks/test_command.py",
    "make": "the installation",
    "pip": "the installation",
    "python3": "the installation",
    "python3.11": "the installation",
    "python -m jaxlfi.robots.simulated": "serves until it is ended: run by tests/robots",
    "python -m timeit": "needs a trained policy, and measures",
}
"""Commands that are not run, by how they begin, and why."""
FRAGMENTS = {
    "x_real[17:23] = np.nan": "for a task and an observation of the reader's own: tests/tasks/test_gaps.py",
    "with ThreadPoolExecutor(8)": "for a simulator of the reader's own: tests/runs/test_executors.py",
    "def simulate(rng, theta):": "has three dots: examples/host_simulator.py is whole",
    "task = jaxlfi.Task.from_command(": "needs a program: tests/tasks/test_command.py",
    "from dask_jobqueue": "needs Slurm",
    "from mpi4py": "needs MPI",
    "from any_robot": "serves until it is ended: tests/robots",
    "from robot_driver": "serves until it is ended: tests/robots",
    "preparation.of_schema": "needs a trained policy: tests/rl/test_prepared_policy.py",
    'policy.load("runs/': "needs a trained policy: tests/rl/test_policy.py",
    "gymnasium.make": "needs a table of policies, and compiles: tests/rl/test_gym.py",
    "WhipVector": "minutes of compiling: tests/envs/whip/test_gym.py",
    "from_brax": "minutes of compiling: tests/rl/test_from_brax.py",
    "export.deserialize": "needs an exported segmenter: tests/envs/whip/vision",
    "MujocoEnvironment": "compiles MJX: tests/envs/mujoco/test_environment.py",
    "--8<--": "an example: tests/docs/test_examples.py",
}
"""Parts of the blocks of Python that are not run, and why."""
NOT_CODE = ("text", "toml")


def steps(page: str) -> Iterator[tuple[str, str]]:
    """The kinds and texts of a page's blocks."""
    for match in BLOCK.finditer(PAGES[page].read_text()):
        yield match[1], match[2]


def commands(body: str) -> list[list[str]]:
    """The command lines of a block, with continued lines joined and comments left out."""
    return [words for line in body.replace("\\\n", " ").splitlines() if (words := shlex.split(line, comments=True))]


def listed(words: list[str]) -> str | None:
    """The longest of the listed beginnings that a command has."""
    return max((start for start in {**RUN, **ELSEWHERE} if " ".join(words).startswith(start)), key=len, default=None)


def runnable(page: str) -> list[tuple[str, str | list[str]]]:
    """The work of a fresh process for a page."""
    todo: list[tuple[str, str | list[str]]] = []
    for kind, body in steps(page):
        if kind == "python" and not any(part in body for part in FRAGMENTS):
            todo.append((kind, body))
        elif kind in ("sh", "bash"):
            run = [words for words in commands(body) if listed(words) in RUN]
            todo += [("command", [*words[1:], *shlex.split(RUN[listed(words)])]) for words in run]
    return todo


def work(todo: str) -> None:
    """Run a page's blocks in a separate process."""
    import jaxlfi
    from tests.small import SETTINGS

    infer = jaxlfi.infer
    jaxlfi.infer = lambda *given, **named: infer(*given, **({"settings": SETTINGS} | named))
    namespace: dict = {}
    for kind, body in json.loads(todo):
        if kind == "python" and (name := re.match(r"# (\w+\.py)\n", body)):
            Path(name[1]).write_text(body)
        elif kind == "python":
            exec(compile(body, "block", "exec"), namespace)
        elif status := cli.main(body):
            raise SystemExit(f"{shlex.join(['jaxlfi', *body])}: {status}")


@pytest.mark.parametrize("page", PAGES)
def test_every_block_is_run_or_listed(page):
    for kind, body in steps(page):
        assert kind in ("python", "sh", "bash", *NOT_CODE), kind
        for words in commands(body) if kind in ("sh", "bash") else ():
            assert listed(words), words


def test_what_is_listed_is_there():
    blocks = [(kind, body) for page in PAGES for kind, body in steps(page)]
    lines = [words for kind, body in blocks if kind in ("sh", "bash") for words in commands(body)]
    assert {listed(words) for words in lines} == {*RUN, *ELSEWHERE}
    for part in FRAGMENTS:
        assert any(kind == "python" and part in body for kind, body in blocks), part


@pytest.mark.parametrize("page", [page for page in PAGES if any(kind in ("sh", "bash") for kind, _ in steps(page))])
def test_every_command_is_understood(page):
    for kind, body in steps(page):
        for words in commands(body) if kind in ("sh", "bash") else ():
            if "jaxlfi" in words:
                parse(words[words.index("jaxlfi") + 1 :])


def parse(words: list[str]) -> None:
    """Parse words with the parser that the command itself uses."""
    if command := cli.foreign_command(words[0]):
        command, own = command.chosen(words[1:]) if isinstance(command, Loops) else (command, words[1:])
        command.parser().parse_args(own)
    else:
        cli.parse(words)


def run_page(page: str, folder: Path) -> None:
    """A page's blocks run in a fresh process and a folder with the repository's examples."""
    (folder / "examples").symlink_to(ROOT / "examples")
    subprocess.run(
        [sys.executable, "-c", "import sys; import test_blocks; test_blocks.work(sys.argv[1])",
         json.dumps(runnable(page))],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(map(str, (ROOT, Path(__file__).parent, folder)))},
        check=True,
    )  # fmt: skip


LIGHT = ("recordings.md",)
"""Pages whose blocks take a few seconds."""


@pytest.mark.parametrize(
    "page",
    [pytest.param(page, marks=[] if page in LIGHT else pytest.mark.slow) for page in PAGES if runnable(page)],
)
def test_a_page_runs_in_a_fresh_process(page, tmp_path):
    run_page(page, tmp_path)


@pytest.mark.slow
def test_a_task_in_a_file_runs_as_printed(tmp_path):
    """They run in a shell, with the printed settings."""
    blocks = list(steps("quickstart.md"))
    place = next(place for place, (_, body) in enumerate(blocks) if body.startswith("# decay.py\n"))
    (_, file), (_, python), (_, sh) = blocks[place : place + 3]
    for name, text in {
        "decay.py": file,
        "block.py": python,
        "jaxlfi": f'exec "{sys.executable}" -m jaxlfi "$@"\n',
    }.items():
        (tmp_path / name).write_text(text)
    (tmp_path / "jaxlfi").chmod(0o755)
    environment = os.environ | {"PYTHONPATH": str(ROOT), "PATH": f"{tmp_path}{os.pathsep}{os.environ['PATH']}"}
    subprocess.run([sys.executable, "block.py"], cwd=tmp_path, env=environment, check=True)
    subprocess.run(["sh", "-ec", sh], cwd=tmp_path, env=environment, check=True)
    assert len((tmp_path / "runs/decay/posterior.csv").read_text().splitlines()) == 10_001
