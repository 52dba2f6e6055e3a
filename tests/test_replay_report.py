"""The page of a replay holds the drive: peaks kept, events as long as they lasted, figures as replay prints them."""

import json
import re

import numpy as np
import pytest
from browserkit import assert_is_drawn

from emb_daemon.cli.main import main
from emb_daemon.report.replay import stretches


def _figures(html: str) -> list[dict]:
    return [json.loads(text) for text in re.findall(r'<script type="application/json" id="f\d+">(.*?)</script>', html)]


def test_the_page_shows_the_figures_and_keeps_the_peaks(rig, tmp_path, capsys):
    path, table = tmp_path / "page.html", tmp_path / "table.parquet"
    log = rig / "static" / "random_0p5mm.log.gz"
    assert main(["replay", str(log), "--report", str(path), "--output", str(table), "--json"]) == 0
    fused = json.loads(capsys.readouterr().out)["logs"][0]["force_N"]["fused"]
    html = path.read_text()
    assert f"RMSE {fused['rmse']:.0f} N" in html and f"largest {fused['max']:.0f} N" in html

    import pyarrow.parquet

    force = pyarrow.parquet.read_table(table)["clamp_force_N"].to_numpy()
    text = next(text for text in re.findall(r'id="f1">(.*?)</script>', html))
    assert "± 2 sigma" in json.loads(text)["data"][1]["name"]
    names = [trace["name"] for trace in json.loads(text)["data"]]
    for name in ("estimate", "stiffness path", "torque path", "reference", "inner surface", "outer mean", "disc"):
        assert name in names
    drawn = _values(next(trace for trace in json.loads(text)["data"] if trace["name"] == "estimate")["y"])
    assert len(drawn) < 0.5 * len(force)
    assert drawn.max() == pytest.approx(1e-3 * force.max(), rel=1e-6)
    assert drawn.min() == pytest.approx(1e-3 * force.min(), abs=1e-6)


def _values(packed) -> np.ndarray:
    """An array as plotly writes it: plain, or base64 of its bytes."""
    import base64

    if isinstance(packed, list):
        return np.array(packed, float)
    return np.frombuffer(base64.b64decode(packed["bdata"]), packed["dtype"])


def test_stretches_begin_and_end_with_what_they_show():
    time = np.arange(1000) * 0.004
    active = np.zeros(1000, bool)
    active[100:200] = active[500:510] = True
    begin, end = stretches(time, active)
    assert np.allclose(begin, [0.4, 2.0]) and np.allclose(end, [199 * 0.004, 509 * 0.004])


def test_one_sample_gives_a_visible_stretch_and_flicker_gives_one_stretch():
    time = np.arange(1_000_000) * 0.004
    active = np.zeros(len(time), bool)
    active[500_000] = True
    begin, end = stretches(time, active)
    assert len(begin) == 1 and end[0] - begin[0] >= 1e-3 * time[-1]
    active[::2] = True
    begin, end = stretches(time, active)
    assert len(begin) == 1 and end[0] == pytest.approx(time[-1], rel=1e-3)
    assert len(stretches(time, np.zeros(len(time), bool))[0]) == 0


def test_a_report_of_frames_is_refused(rig, tmp_path, capsys):
    log = str(rig / "static" / "sine_5Hz.log.gz")
    assert main(["replay", log, "--output", str(tmp_path / "x.log"), "--report", str(tmp_path / "x.html")]) == 2
    assert "--report" in capsys.readouterr().err and not list(tmp_path.iterdir())


def test_what_adaptation_learned_is_shown_beside_the_calibration(rig, tmp_path):
    """Pads of 5 mm under a calibration of 9.5 mm: the page says accepted, and its learned curve is that of the thin pads."""
    path = tmp_path / "page.html"
    log = str(rig / "static" / "training_5mm.log.gz")
    assert main(["replay", log, "--pad-thickness", "9.5", "--state", str(tmp_path), "--report", str(path)]) == 0
    html = path.read_text()
    assert '<td class="pass">accepted</td>' in html
    curves = {trace["name"]: trace for trace in _figures(html)[-1]["data"]}
    travel = {name: _values(curves[name]["x"])[-1] for name in ("calibration", "learned")}
    top = {name: _values(curves[name]["y"])[-1] for name in travel}
    assert top["learned"] == pytest.approx(top["calibration"], rel=0.01)
    assert travel["learned"] < 0.95 * travel["calibration"]
    assert_is_drawn(html, tmp_path, plots=3)
