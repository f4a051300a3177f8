"""Pages in a browser, Chromium if it is installed: what is broken, too wide, unlabelled or hard to read."""

import html
import json
import re
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
MISSING = "needs Chromium, and there is none on the path"
WIDTHS = 390, 1280
"""Widths of a phone's and a laptop's window, in pixels. Chromium's own is at least 500 wide, a frame may be less."""
CONTRAST = 4.5
"""Smallest contrast of text with its background (WCAG 2, level AA)."""
AT_ONCE = 12
"""Number of pages that one browser process opens, at each width."""
PROBE = Path(__file__).with_name("browser.html").read_text()
OFFLINE = "--host-resolver-rules=MAP * ~NOTFOUND"
"""Option that refuses requests of pages, or of Chromium itself, to other hosts at once."""
REFUSED = "net::ERR_NAME_NOT_RESOLVED"


def faults(pages: Sequence[Path], schemes: Sequence[str] = ("light", "dark"), contrast: float = CONTRAST) -> list:
    """Faults of pages at each of `WIDTHS`, and errors of scripts while their tables and pictures are used.

    Args:
        pages: HTML files.
        schemes: colour schemes that readers may prefer.
        contrast: smallest contrast of text with its background.

    Returns:
        For each fault the page's address, the width, the scheme, its kind and its place; then the lines of the console.
        Empty if nothing is wrong.
    """
    found = []
    for first in range(0, len(pages), AT_ONCE):
        found += _seen([page.resolve().as_uri() for page in pages[first:][:AT_ONCE]], schemes, contrast)
    return found


def _seen(addresses: Sequence[str], schemes: Sequence[str], contrast: float) -> list:
    asked = {"pages": addresses, "widths": WIDTHS, "schemes": schemes, "contrast": contrast}
    with tempfile.TemporaryDirectory() as folder:
        probe = Path(folder) / "probe.html"
        probe.write_text(PROBE.replace("ASKED", json.dumps(asked)))
        command = [str(CHROMIUM), "--headless", "--no-sandbox", "--disable-gpu", "--allow-file-access-from-files"]
        command += [OFFLINE, f"--user-data-dir={folder}/profile", "--window-size=1500,900", "--enable-logging=stderr"]
        shown = subprocess.run([*command, "--dump-dom", probe.as_uri()], capture_output=True, text=True, timeout=300)
    (title,) = re.findall(r"<title>(.*?)</title>", shown.stdout)
    said = [line for line in re.findall(r"CONSOLE.*", shown.stderr) if REFUSED not in line]
    return [*json.loads(html.unescape(title)), *said]
