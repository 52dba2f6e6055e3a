"""Faults of a real CAN interface and of the clock, as the daemon's socket sees them."""

from __future__ import annotations

import errno
import os
import socket
import struct
import subprocess
import time
from collections.abc import Iterator

import numpy as np
import pytest
from bus_tools import CHANNEL

from emb_daemon.runtime.rawcan import RawCanSocket, open_socketcan
from emb_daemon.wire.frames import ERROR

pytestmark = pytest.mark.target("can")

RESOLVER = 0x100
FRAME = struct.Struct("=IB3x8s")
#: Room for a few dozen frames; the daemon's own buffer has a megabyte.
SMALL_BUFFER = 8192
FLOOD = 2000
STEP_S = 3600.0


@pytest.fixture
def peer() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as raw:
        raw.bind((CHANNEL,))
        yield raw


def _send(peer: socket.socket, number: int) -> None:
    peer.send(FRAME.pack(RESOLVER, 8, number.to_bytes(8, "little")))


def _numbers(bus: RawCanSocket) -> list[int]:
    time.sleep(0.05)
    return bus.drain()["data"].tolist()


def _link(state: str) -> None:
    subprocess.run(["ip", "link", "set", CHANNEL, state], check=True)


def test_interface_down_and_up(peer: socket.socket) -> None:
    """Said once while it is down, and the same socket hears again when it is up."""
    bus = open_socketcan(CHANNEL, [RESOLVER])
    try:
        _send(peer, 1)
        assert _numbers(bus) == [1] and not bus.down
        _link("down")
        try:
            assert _numbers(bus) == [] and bus.down
            frames = bus.drain().copy()
            bus.send(np.zeros(3, frames.dtype))
            assert bus.unsent == 3
        finally:
            _link("up")
        bus.drain()
        # Sockets keep the news until somebody reads it: the peer's too.
        assert peer.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR) == errno.ENETDOWN
        _send(peer, 2)
        assert _numbers(bus) == [2] and not bus.down
    finally:
        bus.close()


def test_bus_off_is_heard_by_the_daemons_socket() -> None:
    bus = open_socketcan(CHANNEL, [RESOLVER])
    try:
        subprocess.run(["cansend", CHANNEL, "20000040#0000000000000000"], check=True)
        time.sleep(0.05)
        [frame] = bus.drain()
        assert frame["flags"] & ERROR and frame["can_id"] == 0x40
    finally:
        bus.close()


def test_interface_deleted_and_added_again() -> None:
    """As an adapter that is unplugged and plugged in: heard again, within the time that rebinding is tried after."""

    def link(*words: str) -> None:
        subprocess.run(["ip", "link", *words], check=True)

    name = "vcan7"
    link("add", "dev", name, "type", "vcan")
    link("set", name, "up")
    bus = open_socketcan(name, [RESOLVER])
    try:
        link("delete", name)
        assert _numbers(bus) == [] and bus.down
        link("add", "dev", name, "type", "vcan")
        link("set", name, "up")
        time.sleep(0.15)
        bus.drain()
        with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as peer:
            peer.bind((name,))
            _send(peer, 3)
            assert _numbers(bus) == [3] and not bus.down
    finally:
        bus.close()
        subprocess.run(["ip", "link", "delete", name], check=False)


def test_receive_overflow_is_counted_by_the_daemons_socket(peer: socket.socket) -> None:
    bus = open_socketcan(CHANNEL, [RESOLVER], receive_buffer=SMALL_BUFFER)
    try:
        for number in range(FLOOD):
            _send(peer, number)
        heard = _numbers(bus)
        assert 0 < len(heard) < FLOOD
        _send(peer, FLOOD)
        assert _numbers(bus) == [FLOOD], "the kernel tells of drops with the next frame that it takes"
        assert bus.dropped == FLOOD - len(heard)
    finally:
        bus.close()


@pytest.mark.skipif(os.environ.get("EMB_TARGET") == "native", reason="would set the clock of this machine")
@pytest.mark.parametrize("step_s", [STEP_S, -STEP_S])
def test_step_of_the_real_time_clock(peer: socket.socket, step_s: float) -> None:
    """The kernel stamps frames with a clock that steps; the daemon's times neither leave the time since the last drain nor
    change their order."""
    if not os.environ.get("EMB_TARGET"):
        pytest.skip("sets the clock: run it with .ci/target")
    bus = open_socketcan(CHANNEL, [RESOLVER])
    try:
        bus.drain()
        _send(peer, 0)
        assert len(bus.drain()) == 1
        begin = time.monotonic_ns()
        _send(peer, 1)
        time.clock_settime(time.CLOCK_REALTIME, time.time() + step_s)
        try:
            _send(peer, 2)
            time.sleep(0.02)
            frames = bus.drain().copy()
            end = time.monotonic_ns()
        finally:
            time.clock_settime(time.CLOCK_REALTIME, time.time() - step_s)
        assert frames["data"].tolist() == [1, 2]
        assert np.all(np.diff(frames["time_ns"]) >= 0)
        assert begin - 1_000_000_000 < frames["time_ns"][0] and frames["time_ns"][-1] <= end
    finally:
        bus.close()
