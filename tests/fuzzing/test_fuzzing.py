"""Bad input by the hundred, and that the fuzzer notices what it is there to notice."""

import functools
import gc
import mmap
import os
import time
import warnings

import pytest

pytest.importorskip("mujoco")

from jaxlfi.cli import commands
from tests.fuzzing import judging
from tests.fuzzing.cases import made
from tests.fuzzing.judging import Case, judged
from tests.fuzzing.running import HERE, fuzz, prepared_folder
from tests.fuzzing.words import RIGHT, flags_of
from tests.small import whole_runs  # noqa: F401 - a fixture

CASES = 180
"""Enough for every command to have one; `python -m tests.fuzzing` makes thousands."""


@pytest.fixture(scope="module")
def root(whole_runs):  # noqa: F811 - the fixture
    with prepared_folder() as folder:
        yield folder


def test_bad_input_is_refused_in_one_line(root):
    """A part of the cases below, of those that train nothing."""
    some = fuzz(root, 0, [number for number in range(0, CASES, 4) if not made(0, number, root / HERE).work])
    assert [one for one in some if one.finding] == []


@pytest.mark.slow
def test_bad_input_is_refused_in_one_line_or_works(root):
    every = list(fuzz(root, 0, range(CASES)))
    assert [one for one in every if one.finding] == []
    assert {one.command for one in every} == {*RIGHT, "none"}
    assert {one.result.outcome for one in every} == set(judging.PASSED)


def test_every_command_has_words_that_are_right(root):
    assert {name.split()[0] for name in RIGHT} >= set(commands.COMMANDS)
    named = {flag for name in RIGHT for action in flags_of(name) for flag in action.option_strings}
    assert {"--workers", "--scheduler", "--coordinator", "--simulation-timeout", "--domain", "--format"} <= named


def test_a_case_follows_from_its_seed_and_number(root):
    assert made(3, 17, root / HERE) == made(3, 17, root / HERE)
    assert len({made(3, number, root / HERE).words for number in range(0, 70, 7)}) > 5


FAULTS = {
    "traceback": lambda: {}["missing"],
    "hang": lambda: time.sleep(10),
    "output": lambda: warnings.warn("all is well", stacklevel=1),
    "vague": lambda: (_ for _ in ()).throw(ValueError("no")),
    "changed": lambda: open("good/file", "a").write("!"),
    "memory": lambda: mmap.mmap(-1, 2**28).write(b"x" * 2**28),  # pages of its own, not what earlier tests freed
}


@pytest.mark.parametrize("outcome", FAULTS)
def test_what_goes_wrong_is_found(root, monkeypatch, outcome):
    def faulty(arguments, console):
        FAULTS[outcome]()
        if outcome == "output":
            raise ValueError("expected nothing")

    monkeypatch.setitem(commands.COMMANDS, "tasks", faulty)
    if outcome == "hang":
        monkeypatch.setattr(judging, "SECONDS", 1)
    if outcome == "memory":
        monkeypatch.setattr(judging, "MEMORY", 2**26)
        gc.collect()  # what is freed meanwhile would make up for what the case takes
    result, _ = judged(Case("words", ("tasks",), ""), root, root / HERE)
    assert result.outcome == outcome
    (root / HERE / "good" / "file").write_text("precious")


@pytest.mark.parametrize("place", ["own/elsewhere", "../up", "own/run/file", "elsewhere"])
def test_a_file_made_elsewhere_is_found_and_removed(root, monkeypatch, place):
    monkeypatch.setitem(commands.COMMANDS, "tasks", lambda arguments, console: open(place, "w").close())
    here = root / HERE
    (here / "own" / "run").mkdir(parents=True, exist_ok=True)
    assert judged(Case("words", ("tasks",), ""), root, here)[0].outcome == "changed"
    assert not os.path.lexists(here / place)


def test_files_below_out_are_its_own(tmp_path):
    strayed = functools.partial(judging.strayed, {}, root=tmp_path, here=tmp_path / "here")
    assert strayed({"here": "", "here/out": "", "here/out/x": ""}, words=("infer", "--out=out")) == []
    assert strayed({"here/outer": ""}, words=("infer", "--out", "out")) == ["here/outer"]
    assert strayed({"here/own/run/x": ""}, words=("infer", "--out", "out")) == ["here/own/run/x"]
    assert strayed({"here/own/run/x": ""}, words=("report", "own/run")) == []
