"""What survives a restart: stored whole, given back to the same brake alone, and never believed when damaged."""

import errno
import hashlib
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import adaptkit
import msgspec
import numpy as np
import pytest
from adaptkit import ClosedLoop, parked
from hypothesis import given
from hypothesis import strategies as st

from emb_daemon.adapt import files
from emb_daemon.adapt.adaptation import Adaptation
from emb_daemon.adapt.memory import Memory, hold
from emb_daemon.adapt.snapshots import Snapshots, from_fields, to_fields
from emb_daemon.calibration.parameters import moved
from emb_daemon.calibration.types import to_parameters
from emb_daemon.errors import Unavailable
from emb_daemon.models.fusion import STATES

INNER = np.dtype([("phase", "f8"), ("seen", "?")])
RECORD = np.dtype([("angle", "f8"), ("count", "i8"), ("known", "?"), ("pads", "f8", (2, 3)), ("wheel", INNER)], align=True)
SHIPPED = adaptkit.shipped()


def record(angle=1.5, count=-3, known=True, pads=0.25):
    made = np.zeros(1, RECORD)[0]
    made["angle"], made["count"], made["known"], made["pads"] = angle, count, known, pads
    made["wheel"]["phase"], made["wheel"]["seen"] = angle, known
    return made


def same(one, other):
    return all(
        same(one[name], other[name])
        if one.dtype[name].names
        else np.array_equal(one[name], other[name], equal_nan=kind != "b")
        for name, kind in ((name, one.dtype[name].base.kind) for name in one.dtype.names)
    )


@given(st.floats(allow_infinity=False), st.integers(-(2**53), 2**53), st.booleans(), st.floats(allow_infinity=False))
def test_a_record_comes_back_to_the_last_bit(angle, count, known, pads):
    made = record(angle, count, known, pads)
    stored = msgspec.json.decode(msgspec.json.encode(to_fields(made)))
    assert same(from_fields(stored, RECORD), made)


@pytest.mark.parametrize(
    "change", [{"angle": "x"}, {"pads": [1.0, 2.0]}, {"wheel": 3.0}, {"wheel": {"phase": 0.0}}, {"more": 1.0}, {"count": None}]
)
def test_a_record_of_another_shape_is_named(change):
    with pytest.raises(ValueError, match=r"state"):
        from_fields(to_fields(record()) | change, RECORD)


def test_a_snapshot_of_another_version_is_called_that(tmp_path):
    """After an update the filter may have another number of states. Nothing is damaged then."""
    Snapshots(tmp_path, RECORD).save("FL", SHIPPED, record(), 5)
    later = np.dtype([(name, RECORD[name]) for name in RECORD.names] + [("added", "f8")])
    found, _, warning = Snapshots(tmp_path, later).load("FL", SHIPPED)
    assert found is None and "of another version of emb_daemon" in warning and "set aside" in warning


@given(st.integers(0, 10_000), st.integers(1, 255))
def test_any_damaged_byte_is_noticed(tmp_path_factory, position, flip):
    snapshots = Snapshots(tmp_path_factory.mktemp("snapshots"), RECORD)
    snapshots.save("FL", SHIPPED, record(), 5)
    path = snapshots.path("FL")
    content = bytearray(path.read_bytes())
    content[position % len(content)] ^= flip
    path.write_bytes(content)
    found, _, warning = snapshots.load("FL", SHIPPED)
    if found is None:
        assert "set aside" in warning and not path.exists()
    else:
        # White space between the parts means nothing.
        assert same(found, record())


def test_it_belongs_to_one_corner_actuator_and_calibration(tmp_path):
    snapshots = Snapshots(tmp_path, RECORD)
    assert snapshots.load("FL", SHIPPED) == (None, 0, None)
    snapshots.save("FL", SHIPPED, record(), 12345)
    found, time_ns, warning = snapshots.load("FL", SHIPPED)
    assert same(found, record()) and time_ns == 12345 and warning is None
    for other in (adaptkit.shipped(actuator="another"), adaptkit.shipped(pad_thickness_mm=9.0)):
        found, _, warning = snapshots.load("FL", other)
        assert found is None and "not used" in warning and snapshots.path("FL").exists()
    # An actuator's name may be that of its type, and all corners have the same calibration.
    snapshots.path("FR").write_bytes(snapshots.path("FL").read_bytes())
    found, _, warning = snapshots.load("FR", SHIPPED)
    assert found is None and "belongs to corner FL" in warning


@pytest.mark.parametrize("content", [b"[" * 200_000, b'{"a":' + b"9" * 5000 + b"}", b"{}", b"\xff" * 100])
def test_whatever_a_file_holds_the_corner_starts(tmp_path, content):
    sealed = b'{"sha256":"%s","content":%s}' % (hashlib.sha256(content).hexdigest().encode(), content)
    snapshots, memory = Snapshots(tmp_path, RECORD), Memory(tmp_path)
    for path in (snapshots.path("FL"), memory.path("FL")):
        path.write_bytes(sealed)
    found, _, warning = snapshots.load("FL", SHIPPED)
    store, other = memory.load("FL", SHIPPED)
    assert found is None and store.current is None and "damaged" in warning and "damaged" in other


def test_what_is_no_file_holds_nobody_up(tmp_path):
    """A pipe, to which nobody writes, in place of the file; a file that never ends."""
    snapshots, memory = Snapshots(tmp_path, RECORD), Memory(tmp_path)
    os.mkfifo(snapshots.path("FL"))
    memory.path("FL").write_bytes(bytes(files._MOST_BYTES + 1))
    assert "not a regular file" in snapshots.load("FL", SHIPPED)[2]
    assert "larger than" in memory.load("FL", SHIPPED)[1]


def test_a_state_directory_is_one_daemons(tmp_path):
    held = hold(tmp_path / "state")
    with pytest.raises(Unavailable, match="another running process"):
        hold(tmp_path / "state")
    os.close(held)
    os.close(hold(tmp_path / "state"))


def test_a_second_daemon_on_a_state_directory_does_not_start(tmp_path):
    """One line, and a status that makes systemd try again."""
    calibration = Path(__file__).parent.parent / "config" / "calibration.yaml"
    config = tmp_path / "emb.yaml"
    config.write_text(f"format: 1\nstate_directory: state\ncorners:\n  FL: {{calibration: {calibration}}}\n")
    command = [sys.executable, "-m", "emb_daemon.cli.main", "run", "--config", config, "-i", "virtual", "-c", "none"]
    held = hold(tmp_path / "state")
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=60.0)
    finally:
        os.close(held)
    assert done.returncode == 1 and "state directory is in use by another running process" in done.stderr
    assert "Traceback" not in done.stderr


def test_what_a_killed_writer_left_goes_after_an_hour_and_not_before(tmp_path):
    """Until then somebody may still be writing it."""
    now = time.time()
    for name, age_s in (("old", 3700.0), ("new", 3500.0)):
        path = tmp_path / f".adaptation-FL.json.{name}"
        path.write_text("{")
        os.utime(path, (now - age_s, now - age_s))
    Memory(tmp_path).load("FL", SHIPPED)
    assert [path.name for path in tmp_path.iterdir()] == [".adaptation-FL.json.new"]


def test_a_file_that_cannot_be_set_aside_stops_nothing(tmp_path, monkeypatch):
    snapshots = Snapshots(tmp_path, RECORD)
    snapshots.path("FL").write_bytes(b"{")

    def read_only(*_):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr(os, "replace", read_only)
    assert "not set aside: Read-only file system" in snapshots.load("FL", SHIPPED)[2]


def test_a_file_of_another_format_is_set_aside(tmp_path):
    snapshots = Snapshots(tmp_path, RECORD)
    snapshots.save("FL", SHIPPED, record(), 1)
    path = snapshots.path("FL")
    content = json.loads(path.read_bytes())["content"]
    path.write_bytes(files.encode(content | {"format": 9}))
    assert "format 9" in snapshots.load("FL", SHIPPED)[2] and not path.exists()


def restarted(loop, folder, real_ns):
    """A new process on the same folder, at another time of the real-time clock."""
    loop.adaptation = Adaptation({"FL": loop.calibration}, Memory(folder), real_ns)
    loop.pipeline = type(loop.pipeline)(loop.parameters, ("FL",), capacity=64, adaptation=loop.adaptation)
    loop.pipeline.begin(0)


@pytest.fixture
def driven(tmp_path):
    """A closed loop that was stopped after three seconds with the park brake on."""
    loop = ClosedLoop(tmp_path)
    restarted(loop, tmp_path, lambda time_ns: time_ns + 10**18)
    loop.run(parked(2.0, 8000.0))
    assert not loop.pipeline.states[0]["resumed"]
    loop.adaptation.close(loop.pipeline.states, loop.parameters)
    return loop, float(loop.pipeline.states[0]["contact_angle"]), int(loop.adaptation.adapters[0]["time_ns"])


def test_a_restart_goes_on_with_the_first_sample(driven, tmp_path):
    loop, contact_angle, stopped_ns = driven
    restarted(loop, tmp_path, lambda time_ns: stopped_ns + 10**18 + 60 * 10**9)
    loop.run(parked(0.5))
    state = loop.pipeline.states[0]
    assert state["resumed"] and state["clearance"] == pytest.approx(contact_angle, abs=0.05)


def test_a_calibration_that_is_replaced_before_the_first_sample_takes_no_snapshot_of_the_old_one(driven, tmp_path):
    loop, _, stopped_ns = driven
    restarted(loop, tmp_path, lambda time_ns: stopped_ns + 10**18 + 60 * 10**9)
    other = moved(loop.calibration, {"contact.clearance_rad": 7.0})
    loop.adaptation.replace("FL", other, loop.adaptation.read("FL", other))
    loop.pipeline.begin_anew(0, to_parameters(other))
    loop.run(parked(0.5))
    assert loop.pipeline.states[0]["started"] and not loop.pipeline.states[0]["resumed"]


@pytest.mark.parametrize(
    ("name", "value"),
    [("clearance", 90.0), ("clearance_sigma", -1.0), ("scale", 10.0), ("creep", [0.0, 0.6]), ("growth", 1.0), ("disc", 5000.0),
     ("winding", 9.0), ("history", 1e9), ("temperature_sigma", None),
     ("history_sigma", -1.0), ("error", [9e9] * STATES), ("covariance", [[1e-4] * (STATES - 1) + [2e-4]] * STATES)],
)  # fmt: skip
def test_what_no_brake_can_have_known_is_not_used(driven, tmp_path, caplog, name, value):
    """The checksum is right, the values are not."""
    loop, _, stopped_ns = driven
    path = tmp_path / "restart-FL.json"
    content = json.loads(path.read_bytes())["content"]
    path.write_bytes(files.encode(content | {"state": content["state"] | {name: value}}))
    restarted(loop, tmp_path, lambda time_ns: stopped_ns + 10**18 + 60 * 10**9)
    assert f"{name}: impossible for this brake" in caplog.text and not loop.adaptation._resumable


def test_a_snapshot_from_the_future_is_not_used(driven, tmp_path, caplog):
    """The real-time clock was set back, or there is none."""
    loop, _, _ = driven
    restarted(loop, tmp_path, lambda time_ns: 10**18)
    loop.run(parked(0.5))
    assert not loop.pipeline.states[0]["resumed"] and "future" in caplog.text


def test_what_is_kept_is_as_old_as_promised(tmp_path):
    """Ten seconds at most while driving, and at once when the park brake is applied."""
    loop = ClosedLoop(tmp_path)
    restarted(loop, tmp_path, int)
    kept = []
    save = loop.adaptation._snapshots.save
    loop.adaptation._snapshots.save = lambda *arguments: (kept.append(1e-9 * arguments[-1]), save(*arguments))
    schedule = parked(12.0, 8000.0)
    estimates, _ = loop.run(schedule)
    assert np.diff([*kept, 1e-9 * estimates["time_ns"][-1]]).max() <= 10.01
    applied = 0.004 * np.argmax(schedule.drives["park_brake"] == 1)
    assert any(applied <= at <= applied + 0.2 for at in kept)


def test_a_disk_that_is_full_stops_nothing(driven, monkeypatch, caplog):
    loop, _, _ = driven

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(files, "write", full)
    loop.adaptation.close(loop.pipeline.states, loop.parameters)
    assert "could not be written" in caplog.text
