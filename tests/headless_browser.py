"""Chromium without a window: what a page looks like, how it is laid out, and what it would fetch."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from dataclasses import dataclass
from html import unescape
from pathlib import Path
from tempfile import mkdtemp

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")

_SWITCHES = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--hide-scrollbars",
    "--no-first-run",
    "--disable-extensions",
    "--disable-background-networking",
)

# Put at the start of a copy of the page.  What is neither in the page nor {allowed} is refused and noted; when all is
# there, the layout is told in an element that --dump-dom prints.
_PROBE = """<meta http-equiv="Content-Security-Policy" content="default-src data: 'unsafe-inline' {allowed}">
<script>
const refused = [];
document.addEventListener("securitypolicyviolation", event => refused.push(event.blockedURI));
addEventListener("load", () => setTimeout(() => {
  const told = document.createElement("pre");
  const wide = [document.documentElement, ...document.querySelectorAll(".wide")];
  const pictures = [...document.images];
  told.textContent = JSON.stringify({
    refused: refused,
    overflow: wide.map(e => e.scrollWidth - e.clientWidth),
    pictures: pictures.map(i => [i.naturalWidth, i.naturalHeight]),
    shown: pictures.map(i => i.checkVisibility() ? i.width : 0),
    formulas: [...document.querySelectorAll("math")].map(m => m.getBoundingClientRect().width),
    text: document.body.innerText,
  });
  told.id = "probe";
  document.body.append(told);
}, 0));
</script>"""


@dataclass(frozen=True)
class Layout:
    """How a page is laid out in a window of some width."""

    refused: list[str]
    """Addresses outside of the page that it wanted something from."""
    overflow: list[int]
    """Pixels by which the page, and each of its scrolling parts, is wider than its place."""
    pictures: list[tuple[int, int]]
    """Size of each picture in pixels, (0, 0) where it cannot be shown."""
    shown: list[float]
    """Width that each picture has on the page; 0 where it is folded away."""
    formulas: list[float]
    """Width of each formula."""
    text: str
    """The text that is seen."""


@dataclass(frozen=True)
class Browser:
    """Runs Chromium, each time with a profile of its own."""

    program: str
    folder: Path

    def screenshot(self, page: Path, picture: Path, width: int = 1280, height: int = 2400) -> None:
        """Write a PNG of the page."""
        self._run(f"--window-size={width},{height}", f"--screenshot={picture}", page.as_uri())
        assert picture.is_file()

    def layout(self, page: Path, width: int = 1280, allowed: str = "") -> Layout:
        """Return how the page is laid out when nothing is fetched but from the allowed places, such as file:."""
        text = page.read_text(encoding="utf-8")
        copy = page.with_name(f"{page.stem}_probed.html")
        copy.write_text(text.replace("<head>", "<head>" + _PROBE.replace("{allowed}", allowed), 1), encoding="utf-8")
        printed = self._run(f"--window-size={width},900", "--virtual-time-budget=3000", "--dump-dom", copy.as_uri())
        copy.unlink()
        told = re.search(r'<pre id="probe">(.*?)</pre>', printed, re.DOTALL)
        assert told is not None, f"{page} was not laid out"
        return Layout(**json.loads(unescape(told.group(1))))

    def _run(self, *arguments: str) -> str:
        command = [self.program, *_SWITCHES, f"--user-data-dir={mkdtemp(dir=self.folder)}", *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=300).stdout


def find_browser(folder: Path) -> Browser | None:
    """Return a browser that works in a folder; None where there is none."""
    program = next(filter(None, map(shutil.which, NAMES)), None)
    return None if program is None else Browser(program, folder)
