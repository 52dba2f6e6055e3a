"""Reports in a real browser: no script error, every plot drawn, soon enough. `.ci/run` installs Chromium."""

import json
import re
import shutil
import subprocess

import pytest

from emb_daemon.calibration.files import load_calibration
from emb_daemon.replay import Replay
from emb_daemon.report.replay import replay_page
from emb_daemon.resources import resource

_CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
_SECONDS = 3.0

_BEFORE = "<script>window.failures = []; window.onerror = function (text) { window.failures.push(text); };</script>"
#: Stands behind the page's own scripts, which draw as they run; the browser's clock is the real one.
_AFTER = """<script>
var places = Array.from(document.querySelectorAll("[data-figure]"));
document.title = JSON.stringify({
  failures: window.failures, plots: places.length, seconds: performance.now() / 1000,
  drawn: places.filter(function (place) { return place.querySelectorAll("path.js-line").length > 0; }).length,
  lines: document.querySelectorAll("path.js-line").length, width: document.documentElement.scrollWidth });
</script>"""


def opened(html: str, folder) -> dict:
    """What a browser says of a page once it is drawn."""
    if not _CHROMIUM:
        pytest.skip("NOT RUN: no Chromium here (Debian: apt-get install chromium)")
    path = folder / "page.html"
    path.write_text(html.replace("<head>", "<head>" + _BEFORE, 1).replace("</body>", _AFTER + "</body>", 1))
    command = [_CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--window-size=1280,900",
               f"--user-data-dir={folder}/profile", "--dump-dom", path.as_uri()]  # fmt: skip
    result = subprocess.run(command, capture_output=True, text=True, timeout=90, check=True)
    return json.loads(re.search(r"<title>(.*?)</title>", result.stdout, re.DOTALL)[1])


def test_a_six_minute_replay_opens_without_error(rig, tmp_path):
    replay = Replay(load_calibration(resource("config/calibration.yaml")))
    page = replay_page([replay.run(rig / "integrated" / "val.log.gz")], "FL", "the shipped one")
    html = page.render()
    assert "http" not in re.sub(r"<script>.*?</script>", "", html, flags=re.DOTALL)
    said = opened(html, tmp_path)
    assert said["failures"] == [] and said["plots"] == said["drawn"] == 2 and said["lines"] >= 15
    assert said["width"] <= 1280
    assert said["seconds"] < _SECONDS


def test_the_check_itself_sees_a_script_error(tmp_path):
    page = "<html><head></head><body><script>no_such_function();</script></body></html>"
    said = opened(page, tmp_path)
    assert len(said["failures"]) == 1 and "no_such_function" in said["failures"][0]
