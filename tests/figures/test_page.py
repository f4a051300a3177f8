"""Tests of pages: what a browser needs of them, by a parser and, where there is one, in Chromium itself."""

import base64
from html.parser import HTMLParser
from pathlib import Path

import pytest

from jaxlfi.figures import report
from jaxlfi.io import files, web_page
from jaxlfi.io.run_summary import ParameterSummary, RunSummary
from tests import browser
from tests.figures.test_figures import write_run

VOID = {"meta", "img", "br", "link", "hr"}


class Page(HTMLParser):
    """Elements of a page with what they stand in, its pictures, and its text outside code and scripts."""

    def __init__(self, text: str):
        super().__init__()
        self.open, self.unclosed, self.pictures, self.loose_tables, self.text = [], [], [], 0, ""
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        attributes = dict(attrs)
        if tag == "img":
            self.pictures.append(attributes)
        if tag == "table":
            self.loose_tables += not any(inside == "wide" for _, inside in self.open)
        if tag not in VOID:
            self.open.append((tag, attributes.get("class")))

    def handle_endtag(self, tag):
        if self.open.pop()[0] != tag:
            self.unclosed.append(tag)

    def handle_data(self, data):
        if not {"pre", "script", "style"} & {tag for tag, _ in self.open}:
            self.text += data


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> Path:
    """The page of a run whose summary names commands."""
    folder = write_run(tmp_path_factory.mktemp("page") / "run", dim=2, rounds=2, records=21, channels=("x",))
    rest = 308.0, 2832.0, "identified", (), None, 5
    damping = ParameterSummary("joint/shoulder/damping", "N m s/rad", 0.12948, (0.12916, 0.12977), (0.12, 0.13), *rest)
    found = RunSummary((damping,), ("The box was `low`.",), ("Run `jaxlfi diagnose <run>`.",))
    files.write_json(folder / "summary.json", found.to_dict())
    return report(folder, dpi=30)[0]


def test_a_page_is_well_formed_and_says_what_its_pictures_show(written):
    page = Page(written.read_text(encoding="utf-8"))
    assert not page.unclosed and not page.open
    assert len(page.pictures) >= 5 and page.loose_tables == 0
    for picture in page.pictures:
        assert len(picture["alt"]) > 20
        assert base64.b64decode(picture["src"].partition("base64,")[2]).startswith(b"\x89PNG")
    assert "`" not in page.text and "jaxlfi diagnose <run>" in page.text
    assert page.text.index("Answer") < page.text.index("Posterior by pairs of parameters")
    results = page.text.partition("Results")[2]
    assert "parameter error" in results and "median" not in results.partition("Parameter error")[0]  # of one run


def test_nothing_of_fixed_width_is_wider_than_a_phone():
    """Pictures shrink, tables and code scroll, long words break."""
    for rule in ("img { display: block; max-width: 100%", ".wide { overflow-x: auto", "overflow-wrap: anywhere"):
        assert rule in web_page.CSS
    assert "prefers-color-scheme: dark" in web_page.CSS


@pytest.mark.skipif(browser.CHROMIUM is None, reason=browser.MISSING)
def test_a_browser_finds_nothing_wrong(written):
    assert browser.faults([written]) == []


@pytest.mark.slow
@pytest.mark.skipif(browser.CHROMIUM is None, reason=browser.MISSING)
def test_a_browser_finds_what_is_wrong(tmp_path):
    """At both widths and in both schemes, but for what matters on a laptop only."""
    page = tmp_path / "page.html"
    page.write_text(
        """<!doctype html><body><img src="none.png"><p style="color: #999; background: #fff">Faint</p>
        <div style="width: 900px"></div>
        <div class="wide" style="width: 9px; overflow: auto"><table><tr><td>Long</table></div>
        <table style="width: 2000px"><caption>Far</caption></table><script>missing()</script>"""
    )
    found = browser.faults([page])
    kinds = [one[3] for one in found if isinstance(one, list)]
    always = "no heading", "not loaded", "without a text alternative", "caption cut off", "hard to read"
    assert [kinds.count(kind) for kind in (*always, "wider than the window")] == [4] * 6
    assert kinds.count("table cut off on a laptop") == 2
    assert sum("missing is not defined" in one for one in found if isinstance(one, str)) == 4
