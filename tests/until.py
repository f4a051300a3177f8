"""A plugin of pytest for `tests.affected`: files in the order of the command line, no test begun after TESTS_UNTIL."""

import os
import time

import pytest


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Keep the order of the command line, which tests/conftest.py changes."""
    named = [config.rootpath / word.partition("::")[0] for word in config.args]
    items.sort(key=lambda item: named.index(item.path) if item.path in named else len(named))


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Skip what would begin too late."""
    if time.time() > float(os.environ["TESTS_UNTIL"]):
        pytest.skip("the time of `make check` was up: `make test` runs this test, too")
