"""The documentation's site, built and opened in Chromium as files: no page is broken, or wider than its window."""

import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

from tests import browser

ROOT = Path(__file__).parents[2]
BUILD = """
import sys
sys.path.insert(0, "docs")
import tutorials
from mkdocs.__main__ import cli
tutorials.executed = lambda markdown: (markdown, {})  # they take minutes; tests/docs run them
cli(["build", "--strict", "--quiet", "--site-dir", sys.argv[1]])
"""


@pytest.mark.slow
@pytest.mark.skipif(browser.CHROMIUM is None, reason=browser.MISSING)
@pytest.mark.skipif(importlib.util.find_spec("mkdocs") is None, reason="needs the extra docs")
def test_a_browser_finds_nothing_wrong_with_any_page(tmp_path):
    site = tmp_path / "site"
    subprocess.run([sys.executable, "-c", BUILD, str(site)], cwd=ROOT, check=True)
    pages = [path for path in sorted(site.rglob("*.html")) if path.name != "404.html"]
    assert {"index.html", "mujoco.html", "tutorials/spring.html"} <= {str(one.relative_to(site)) for one in pages}
    # The theme has one scheme, and keeps words on drawers that are out of sight.
    assert browser.faults(pages, schemes=["light"], contrast=0.0) == []
