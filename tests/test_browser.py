"""Reports in a real browser: no script error, every plot drawn, of few points. `.ci/run` installs Chromium.

Those of identify and diagnose are opened where their tests make them.
"""

import re

import numpy as np
import pytest
from browserkit import assert_is_drawn, opened, said_by

from emb_daemon.replay import Replay
from emb_daemon.report.figures import Panel, Trace, time_figure
from emb_daemon.report.page import Page
from emb_daemon.report.replay import replay_page


@pytest.mark.trial
def test_a_seven_minute_replay_opens_without_error(rig, tmp_path, calibration):
    page = replay_page([Replay(calibration).run(rig / "integrated" / "val.log.gz")], "FL", calibration, "the shipped one")
    html = page.render()
    assert "http" not in re.sub(r"<script>.*?</script>", "", html, flags=re.DOTALL)
    assert assert_is_drawn(html, tmp_path, plots=2)["lines"] >= 15


def test_the_check_itself_sees_a_script_error(tmp_path):
    page = "<html><head></head><body><script>no_such_function();</script></body></html>"
    said = opened(page, tmp_path)
    assert len(said["failures"]) == 1 and "no_such_function" in said["failures"][0]


_ZOOM = """<script>
var place = document.querySelector("[data-figure]"), counts = [place.calcdata[0].length];
Plotly.relayout(place, {"xaxis.range[0]": 10.0, "xaxis.range[1]": 11.0}).then(function () {
  counts.push(place.data[0].x.length, place.data[0].y[1], place.data[1].y[1]);
  return Plotly.relayout(place, {"xaxis.autorange": true});
}).then(function () { counts.push(place.data[0].x.length); document.title = JSON.stringify(counts); });
</script>"""


def test_zooming_shows_single_samples(tmp_path):
    """What is thinned out for the screen has gaps and false differences between two traces; a stretch is shown whole."""
    time_s, values = 0.004 * np.arange(20_000), np.random.default_rng(0).normal(size=20_000)
    page = Page("noise")
    figure = time_figure([Panel("one", "N", [Trace("a", time_s, values)]), Panel("other", "N", [Trace("b", time_s, -values)])])
    page.section("noise").figure(figure)
    all_, zoomed, one, other, again = said_by(page.render(), tmp_path, _ZOOM)
    assert all_ <= 3002 and again <= 3002
    assert 250 <= zoomed <= 253
    assert one == np.float32(values[2500]) == -other
