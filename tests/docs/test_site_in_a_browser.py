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
PROBE = """<!doctype html><title></title><body>FRAMES</body><script>
window.onload = () => {
  const found = [];
  for (const frame of document.querySelectorAll("iframe")) {
    const seen = frame.contentDocument, width = Number(frame.width), across = seen.documentElement.scrollWidth;
    const broken = [...seen.images].filter(image => image.complete && !image.naturalWidth).map(image => image.src);
    if (broken.length || across > width || !seen.querySelector("h1"))
      found.push([frame.getAttribute("src"), width, across, broken]);
  }
  document.title = JSON.stringify(found);
};
</script>"""
AT_ONCE = 12
"""Pages that one window of the browser shows."""
OFFLINE = "--host-resolver-rules=MAP * ~NOTFOUND"
"""What pages ask other hosts for is refused at once."""


@pytest.mark.slow
def test_no_page_is_broken_or_wider_than_its_window(tmp_path):
    if CHROMIUM is None or importlib.util.find_spec("mkdocs") is None:
        pytest.skip("needs Chromium on the path, and the extra docs")
    site = tmp_path / "site"
    subprocess.run([sys.executable, "-c", BUILD, str(site)], cwd=ROOT, check=True)
    pages = sorted(path.relative_to(site).as_posix() for path in site.rglob("*.html") if path.name != "404.html")
    assert {"index.html", "mujoco.html", "tutorials/spring.html"} <= set(pages)
    faults, probe = [], site / "probe.html"
    for width in (390, 1280):
        for first in range(0, len(pages), AT_ONCE):
            shown = [f'<iframe src="{page}" width={width} height=800></iframe>' for page in pages[first:][:AT_ONCE]]
            probe.write_text(PROBE.replace("FRAMES", "".join(shown)))
            faults += seen(probe)
    assert faults == []


def seen(probe: Path) -> list:
    """What the probe finds wrong, and what scripts of the pages complain of."""
    command = [CHROMIUM, "--headless", "--no-sandbox", "--allow-file-access-from-files", "--window-size=1500,900"]
    command += [OFFLINE, "--enable-logging=stderr", "--dump-dom", probe.as_uri()]
    shown = subprocess.run(command, capture_output=True, text=True, timeout=300)
    (title,) = re.findall(r"<title>(.*?)</title>", shown.stdout)
    return [*json.loads(title), *re.findall(r"CONSOLE.*Uncaught.*", shown.stderr)]
