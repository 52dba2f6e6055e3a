"""Buses that python-can drives: what others send is heard, what we send ourselves is not."""

import argparse
import os
import socket
import struct
from types import SimpleNamespace

import can
import numpy as np
import processkit
import pytest
import wirekit

from emb_daemon.calibration.configuration import Bus
from emb_daemon.cli.options import add_bus_arguments, bus_options
from emb_daemon.errors import InputError, Unavailable
from emb_daemon.runtime.bus import open_bus
from emb_daemon.runtime.rawcan import _bound_socket
from emb_daemon.wire.frames import ERROR, FRAME

#: Of its own for each run, so that two test runs on one machine do not hear each other.
_GROUP = f"239.74.163.{os.getpid() % 250 + 3}"
_OURS = [0x200, 0x100]


@pytest.fixture
def ends():
    """Two programs on a bus that gives a sender its own frames back."""
    try:
        buses = [open_bus("udp_multicast", _GROUP, _OURS) for _ in range(2)]
    except Unavailable as error:
        pytest.skip(f"NOT RUN: no multicast here: {error}")
    yield buses
    for bus in buses:
        bus.close()


def _heard(bus, count: int) -> list[tuple[int, int]]:
    """The next frames, at least ``count`` of them, and all that come within a moment after."""
    heard = []
    while bus.wait(1.0 if len(heard) < count else 0.05):
        heard += [(frame["can_id"], frame["data"]) for frame in bus.drain()]
    return [(int(can_id), int(data)) for can_id, data in heard]


def test_own_frames_are_left_out_and_those_of_others_are_received(ends):
    ours, theirs = ends
    mine = np.concatenate([wirekit.frame("EMB_FL_ClampForce", counter=c, ClampForce=0.1 * c) for c in range(15)])
    foreign = np.concatenate([wirekit.frame("EMB_FL_ClampForce", counter=c, ClampForce=3.0) for c in range(3)])
    ours.send(mine)
    theirs.send(foreign)
    assert _heard(theirs, 15) == list(zip(mine["can_id"].tolist(), mine["data"].tolist(), strict=True))
    # A second sender of our message is one: this is how the daemon notices.
    assert _heard(ours, 3) == list(zip(foreign["can_id"].tolist(), foreign["data"].tolist(), strict=True))


def test_an_own_frame_that_comes_twice_is_from_another_sender(ends):
    ours, theirs = ends
    mine = wirekit.frame("EMB_FL_ClampForce", ClampForce=5.0)
    ours.send(mine)
    assert len(_heard(theirs, 1)) == 1 and _heard(ours, 0) == []
    theirs.send(mine)
    assert len(_heard(ours, 1)) == 1


@pytest.mark.parametrize(
    ("one", "other"),
    [pytest.param(_GROUP, "239.74.162.1", id="IPv4"), pytest.param(f"ff15::{os.getpid() % 0xFFFF:x}", "ff15::1:1", id="IPv6")],
)
def test_two_groups_on_one_machine_are_two_buses(one, other):
    try:
        first, second = open_bus("udp_multicast", one, _OURS), open_bus("udp_multicast", other, _OURS)
    except Unavailable as error:
        pytest.skip(f"NOT RUN: no multicast here: {error}")
    second.send(wirekit.frame("EMB_FL_ClampForce", ClampForce=5.0))
    assert _heard(first, 1) == []
    first.close()
    second.close()


@pytest.fixture
def virtual():
    """Our end of an in-process bus, and python-can's of somebody who sends what does not concern us too."""
    channel = f"test_bus {os.getpid()}"
    ours, theirs = open_bus("virtual", channel, _OURS), can.Bus(interface="virtual", channel=channel)
    yield ours, theirs
    ours.close()
    theirs.shutdown()


def test_one_drain_returns_all_waiting_frames_past_those_that_do_not_concern_it(virtual):
    ours, theirs = virtual
    for number in range(20):
        theirs.send(can.Message(arbitration_id=0x555, data=bytes(8), is_extended_id=False))
        theirs.send(can.Message(arbitration_id=0x100, data=bytes(8), is_extended_id=True))
        theirs.send(can.Message(arbitration_id=0x100, data=bytes([number] * 8), is_extended_id=False))
    assert [int(data) & 0xFF for data in ours.drain()["data"]] == list(range(20))
    assert len(ours.drain()) == 0


def test_error_frames_are_heard(virtual):
    ours, theirs = virtual
    theirs.send(can.Message(arbitration_id=0x20, is_error_frame=True, is_extended_id=False))
    assert ours.drain()["flags"].tolist() == [ERROR]


def test_unsent_frames_are_counted_and_the_others_are_sent(virtual, monkeypatch):
    ours, theirs = virtual
    send = ours._bus.send

    def refuse_one(message):
        if message.arbitration_id == 0x102:
            raise can.CanOperationError("no buffer space")
        send(message)

    monkeypatch.setattr(ours._bus, "send", refuse_one)
    frames = np.zeros(3, FRAME)
    frames["can_id"] = 0x101, 0x102, 0x103
    ours.send(frames)
    assert ours.unsent == 1 and [theirs.recv(1.0).arbitration_id for _ in range(2)] == [0x101, 0x103]


def _options(command_line: str, defaults=None) -> dict:
    parser = argparse.ArgumentParser()
    add_bus_arguments(parser)
    return bus_options(parser.parse_args(command_line.split()), defaults)


def test_python_can_is_not_loaded_for_a_named_socketcan_bus():
    """It would take a tenth of the daemon's start."""
    code = (
        "import argparse, sys; sys.modules['can'] = None; from emb_daemon.cli import options;"
        "from emb_daemon.runtime.bus import open_bus; parser = argparse.ArgumentParser(); options.add_bus_arguments(parser);"
        "arguments = parser.parse_args(['-i', 'socketcan', '-c', 'none0']);"
        "open_bus(**options.bus_options(arguments), ids=[])"
    )
    done = processkit.python("-c", code, NUMBA_DISABLE_JIT="1")
    assert done.stderr.splitlines()[-1].startswith("emb_daemon.errors.Unavailable: socketcan: "), done.stderr


def test_python_can_fills_in_what_is_not_given(monkeypatch):
    monkeypatch.setattr("emb_daemon.runtime.bus.open_socketcan", lambda channel, ids: channel)
    monkeypatch.setenv("CAN_CHANNEL", "can7")
    assert [open_bus("socketcan", channel, []) for channel in (None, "can3")] == ["can7", "can3"]
    with pytest.raises(InputError, match="name one with --interface"):
        open_bus("no_such", "can3", [])


def test_command_line_before_environment_before_configuration(monkeypatch):
    configured = Bus(interface="socketcan", channel="can0", bitrate=500_000)
    for name in ("CAN_INTERFACE", "CAN_CHANNEL", "CAN_BITRATE", "CAN_CONFIG"):
        monkeypatch.delenv(name, raising=False)
    assert _options("", configured) == {"interface": "socketcan", "channel": "can0", "bitrate": 500_000}
    monkeypatch.setenv("CAN_CHANNEL", "can7")
    assert _options("", configured)["channel"] == "can7"
    assert _options("-c can3", configured)["channel"] == "can3"


def test_options_that_are_not_given_come_from_can_conf(monkeypatch):
    there = {"interface": "virtual", "channel": f"test_bus rc {os.getpid()}"}
    monkeypatch.setattr(can, "rc", there)
    bus = open_bus(**_options(""), ids=_OURS)
    with can.Bus(**there) as theirs:
        theirs.send(can.Message(arbitration_id=0x100, is_extended_id=False, data=bytes(8)))
        assert _heard(bus, 1) == [(0x100, 0)]
    bus.close()


def test_the_kernel_filters_pass_our_ids_only(monkeypatch):
    """A filter passes a frame whose id is the filter's in the bits of its mask."""
    told, none = {}, SimpleNamespace(setsockopt=lambda _, option, value: told.update({option: value}), bind=lambda _: None)
    monkeypatch.setattr("emb_daemon.runtime.rawcan.socket.socket", lambda *_: none)
    _bound_socket("can0", _OURS, 1 << 20)
    filters = list(struct.iter_unpack("=II", told[socket.CAN_RAW_FILTER]))
    flagged = (can_id | flag for can_id in range(0x800) for flag in (0, socket.CAN_EFF_FLAG, socket.CAN_RTR_FLAG))
    passed = {can_id for can_id in flagged if any(can_id & mask == own & mask for own, mask in filters)}
    assert passed == set(_OURS)
