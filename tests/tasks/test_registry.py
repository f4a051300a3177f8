"""Tasks by name: entry points, module:factory, and options in the types that the factory declares."""

import sys
import types
from pathlib import Path
from typing import Literal

import pytest

from jaxlfi.envs import gaussian_linear
from jaxlfi.references import convert, parse
from jaxlfi.registry import TASKS


@pytest.fixture
def here(monkeypatch):
    """A module of factories that note what they were called with."""
    module = types.ModuleType("made_up_tasks")
    seen = {}

    def factory(
        steps: int = 3,
        duration: float | None = None,
        clean: bool = False,
        kind: Literal["soft", "stiff"] = "soft",
        path: Path = Path(),
        label: str = "x",
        anything=None,
    ):
        seen.update({name: value for name, value in locals().items() if name != "seen"})
        return gaussian_linear.task()

    def late(size: "int" = 1, ratio: "float | int" = 0.5):
        seen.update({name: value for name, value in locals().items() if name != "seen"})
        return gaussian_linear.task()

    module.factory, module.late, module.seen = factory, late, seen
    module.nothing, module.number = lambda: None, 3
    module.keywords = lambda **options: seen.update(options) or gaussian_linear.task()
    module.ready = gaussian_linear.task()
    monkeypatch.setitem(sys.modules, "made_up_tasks", module)
    return module


def test_registered_tasks_are_found():
    assert {"gaussian_linear", "lotka_volterra", "lotka_volterra_ode", "mg1"} <= set(TASKS.names())
    assert TASKS.load("gaussian_linear") == gaussian_linear.task()


def test_options_have_the_types_of_the_signature(here):
    TASKS.load("made_up_tasks:factory,steps=5,duration=20,clean=yes,kind=stiff,path=a/b,label=7,anything=8")
    assert here.seen == {
        "steps": 5, "duration": 20.0, "clean": True, "kind": "stiff", "path": Path("a/b"), "label": "7",
        "anything": "8",
    }  # fmt: skip
    assert isinstance(here.seen["duration"], float) and isinstance(here.seen["steps"], int)


def test_annotations_that_are_text_are_understood(here):
    TASKS.load("made_up_tasks:late,size=4,ratio=2")
    assert here.seen == {"size": 4, "ratio": 2.0}


def test_factories_of_any_keywords_get_text(here):
    TASKS.load("made_up_tasks:keywords,colour=red,n=3")
    assert here.seen == {"colour": "red", "n": "3"}


def test_a_task_of_ours_takes_its_options():
    task = TASKS.load("lotka_volterra_ode,duration=20")
    assert task.name == "lotka_volterra_ode" and float(task.times[-1]) == pytest.approx(20.0)


@pytest.mark.parametrize(
    ("reference", "message"),
    [
        ("made_up_tasks:factory,steps=2.5", "steps: expected a value of type int, got '2.5'"),
        ("made_up_tasks:factory,steps=many", "steps: expected a value of type int, got 'many'"),
        ("made_up_tasks:factory,duration=long", "duration: expected a value of type float, got 'long'"),
        ("made_up_tasks:factory,clean=maybe", "clean: expected true or false, got 'maybe'"),
        ("made_up_tasks:factory,kind=hard", r"kind: expected one of \['soft', 'stiff'\], got 'hard'"),
        ("made_up_tasks:factory,size=3", "expected options among steps, duration, clean, kind, path, label, anything"),
        ("lotka_volterra_ode,duration=long", "duration: expected a value of type float, got 'long'"),
        ("made_up_tasks:factory,steps", "expected options as NAME,key=value,key=value, each key once"),
        ("made_up_tasks:factory,steps=", "expected options as NAME,key=value"),
        ("made_up_tasks:factory,steps=1,steps=2", "each key once"),
        ("made_up_tasks:factory,2=1", "expected options as NAME,key=value"),
        ("made_up_tasks:ready,steps=1", "expected no options of"),
        ("made_up_tasks:nothing", "to give a jaxlfi.Task, got NoneType"),
        ("made_up_tasks:number", "to give a jaxlfi.Task, got int"),
        ("made_up_tasks:absent", "cannot load 'made_up_tasks:absent': AttributeError"),
        ("no_such_module:task", "cannot load 'no_such_module:task': ModuleNotFoundError"),
        ("jaxlfi/envs/gaussian_linear.py:task", "leave out '.py'"),
        ("gaussian", "or module:factory, got 'gaussian'"),
        ("", "or module:factory, got ''"),
    ],
)
def test_wrong_references_are_reported_in_one_line(here, reference, message):
    with pytest.raises(ValueError, match=f"^task: .*{message}") as error:
        TASKS.load(reference)
    assert "\n" not in str(error.value)


def test_a_task_itself_can_be_named(here):
    assert TASKS.load("made_up_tasks:ready") is here.ready


@pytest.mark.parametrize(
    ("text", "kind", "value"),
    [
        ("3", int, 3),
        ("-2", int | None, -2),
        ("1e-3", float, 1e-3),
        ("TRUE", bool, True),
        ("0", bool, False),
        ("2", Literal[1, 2], 2),
        ("a", str, "a"),
        ("x.npz", Path | None, Path("x.npz")),
        ("x", int | str, "x"),
        ("7", int | str, 7),
        ("[1]", list[int], "[1]"),
        ("a;b c", tuple[str, ...], ("a", "b c")),
        ("a", tuple[str, ...] | str | None, ("a",)),
        ("1;2", tuple[int, ...], (1, 2)),
        ("1;2", tuple[int, int], "1;2"),
    ],
)
def test_texts_become_values(text, kind, value):
    got = convert(text, kind, "name")
    assert got == value and type(got) is type(value)


def test_references_are_parsed():
    assert parse("whip,object=dlo-0,detector=clean") == ("whip", {"object": "dlo-0", "detector": "clean"})
    assert parse("pkg.mod:make,a=b=c") == ("pkg.mod:make", {"a": "b=c"})
