"""A pytest plugin for `tests.affected`: files in the order of the command line, no new tests after TESTS_SECONDS."""

import os
import time

import pytest

DEADLINE = pytest.StashKey[float]()


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Keep the order of the command line, which tests/conftest.py changes, and start the clock."""
    named = [config.rootpath / word.partition("::")[0] for word in config.args]
    items.sort(key=lambda item: named.index(item.path) if item.path in named else len(named))
    config.stash[DEADLINE] = time.monotonic() + float(os.environ["TESTS_SECONDS"])


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Skip tests that would begin too late."""
    if time.monotonic() > item.config.stash[DEADLINE]:
        pytest.skip("the time of `make check` was up: `make test` runs this test, too")
