"""The machine of `jaxlfi r2s2r mujoco`, and its recordings, which are kept.

A recording is whole once its report, the last of its files, is written, unless the report says that an error or a
signal cut it short. Such a recording is moved into a folder next to it, `NAME.cut-1`, and made again: no measurement is
lost.
"""

import argparse
import contextlib
import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from jaxlfi.cli import loops

Connect = Callable[[], Any]
"""Makes a driver of the machine, for one recording."""
LEAST = 2
"""Smallest number of controls in a recording from which anything can be inferred."""


@contextlib.contextmanager
def connected(
    arguments: argparse.Namespace, config: Path, seed: int, scattered: bool = False, first: int = 0
) -> Iterator[Connect]:
    """Drivers of the machine; a simulated one lives in a process that ends with the context, or with this process.

    Args:
        arguments: of the loop.
        config: of its task.
        seed: of a simulated machine.
        scattered: whether its episodes begin as in training.
        first: number of its first episode.

    Raises:
        ValueError: if a simulated machine does not start, and if nobody can confirm that the machine may move.
    """
    from jaxlfi.robots import wire
    from jaxlfi.robots.client import SocketDriver

    if arguments.address is not None:
        token = None if arguments.token is None else wire.token_of(arguments.token)

        def driver() -> Any:
            if arguments.confirm:
                _confirm("policies' episodes begin" if scattered else "recordings begin")
            return SocketDriver(arguments.address, arguments.remote, token)

        yield driver
        return
    words = [sys.executable, "-m", "jaxlfi.envs.mujoco.cli", "serve", str(config), "--until-closed"]
    words += ["--seed", str(seed), "--first-episode", str(first), *(["--scattered"] if scattered else [])]
    # In a session of its own, Ctrl-C does not end it before the loop has stopped it.
    process = subprocess.Popen(
        words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    try:
        line = process.stdout.readline() if process.stdout else ""
        if not line:
            why = process.stderr.read().strip().rpartition("\n")[2] if process.stderr else ""
            raise ValueError(f"robot: expected a simulated machine that listens, got one that ended: {why}")
        yield lambda: SocketDriver(line.split()[-1])
    finally:
        process.terminate()
        process.wait()
        for pipe in (process.stdin, process.stdout, process.stderr):
            if pipe:
                pipe.close()


def _confirm(where: str) -> None:
    try:
        input(f"bring the machine to where {where}, and press Enter: it moves then ")
    except EOFError:
        raise ValueError("confirm: expected Enter on a terminal before each recording, got the end of input") from None


def excited(arguments: argparse.Namespace, config: Path, path: Path) -> Path:
    """Record the machine, excited by sines of its actuators."""
    from jaxlfi.envs.mujoco import excitation

    if not whole(path):
        loops.say("the machine under sines of its actuators")
        with connected(arguments, config, arguments.seed) as driver, _kept(path):
            excitation.record(driver(), config, path, arguments.excitation, arguments.seed)
    return _informative(path)


def played(arguments: argparse.Namespace, config: Path, controls: Path, path: Path, iteration: int) -> Path:
    """Record the machine under planned controls; it begins where recordings begin."""
    from jaxlfi.envs.mujoco import excitation

    if not whole(path):
        loops.say(f"{controls} on the machine")
        with connected(arguments, config, arguments.seed + iteration) as driver, _kept(path):
            excitation.play(driver(), config, path, controls)
    return _informative(path)


def rolled_out(arguments: argparse.Namespace, config: Path, policy: Path, path: Path, iteration: int) -> Path:
    """Record a policy on the machine; a recording that a limit or a termination ended counts, too.

    It begins as in training, if recordings show how they begin: at the task's own start there may be nothing to do, and
    nothing to learn.
    """
    from jaxlfi.envs.mujoco import excitation

    if not whole(path):
        loops.say(f"{policy} on the machine")
        scattered = excitation.says_its_start(config)
        with connected(arguments, config, arguments.seed + iteration, scattered) as driver:
            controlled(driver(), policy, config, path)
    return _informative(path)


def controlled(driver: Any, policy: Path, config: Path, path: Path) -> None:
    """Let a policy control the machine for an episode, and record it.

    Raises:
        RobotError: for a machine that failed; what it measured until then is written.
    """
    from jaxlfi.envs.mujoco import excitation
    from jaxlfi.rl import policy as policies
    from jaxlfi.robots import driving, sessions

    trained = policies.load(policy)
    settings = excitation.measuring(driving.settings_of(trained), config)
    with _kept(path):
        sessions.of(trained, settings).run(driver, path, {"policy": str(policy)}, say=print)


def whole(path: Path) -> bool:
    """Whether a recording is whole; one that was cut short is moved out of the way."""
    from jaxlfi.robots import recording

    report, loop = recording.beside(path)
    if report.exists() and not report_of(path).get("failed"):
        return True
    if report.exists() and report_of(path)["recording"]:
        aside = next(one for n in range(1, 10**6) if not (one := path.with_name(f"{path.stem}.cut-{n}")).exists())
        aside.mkdir()
        for one in filter(Path.exists, (path, loop, report)):  # the report last, in case of a kill in between
            one.replace(aside / one.name)
        loops.say(f"{path} was cut short: it is kept in {aside}, and recorded again")
    for left in (path, loop, report):  # an incomplete recording's files
        left.unlink(missing_ok=True)
    return False


def report_of(path: Path) -> dict[str, Any]:
    """The report of a recording."""
    from jaxlfi.robots import recording

    return json.loads(recording.beside(path)[0].read_text())


@contextlib.contextmanager
def _kept(path: Path) -> Iterator[None]:
    """Handle stops and failures of a machine: a stop by the loop ends the recording, a failure the loop.

    Raises:
        RobotError: saying where the measurements are.
    """
    from jaxlfi.robots import recording
    from jaxlfi.robots.robot import RobotError

    try:
        yield
    except RobotError as error:
        if not recording.beside(path)[0].exists():
            raise
        report = report_of(path)
        if not report["failed"]:
            print(f"{error}; the recording ends there")
            return
        where = path if report["recording"] else "nowhere: there was nothing yet"
        raise RobotError(f"{error}; the measurements until then are in {where}") from error


def _informative(path: Path) -> Path:
    """A recording, if it is more than a beginning.

    Raises:
        ValueError: if the machine was stopped at once.
    """
    report = report_of(path)
    if (count := report["controls"]) < LEAST:
        why = report["stopped"] or report.get("ended") or "it was over"
        raise ValueError(
            f"{path}: expected at least {LEAST} controls to infer from, got {count}: {why}; see to it, remove "
            f"{path.with_suffix('.json')}, and repeat the command"
        )
    return path
