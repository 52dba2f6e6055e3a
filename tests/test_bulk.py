"""Binary logs read in bulk: what python-can gives frame by frame, and nothing of a damaged file."""

import contextlib
import io
import os
import struct
import subprocess
import sys
import zlib
from itertools import pairwise
from types import SimpleNamespace

import can
import numpy as np
import psutil
import pytest

from emb_daemon.errors import InputError
from emb_daemon.logs import apart, inflate, read
from emb_daemon.logs.read import read_frames, read_log
from emb_daemon.wire.frames import EXTENDED, FRAME, row_of

_CAN, _ERROR, _CAN_2, _MARKER, _FD, _FD_64 = 1, 73, 86, 96, 100, 101
_SYSTEMTIME = struct.pack("<8H", 2026, 11, 4, 26, 13, 45, 30, 250)


def _object(kind: int, rng: np.random.Generator, number: int) -> bytes:
    """One object as Vector's recorders write it, of random content, sometimes followed by padding."""
    data, channel, can_id = rng.bytes(64), int(rng.integers(1, 5)), int(rng.integers(0, 1 << 29))
    can_id = can_id | 1 << 31 if rng.random() < 0.5 else can_id & 0x7FF
    remote, classic = 0x80 * int(rng.random() < 0.2), int(rng.integers(0, 9))
    length = int(rng.choice([0, 5, 8, 12, 24, 64]))
    if kind in (_CAN, _CAN_2):
        body = struct.pack("<HBBL8s", channel, remote, classic, can_id, data) + bytes(8 * (kind == _CAN_2))
    elif kind == _ERROR:
        body = struct.pack("<HHLBBBxLLH2x8s", channel, 0, 0, 0, 0, classic, 0, can_id, 0, data)
    elif kind == _FD:
        flags = int(rng.integers(0, 8))
        body = struct.pack("<HBBLLBBB5x64s", channel, remote if not flags & 1 else 0, 9, can_id, 0, 0, flags, length, data)
    elif kind == _FD_64:
        # Recorders leave out data at the end, which are zero then; what follows the data has its own offset.
        there = int(rng.integers(0, length + 1))
        behind = 72 + there if rng.random() < 0.5 else 0
        head = (channel, 9, length, 0, can_id, 0, 0x1000 * int(rng.integers(0, 2)), 0, 0, 0, 0, 0, 0, behind, 0)
        body = struct.pack("<BBBBLLLLLLLHBBL", *head) + data[:there] + (rng.bytes(12) if behind else b"")
    else:
        body = rng.bytes(40)
    version = 1 if kind == _FD_64 or rng.random() < 0.5 else 2
    tens = int(rng.random() < 0.5)
    stamp = number * (100 if tens else 1_000_000)
    header = struct.pack("<LHHQ" if version == 1 else "<LBxHQ8x", 1 if tens else 2, 0, 0, stamp)
    size = 16 + len(header) + len(body)
    made = struct.pack("<4sHHLL", b"LOBJ", 16 + len(header), version, size, kind) + header + body
    return made + bytes(-size % 4 if rng.random() < 0.5 else 0)


def _container(payload: bytes, packed: bool) -> bytes:
    content = zlib.compress(payload) if packed else payload
    size = 32 + len(content)
    return struct.pack("<4sHHLLH6xL4x", b"LOBJ", 16, 1, size, 10, 2 * packed, len(payload)) + content + bytes(size % 4)


def _file(content: bytes) -> bytes:
    return struct.pack("<4sL32x", b"LOGG", 144) + _SYSTEMTIME + bytes(88) + content


def _log(seed: int, count: int = 200, packed: bool = True) -> bytes:
    """Objects of all kinds; containers end anywhere in them."""
    rng = np.random.default_rng(seed)
    kinds = rng.choice([_CAN, _ERROR, _CAN_2, _MARKER, _FD, _FD_64], count)
    objects = b"".join(_object(int(kind), rng, number) for number, kind in enumerate(kinds))
    cuts = [0, *sorted(rng.integers(0, len(objects), 5).tolist()), len(objects)]
    return _file(b"".join(_container(objects[a:b], packed) for a, b in pairwise(cuts)))


def _rows(messages: list[can.Message]) -> np.ndarray:
    return np.array([row_of(message, round(1e9 * message.timestamp)) for message in messages], FRAME)


def _same(recorded: read.Recorded, messages: list[can.Message]) -> None:
    rows = _rows(messages)
    for name in ("can_id", "length", "flags", "data"):
        np.testing.assert_array_equal(recorded.frames[name], rows[name], name)
    # python-can counts seconds in floating point, to a fifth of a microsecond.
    assert np.abs(recorded.frames["time_ns"] - rows["time_ns"]).max() <= 300
    assert recorded.octets.tobytes() == b"".join(bytes(message.data) for message in messages)


@pytest.mark.parametrize("packed", [True, False])
@pytest.mark.parametrize("seed", range(4))
def test_a_blf_is_read_as_python_can_reads_it(tmp_path, capsys, seed, packed):
    content = _log(seed, packed=packed)
    messages = list(can.BLFReader(io.BytesIO(content)))
    (tmp_path / "a.blf").write_bytes(content)
    recorded = read_log(tmp_path / "a.blf")
    assert len(messages) > 100
    _same(recorded, messages)
    assert recorded.channels.tolist() == [str(message.channel + 1) for message in messages]
    assert not capsys.readouterr().err


def test_a_blf_counts_time_from_its_start_to_the_nanosecond(tmp_path):
    content = _log(0)
    (tmp_path / "a.blf").write_bytes(content)
    stamps = read_frames(tmp_path / "a.blf")["time_ns"]
    # The objects are a millisecond apart, and some of them are no frames.
    assert np.all((stamps - 1_795_700_730_250_000_000) % 1_000_000 == 0) and np.all(np.diff(stamps) > 0)
    assert 0 <= stamps[0] - 1_795_700_730_250_000_000 < 10_000_000
    # A recorder without a clock.
    (tmp_path / "a.blf").write_bytes(content[:40] + bytes(16) + content[56:])
    np.testing.assert_array_equal(read_frames(tmp_path / "a.blf")["time_ns"], stamps - 1_795_700_730_250_000_000)


def test_objects_outside_of_containers_are_read_too(tmp_path):
    rng = np.random.default_rng(1)
    objects = [_object(_CAN, rng, number) for number in range(20)]
    for name, content in (("a.blf", b"".join(objects)), ("b.blf", _container(b"".join(objects), True))):
        (tmp_path / name).write_bytes(_file(content))
    np.testing.assert_array_equal(read_frames(tmp_path / "a.blf"), read_frames(tmp_path / "b.blf"))


@pytest.mark.parametrize("fast", [True, False])
def test_a_blf_that_was_cut_off_is_read_up_to_there(tmp_path, monkeypatch, capsys, fast):
    if not fast:
        monkeypatch.setattr(inflate, "library", zlib)
    content, path = _log(3), tmp_path / "a.blf"
    path.write_bytes(content)
    whole = read_frames(path)
    for size in np.random.default_rng(0).integers(400, len(content) - 4, 12).tolist():
        path.write_bytes(content[:size])
        capsys.readouterr()
        try:
            frames = read_frames(path)
        except InputError as error:
            assert "holds no frames" in str(error)
            frames = whole[:0]
        np.testing.assert_array_equal(frames, whole[: len(frames)])
        assert "cut off" in capsys.readouterr().err
        # zlib gives all that a block of its has up to the cut, which here is the whole container's.
        assert len(frames) > 0.8 * len(whole) * (size - len(content) / 4) / len(content)


def test_a_blf_cut_off_between_objects_is_reported(tmp_path, capsys):
    """In the header of its next container, or in one of which all but the end of its stream is there."""
    rng = np.random.default_rng(2)
    first, second = (_container(b"".join(_object(_CAN, rng, number) for number in range(9)), True) for _ in range(2))
    for name, content in (("a.blf", first + second[:20]), ("b.blf", first + second[:-5])):
        (tmp_path / name).write_bytes(_file(content))
        assert len(read_frames(tmp_path / name)) == (9 if name == "a.blf" else 18)
        assert "cut off" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda raw: raw[:60], "not a BLF file"),
        (lambda raw: raw[:144] + bytes(64), "damaged, no object where one is due (byte 144)"),
        (lambda raw: raw[:160] + b"\x07" + raw[161:], "byte 144 is packed in an unknown way (7)"),
        (lambda raw: raw[:180] + bytes(100) + raw[280:], "damaged, container at byte 144"),
        # A size of nothing would never end, one of less than the object's header read what is not its own.
        (lambda raw: raw[:152] + bytes(4) + raw[156:], "damaged, no object where one is due (byte 144)"),
        (lambda raw: _file(_container(b"LOBJ" + bytes(60), True)), "damaged, no object where one is due (byte 0 of what"),
        (lambda raw: _file(_container(_object(_CAN, np.random.default_rng(0), 0) + bytes(60), True)), "of what is unpacked"),
        (lambda raw: _file(_container(struct.pack("<4sHHLL", b"LOBJ", 32, 1, 36, _CAN) + bytes(60), True)), "byte 0 of what"),
    ],
)
def test_a_damaged_blf_is_named_in_one_line(tmp_path, damage, said):
    path = tmp_path / "a.blf"
    path.write_bytes(damage(_log(0)))
    with pytest.raises(InputError) as caught:
        read_log(path)
    assert str(caught.value).startswith(f"{path}: ") and said in str(caught.value) and "\n" not in str(caught.value)


def test_a_blf_that_unpacks_to_too_much_is_refused(tmp_path, monkeypatch):
    (tmp_path / "a.blf").write_bytes(_file(_container(bytes(900_000), True) * 4))
    monkeypatch.setattr(read, "_most_bytes", lambda: 1_000_000)
    with pytest.raises(InputError, match="unpacks to more than"):
        read_log(tmp_path / "a.blf")


def test_whatever_a_blf_holds_it_is_read_or_refused(tmp_path):
    """Bytes of the unpacked objects turned over, which no checksum protects."""
    content, path = bytearray(_log(5, 60, packed=False)), tmp_path / "a.blf"
    rng, outcomes = np.random.default_rng(0), set()
    for _ in range(300):
        damaged = content.copy()
        for at in rng.integers(72, len(content), rng.integers(1, 4)).tolist():
            damaged[at] = int(rng.choice([0, 1, 127, 255, rng.integers(256)]))
        path.write_bytes(damaged)
        try:
            recorded = read_log(path)
        except InputError:
            outcomes.add("refused")
            continue
        outcomes.add("read")
        assert recorded.frames["length"].max() <= 64 and len(recorded.octets) == recorded.frames["length"].sum(dtype=int)
        assert recorded.frames["can_id"].max() < 1 << 29
    assert outcomes == {"read", "refused"}


@pytest.fixture(scope="module")
def mdf(tmp_path_factory):
    pytest.importorskip("asammdf", reason="NOT RUN: the mf4 extra is not installed")
    path, rng = tmp_path_factory.mktemp("mdf") / "a.mf4", np.random.default_rng(0)
    with can.Logger(path) as log:
        for number in range(60):
            fd, extended, kind = rng.random() < 0.4, rng.random() < 0.5, rng.choice(["data", "data", "remote", "error"])
            length = int(rng.choice([0, 3, 8, 12, 64] if fd else [0, 3, 8]))
            log(
                can.Message(
                    1_790_000_000 + 0.001 * number, int(rng.integers(0, 1 << (29 if extended else 11))), bool(extended),
                    kind == "remote", kind == "error", int(rng.integers(1, 4)), length,
                    None if kind == "remote" else rng.bytes(length), bool(fd) and kind != "remote",
                )
            )  # fmt: skip
    return path


def test_an_mdf4_log_is_read_as_python_can_reads_it(mdf):
    messages = list(can.MF4Reader(mdf))
    assert len(messages) == 60 and {message.is_error_frame for message in messages} == {True, False}
    recorded = read_log(mdf)
    _same(recorded, messages)
    assert recorded.channels.tolist() == [str(message.channel) for message in messages]


def test_an_mdf4_log_of_one_kind_of_frame_is_narrow(mdf, tmp_path):
    """Payloads of eight bytes at most, and no channel."""
    with can.Logger(tmp_path / "a.mf4") as log:
        for number in range(5):
            log(can.Message(1_790_000_000 + 0.004 * number, 0x100 + number, number % 2 == 1, data=bytes([number] * number)))
    frames = read_frames(tmp_path / "a.mf4")
    assert frames["can_id"].tolist() == [0x100, 0x101, 0x102, 0x103, 0x104]
    assert frames["flags"].tolist() == [0, EXTENDED, 0, EXTENDED, 0]
    assert frames["length"].tolist() == [0, 1, 2, 3, 4] and frames["data"].tolist() == [0, 1, 0x202, 0x30303, 0x4040404]
    # python-can's writer has the times in floating point, to a fifth of a microsecond.
    np.testing.assert_allclose(np.diff(frames["time_ns"]), 4_000_000, atol=300)


def test_a_reader_of_mdf4_that_died_is_begun_anew(mdf):
    frames = read_frames(mdf)
    reader = apart._reader(os.pathsep.join(filter(None, sys.path)))
    reader.kill()
    reader.wait()
    with pytest.raises(InputError, match="is gone; try again"):
        read_frames(mdf)
    np.testing.assert_array_equal(read_frames(mdf), frames)


def test_a_reader_of_mdf4_ends_with_its_parent(mdf):
    """Killed, it can tell nobody."""
    code = f"""if True:
        import os, sys
        from emb_daemon.logs import apart
        from emb_daemon.logs.read import read_frames
        read_frames({str(mdf)!r})
        print(apart._reader(os.pathsep.join(filter(None, sys.path))).pid, flush=True)
        os.kill(os.getpid(), 9)
    """
    done = subprocess.run([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert done.returncode == -9
    with contextlib.suppress(psutil.NoSuchProcess):
        psutil.Process(int(done.stdout)).wait(timeout=30)


def test_a_remote_frame_of_mdf4_asks_for_bytes_and_has_none():
    """Some recorders state for it how many it asks for, others write it among the data frames with a flag."""
    asks = np.zeros(2, [("CAN_RemoteFrame.ID", "u4"), ("CAN_RemoteFrame.DataLength", "u1")])
    asks["CAN_RemoteFrame.DataLength"] = 8
    found = apart._frames_of("CAN_RemoteFrame", SimpleNamespace(samples=asks, timestamps=np.zeros(2)))
    assert found["remote"].all() and found["length"].tolist() == [0, 0]
    flagged = np.zeros(
        2, [("CAN_DataFrame.RTR", "u1"), ("CAN_DataFrame.DataLength", "u1"), ("CAN_DataFrame.DataBytes", "u1", 8)]
    )
    flagged["CAN_DataFrame.RTR"], flagged["CAN_DataFrame.DataLength"] = [0, 1], 8
    found = apart._frames_of("CAN_DataFrame", SimpleNamespace(samples=flagged, timestamps=np.zeros(2)))
    assert found["remote"].tolist() == [False, True] and found["length"].tolist() == [8, 0]
