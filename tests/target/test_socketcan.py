"""What the daemon relies on in SocketCAN, shown on the kernel it runs on here."""

from __future__ import annotations

import socket
import struct
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from bus_tools import CHANNEL, Recording, playing, read_log

pytestmark = pytest.mark.target("can")

# Linux has them, Python's socket module does not name them (not all of its builds, for the last).
SO_TIMESTAMPNS = 35
SO_RXQ_OVFL = 40
CAN_RAW_ERR_FILTER = 2
CAN_ERR_BUSOFF = 0x40
FRAME = struct.Struct("=IB3x8s")


@pytest.fixture
def bus():
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as raw:
        raw.bind((CHANNEL,))
        raw.settimeout(2)
        yield raw


@pytest.fixture
def peer():
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as raw:
        raw.bind((CHANNEL,))
        yield raw


def test_kernel_stamps_frames_when_they_arrive(bus: socket.socket, peer: socket.socket) -> None:
    bus.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
    sent_ns = time.time_ns()
    peer.send(FRAME.pack(0x123, 8, bytes(range(8))))
    arrived_ns = time.time_ns()
    time.sleep(0.05)  # the stamp must not be that of reading
    data, ancillary, _, _ = bus.recvmsg(16, 64)
    (_, kind, stamp) = ancillary[0]
    seconds, nanoseconds = struct.unpack("qq", stamp)
    assert (FRAME.unpack(data)[0], kind) == (0x123, SO_TIMESTAMPNS)
    assert sent_ns <= seconds * 10**9 + nanoseconds <= arrived_ns


def test_receive_overflow_is_counted(bus: socket.socket, peer: socket.socket) -> None:
    bus.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    bus.setsockopt(socket.SOL_SOCKET, SO_RXQ_OVFL, 1)
    for _ in range(200):
        peer.send(FRAME.pack(0x123, 0, b""))
    bus.setblocking(False)
    received = 0
    with pytest.raises(BlockingIOError):
        while bus.recv(16):
            received += 1
    peer.send(FRAME.pack(0x124, 0, b""))
    (_, _, dropped) = bus.recvmsg(16, 64)[1][0]
    assert 0 < received < 200
    assert struct.unpack("I", dropped)[0] == 200 - received


def test_filters_keep_foreign_frames_out(bus: socket.socket, peer: socket.socket) -> None:
    bus.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, struct.pack("=II", 0x100, 0x7FC))
    for can_id in (0x0FF, 0x104, 0x700, 0x102):
        peer.send(FRAME.pack(can_id, 0, b""))
    assert FRAME.unpack(bus.recv(16))[0] == 0x102


def test_bus_off_arrives_as_an_error_frame(bus: socket.socket) -> None:
    bus.setsockopt(socket.SOL_CAN_RAW, CAN_RAW_ERR_FILTER, socket.CAN_ERR_MASK)
    subprocess.run(["cansend", CHANNEL, "20000040#0000000000000000"], check=True)
    can_id = FRAME.unpack(bus.recv(16))[0]
    assert can_id == socket.CAN_ERR_FLAG | CAN_ERR_BUSOFF


def test_a_log_is_played_and_recorded_whole(record: Callable[..., Recording], rig_log: Path, tmp_path: Path) -> None:
    lines = rig_log.read_text().splitlines(keepends=True)[:5000]
    excerpt = tmp_path / "excerpt.log"
    excerpt.write_text("".join(lines))
    sent = read_log(excerpt)
    with record() as recording, playing(excerpt) as player:
        player.wait(60)
    assert [(f.can_id, f.data) for f in recording.frames] == [(f.can_id, f.data) for f in sent]
