"""The tests that `make check` runs: those nearest to a change."""

import contextlib
from types import SimpleNamespace

import pytest

from tests import affected, until
from tests.affected import ROOT, nearest

OURS = ROOT / "tests" / "test_affected.py"


@pytest.fixture(scope="module")
def graph():
    return affected.users()


def names(found) -> list[str]:
    return [path.relative_to(ROOT / "tests").as_posix() for path in found]


def test_tests_of_a_module_come_before_those_of_what_imports_it(graph):
    found = nearest({ROOT / "jaxlfi/diagnostics/c2st.py"}, graph)
    assert names(found)[0] == "diagnostics/test_c2st.py" and found[ROOT / "tests/diagnostics/test_c2st.py"] == 1
    assert list(found.values()) == sorted(found.values()) and max(found.values()) > 1
    assert not {"io/test_shell.py", "io/test_locks.py"} & set(names(found))  # their imports do not lead there


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ("jaxlfi/heuristics/truncate.py", "heuristics/test_heuristics.py"),  # by a public name
        ("envs/mg1.py", "envs/test_mg1.py"),  # by the name under which the folder is imported
        ("tests/small.py", "runs/test_infer.py"),  # a module of the tests
        ("Makefile", "test_affected.py"),  # not a module, but this file names it
    ],
)
def test_changes_of_every_kind_lead_to_tests(change, expected, graph):
    assert expected in names(nearest({ROOT / change}, graph))


def test_a_changed_test_is_the_nearest_of_all_and_what_nothing_names_affects_none(graph):
    assert nearest({OURS}, graph) == {OURS: 0}
    assert nearest({ROOT / "no-such" / "file.of-nothing"} - {OURS}, graph).keys() <= {OURS}
    assert nearest({ROOT / "tests" / "test_of_a_module_that_was_removed.py"}, graph).keys() <= {OURS}


def test_no_test_begins_once_the_time_is_up(monkeypatch):
    config = SimpleNamespace(rootpath=ROOT, args=[str(OURS)], stash={})
    item = SimpleNamespace(config=config, path=OURS)
    for seconds, over in (("60", False), ("-1", True)):
        monkeypatch.setenv("TESTS_SECONDS", seconds)
        until.pytest_collection_modifyitems(config, [item])
        with pytest.raises(pytest.skip.Exception, match="make test") if over else contextlib.nullcontext():
            until.pytest_runtest_setup(item)


def test_files_keep_the_order_of_the_command_line(monkeypatch):
    monkeypatch.setenv("TESTS_SECONDS", "1")
    config = SimpleNamespace(rootpath=ROOT, args=["tests/b.py::test_it", "tests/a.py"], stash={})
    items = [SimpleNamespace(path=ROOT / "tests" / name) for name in ("a.py", "b.py", "a.py")]
    until.pytest_collection_modifyitems(config, items)
    assert [item.path.name for item in items] == ["b.py", "a.py", "a.py"]
