"""The documentation's site, built and opened in Chromium as files: no page is broken, or wider than its window."""

import importlib.util
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
BUILD = """
import sys
sys.path.insert(0, "docs")
import tutorials
from mkdocs.__main__ import cli
tutorials.executed = lambda markdown: (markdown, {})  # they take minutes; tests/docs run them
cli(["build", "--strict", "--quiet", "--site-dir", sys.argv[1]])
"""
PROBE = """<!doctype html><title></title><script>
const pages = PAGES, widths = [390, 1280], found = [];
async function look(page, width) {
  const frame = document.createElement("iframe");
  frame.width = width; frame.height = 800; frame.src = page;
  const loaded = new Promise(done => { frame.onload = done; });
  document.body.append(frame);
  await loaded;
  const seen = frame.contentDocument, root = seen.documentElement;
  const broken = [...seen.images].filter(image => image.complete && !image.naturalWidth).map(image => image.src);
  if (broken.length || root.scrollWidth > width || !seen.querySelector("h1"))
    found.push([page, width, root.scrollWidth, broken]);
  frame.remove();
}
window.onload = async () => {
  for (const width of widths) for (const page of pages) await look(page, width);
  document.title = JSON.stringify(found);
};
</script><body></body>"""


@pytest.mark.slow
def test_no_page_is_broken_or_wider_than_its_window(tmp_path):
    if CHROMIUM is None or importlib.util.find_spec("mkdocs") is None:
        pytest.skip("needs Chromium on the path, and the extra docs")
    site = tmp_path / "site"
    subprocess.run([sys.executable, "-c", BUILD, str(site)], cwd=ROOT, check=True)
    pages = sorted(path.relative_to(site).as_posix() for path in site.rglob("*.html") if path.name != "404.html")
    assert {"index.html", "mujoco.html", "tutorials/spring.html"} <= set(pages)
    probe = site / "probe.html"
    probe.write_text(PROBE.replace("PAGES", json.dumps(pages)))
    command = [CHROMIUM, "--headless", "--no-sandbox", "--allow-file-access-from-files", "--window-size=1500,900"]
    command += ["--enable-logging=stderr", "--virtual-time-budget=600000", "--dump-dom", probe.as_uri()]
    shown = subprocess.run(command, capture_output=True, text=True, timeout=600)
    (title,) = re.findall(r"<title>(.*?)</title>", shown.stdout)
    assert json.loads(title) == []
    assert not re.findall(r"CONSOLE.*(?:Uncaught|Error).*", shown.stderr)
