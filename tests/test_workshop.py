"""Trouble codes and data over UDS: what udsoncan, a tester that is not ours, reads over ISO-TP; and what survives a kill."""

import contextlib
import errno
import os
import struct
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import processkit
import pytest
import wirekit
from hypothesis import given, settings
from hypothesis import strategies as st

import emb_daemon
from emb_daemon.calibration.files import calibration_hash
from emb_daemon.cli.main import main
from emb_daemon.errors import Unavailable
from emb_daemon.monitor.listener import Listener
from emb_daemon.runtime.bus import open_bus
from emb_daemon.wire.contract import CURRENT_LOST, DEGRADED, INIT, REASONS, RESOLVER_LOST, RUNNING
from emb_daemon.wire.frames import FRAME
from emb_daemon.wire.layout import CORNERS, ESTIMATOR_STATUS
from emb_daemon.workshop import trouble
from emb_daemon.workshop.trouble import CONFIRMED, FAILED_THIS_CYCLE, PENDING, TEST_FAILED, Frame, TroubleMemory, code_of
from emb_daemon.workshop.uds import Server

_ROOT = Path(__file__).parent.parent
_CONFIGURATION = _ROOT / "config" / "emb.yaml"
_FRAME = Frame(1_700_000_000, DEGRADED, 1, 12_345.0, 67.0, (301.2, 250.0, 290.0, None), -73.1, 0.912)
_GROUP = f"239.74.164.{os.getpid() % 250 + 3}"
FL, RR = 0, 3


def _judge(memory, reasons, times=3, corner=FL, mode=DEGRADED, frame=_FRAME, now_s=0.0):
    for _ in range(times):
        memory.judge(corner, mode, reasons, frame, now_s)
    return [memory.entries[code_of(corner, bit)] for bit in range(len(REASONS))]


# --- What is remembered -------------------------------------------------------------------------------------------------


def test_a_code_fails_when_its_reason_stays(tmp_path):
    memory = TroubleMemory(tmp_path)
    resolver, current, *_ = _judge(memory, RESOLVER_LOST, times=2)
    assert (resolver.status, current.status) == (0x50, 0x00), "one not yet complete, the other passed"
    assert _judge(memory, 0)[0].status == 0
    resolver, *_ = _judge(memory, RESOLVER_LOST)
    assert resolver.status == TEST_FAILED | FAILED_THIS_CYCLE | PENDING | CONFIRMED | trouble.FAILED_SINCE_CLEAR
    assert (resolver.occurrences, resolver.frame) == (1, _FRAME)
    later = Frame(1_800_000_000, RUNNING, 0, 1.0, 1.0, (None,) * 4, 0.0, 1.0)
    _judge(memory, 0)
    resolver, *_ = _judge(memory, RESOLVER_LOST, frame=later)
    assert (resolver.occurrences, resolver.frame) == (2, _FRAME), "the first failure's frame stays"


def test_before_a_corner_has_heard_anything_nothing_has_failed(tmp_path):
    entries = _judge(TroubleMemory(tmp_path), 0x3F, times=10, mode=INIT)
    assert all(entry.status == 0x50 for entry in entries)


def test_a_confirmed_code_is_forgotten_after_cycles_without_failure(tmp_path):
    _judge(TroubleMemory(tmp_path), CURRENT_LOST)
    for cycle in range(trouble.AGED):
        memory = TroubleMemory(tmp_path)
        entry = memory.entries[code_of(FL, 1)]
        assert entry.status & CONFIRMED and entry.frame is not None and entry.aged == cycle
        assert not entry.status & (TEST_FAILED | FAILED_THIS_CYCLE)
        _judge(memory, 0)
        memory.save()
    entry = TroubleMemory(tmp_path).entries[code_of(FL, 1)]
    assert not entry.status & (CONFIRMED | PENDING) and entry.frame is None


def test_a_cycle_in_which_nothing_was_judged_does_not_count(tmp_path):
    _judge(TroubleMemory(tmp_path), CURRENT_LOST)
    for _ in range(5):
        entry = TroubleMemory(tmp_path).entries[code_of(FL, 1)]
    assert entry.aged == 0 and entry.status & CONFIRMED and entry.status & PENDING


def test_a_damaged_file_is_set_aside_and_told(tmp_path):
    _judge(TroubleMemory(tmp_path), CURRENT_LOST)
    path = tmp_path / trouble.FILE
    path.write_bytes(path.read_bytes().replace(b'"occurrences": 1', b'"occurrences": 2'))
    memory = TroubleMemory(tmp_path)
    assert "checksum is wrong" in memory.warning and "set aside" in memory.warning
    assert all(entry.status == 0x50 for entry in memory.entries.values())


@pytest.mark.parametrize("group", [code_of(FL, 0), 0xFFFFFF])
def test_a_code_that_was_cleared_fails_again_when_its_reason_stays(tmp_path, group):
    memory = TroubleMemory(tmp_path)
    _judge(memory, RESOLVER_LOST)
    assert memory.clear(group)
    assert _judge(memory, RESOLVER_LOST, times=2)[0].status == 0x50
    assert _judge(memory, RESOLVER_LOST, times=1)[0].status & TEST_FAILED


@settings(max_examples=25)
@given(st.lists(st.tuples(st.integers(0, 3), st.integers(0, 4), st.integers(0, 0xFFFF), st.booleans()), max_size=12))
def test_status_bits_never_contradict_each_other(tmp_path_factory, steps):
    folder = tmp_path_factory.mktemp("trouble")
    memory = TroubleMemory(folder)
    for corner, mode, reasons, restart in steps:
        if restart:
            memory.save()
            memory = TroubleMemory(folder)
        _judge(memory, reasons, times=2, corner=corner, mode=mode)
        for entry in memory.entries.values():
            s = entry.status
            assert not s & TEST_FAILED or (s & FAILED_THIS_CYCLE and s & PENDING)
            assert not s & FAILED_THIS_CYCLE or not s & trouble.NOT_COMPLETED_THIS_CYCLE
            assert not s & trouble.NOT_COMPLETED_SINCE_CLEAR or s & trouble.NOT_COMPLETED_THIS_CYCLE
            assert bool(s & CONFIRMED) == (entry.frame is not None) == (entry.occurrences > 0)


@pytest.mark.parametrize(
    ("value", "unsigned", "signed"),
    [(None, "ffff", "8000"), (1e9, "fffe", "7fff"), (-1e9, "0000", "8001"), (3.0, "0003", "001e")],
)
def test_no_value_is_taken_for_one_that_is_not_to_be_used(value, unsigned, signed):
    factor = value and 1e-4 * value
    frame = Frame(1, DEGRADED, 2, value, value, (value,) * 4, value, factor).encode()
    assert frame.hex() == f"00000001{DEGRADED:02x}02" + 2 * unsigned + 5 * signed + unsigned


def test_every_reason_of_every_corner_has_a_code_of_its_own():
    codes = {code_of(corner, reason) for corner in range(len(CORNERS)) for reason in range(len(REASONS))}
    assert len(codes) == trouble.CODES
    assert code_of(2, 5) == 0x520500


# --- Requests -----------------------------------------------------------------------------------------------------------


@given(st.binary(min_size=1, max_size=12))
def test_any_request_has_one_answer_or_a_reason(tmp_path_factory, request_):
    server = Server(TroubleMemory(tmp_path_factory.mktemp("trouble")), {0x1000: lambda: b"abc"})
    response = server.answer(request_, 0.0)
    if not response:
        assert request_[0] in (0x10, 0x19, 0x3E) and request_[1] & 0x80
    elif response[0] == 0x7F:
        assert response[1] == request_[0] and response[2] in (0x11, 0x12, 0x13, 0x31)
    else:
        assert response[0] == request_[0] | 0x40


def test_a_session_ends_without_requests(tmp_path):
    server = Server(TroubleMemory(tmp_path), {})
    assert server.answer(b"\x10\x03", 0.0) == b"\x50\x03\x03\xe8\x01\xf4"
    assert server.answer(b"\x22\xf1\x86", 4.0) == b"\x62\xf1\x86\x03"
    assert server.answer(b"\x3e\x80", 8.0) == b""
    assert server.answer(b"\x22\xf1\x86", 12.9) == b"\x62\xf1\x86\x03"
    assert server.answer(b"\x22\xf1\x86", 18.0) == b"\x62\xf1\x86\x01"


# --- A tester -----------------------------------------------------------------------------------------------------------


class _Served:
    """The server on a bus inside the process, and a daemon's broadcasts on the same."""

    def __init__(self, channel: str, state: Path):
        from emb_daemon.workshop.serve import Diagnostics

        self.bus = open_bus("virtual", channel, [*Listener().ids, 0x710])
        self.daemon = open_bus("virtual", channel, [])
        self.diagnostics = Diagnostics(self.bus, _CONFIGURATION, state, 0x710, 0x718)
        self._stop, self._counter = threading.Event(), 0
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self):
        while not self._stop.is_set():
            self.diagnostics.step()

    def broadcast(self, reasons: int, times: int = 3) -> None:
        """Each is heard before the next comes: of what comes at once, the server takes the newest."""
        status = self.diagnostics.listener.corners[FL].streams[ESTIMATOR_STATUS]
        for _ in range(times):
            heard, deadline = status.received, time.monotonic() + 30.0
            now, counter = time.monotonic_ns(), self._counter % 15
            self._counter += 1
            self.daemon.send(np.concatenate([
                wirekit.frame("EMB_FL_ClampForce", now, counter, 1, ClampForce=12.345, ClampForceSigma=0.067, ForceSource=1),
                wirekit.frame("EMB_FL_PadTemp", now, counter, 0, InnerSurfaceTemp=301.25, InnerMeanTemp=250.0,
                              OuterSurfaceTemp=290.0, OuterMeanTemp=240.0),
                wirekit.frame("EMB_FL_EstimatorStatus", now, counter, 1, Mode=3, StiffnessFactor=0.912, ContactAngle=-73.1,
                              DegradedReasons=reasons),
            ]))  # fmt: skip
            while status.received == heard:
                assert time.monotonic() < deadline, "a broadcast was not heard"
                time.sleep(0.01)

    def stop(self) -> None:
        self._stop.set()
        self._thread.join()
        self.bus.close(), self.daemon.close()


@contextlib.contextmanager
def _tester(channel: str):
    """udsoncan's client over can-isotp, neither of them ours."""
    import can
    import isotp
    from udsoncan import AsciiCodec, DidCodec
    from udsoncan.client import Client
    from udsoncan.connections import PythonIsoTpConnection

    class Bytes(DidCodec):
        def __init__(self, length):
            self.length = length

        def encode(self, value):
            return value

        def decode(self, payload):
            return payload

        def __len__(self):
            return self.length

    class Rest(Bytes):
        def __len__(self):
            raise DidCodec.ReadAllRemainingData

    with can.Bus(interface="virtual", channel=channel) as bus:
        address = isotp.Address(isotp.AddressingMode.Normal_11bits, txid=0x710, rxid=0x718)
        stack = isotp.CanStack(bus, address=address, params={"tx_padding": 0})
        size = struct.calcsize(Frame.LAYOUT)
        identifiers = {0xF189: Rest(0), 0x1000: AsciiCodec(12), 0x1010: Rest(0), 0x1100: Bytes(size)}
        # No timed test: what the server promises is for a machine that is not busy with others.
        config = {"data_identifiers": identifiers, "use_server_timing": False, "request_timeout": 10, "p2_timeout": 10}
        with Client(PythonIsoTpConnection(stack), config=config) as client:
            yield client


@pytest.fixture
def served(tmp_path, request):
    pytest.importorskip("udsoncan", reason="NOT RUN: udsoncan is not installed")
    pytest.importorskip("isotp", reason="NOT RUN: can-isotp is not installed")
    server = _Served(request.node.name, tmp_path)
    with _tester(request.node.name) as client:
        yield server, client
    server.stop()


def test_a_tester_reads_and_clears_trouble_codes(served, tmp_path):
    server, client = served
    client.change_session(3)
    client.tester_present()
    assert len(client.get_supported_dtc().service_data.dtcs) == trouble.CODES
    assert client.get_number_of_dtc_by_status_mask(CONFIRMED).service_data.dtc_count == 0
    server.broadcast(RESOLVER_LOST | CURRENT_LOST)
    server.broadcast(RESOLVER_LOST)
    assert client.get_number_of_dtc_by_status_mask(CONFIRMED).service_data.dtc_count == 2
    found = {dtc.id: dtc.status for dtc in client.get_dtc_by_status_mask(0xFF).service_data.dtcs if dtc.status.confirmed}
    assert set(found) == {code_of(FL, 0), code_of(FL, 1)}
    assert found[code_of(FL, 0)].test_failed and not found[code_of(FL, 1)].test_failed

    [dtc] = client.get_dtc_snapshot_by_dtc_number(code_of(FL, 0), record_number=1).service_data.dtcs
    stamp, *values = struct.unpack(Frame.LAYOUT, dtc.snapshots[0].data)
    assert abs(stamp - time.time()) < 60
    assert values == [3, 1, 12345, 67, 3012, 2500, 2900, 2400, -731, 9120]
    [dtc] = client.get_dtc_extended_data_by_dtc_number(code_of(FL, 0), record_number=1, data_size=2).service_data.dtcs
    assert list(dtc.extended_data[0].raw_data) == [1, 0]

    client.clear_dtc(code_of(FL, 1))
    assert client.get_number_of_dtc_by_status_mask(CONFIRMED).service_data.dtc_count == 1
    client.clear_dtc()
    assert client.get_number_of_dtc_by_status_mask(CONFIRMED).service_data.dtc_count == 0
    assert TroubleMemory(tmp_path).entries[code_of(FL, 0)].frame is None


def test_a_tester_reads_versions_calibration_and_estimates(served):
    server, client = served
    assert client.read_data_by_identifier(0xF189).service_data.values[0xF189] == emb_daemon.__version__.encode()
    expected = calibration_hash(emb_daemon.shipped_calibration())
    assert client.read_data_by_identifier(0x1000).service_data.values[0x1000] == expected
    assert client.read_data_by_identifier(0x1010).service_data.values[0x1010] == b"{}"
    server.broadcast(0, times=1)
    assert struct.unpack(Frame.LAYOUT, client.read_data_by_identifier(0x1100).service_data.values[0x1100])[3] == 12345


def test_codes_that_cannot_be_kept_are_told_all_the_same(served, monkeypatch):
    server, client = served

    def full(path, content):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(trouble.files, "write", full)
    server.broadcast(RESOLVER_LOST, times=5)
    assert client.get_number_of_dtc_by_status_mask(CONFIRMED).service_data.dtc_count == 1
    assert server.diagnostics.trouble.endswith("trouble.json: No space left on device")
    with pytest.raises(Exception, match="GeneralProgrammingFailure"):
        client.clear_dtc()
    assert client.get_number_of_dtc_by_status_mask(CONFIRMED).service_data.dtc_count == 1, "forgotten all the same"


def test_what_is_not_there_is_refused(served):
    from udsoncan.exceptions import NegativeResponseException

    client = served[1]
    for call, code in (
        (lambda: client.ecu_reset(1), 0x11),
        (lambda: client.clear_dtc(0x123456), 0x31),
        (lambda: client.change_session(2), 0x12),
    ):
        with pytest.raises(NegativeResponseException) as refused:
            call()
        assert refused.value.response.code == code


def test_the_command_serves_and_a_freeze_frame_survives_its_kill(tmp_path):
    pytest.importorskip("isotp", reason="NOT RUN: can-isotp is not installed")
    try:
        daemon = open_bus("udp_multicast", _GROUP, [0x718])
    except Unavailable as error:
        pytest.skip(f"NOT RUN: no multicast here ({error})")
    command = [sys.executable, "-m", "emb_daemon.cli.main", "uds", "--config", _CONFIGURATION, "--state", tmp_path]
    process = subprocess.Popen([*command, "-i", "udp_multicast", "-c", _GROUP], stdout=subprocess.PIPE, text=True,
                               env=processkit.environment(NUMBA_DISABLE_JIT="1"))  # fmt: skip
    try:
        assert "requests 0x710, responses 0x718" in process.stdout.readline()
        request = np.zeros(1, FRAME)
        request["can_id"], request["length"], request["data"] = 0x710, 8, 0x3E02
        # Until the code is kept: of what comes at once, the server takes the newest.
        deadline, counter = time.monotonic() + 30.0, 0
        while b'"occurrences": 1' not in (tmp_path / trouble.FILE).read_bytes():
            assert time.monotonic() < deadline, "no trouble code was kept"
            daemon.send(wirekit.frame("EMB_RR_EstimatorStatus", time.monotonic_ns(), counter, 1, Mode=3, DegradedReasons=1))
            counter = (counter + 1) % 15
            time.sleep(0.1)
        daemon.send(request)
        while not len(heard := daemon.drain()):
            assert time.monotonic() < deadline, "no answer to tester present"
            daemon.wait(1.0)
        assert int(heard["data"][0]) & 0xFFFFFF == 0x007E02
    finally:
        process.kill()
        process.wait()
        daemon.close()
    entry = TroubleMemory(tmp_path).entries[code_of(RR, 0)]
    assert entry.status & CONFIRMED and entry.frame.mode == DEGRADED


def test_an_id_that_the_daemon_sends_is_refused(capsys):
    assert main(["uds", "--config", str(_CONFIGURATION), "--request-id", "0x200", "-i", "virtual", "-c", "none"]) == 2
    assert capsys.readouterr().err == "--request-id 0x200: expected an id that no other message uses\n"
