"""Faults of bus, machine and clock around a daemon whose ticks the test makes: which flag rises, for how long, and what the
estimate does meanwhile."""

import ctypes
import errno
import logging
import os
import socket
import struct
import time
from pathlib import Path
from types import SimpleNamespace

import adaptkit
import numpy as np
import pytest
from test_pipeline import _run, _sliding, car  # noqa: F401

from emb_daemon.adapt.learned import Evaluation
from emb_daemon.adapt.memory import Memory, Store
from emb_daemon.adapt.records import ACCEPTED
from emb_daemon.calibration.configuration import Setup
from emb_daemon.calibration.parameters import moved
from emb_daemon.calibration.types import to_parameters
from emb_daemon.errors import Unavailable
from emb_daemon.estimator.status import WHEEL_CONTRADICTED, ZERO_WANDERS
from emb_daemon.runtime import rawcan
from emb_daemon.runtime.daemon import Daemon, Pacer
from emb_daemon.runtime.rawcan import RawCanSocket, socket_pair
from emb_daemon.wire import contract as r
from emb_daemon.wire.contract import CYCLE_NS
from emb_daemon.wire.frames import ERROR, EXTENDED, FRAME, REMOTE

CONFIG = Path(__file__).parent.parent / "config" / "emb.yaml"
_SHOWN_CYCLES = 250
#: By how much two clocks may seem apart where the machine interrupts their reading, ns: a fifth of what is to be seen.
_CLOCKS_NS = 1_000_000


class Bus:
    """A bus whose state the test sets; it delivers what was put on it."""

    def __init__(self):
        self.waiting: list[np.ndarray] = []
        self.dropped = self.unsent = 0
        self.down = self.full = False

    def drain(self):
        frames = np.concatenate(self.waiting) if self.waiting and not self.down else np.zeros(0, FRAME)
        self.waiting = []
        return frames

    def send(self, frames):
        if self.down:
            self.unsent += len(frames)


class Driven:
    """One corner of a daemon, ticked once a cycle by the test's clock, with a drive on its bus."""

    def __init__(self):
        self.bus = Bus()
        self.daemon = Daemon(Setup(CONFIG), self.bus)
        self.daemon.pipeline.corners["active"] = [True, False, False, False]
        self.daemon._active = 1
        self.daemon.pipeline.begin(0)
        self.pacer = Pacer(0)
        self.cycle = 0
        self.estimates: list[np.void] = []
        self._drive: dict[int, list[np.ndarray]] = {}
        for frame in _sliding(900):
            self._drive.setdefault(round(frame["time_ns"][0] / CYCLE_NS), []).append(frame)
        follow = self.daemon._follow
        self.daemon._follow = lambda count, pacer: (self._keep(count), follow(count, pacer))

    def _keep(self, count):
        self.estimates += [row.copy() for row in self.daemon.pipeline.estimates[:count]]

    def run(self, cycles, ticks=None, lose=False):
        """``cycles`` of the drive, with a tick after each, or with the last ``ticks`` alone: a stall."""
        first = len(self.estimates)
        for number in range(cycles):
            if not lose:
                self.bus.waiting += self._drive[self.cycle]
            self.cycle += 1
            if ticks is None or number >= cycles - ticks:
                now = self.cycle * CYCLE_NS - CYCLE_NS // 2
                self.daemon._count(now, self.pacer)
                self.daemon.tick(now, self.pacer)
        return np.array(self.estimates[first:])


@pytest.fixture
def driven():
    made = Driven()
    made.run(150)
    return made


def _reasons(estimates):
    return np.unique(estimates["reasons"]).tolist()


def test_bus_off_and_recovery(driven, caplog):
    """An error frame of the controller: Bus disturbed for a second, the force goes on."""
    # Until then a brake that was never seen before is not certain to 300 N.
    driven.run(10)
    off = np.zeros(1, FRAME)
    off["time_ns"], off["can_id"], off["flags"], off["length"] = driven.cycle * CYCLE_NS, 0x40, ERROR, 8
    driven.bus.waiting.append(off)
    during = driven.run(_SHOWN_CYCLES)
    assert np.all(during["reasons"][1:] == r.BUS_DISTURBED) and np.all(during["mode"][1:] == r.DEGRADED)
    assert np.all(during["source"] == r.FUSED)
    assert "corner FL: degraded (bus or loop)" in caplog.text and "bus disturbed" in caplog.text
    assert _reasons(driven.run(50)[2:]) == [0]


def test_interface_down_and_up(driven):
    """Predictions with growing sigma, a fault after a tenth of a second, Bus disturbed as long and for a second more; the
    first sample back is an estimate, without a restart."""
    before = driven.estimates[-1]
    driven.bus.down = True
    down = driven.run(60)
    assert np.all(down["reasons"][1:] & r.BUS_DISTURBED) and np.all(down["reasons"][3:] & r.RESOLVER_LOST)
    assert down["source"][5] == r.PREDICTED and down["source"][-1] == r.INVALID and down["mode"][-1] == r.FAULT
    assert np.all(np.diff(down["sigma"]) >= 0.0) and down["sigma"][-1] > 3.0 * before["sigma"]
    driven.bus.down = False
    up = driven.run(_SHOWN_CYCLES + 30)
    assert up["is_sample"][0] and up["source"][0] != r.INVALID and up["reasons"][0] & r.BUS_DISTURBED
    # What the brake did meanwhile nobody saw, nor whether its controller went on: the contact is unknown until a release.
    assert up["reasons"][-1] & ~(r.PATHS_DISAGREE | r.CONTACT_UNCERTAIN) == 0
    assert driven.bus.unsent > 0


def test_receive_overflow(driven):
    """Frames that the kernel dropped: Bus disturbed for a second, the lost samples are no news and no fault."""
    driven.run(2, lose=True)
    driven.bus.dropped += 12
    after = driven.run(_SHOWN_CYCLES + 30)
    assert after["reasons"][1] & r.BUS_DISTURBED and after["reasons"][-1] == 0
    assert np.all(after["is_sample"]) and after["source"][-1] == r.FUSED
    assert after["cycle"][-1] == driven.cycle - 1


@pytest.mark.parametrize("stall_ms", [12, 100, 500])
def test_process_stall(driven, stall_ms):
    """All samples that waited are answered, with the forces of a loop that never stood still; Deadline missed for a second."""
    smooth = Driven()
    smooth.run(150)
    cycles = stall_ms // 4
    stalled, expected = driven.run(cycles, ticks=1), smooth.run(cycles)
    assert len(stalled[stalled["is_sample"]]) == cycles
    np.testing.assert_array_equal(stalled[stalled["is_sample"]]["force"], expected["force"])
    assert driven.daemon.missed >= cycles - 1 and smooth.daemon.missed == 0
    after = driven.run(_SHOWN_CYCLES + 20)
    assert after["reasons"][5] == r.DEADLINE_MISSED and after["reasons"][-1] == 0 and np.all(after["source"] == r.FUSED)


def test_a_current_that_is_queued_late_still_belongs_to_its_sample(driven):
    """Stamped in time, and in the queue only after the loop has looked: replay of the bus's log pairs them, and so does the
    loop."""
    frames = driven._drive[driven.cycle]
    late = [frame for frame in frames if frame["can_id"][0] == 0x110]
    driven.bus.waiting += [frame for frame in frames if frame["can_id"][0] != 0x110]
    looked, before = int(late[0]["time_ns"][0]) + 2_500_000, len(driven.estimates)
    driven.daemon.tick(looked, driven.pacer)
    driven.bus.waiting += late
    driven.daemon.tick(looked + 500_000, driven.pacer)
    assert len(late) == 1 and len(driven.estimates) == before + 1 and np.isfinite(driven.estimates[-1]["torque_force"])


def test_frames_left_by_a_full_batch_are_not_counted_as_missing(driven):
    """After half a second's stall more is waiting than one look takes: what is still to come was not lost."""
    stalled, smooth = driven, Driven()
    smooth.run(150)
    expected = smooth.run(60)
    frames = np.concatenate([frame for cycle in range(150, 210) for frame in stalled._drive[cycle]])
    before = len(stalled.estimates)
    for batch in (frames[:51], frames[51:]):
        stalled.bus.waiting, stalled.bus.full = [batch], len(batch) == 51
        stalled.daemon.tick(210 * CYCLE_NS, stalled.pacer)
    answered = np.array(stalled.estimates[before:])
    assert np.all(answered["is_sample"]) and answered["force"].tobytes() == expected["force"].tobytes()


def test_step_of_the_real_time_clock(monkeypatch):
    """Kernel stamps are of CLOCK_REALTIME. Stepped by an hour either way while frames wait, none comes from the past or the
    future, and order is kept."""
    near, far = socket_pair()
    far._stamped = False
    real = time.time_ns
    for step_ns in (3_600_000_000_000, -3_600_000_000_000, 0):
        frames = np.zeros(3, FRAME)
        frames["can_id"], frames["length"], frames["data"] = 0x100, 8, np.arange(3)
        last = time.monotonic_ns()
        near.send(frames)
        monkeypatch.setattr(time, "time_ns", lambda step=step_ns: real() + step)
        heard = far.drain()
        assert np.array_equal(heard["data"], np.arange(3))
        assert np.all(np.diff(heard["time_ns"]) >= 0) and heard["time_ns"][0] >= last - 1_000_000_000
        assert heard["time_ns"][-1] <= time.monotonic_ns()
    near.close()
    far.close()


@pytest.mark.parametrize("order", [1, -1])
def test_control_messages_of_the_kernel_are_read(order):
    """Its stamp and how many frames it dropped, as control messages in either order."""
    near, far = socket_pair()
    time.sleep(0.005)
    before_ns, stamp_ns, after_ns = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
    time.sleep(0.005)
    stamp = struct.pack("=QiiQQ", 32, socket.SOL_SOCKET, rawcan._SO_TIMESTAMPNS, *divmod(stamp_ns, 1_000_000_000))
    drops = struct.pack("=QiiI4x", 20, socket.SOL_SOCKET, rawcan._SO_RXQ_OVFL, 0x01020304)
    content = b"".join((stamp, drops)[::order])
    near._received.control.view(np.uint8)[0, : len(content)] = np.frombuffer(content, np.uint8)
    near._received.headers["length"][0], near._received.headers["control_length"][0] = 16, len(content)
    assert near._take(1, time.monotonic_ns()) == (1, 0x01020304)
    assert before_ns - _CLOCKS_NS < near._frames["time_ns"][0] < after_ns + _CLOCKS_NS
    near.close()
    far.close()


@pytest.mark.parametrize("step_ns", [0, 1_000_000_000])
def test_a_frame_that_was_queued_long_after_it_was_stamped_keeps_its_stamp(monkeypatch, step_ns):
    """The kernel was held up in between: a log of the bus has that stamp, too. It is doubted only if the clock was set."""
    near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    with near, far:
        bus, real = RawCanSocket(near), time.time_ns
        bus._latest_ns -= 500_000_000
        arrived_ns, stamp_ns = time.monotonic_ns(), real()
        time.sleep(0.05)
        looked_ns = bus._looked_ns = time.monotonic_ns()
        monkeypatch.setattr(time, "time_ns", lambda: real() + step_ns)
        stamp = struct.pack("=QiiQQ", 32, socket.SOL_SOCKET, rawcan._SO_TIMESTAMPNS, *divmod(stamp_ns, 1_000_000_000))
        bus._received.control.view(np.uint8)[0, : len(stamp)] = np.frombuffer(stamp, np.uint8)
        bus._received.headers["length"][0], bus._received.headers["control_length"][0] = 16, len(stamp)
        bus._take(1, time.monotonic_ns())
        heard_ns = bus._frames["time_ns"][0]
        if step_ns:
            assert looked_ns - 2 * CYCLE_NS <= heard_ns <= looked_ns
        else:
            assert abs(heard_ns - arrived_ns) < _CLOCKS_NS


@pytest.mark.parametrize(("apart_ns", "held_up_s"), [(50_000, 0.0), (-50_000, 0.0), (0, 0.01)])
def test_what_passes_between_reading_two_clocks_moves_no_stamp(monkeypatch, apart_ns, held_up_s):
    """Microseconds: stamps stay whole microseconds apart, as in a log of the bus, else a sample's age is rounded another way
    live. And a hold-up: the scheduler may take the CPU away at any place; 10 ms there once made genuine frames look early."""
    near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    with near, far:
        bus, real = RawCanSocket(near), time.time_ns
        before = bus._offset_ns

        def clock():
            time.sleep(held_up_s)
            return real() + apart_ns

        monkeypatch.setattr(time, "time_ns", clock)
        far.send(bytes(16))
        assert len(bus.drain()) == 1
        assert bus._offset_ns == before


def test_an_impossible_stamp_is_limited_to_between_the_last_frame_and_now():
    near, far = socket_pair()
    for wrong in (-(10**12), 10**12):
        batch = far._received
        batch.raw["time_ns"][:1] = far._latest_ns + wrong
        batch.headers["length"][:1], batch.headers["control_length"][:1] = 24, 0
        now = time.monotonic_ns()
        assert far._take(1, now)[0] == 1
        assert far._latest_ns <= far._frames["time_ns"][0] <= now
    near.close()
    far.close()


def _wait_for_stamps(ours, theirs):
    """The kernel begins to stamp what arrives some time after it was asked to; until then it stamps what is read."""
    for _ in range(4000):
        theirs.send(bytes(16))
        time.sleep(0.005)
        asked_ns = time.time_ns()
        _, ((_, _, stamp),), *_ = ours.recvmsg(16, 64)
        if asked_ns - int(np.frombuffer(stamp, np.int64) @ (1_000_000_000, 1)) > 4_000_000:
            return
    raise AssertionError("the kernel stamps nothing on arrival")


def test_a_frame_that_comes_while_the_loop_is_held_up_keeps_its_stamp(monkeypatch):
    """Held up between looking into the queue and at the clock: what comes meanwhile is stamped before that. A log of the bus
    has the stamp, and the estimate is to be made with it too."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ours, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as theirs:
        ours.bind(("127.0.0.1", 0))
        ours.setsockopt(socket.SOL_SOCKET, rawcan._SO_TIMESTAMPNS, 1)
        theirs.connect(ours.getsockname())
        _wait_for_stamps(ours, theirs)
        bus, clock, sent = RawCanSocket(ours), time.monotonic_ns, []

        def take(*arguments):
            theirs.send(bytes(16))
            sent.append(clock())
            time.sleep(0.005)
            return real_take(arguments[0], clock())

        theirs.send(bytes(16))
        real_take = bus._take
        monkeypatch.setattr(bus, "_take", take)
        assert len(bus.drain()) == 1
        monkeypatch.undo()
        assert bus.drain()["time_ns"][0] <= sent[0] + _CLOCKS_NS


def test_dropped_frames_are_counted_from_control_messages():
    """The kernel says with each frame how many were dropped before it."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ours, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as theirs:
        ours.bind(("127.0.0.1", 0))
        for option, value in ((rawcan._SO_TIMESTAMPNS, 1), (rawcan._SO_RXQ_OVFL, 1), (socket.SO_RCVBUF, 4096)):
            ours.setsockopt(socket.SOL_SOCKET, option, value)
        theirs.connect(ours.getsockname())
        bus = RawCanSocket(ours)
        for _ in range(200):
            theirs.send(bytes(16))
        heard = len(bus.drain())
        theirs.send(bytes(16))
        assert len(bus.drain()) == 1
        assert 0 < heard < 200 and bus.dropped == 200 - heard


def test_waiting_ends_with_the_first_frame():
    near, far = socket_pair()
    frames = np.zeros(1, FRAME)
    frames["can_id"], frames["length"] = 0x123, 8
    assert not far.wait(0.01)
    near.send(frames)
    assert far.wait(1.0) and not far.wait(0.0)
    near.close()
    far.close()


def test_a_peer_that_is_gone_sends_nothing():
    """The end of a socket pair reads as empty messages for ever."""
    near, far = socket_pair()
    frames = np.zeros(2, FRAME)
    frames["can_id"], frames["length"] = 0x123, 8
    near.send(frames)
    near.close()
    assert len(far.drain()) == 2
    assert len(far.drain()) == 0 and not far.down
    far.close()


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EROFS])
def test_full_disk_under_the_state_directory(tmp_path, monkeypatch, caplog, code):
    """The old file stays whole, the journal says so, and nothing else notices."""
    memory_ = Memory(tmp_path)
    calibration = adaptkit.shipped()
    old, _ = memory_.load("FL", calibration)
    memory_.save(old)
    content = memory_.path("FL").read_bytes()

    def full(*_):
        raise OSError(code, os.strerror(code))

    loop = adaptkit.ClosedLoop(tmp_path)
    monkeypatch.setattr(os, "fsync", full)
    adapter = loop.adaptation.adapters[0]
    adapter["outcome"] = ACCEPTED
    loop.adaptation._evaluations[0] = Evaluation(ACCEPTED, values={"friction.offset_Nm": 0.03})
    with caplog.at_level(logging.ERROR):
        loop.adaptation._keep(0, adapter)
    assert "could not be written" in caplog.text and os.strerror(code) in caplog.text
    assert memory_.path("FL").read_bytes() == content
    assert [path.name for path in tmp_path.iterdir()] == ["adaptation-FL.json"], "nothing half written is left"
    assert isinstance(memory_.read("FL"), Store)
    assert loop.adaptation.current("FL") is not None, "what was learned is in use all the same"


def _pinged(daemon):
    said = []
    daemon._manager.notify = lambda *assignments: said.extend(assignments)
    assert daemon._ping() == ("WATCHDOG=1" in said)
    return "WATCHDOG=1" in said


def test_a_corner_that_cannot_be_estimated_is_no_reason_to_restart_the_others(driven):
    """Resolver stuck, no current: Invalid, and a restart would mend nothing. A state that is no number is another matter."""
    estimate = driven.daemon.pipeline.estimates[0]
    for name, value in (("is_sample", True), ("source", r.INVALID), ("corner", 0)):
        estimate[name] = value
    driven.daemon._follow(1, driven.pacer)
    assert _pinged(driven.daemon)
    driven.daemon.pipeline.states[0]["alternatives"][1]["error"][2] = np.nan
    driven.daemon._follow(1, driven.pacer)
    assert not _pinged(driven.daemon)


@pytest.mark.parametrize(("corner", "name"), [(1, "FR"), (3, "RR")])
def test_a_change_is_logged_for_its_corner(driven, caplog, corner, name):
    estimate = driven.daemon.pipeline.estimates[0]
    estimate["corner"], estimate["mode"], estimate["reasons"], estimate["facts"] = corner, r.DEGRADED, r.STUCK, 0
    driven.daemon._estimated = 0
    for _ in range(2):
        driven.daemon._follow(1, driven.pacer)
    assert driven.daemon._estimated == 1 << corner
    assert caplog.text.count("corner") == caplog.text.count(f"corner {name}: degraded (signal stuck)\n") == 1
    estimate["reasons"], estimate["facts"] = r.OUT_OF_RANGE, ZERO_WANDERS | WHEEL_CONTRADICTED
    driven.daemon._follow(1, driven.pacer)
    assert (
        f"corner {name}: degraded (signal out of range): the motor angle drifts or loses counts beside the motor speed; "
        "the wheel speed is zero while pulses or vehicle speed show motion\n"
    ) in caplog.text
    assert caplog.records[-1].fields["found"] in caplog.text


def test_of_many_changes_the_first_and_the_last_are_logged(driven, caplog):
    """A machine that is too slow changes the reasons at nearly every tick. Nothing is lost but what came between: the last
    state is in the log when ten seconds are over, and another corner's are not held up."""
    estimate = driven.daemon.pipeline.estimates[0]

    def change(corner, reasons, after_s):
        estimate["corner"], estimate["mode"], estimate["reasons"], estimate["facts"] = corner, r.DEGRADED, reasons, 0
        driven.pacer.last_tick_ns = begin_ns + round(1e9 * after_s)
        driven.daemon._follow(1, driven.pacer)

    begin_ns = driven.pacer.last_tick_ns + 20_000_000_000
    for number in range(500):
        change(1, r.RESOLVER_LOST if number % 2 else r.RESOLVER_LOST | r.CURRENT_LOST, 0.01 * number)
    change(1, r.STUCK, 5.0)
    change(2, r.STUCK, 5.1)
    assert caplog.text.count("corner FR") == 10 and caplog.text.count("corner RL: degraded (signal stuck)") == 1
    change(1, r.STUCK, 9.9)
    assert caplog.text.count("corner FR") == 10
    for after_s in (10.0, 10.1, 30.0):
        change(1, r.STUCK, after_s)
    assert caplog.text.count("corner FR") == 11
    assert "corner FR: degraded (signal stuck), after 491 changes that were not logged" in caplog.text
    change(1, r.CURRENT_LOST, 30.1)
    assert "corner FR: degraded (current lost)\n" in caplog.text
    caplog.clear()
    for number in range(20):
        change(1, r.RESOLVER_LOST if number % 2 else r.STUCK, 50.0 + 0.01 * number)
    change(1, r.CURRENT_LOST, 61.0)
    assert caplog.text.count("corner FR") == 11, "one line, although it changed when the time was over"
    assert "corner FR: degraded (current lost), after 10 changes that were not logged" in caplog.text


def test_a_loop_that_misses_most_of_its_ticks_for_half_a_minute_is_not_well(driven, caplog):
    driven.run(20)
    assert _pinged(driven.daemon)
    for _ in range(5):
        driven.run(100, ticks=20)
        assert _pinged(driven.daemon), "a restart would take longer"
    driven.daemon.missed += 7100
    assert not _pinged(driven.daemon) and "most of 7600 periods missed" in caplog.text
    driven.run(20)
    assert _pinged(driven.daemon), "it recovered"


def test_a_loop_that_answers_for_no_corner_is_not_well(driven, caplog):
    assert _pinged(driven.daemon)
    driven.daemon.ticks += 100
    assert not _pinged(driven.daemon) and "corner FL: no estimate" in caplog.text


def test_an_interface_that_is_down_is_no_reason_to_restart(driven):
    driven.bus.down = True
    driven.run(60)
    assert _pinged(driven.daemon)


def test_an_interface_that_was_deleted_and_added_again_is_bound_again():
    """The old socket says once that its interface is gone, and nothing any more; another is tried for until it is there."""
    (old, _), (new, theirs) = socket_pair(), socket_pair()
    found = [Unavailable("no such interface"), new._socket]

    def reopen():
        result = found.pop(0)
        if isinstance(result, Exception):
            raise result
        return result

    bus = RawCanSocket(old._socket, stamped=True, reopen=reopen)
    bus._failed(errno.ENODEV)
    assert len(bus.drain()) == 0 and bus.down and len(found) == 1
    frames = np.zeros(1, FRAME)
    frames["can_id"], frames["length"] = 0x100, 8
    theirs.send(frames)
    assert len(bus.drain()) == 0 and len(found) == 1, "not at every tick"
    bus._reopen_ns -= rawcan._REOPEN_NS
    assert bus.drain()["can_id"].tolist() == [0x100] and not bus.down and bus._reopen_ns is None
    assert old._socket.fileno() == -1, "an interface that comes and goes must not use up the process's descriptors"
    with pytest.raises(OSError, match="Bad file descriptor"):
        bus._failed(errno.EBADF)


def test_calibration_replaced_while_clamped(driven):
    """The clamped brake keeps the calibration that knows its contact; released, the corner begins anew with the other."""
    other = moved(driven.daemon._calibrations["FL"], {"motor.inertia_kg_m2": 2e-4})
    before = driven.daemon.pipeline.parameters.copy()
    driven.daemon._waiting["FL"] = other, None
    driven.daemon._follow_reload()
    assert driven.estimates[-1]["engaged"] and driven.daemon.pipeline.parameters.tobytes() == before.tobytes()
    driven.daemon.pipeline.states[0]["contact"]["engaged"] = False
    driven.daemon._follow_reload()
    assert driven.daemon.pipeline.parameters[0] == to_parameters(other) and not driven.daemon.pipeline.states[0]["started"]


def test_swapped_messages_of_a_pair_are_one_sample(car):  # noqa: F811
    """Current before resolver, each cycle: nothing is lost and no force differs."""
    swapped = []
    for cycle in range(300):
        frames = _sliding(1, first=cycle)
        pair = {int(f["can_id"][0]): f for f in frames}
        pair[0x100]["time_ns"], pair[0x110]["time_ns"] = int(pair[0x110]["time_ns"][0]), int(pair[0x100]["time_ns"][0])
        swapped += frames
    frames = np.concatenate(swapped)
    estimates, _ = _run(car, frames[np.argsort(frames["time_ns"], kind="stable")])
    straight, _ = _run(car, np.concatenate(_sliding(300)))
    assert len(estimates) == 300 and not estimates["reasons"].any()
    np.testing.assert_array_equal(estimates["force"], straight["force"])


@pytest.mark.parametrize(("bits", "flags"), [(0, 0), (0x8000_0000, EXTENDED), (0x4000_0000, REMOTE), (0x2000_0000, ERROR)])
def test_flag_bits_of_the_id_give_the_kind_of_frame(bits, flags):
    """Of linux/can.h."""
    near, far = socket_pair()
    near._received.raw["can_id"][0], near._received.headers["length"][0] = bits | 0x123, 16
    near._received.headers["control_length"][0] = 0
    assert near._take(1, time.monotonic_ns())[0] == 1
    assert (near._frames["flags"][0], near._frames["can_id"][0]) == (flags, 0x123)
    near.close()
    far.close()


def test_an_interface_that_sends_nothing_is_down_until_it_sends_again(monkeypatch):
    """Whatever error somebody else left behind meanwhile."""
    near, far = socket_pair()

    def fails(*_):
        ctypes.set_errno(errno.ENETDOWN)
        return -1

    with monkeypatch.context() as patched:
        patched.setattr(rawcan, "_libc", SimpleNamespace(sendmmsg=fails))
        near.send(np.zeros(3, FRAME))
    assert near.down and near.unsent == 3
    ctypes.set_errno(errno.EIO)
    near.send(np.zeros(1, FRAME))
    near.send(np.zeros(1, FRAME))
    heard = far.drain()
    assert not near.down and near.unsent == 3 and len(heard) == 2 and far._latest_ns == heard["time_ns"][1]
    near.close()
    far.close()
