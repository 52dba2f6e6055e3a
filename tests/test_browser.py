"""Reports in a real browser: no script error, every plot drawn, soon enough. `.ci/run` installs Chromium.

Those of identify and diagnose are opened where their tests make them.
"""

import re

from browserkit import assert_is_drawn, opened

from emb_daemon.calibration.files import load_calibration
from emb_daemon.replay import Replay
from emb_daemon.report.replay import replay_page
from emb_daemon.resources import resource


def test_a_seven_minute_replay_opens_without_error(rig, tmp_path):
    replay = Replay(load_calibration(resource("config/calibration.yaml")))
    page = replay_page([replay.run(rig / "integrated" / "val.log.gz")], "FL", "the shipped one")
    html = page.render()
    assert "http" not in re.sub(r"<script>.*?</script>", "", html, flags=re.DOTALL)
    assert assert_is_drawn(html, tmp_path, plots=2)["lines"] >= 15


def test_the_check_itself_sees_a_script_error(tmp_path):
    page = "<html><head></head><body><script>no_such_function();</script></body></html>"
    said = opened(page, tmp_path)
    assert len(said["failures"]) == 1 and "no_such_function" in said["failures"][0]
