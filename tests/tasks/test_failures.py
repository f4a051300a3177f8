"""Why simulations failed, in their own words: grouped, counted, kept and taken back."""

import dataclasses

import jax
import numpy as np
import pytest

import jaxlfi
from jaxlfi.tasks import failures
from jaxlfi.tasks.failures import Failure, FailureLog, Message, Tally
from jaxlfi.tasks.host import HostSimulator
from jaxlfi.tasks.worker import LONGEST_MESSAGE, failed
from tests.small import FLAGS, command, gaussian, settings, whole_runs  # noqa: F401 - a fixture

ALIKE = [
    ["mesh inverted at a=2.31", "mesh inverted at a=3", "mesh inverted at a=-2.5e-07", "mesh inverted at a=nan"],
    ["node 17 of 20: no step", "node 3 of 20: no step"],
    ["segfault at 0x7f3a", "segfault at 0xdead"],
    ["mesh inverted at b=2.31"],
    ["no licence"],
    [""],
]


def test_messages_that_differ_in_numbers_only_are_one():
    tally = Tally()
    for place, message in enumerate(message for group in ALIKE for message in group):
        tally.add("error", message, 100 - place)
        tally.add("crash", message, place)
    found = tally.commonest()
    assert sorted(one.count for one in found) == sorted(2 * [len(group) for group in ALIKE])
    assert [one.count for one in found] == sorted((one.count for one in found), reverse=True)
    first = {one.reason: one.message for one in found[:2]}  # of the first place, in whatever order they arrive
    assert first == {"error": ALIKE[0][-1], "crash": ALIKE[0][0]}


def test_what_is_counted_is_bounded():
    tally = Tally()
    for place in range(2 * failures.MANY):
        tally.add("error", "".join(chr(97 + int(digit)) for digit in str(place)), place)
    assert len(tally.commonest()) == failures.MANY
    assert len(failed("error", "long " * 1000).message) <= LONGEST_MESSAGE
    assert failed("error", "\x1b[31mred\x1b[0m\nand so on").message == "?[31mred?[0m and so on"


def test_what_no_message_is_known_of_is_counted_by_its_reason():
    log = FailureLog(("slow", "error"), [Message(0, "error", "at 1", 2), Message(1, "error", "at 2", 1)])
    found = failures.together([(log, np.array([[4, 2], [1, 2]])), (FailureLog(("slow", "error")), np.array([[0, 1]]))])
    assert found == [Failure("slow", "", 5), Failure("error", "at 1", 3), Failure("error", "", 2)]
    assert failures.together([]) == []


def test_rounds_that_are_made_again_are_taken_back(tmp_path):
    made = [Message(0, "error", "a", 1), Message(1, "error", 'b, \u2028 "quoted"', 2), Message(2, "crash", "", 3)]
    assert failures.read(tmp_path) == failures.cut(tmp_path, 5) == []
    failures.append(tmp_path, made)
    assert failures.read(tmp_path) == made
    with (tmp_path / failures.FILE).open("a") as file:
        file.write('{"round": 3, "rea')
    with pytest.raises(ValueError, match="expected messages of failures, got a damaged file"):
        failures.read(tmp_path)
    assert failures.cut(tmp_path, 2) == made[:2] == failures.read(tmp_path)


def moody(rng, theta):
    """Fails in a third of simulations, with numbers in what it says; and in others without a word."""
    place = rng.uniform()
    if place < 0.3:
        raise RuntimeError(f"mesh inverted at a={theta[0]}\nby {place}")
    return theta * (np.nan if place < 0.4 else 1.0) + 0.3 * rng.normal(size=2), place < 0.4 or place > 0.5


def moody_task():
    """The Gaussian task with that simulator, as the command line finds it."""
    return dataclasses.replace(
        gaussian(), simulate=HostSimulator(moody, each=True), observation=np.float32([0.5, 0.2]), failures=("shy",)
    )


def test_a_run_tells_why_its_simulations_failed(tmp_path):
    numbers = settings()
    run = jaxlfi.infer(jax.random.key(0), moody_task(), settings=numbers)
    counts = dict(zip(moody_task().reasons, np.sum(run.history["failed"], axis=0).tolist(), strict=True))
    error = next(one for one in run.failures if one.reason == "error")
    assert error.count == counts["error"] > 1
    assert error.message.startswith("RuntimeError: mesh inverted at a=")
    assert {one.reason: one.count for one in run.failures} == {name: count for name, count in counts.items() if count}
    assert [one.count for one in run.failures] == sorted(counts.values(), reverse=True)[: len(run.failures)]
    kept = jaxlfi.infer(jax.random.key(0), moody_task(), settings=numbers, out=tmp_path / "run")
    saved = jaxlfi.load(run.save(tmp_path / "saved"), moody_task())
    again = jaxlfi.load(tmp_path / "run")
    assert run.failures == kept.failures == saved.failures == again.failures
    assert jax.tree.structure(run) == jax.tree.structure(run.replace(failure_log=FailureLog()))
    (tmp_path / "run" / failures.FILE).unlink()  # as earlier versions leave it
    assert sum(one.count for one in jaxlfi.load(tmp_path / "run", moody_task()).failures) == sum(counts.values())


def test_commands_print_the_commonest(tmp_path, capsys):
    assert command("infer", f"{__name__}:moody_task", *FLAGS, "--out", tmp_path / "run") == 0
    said = capsys.readouterr().out.splitlines()
    (line,) = [line for line in said if " simulations failed: " in line]
    found = jaxlfi.load(tmp_path / "run").failures
    assert len(found) == 3 and all(f"{one.count} {one.reason}" in line and one.message in line for one in found)
    alike = ("--configurations", "ok+edge", "--seeds", 1)  # the same program
    assert command("compare", f"{__name__}:moody_task", *FLAGS, *alike, "--out", tmp_path / "runs") == 0
    assert any(line.startswith("failed: ") for line in capsys.readouterr().out.splitlines())
