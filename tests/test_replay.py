"""emb-daemon replay: one or all corners, tables with reasons and references, inputs that stay as they are."""

import collections
import json
import os

import numpy as np
import pyarrow.parquet
import pytest
import wirekit

import emb_daemon
from emb_daemon.cli.main import main
from emb_daemon.cli.options import load_chosen
from emb_daemon.logs import read
from emb_daemon.logs.candump import format_candump
from emb_daemon.logs.columns import Decoder
from emb_daemon.offline.score import temperature_figures
from emb_daemon.replay import Replay
from emb_daemon.resources import resource

_ANGLE = np.concatenate([np.linspace(0.0, 12.0, 200), np.linspace(12.0, 0.0, 200)])
_SPEED = np.gradient(_ANGLE, 0.004)


def _corner(corner: str, current: float) -> np.ndarray:
    frames = wirekit.drive(800, corner=corner, angle=_ANGLE, speed=_SPEED, current=(current,))
    return np.concatenate(frames)


@pytest.fixture
def two_corners(tmp_path):
    """A log of FL and RR, each with a current of its own, and each corner's part of it alone."""
    parts = {"FL": _corner("FL", 1.0), "RR": _corner("RR", 2.0)}
    shared = [0x180, 0x181, 0x182]
    frames = np.concatenate([parts["FL"], parts["RR"][~np.isin(parts["RR"]["can_id"], shared)]])
    parts["FL, RR"] = frames
    for name, part in parts.items():
        ordered = wirekit.merged(part)
        ordered["time_ns"] += 1_000_000_000
        (tmp_path / f"{name.replace(', ', '_')}.log").write_text(format_candump(ordered))
    return tmp_path


def _table(*arguments, output):
    assert main(["replay", *map(str, arguments), "--output", str(output)]) == 0
    return pyarrow.parquet.read_table(output)


def test_all_corners_of_a_log_are_each_what_they_are_alone(two_corners, capsys):
    log, out = two_corners / "FL_RR.log", two_corners / "out.parquet"
    both = _table(log, "--corner", "all", output=out)
    assert set(both["corner"].to_pylist()) == {"FL", "RR"}
    assert np.all(np.diff(both["time_s"].to_numpy()) >= 0.0)
    for corner in ("FL", "RR"):
        rows = np.array(both["corner"].to_pylist()) == corner
        alone = _table(log, "--corner", corner, output=two_corners / f"{corner}.parquet")
        assert rows.sum() == len(alone) > 700
        for name in ("clamp_force_N", "torque_force_N", "clamp_force_sigma_N"):
            assert np.array_equal(both[name].to_numpy()[rows], alone[name].to_numpy(), equal_nan=True), name
    capsys.readouterr()
    assert main(["replay", str(log), "--corner", "all", "--json"]) == 0
    assert [part["corner"] for part in json.loads(capsys.readouterr().out)["logs"]] == ["FL", "RR"]


def test_frames_of_all_corners_are_those_of_the_corners_heard(two_corners):
    out = two_corners / "sent.log"
    assert main(["replay", str(two_corners / "FL_RR.log"), "--corner", "all", "--output", str(out)]) == 0
    sent = set(read.read_frames(out)["can_id"].tolist())
    assert {0x200, 0x203} <= sent and not sent & {0x201, 0x202}


def test_which_signal_is_out_of_range_is_said(tmp_path, capsys):
    """The reason on the wire says no more than that something is: of a thermocouple without its wire, four frames."""
    before, after = _cut(0, 100, 20.0), _cut(100, 110, 3000.0)
    frames = wirekit.merged(*before, *after, *_cut(110, 400, 20.0))
    frames["time_ns"] += 1_000_000_000
    (tmp_path / "a.log").write_text(format_candump(frames))
    assert main(["replay", str(tmp_path / "a.log")]) == 0
    told = capsys.readouterr()
    assert "signal out of range" in told.out
    for name in ("InnerBackplateTemp", "OuterBackplateTemp", "CaliperTemp"):
        assert f"EMB_FL_Thermocouple.{name} is beyond -200 to 1400 in 4 of 160 frames, which are not used" in told.err
    assert "MotorSpeed is beyond" not in told.err


def _cut(first: int, end: int, backplate: float) -> list[np.ndarray]:
    return wirekit.drive(end - first, first=first, backplate=backplate, angle=_ANGLE, speed=_SPEED, current=(1.0,))


def test_reasons_are_words_after_the_source_and_a_car_has_no_reference_columns(two_corners):
    frames = read.read_frames(two_corners / "FL.log")
    lost = np.isin(frames["can_id"], [Decoder().can_id(name) for name in ("EMB_FL_Thermocouple", "VEH_WheelSpeed")])
    (two_corners / "FL.log").write_text(format_candump(frames[~lost | (frames["time_ns"] < 2_500_000_000)]))
    table = _table(two_corners / "FL.log", output=two_corners / "out.parquet")
    names = table.column_names
    assert names.index("reasons") == names.index("source") + 1 == len(names) - 1
    words = set(table["reasons"].to_pylist())
    assert "" in words and any("lost; " in text for text in words), words
    results = Replay(emb_daemon.shipped_calibration()).run(two_corners / "FL.log")
    quiet = results.estimates["reasons"] == 0
    assert np.array_equal(np.array(table["reasons"].to_pylist()) == "", quiet)


def test_facts_are_printed_in_words(two_corners, capsys):
    """A reason on the wire has several causes."""
    frames = read.read_frames(two_corners / "FL.log")
    (two_corners / "FL.log").write_text(format_candump(frames[frames["can_id"] != Decoder().can_id("EMB_FL_Thermocouple")]))
    assert main(["replay", str(two_corners / "FL.log")]) == 0
    assert "found: pad temperatures are unknown 100 %" in capsys.readouterr().out
    page = two_corners / "page.html"
    assert main(["replay", str(two_corners / "FL.log"), "--json", "--report", str(page)]) == 0
    told = json.loads(capsys.readouterr().out)["logs"][0]
    assert told["facts"]["temperature_unknown"] == told["reasons"]["pad temperature uncertain"] == 1.0
    assert "temperature unknown" in page.read_text()


def test_references_are_columns_next_to_the_estimates(rig, tmp_path, capsys):
    log = rig / "static" / "random_0p5mm.log.gz"
    out = tmp_path / "out.parquet"
    assert main(["replay", str(log), "--output", str(out), "--json"]) == 0
    judged = json.loads(capsys.readouterr().out)["logs"][0]["force_N"]
    figures = judged["fused"]
    table = pyarrow.parquet.read_table(out)
    error = table["clamp_force_N"].to_numpy() - table["clamp_force_ref_N"].to_numpy()
    error = error[judged["unknown_samples"] :]
    assert np.sqrt(np.nanmean(error**2)) == pytest.approx(figures["rmse"])
    assert "inner_2mm_ref_C" not in table.column_names


def test_temperatures_of_a_second_log_are_judged_at_its_own_times(rig):
    """Two logs whose clocks overlap are one drive; what is known of the second's temperatures does not depend on that."""
    log = rig / "thermal" / "disc_cooling_6tps.log.gz"
    replay = Replay(emb_daemon.shipped_calibration())
    first, second = replay.run(log), replay.run(log)
    shift = second.estimates["time_ns"][0] - first.estimates["time_ns"][0]
    assert shift > 0 and np.array_equal(first.time_ns, second.time_ns)
    expected = temperature_figures(second.estimates["time_ns"], second.estimates, second.reference)
    assert second.figures["temperature_K"] == expected
    assert expected["disc"]["samples"] > 900


@pytest.mark.parametrize("output", ["FL.log", "./FL.log", "RR.log"])
def test_an_output_that_is_an_input_is_refused(two_corners, capsys, monkeypatch, output):
    monkeypatch.chdir(two_corners)
    before = (two_corners / "FL.log").read_bytes()
    assert main(["replay", "FL.log", "RR.log", "--output", output]) == 2
    assert "is one of the inputs" in capsys.readouterr().err
    assert (two_corners / "FL.log").read_bytes() == before


@pytest.mark.parametrize("option", ["--report", "--output"])
def test_pipes_links_to_them_and_folders_are_not_replaced(two_corners, capsys, option):
    """A pipe stands for devices here: root could replace /dev/null, and a link to one."""
    pipe, link = two_corners / "pipe.csv", two_corners / "link.csv"
    os.mkfifo(pipe)
    link.symlink_to(pipe)
    for path in (pipe, link, two_corners):
        assert main(["replay", str(two_corners / "FL.log"), option, str(path)]) == 2
        assert "not a regular file" in capsys.readouterr().err
    assert pipe.is_fifo() and link.is_symlink()


def test_each_log_is_read_once(two_corners, monkeypatch, capsys):
    reads = collections.Counter()

    def counted(path):
        reads[path.name] += 1
        return path.read_bytes()

    monkeypatch.setattr(read, "read_file", counted)
    out = two_corners / "out.parquet"
    _table(two_corners / "FL_RR.log", two_corners / "FL.log", "--corner", "FL", output=out)
    assert reads == {"FL_RR.log": 1, "FL.log": 1}
    _table(two_corners / "FL_RR.log", "--corner", "all", output=out)
    assert reads["FL_RR.log"] == 2


def test_the_calibration_that_is_named_is_the_one_that_is_used(tmp_path):
    named = tmp_path / "calibration.yaml"
    named.write_text(
        resource("config/calibration.yaml").read_text().replace("pad_thickness_mm: 10.0", "pad_thickness_mm: 7.0")
    )
    assert load_chosen(named).pad_thickness_mm == 7.0
    assert load_chosen(None).pad_thickness_mm == 10.0
