"""Pages as a browser shows them, in Chromium where there is one: what is broken, too wide, mute or hard to read."""

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
"""Of a phone's window and of a laptop's, in pixels. Chromium's own is never narrower than 500, a frame in it is."""
CONTRAST = 4.5
"""Of text and what is behind it, at least (WCAG 2, level AA)."""
AT_ONCE = 12
"""Pages that one process of the browser opens, at each width."""
PROBE = Path(__file__).with_name("browser.html").read_text()
OFFLINE = "--host-resolver-rules=MAP * ~NOTFOUND"
"""What pages, or Chromium itself, ask other hosts for is refused at once."""
REFUSED = "net::ERR_NAME_NOT_RESOLVED"


def faults(pages: Sequence[Path], schemes: Sequence[str] = ("light", "dark"), contrast: float = CONTRAST) -> list:
    """What is wrong with pages at each of `WIDTHS`, and what scripts complain of as their tables and pictures are used.

    Args:
        pages: files in HTML.
        schemes: of colours that readers may prefer.
        contrast: of text and what is behind it, at least.

    Returns:
        For each fault the page's address, the width, the scheme, its kind and its place; lines of the console. Empty if
        nothing is wrong.
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
