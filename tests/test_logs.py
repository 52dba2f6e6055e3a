"""Log files: our bulk reader beside python-can's, and what is said of files that are damaged."""

import bz2
import contextlib
import gzip
import lzma
import os
import tracemalloc
import zlib

import can
import numpy as np
import pytest
import wirekit
from hypothesis import given
from hypothesis import strategies as st

from emb_daemon.errors import InputError
from emb_daemon.logs import apart, inflate, read
from emb_daemon.logs.candump import format_candump, parse_candump
from emb_daemon.logs.columns import Decoder, References
from emb_daemon.logs.read import read_frames, read_log
from emb_daemon.offline import log_of
from emb_daemon.wire.frames import ERROR, EXTENDED, FD, FRAME, REMOTE

_messages = st.builds(
    lambda stamp, extended, can_id, data, remote, error, rx: can.Message(
        timestamp=stamp / 1e6,
        is_extended_id=extended,
        arbitration_id=can_id if extended else can_id & 0x7FF,
        data=None if remote else data,
        dlc=0 if remote else None,
        is_remote_frame=remote and not error,
        is_error_frame=error and not extended,
        is_rx=rx,
        channel="can0",
    ),
    st.integers(0, 1_900_000_000_000_000),
    st.booleans(),
    st.integers(0, 0x1FFF_FFFF),
    st.binary(max_size=8),
    st.booleans(),
    st.just(False),
    st.booleans(),
)


def _matches(frames, messages):
    assert len(frames) == len(messages)
    for frame, message in zip(frames, messages, strict=True):
        assert abs(int(frame["time_ns"]) - message.timestamp * 1e9) <= 2000
        assert frame["can_id"] == message.arbitration_id
        assert bool(frame["flags"] & EXTENDED) == message.is_extended_id
        assert bool(frame["flags"] & REMOTE) == message.is_remote_frame
        if not message.is_remote_frame:
            assert int(frame["data"]).to_bytes(8, "little")[: frame["length"]] == bytes(message.data[:8])


@given(st.lists(_messages, min_size=1, max_size=20))
def test_candump_is_read_as_python_can_reads_it(tmp_path_factory, messages):
    path = tmp_path_factory.mktemp("logs") / "x.log"
    with can.CanutilsLogWriter(path) as writer:
        for message in messages:
            writer(message)
    _matches(read_frames(path), list(can.CanutilsLogReader(path)))


@given(
    st.lists(st.tuples(st.integers(0, 2**60), st.integers(0, 2**64 - 1), st.integers(0, 2047), st.integers(0, 8)), max_size=20)
)
def test_what_we_write_we_read(rows):
    frames = np.zeros(len(rows), FRAME)
    for frame, (stamp, data, can_id, length) in zip(frames, rows, strict=True):
        frame["time_ns"], frame["can_id"], frame["length"] = stamp // 1000 * 1000, can_id, length
        frame["data"] = data & ((1 << (8 * length)) - 1)
    parsed, bad_line, _ = parse_candump(format_candump(frames).encode())
    assert bad_line == 0 and wirekit.same(parsed, frames)


@pytest.mark.parametrize(
    ("line", "can_id", "flags", "data"),
    [
        ("(1.5) vcan0 123#0011", 0x123, 0, b"\x00\x11"),
        ("(1.500000) can0 123#", 0x123, 0, b""),
        ("(1.500000000) can0 00000123#AA", 0x123, EXTENDED, b"\xaa"),
        ("(1.5) can0 20000040#0000000000000000", 0x40, ERROR, bytes(8)),
        ("(1.5) can0 123#R", 0x123, REMOTE, b""),
        ("(1.5) can0 123#R8", 0x123, REMOTE, b""),
        ("(1.5) can0 123##1" + "AB" * 12, 0x123, FD, b"\xab" * 8),
        ("(1.5) can0 123#aabb R", 0x123, 0, b"\xaa\xbb"),
    ],
)
@pytest.mark.parametrize("end", ["\n", "\r\n", ""])
def test_lines_of_can_utils(line, can_id, flags, data, end):
    frames, bad_line, _ = parse_candump((line + end).encode())
    assert bad_line == 0 and len(frames) == 1
    frame = frames[0]
    assert (int(frame["time_ns"]), int(frame["can_id"]), int(frame["flags"]) & ~16) == (1_500_000_000, can_id, flags)
    assert int(frame["data"]).to_bytes(8, "little")[: len(data)] == data


_GOOD = "(1.000000) can0 100#00\n"


@pytest.mark.parametrize(
    "line",
    ["hello", "(1) can0 123#00", "(1.0 can0 123#00", "(1.0) can0 12#00", "(1.0) can0 123#0", "(1.0) can0 123#0G",
     "(1.0) can0 123#001122334455667788", "(1.0) 123#00", "(1.0) can0 1234567#00", "1.0 can0 123#00", "(1.0)  123#00"],
)  # fmt: skip
def test_a_malformed_line_is_named(tmp_path, line):
    path = tmp_path / "x.log"
    path.write_text(_GOOD + line + "\n" + _GOOD)
    with pytest.raises(InputError, match=rf"{path}:2: not a candump line"):
        read_frames(path)


@given(st.binary(max_size=60))
def test_no_bytes_make_the_parser_fall(tail):
    frames, bad_line, _ = parse_candump(_GOOD.encode() + tail)
    assert len(frames) >= 1 and bad_line >= 0


def test_a_line_cut_off_at_the_end_is_left_out_with_a_word(tmp_path, capsys):
    path = tmp_path / "x.log"
    path.write_text(_GOOD * 3 + "(2.000000) can0 10")
    assert len(read_frames(path)) == 3
    assert f"{path}: line 4 is cut off" in capsys.readouterr().err
    path.write_text(path.read_text().rsplit("\n", 1)[0] + "\n(1790")
    assert len(read_log(path).channels) == 3, "the channel of what is left, too"


@pytest.mark.parametrize("name", ["random_6.5mm.log", "a.b.c.log.gz", "plain.log", "UPPER.LOG", "dots...log"])
def test_names_with_dots(tmp_path, name):
    path = tmp_path / name
    path.write_bytes(gzip.compress(_GOOD.encode()) if name.endswith("gz") else _GOOD.encode())
    assert len(read_frames(path)) == 1


@pytest.mark.parametrize(("packer", "name"), [(bz2, "bzip2"), (lzma, "xz")])
def test_other_packers_are_unpacked_or_their_damage_named(tmp_path, capsys, packer, name):
    packed, path = packer.compress(_GOOD.encode() * 5000), tmp_path / "a.log"
    path.write_bytes(packed)
    assert len(read_frames(path)) == 5000
    path.write_bytes(packed[: len(packed) // 2])
    with contextlib.suppress(InputError):
        read_frames(path)
    assert "cut off, read up to there" in capsys.readouterr().err
    path.write_bytes(packed[:20] + bytes(40) + packed[60:])
    with pytest.raises(InputError, match=f"damaged {name} file"):
        read_frames(path)


def test_what_is_too_large_or_no_file_is_not_read(tmp_path, monkeypatch):
    """A gzip bomb, and a pipe to which nobody writes."""
    bomb, pipe = tmp_path / "bomb.log.gz", tmp_path / "pipe.log"
    bomb.write_bytes(gzip.compress(b"\n" * 10_000_000))
    os.mkfifo(pipe)
    monkeypatch.setattr(read, "_most_bytes", lambda: 5_000_000)
    with pytest.raises(InputError, match="unpacks to more than 5000000 bytes"):
        read_frames(bomb)
    with pytest.raises(InputError, match="not a regular file"):
        read_frames(pipe)


def test_a_time_that_no_clock_shows_is_refused(tmp_path):
    path = tmp_path / "late.trc"
    header = ";$FILEVERSION=2.1\n;$STARTTIME=43000.5\n;$COLUMNS=N,O,T,B,I,d,R,L,D\n"
    path.write_text(header + " 1 1e30 DT 1 0100 Rx - 8 00 00 00 00 00 00 00 00\n")
    with pytest.raises(InputError, match="not readable by python-can's TRCReader"):
        read_frames(path)


def test_a_gzipped_log_that_is_cut_off_is_read_up_to_the_cut(tmp_path, capsys):
    rows = "".join(f"(1{row:09d}.000000) can0 123#{row % 251:02X}{row * 7919 % 65521:06X}\n" for row in range(20_000))
    packed = gzip.compress(rows.encode())
    (tmp_path / "whole.log.gz").write_bytes(packed)
    (tmp_path / "cut.log.gz").write_bytes(packed[: len(packed) // 2])
    whole, cut = read_frames(tmp_path / "whole.log.gz"), read_frames(tmp_path / "cut.log.gz")
    assert 5_000 < len(cut) < 15_000 and np.array_equal(cut, whole[: len(cut)])
    assert "cut.log.gz: cut off, read up to there" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "content", "expected"),
    [
        ("none.log", None, "no such file"),
        ("empty.log", b"", "holds no frames"),
        ("blank.log", b"\n\n", "holds no frames"),
        ("empty.log.gz", gzip.compress(b"", mtime=0), "holds no frames"),
        ("damaged.log.gz", gzip.compress(_GOOD.encode() * 1000, mtime=0)[:-8] + b"wrong CRC", "damaged gzip"),
        ("flipped.log.gz", gzip.compress(_GOOD.encode(), mtime=0)[:10] + b"\xff\xff\xff", "damaged gzip"),
        ("notes.txt", b"hello", "unknown log format"),
        (
            "run.csv",
            b"t,angle\n0.0,1.5\n",
            "begins with ['t,angle'], as no log of frames that is known here does (python-can's CSV, SavvyCAN's, "
            "PEAK-Converter's); a table of signals needs --mapping",
        ),
        ("run.mat", b"MATLAB 5.0", "or --mapping of a table's columns"),
        ("nothing", b"hello", "unknown log format"),
        ("x.blf", b"not a blf file at all", "not a BLF file"),
        ("x.mf4", b"not an mf4 file at all", "not readable by asammdf"),
        ("random.log", bytes(range(256)), "not a candump line"),
    ],
)
def test_unusable_files_are_named_in_one_line(tmp_path, name, content, expected):
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError) as caught:
        read_frames(path)
    assert str(path) in str(caught.value) and expected in str(caught.value) and "\n" not in str(caught.value)


def test_a_folder_is_no_log(tmp_path):
    (tmp_path / "x.log").mkdir()
    with pytest.raises(InputError, match="directory"):
        read_frames(tmp_path / "x.log")


@pytest.mark.parametrize("ending", [".log", ".asc", ".blf", ".trc", ".mf4", ".log.gz", ".asc.gz"])
def test_formats_of_python_can(tmp_path, ending):
    """The same frames through every writer; text formats count time from the log's start."""
    if ending == ".mf4":
        pytest.importorskip("asammdf", reason="NOT RUN: the mf4 extra is not installed")
    drive = [f[0] for f in wirekit.drive(30, start_ns=1_790_000_000_000_000_000, angle=np.arange(30.0))]
    path = tmp_path / f"a.b{ending}"
    with can.Logger(str(tmp_path / ("ab" + ending))) as writer:
        for frame in drive:
            data = int(frame["data"]).to_bytes(8, "little")
            can_id = int(frame["can_id"])
            writer(can.Message(1e-9 * float(frame["time_ns"]), can_id, False, data=data, channel=1))
    (tmp_path / ("ab" + ending)).rename(path)
    frames = read_frames(path)
    assert np.array_equal(frames["can_id"], [f["can_id"] for f in drive])
    assert np.array_equal(frames["data"], [f["data"] for f in drive])
    assert np.all(frames["length"] == 8) and not np.any(frames["flags"] & (EXTENDED | REMOTE | ERROR | FD))
    stamps = frames["time_ns"] - frames["time_ns"][0]
    expected = np.array([int(f["time_ns"]) - int(drive[0]["time_ns"]) for f in drive])
    assert np.abs(stamps - expected).max() <= 1_000_000


def test_columns_are_the_signals_of_a_message():
    frames = np.concatenate(wirekit.drive(25, angle=np.linspace(-3.0, 40.0, 25)))
    columns = Decoder().columns(frames, "EMB_FL_Resolver")
    np.testing.assert_allclose(columns["MotorAngle"], np.linspace(-3.0, 40.0, 25), atol=1.1e-4)
    assert np.array_equal(columns["Counter"], np.arange(25) % 15)
    assert len(Decoder().columns(frames, "EMB_RR_Resolver")["MotorAngle"]) == 0


def test_reference_is_the_nearest_in_time_or_nothing():
    """An instrument's frame of 1000 N every 4 ms; one cut short by the writer's end is no measurement."""
    payload = bytes.fromhex("6400000000000000")
    frames = np.concatenate([wirekit.record(4_000_000 * n, 0x700, payload) for n in range(10)])
    frames[-1]["length"] = 3
    reference = References(frames, "FL")
    assert len(reference.time_ns) == 9
    at = reference.at(np.array([0, 5_000_000, 6_100_000, 90_000_000, -1_000_000]), np.arange(9.0))
    assert np.array_equal(at, [0.0, 1.0, 2.0, np.nan, 0.0], equal_nan=True)
    nothing = References(np.zeros(0, FRAME), "FL")
    assert np.all(np.isnan(nothing.at(np.array([0, 1]), nothing.clamp_force_N)))


_READER = """
import io, os, signal, time
class MDF:
    def __init__(self, file, process_bus_logging):
        %s
"""


@pytest.mark.parametrize(
    ("deed", "said"),
    [
        ("os.kill(os.getpid(), signal.SIGSEGV)", r"x.mf4: asammdf crashed \(SIGSEGV\): damaged"),
        ("while True: ...", "x.mf4: asammdf did not come to an end within 1 s: damaged"),
        ("bytearray(1 << 45)", "x.mf4: not readable by asammdf: MemoryError"),
        ("round(1e999)", "x.mf4: not readable by asammdf: cannot convert float infinity to integer"),
        ("os._exit(7)", "x.mf4: not readable by asammdf"),
        ("import asammdf.nothing", r"x.mf4: this format needs an extra: pip install emb_daemon\[mf4\]"),
    ],
)
def test_a_reader_that_fails_takes_nothing_with_it(tmp_path, monkeypatch, deed, said):
    """A reader of somebody else's that does as one told by a damaged file."""
    (tmp_path / "asammdf.py").write_text(_READER % deed)
    (tmp_path / "x.mf4").write_bytes(bytes(100))
    monkeypatch.syspath_prepend(tmp_path)
    if "within 1 s" in said:
        monkeypatch.setattr(apart, "_START_S", 1.0)
    with pytest.raises(InputError, match=said):
        read_frames(tmp_path / "x.mf4")


@pytest.mark.parametrize(
    "damage",
    [
        lambda raw: raw,
        lambda raw: raw + raw,
        lambda raw: raw[:-3],
        lambda raw: raw[:200],
        lambda raw: raw[:5],
        lambda raw: raw[:30] + b"xxxx" + raw[34:],
        lambda raw: raw[:-8] + b"12345678",
        lambda raw: raw + b"rubbish",
        lambda raw: raw + bytes(100),
    ],
)
def test_a_fast_library_changes_nothing_of_what_is_read_or_said(damage, tmp_path, monkeypatch, capsys):
    pytest.importorskip("isal")
    raw = damage(gzip.compress(np.random.default_rng(0).integers(0, 40, 100_000, np.uint8).tobytes()))

    def outcome():
        try:
            return read.unpack(tmp_path, raw), capsys.readouterr().err
        except InputError as error:
            return str(error), capsys.readouterr().err

    fast = outcome()
    monkeypatch.setattr(inflate, "library", zlib)
    assert outcome() == fast


def test_a_log_takes_memory_for_its_frames_and_not_for_its_lines(tmp_path):
    count = 20_000
    path = tmp_path / "long.log"
    path.write_text("".join(f"(1.{i:06d}) can0 0A0#0011223344556677\n" for i in range(count)))
    read_log(path)
    tracemalloc.start()
    recorded = read_log(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 3 * path.stat().st_size
    assert set(recorded.channels) == {"can0"}


@pytest.mark.parametrize("corner", ["fl", "XX", ""])
def test_what_is_no_corner_is_refused(corner):
    frames = np.zeros(1, FRAME)
    with pytest.raises(InputError, match=f"corner {corner}: expected one of FL, FR, RL, RR"):
        log_of(frames, corner)
