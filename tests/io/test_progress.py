"""Progress in lines: rounds, and simulations where they are slow."""

import io

import pytest
from rich.console import Console

from jaxlfi.io import progress
from jaxlfi.io.progress import RoundProgress


def test_slow_simulations_are_told_now_and_then(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    file = io.StringIO()
    with RoundProgress(Console(file=file, width=120), 2, 0, "arm: 1 run") as bar:
        now[0] = 30.0
        bar.compiled(30.0)
        for done in range(1, 31):  # one a second
            now[0] += 1
            bar.simulated(done, 25)
        bar.advance()
        now[0] += 5
        bar.simulated(1, 25)
    assert file.getvalue().splitlines()[2:] == [
        "round 1: 10 simulations so far, 25 must succeed, 10 s elapsed",
        "round 1: 20 simulations so far, 25 must succeed, 20 s elapsed",
        "round 1: 30 simulations so far, 25 must succeed, 30 s elapsed",
        "round 1 of 2, 30 s elapsed, about 30 s left",
    ]


@pytest.mark.parametrize("width", [120, 80, 60])
def test_a_narrow_window_shows_every_number(width):
    file = io.StringIO()
    console = Console(file=file, width=width, force_terminal=True, color_system=None)
    with RoundProgress(console, 200, 3, "lotka_volterra: 12 runs in a batch") as bar:
        bar.advance()
        bar._shown = 0.0
        bar.simulated(1234, 5000)
    for word in ("4/200", "rounds,", "0:00:00", "elapsed,", "left", "12 runs", "1234", "5000"):
        assert word in file.getvalue().rpartition("lotka_volterra")[2], word
    assert "\u2026" not in file.getvalue()


def test_compiling_is_said_until_it_is_over():
    """In a bar by its description; in lines at the start. Where nobody says that it is over, the first round does."""
    for over in (lambda shown: shown.compiled(3.0), lambda shown: shown.advance()):
        shown = RoundProgress(Console(file=io.StringIO(), force_terminal=True, width=120), 4, 0, "2 runs")
        with shown:
            assert shown._bar.tasks[0].description == "2 runs, compiling"
            over(shown)
            assert shown._bar.tasks[0].description == "2 runs"
    lines = io.StringIO()
    with RoundProgress(Console(file=lines, width=120), 4, 0, "2 runs"):
        assert lines.getvalue() == "2 runs: 4 of 4 rounds to do, after compiling\n"


def test_the_time_left_is_not_estimated_from_compiling(monkeypatch):
    """A training compiles within its first updates, and nobody says when that is over."""
    now = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    file = io.StringIO()
    with RoundProgress(Console(file=file, width=120), 60, 0, "arm: 2 policies", "update") as bar:
        for seconds in (86.0, 4.0, 4.0):
            now[0] += seconds
            bar.advance(20)
    assert file.getvalue().splitlines()[1:] == [
        "update 20 of 60, 86 s elapsed",
        "update 40 of 60, 90 s elapsed, about 4 s left",
        "update 60 of 60, 94 s elapsed, about 0 s left",
    ]


def test_where_nothing_is_compiled_nothing_is_said_of_it():
    lines = io.StringIO()
    with RoundProgress(Console(file=lines, width=120), 4, 0, "arm: polishing", "step", ""):
        assert lines.getvalue() == "arm: polishing: 4 of 4 steps to do\n"
    shown = RoundProgress(Console(file=io.StringIO(), force_terminal=True, width=120), 4, 0, "polishing", first="")
    with shown:
        assert shown._bar.tasks[0].description == "polishing"
