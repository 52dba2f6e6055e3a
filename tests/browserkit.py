"""Pages in a real browser, as a reader sees them."""

import json
import re
import shutil
import subprocess

import pytest

from emb_daemon.report.figures import SCREEN_POINTS

_CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
#: Of all traces of a page: what a browser draws in the time in which a reader waits, on a machine of any speed. A replay of
#: three panels of five lines or so each has a third of it.
_POINTS = 50 * SCREEN_POINTS

_BEFORE = "<script>window.failures = []; window.onerror = function (text) { window.failures.push(text); };</script>"
#: Stands behind the page's own scripts, which draw as they run.
_AFTER = """<script>
var places = Array.from(document.querySelectorAll("[data-figure]"));
var points = places.flatMap(function (place) { return (place.calcdata || []).map(function (line) { return line.length; }); });
document.title = JSON.stringify({
  failures: window.failures, plots: places.length, points: points,
  drawn: places.filter(function (place) { return place.querySelectorAll("path.js-line, .points path").length > 0; }).length,
  lines: document.querySelectorAll("path.js-line").length, width: document.documentElement.scrollWidth });
</script>"""


def opened(html: str, folder) -> dict:
    """What a browser says of a page once it is drawn."""
    return said_by(html, folder, _AFTER)


def said_by(html: str, folder, script: str):
    """What a script behind the page's own makes of the document's title, as JSON; promises are waited for."""
    return said_at(folder / "page.html", html, script)


def said_at(path, html: str, script: str):
    """The same of a page with the files that lie about ``path``."""
    if not _CHROMIUM:
        pytest.skip("NOT RUN: no Chromium here (Debian: apt-get install chromium)")
    path.write_text(html.replace("<head>", "<head>" + _BEFORE, 1).replace("</body>", script + "</body>", 1))
    command = [_CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--window-size=1280,900",
               f"--user-data-dir={path.parent}/profile", "--dump-dom", path.as_uri()]  # fmt: skip
    result = subprocess.run(command, capture_output=True, text=True, timeout=90, check=True)
    return json.loads(re.search(r"<title>(.*?)</title>", result.stdout, re.DOTALL)[1])


def assert_is_drawn(html: str, folder, plots: int) -> dict:
    """No script error, all of ``plots`` drawn, nothing wider than the window, of so few points that nobody waits for them."""
    said = opened(html, folder)
    assert said["failures"] == [] and said["plots"] == said["drawn"] == plots
    assert said["width"] <= 1280 and max(said["points"]) <= SCREEN_POINTS + 2 and sum(said["points"]) <= _POINTS
    return said
