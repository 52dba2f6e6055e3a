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
from types import SimpleNamespace

import msgspec
import numpy as np
import processkit
import pytest
import wirekit
from hypothesis import given, settings
from hypothesis import strategies as st

import emb_daemon
from emb_daemon.calibration.configuration import Setup
from emb_daemon.calibration.files import calibration_hash
from emb_daemon.cli import serving
from emb_daemon.cli.main import main
from emb_daemon.errors import Unavailable
from emb_daemon.estimator.records import ESTIMATE, PARAMETERS, SAMPLE
from emb_daemon.estimator.status import TABLE, names
from emb_daemon.monitor.listener import broadcast_ids
from emb_daemon.plant.car import Car
from emb_daemon.plant.derive import plant_from_calibration
from emb_daemon.plant.live import LiveCar
from emb_daemon.plant.scenarios import rest, stop
from emb_daemon.runtime import shared
from emb_daemon.runtime.bus import open_bus
from emb_daemon.runtime.daemon import Daemon
from emb_daemon.runtime.shared import EstimatesReader, PresentEstimates, SharedEstimates
from emb_daemon.wire.contract import CURRENT_LOST, DEGRADED, INIT, REASONS, RESOLVER_LOST, RUNNING
from emb_daemon.wire.layout import CORNERS, ESTIMATOR_STATUS
from emb_daemon.workshop import trouble
from emb_daemon.workshop.trouble import CONFIRMED, FAILED_THIS_CYCLE, PENDING, TEST_FAILED, Frame, TroubleMemory, code_of
from emb_daemon.workshop.uds import Server

_ROOT = Path(__file__).parent.parent
_CONFIGURATION = _ROOT / "config" / "emb.yaml"
_FRAME = Frame(1_700_000_000, DEGRADED, 1, 12_345.0, 67.0, (301.2, 250.0, 290.0, None), -73.1, 0.912)
_GROUP = f"239.74.164.{os.getpid() % 250 + 3}"
FL, RR = 0, 3
#: Of `Frame`, what only a daemon that shares its estimates tells, and that on the wire where it is not to be used.
_SHARED = ("stiffness_force_N", "stiffness_sigma_N", "torque_force_N", "torque_sigma_N", "facts")
_NOT_SHARED = [0xFFFF] * 4 + [0xFFFFFFFF]


def _judge(memory, reasons, times=3, corner=FL, mode=DEGRADED, frame=_FRAME):
    for _ in range(times):
        memory.evaluate(corner, mode, reasons, frame, 0.0)
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


def test_before_a_corner_has_inputs_no_code_fails(tmp_path):
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


def test_an_operation_cycle_without_a_test_does_not_age_a_code(tmp_path):
    _judge(TroubleMemory(tmp_path), CURRENT_LOST)
    for _ in range(5):
        entry = TroubleMemory(tmp_path).entries[code_of(FL, 1)]
    assert entry.aged == 0 and entry.status & CONFIRMED and entry.status & PENDING


def test_a_file_of_a_version_without_shared_values_is_read(tmp_path):
    _judge(TroubleMemory(tmp_path), CURRENT_LOST)
    path = tmp_path / trouble.FILE
    content = msgspec.json.decode(path.read_bytes())["content"]
    for entry in content["entries"].values():
        for name in _SHARED if entry["frame"] else ():
            assert entry["frame"].pop(name) is None
    trouble.files.write(path, content)
    memory = TroubleMemory(tmp_path)
    assert not memory.warning and memory.entries[code_of(FL, 1)].frame == _FRAME


def test_a_damaged_file_is_set_aside_and_reported(tmp_path):
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
def test_values_saturate_below_the_code_for_invalid(value, unsigned, signed):
    factor = value and 1e-4 * value
    facts = None if value is None else ("zero_wanders", "not_a_number")
    frame = Frame(1, DEGRADED, 2, value, value, (value,) * 4, value, factor, value, value, value, value, facts).encode()
    bits = "ffffffff" if value is None else "02000002"
    assert frame.hex() == f"00000001{DEGRADED:02x}02" + 2 * unsigned + 5 * signed + 5 * unsigned + bits


def test_every_reason_of_every_corner_has_a_code_of_its_own():
    codes = {code_of(corner, reason) for corner in range(len(CORNERS)) for reason in range(len(REASONS))}
    assert len(codes) == trouble.CODES
    assert code_of(2, 5) == 0x520500


# --- What is shared -----------------------------------------------------------------------------------------------------


def _row(corner=FL, time_ns=0, **values) -> np.ndarray:
    row = np.zeros(1, ESTIMATE)
    row["corner"], row["time_ns"], row["is_sample"] = corner, time_ns, True
    for name, value in values.items():
        row[name] = value
    return row


class _Sharing:
    """A daemon's side and a reader's, by a clock that stands until told otherwise."""

    def __init__(self, path: Path):
        self.pipeline = SimpleNamespace(
            samples=np.zeros(4, SAMPLE), estimates=np.zeros(4, ESTIMATE), parameters=np.zeros(4, PARAMETERS)
        )
        self.now_ns, self.present, self._loop = 0, PresentEstimates(path), SharedEstimates(path, self.pipeline)
        self.present.follow(0)

    def tell(self, row: np.ndarray) -> None:
        self.pipeline.estimates[:1] = row
        self._loop.write(1)
        self.pass_ms(0)

    def pass_ms(self, ms: int) -> None:
        self.now_ns += ms * wirekit.MS
        for _ in range(2):
            self.present.follow(self.now_ns)


def test_the_newest_sample_of_each_corner_is_available_for_as_long_as_it_is_current(tmp_path):
    sharing = _Sharing(tmp_path / "estimates")
    for row in (_row(torque_force=1.0), _row(RR, torque_force=2.0), _row(torque_force=3.0), _row(is_sample=False)):
        sharing.tell(row)
    assert [sharing.present.of(corner)["torque_force"] for corner in (FL, RR)] == [3.0, 2.0]
    assert sharing.present.of(1) is None
    sharing.pass_ms(200)
    sharing.tell(_row(RR, 200 * wirekit.MS))
    assert sharing.present.of(FL) is not None and not sharing.present.trouble
    sharing.pass_ms(200)
    assert sharing.present.of(FL) is None and sharing.present.of(RR) is not None, "FL's daemon is silent"
    for _ in range(20):
        sharing.pass_ms(10)
    assert sharing.present.of(RR) is None and sharing.present.trouble.endswith("no daemon shares its estimates there")
    sharing.tell(_row(RR, 600 * wirekit.MS))
    assert sharing.present.of(RR) is not None and not sharing.present.trouble


@pytest.mark.parametrize("content, said", [
    (None, "no daemon shares its estimates there"),
    (bytes(shared.SHARED.itemsize), "written by another version of the daemon"),
])  # fmt: skip
def test_the_reason_for_missing_estimates_is_reported_when_it_lasts(tmp_path, content, said):
    path = tmp_path / "estimates"
    if content:
        path.write_bytes(content)
    present = PresentEstimates(path)
    for expected in ["", "", "", *[None] * 50, f"{path}: {said}"]:
        present.follow(0)
        assert expected is None or present.trouble == expected
        assert present.of(FL) is None


# --- Requests -----------------------------------------------------------------------------------------------------------


@given(st.binary(min_size=1, max_size=12))
def test_any_request_gets_one_positive_or_negative_response(tmp_path_factory, request_):
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

        self.bus = open_bus("virtual", channel, [*broadcast_ids(), 0x710])
        self.daemon = open_bus("virtual", channel, [])
        self.diagnostics = Diagnostics(self.bus, _CONFIGURATION, state, 0x710, 0x718, state / "estimates")
        self._stop, self._counter = threading.Event(), 0
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self):
        while not self._stop.is_set():
            self.diagnostics.step()

    def broadcast(self, reasons: int, times: int = 3, corner: str = "FL") -> None:
        """Each is heard before the next comes: of what comes at once, the server takes the newest."""
        status = self.diagnostics.listener.corners[CORNERS.index(corner)].streams[ESTIMATOR_STATUS]
        for _ in range(times):
            heard, deadline = status.received, time.monotonic() + 30.0
            now, counter = time.monotonic_ns(), self._counter % 15
            self._counter += 1
            self.daemon.send(np.concatenate([
                wirekit.frame(f"EMB_{corner}_ClampForce", now, counter, 1, ClampForce=12.345, ClampForceSigma=0.067,
                              ForceSource=1),
                wirekit.frame(f"EMB_{corner}_PadTemp", now, counter, 0, InnerSurfaceTemp=301.25, InnerMeanTemp=250.0,
                              OuterSurfaceTemp=290.0, OuterMeanTemp=240.0),
                wirekit.frame(f"EMB_{corner}_EstimatorStatus", now, counter, 1, Mode=3, StiffnessFactor=0.912,
                              ContactAngle=-73.1, DegradedReasons=reasons),
            ]))  # fmt: skip
            while status.received == heard:
                assert time.monotonic() < deadline, "a broadcast was not heard"
                time.sleep(0.01)

    def stop(self) -> None:
        self._stop.set()
        self._thread.join()
        self.bus.close(), self.daemon.close()


@contextlib.contextmanager
def _tester(channel: str, interface: str = "virtual"):
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

    with can.Bus(interface=interface, channel=channel) as bus:
        address = isotp.Address(isotp.AddressingMode.Normal_11bits, txid=0x710, rxid=0x718)
        stack = isotp.CanStack(bus, address=address, params={"tx_padding": 0})
        size = struct.calcsize(Frame.LAYOUT)
        texts = dict.fromkeys((0xF189, 0x1010, 0x1120, 0x1122), Rest(0))
        identifiers = texts | {0x1000: AsciiCodec(12), 0x1100: Bytes(size)}
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
    assert values == [3, 1, 12345, 67, 3012, 2500, 2900, 2400, -731, 9120, *_NOT_SHARED]
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
    assert client.read_data_by_identifier(0x1120).service_data.values[0x1120] == b"not known"


def test_shared_estimates_are_assigned_to_their_corner(served, tmp_path):
    server, client = served
    found, later = TABLE["zero_wanders"].sentence + "; " + TABLE["beyond_range"].sentence, time.monotonic_ns() + 10**12
    facts = sum(1 << bit for bit, name in enumerate(TABLE) if name in ("zero_wanders", "beyond_range"))
    forces = {"stiffness_force": 12000.4, "stiffness_sigma": 70.0, "torque_force": np.nan, "torque_sigma": np.inf}
    rows = np.concatenate([_row(FL, later, torque_force=1.0), _row(2, later, facts=facts, **forces)])
    loop = SharedEstimates(tmp_path / "estimates", SimpleNamespace(
        samples=np.zeros(2, SAMPLE), estimates=rows, parameters=np.zeros(4, PARAMETERS)))  # fmt: skip
    deadline = time.monotonic() + 30.0
    while client.read_data_by_identifier(0x1122).service_data.values[0x1122] != found.encode():
        assert time.monotonic() < deadline, "the facts are not told"
        loop.write(2)
    server.broadcast(RESOLVER_LOST, corner="RL")
    [dtc] = client.get_dtc_snapshot_by_dtc_number(code_of(2, 0), record_number=1).service_data.dtcs
    assert struct.unpack(Frame.LAYOUT, dtc.snapshots[0].data)[-5:] == (12000, 70, 0xFFFF, 0xFFFF, facts)


def test_codes_that_cannot_be_stored_can_still_be_read(served, monkeypatch):
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


def test_unsupported_requests_are_refused(served):
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


class _Losing:
    """A bus that loses what FL's thermocouples send once its brake is clamped."""

    def __init__(self, bus):
        self._bus, self._lost = bus, -1

    def __getattr__(self, name):
        return getattr(self._bus, name)

    def send(self, frames: np.ndarray) -> None:
        self._bus.send(frames[frames["can_id"] != self._lost])

    def follow(self, _, truth: np.ndarray) -> None:
        if truth["force"][0] > 3000.0:
            self._lost = wirekit.database().get_message_by_name("EMB_FL_Thermocouple").frame_id


@contextlib.contextmanager
def _driven(calibration, estimates: Path):
    """A daemon that shares its estimates, and a car that brakes, each on the group's bus."""
    setup = Setup(_CONFIGURATION)
    ids = np.flatnonzero(setup.layout["slot"][0] != -1).tolist()
    daemon = Daemon(setup, open_bus("udp_multicast", _GROUP, ids))
    daemon.share(estimates)
    bus, plant = _Losing(open_bus("udp_multicast", _GROUP, [])), np.array([plant_from_calibration(calibration, 0)])
    car = LiveCar(Car(plant, ("FL",)), bus, rest(1.0) + stop(6000.0, 60.0))
    daemon.warm_up(), car.warm_up()
    ended = threading.Event()
    threads = [threading.Thread(target=daemon.run), threading.Thread(target=car.run, args=(ended.is_set, None, bus.follow))]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        ended.set(), daemon.stop()
        for thread in threads:
            thread.join()
        daemon._bus.close(), bus.close()


def _told(row) -> tuple:
    """Of an ESTIMATE, what `_SHARED` names."""
    forces = (row["stiffness_force"], row["stiffness_sigma"], row["torque_force"], row["torque_sigma"])
    return *(float(value) if np.isfinite(value) else None for value in forces), names(int(row["facts"]))


def test_the_command_serves_and_a_freeze_frame_survives_its_kill(tmp_path, calibration):
    """A tester gets both paths' forces, which are on no bus, as the daemon's ESTIMATE has them at a failure."""
    pytest.importorskip("udsoncan", reason="NOT RUN: udsoncan is not installed")
    pytest.importorskip("isotp", reason="NOT RUN: can-isotp is not installed")
    try:
        open_bus("udp_multicast", _GROUP, []).close()
    except Unavailable as error:
        pytest.skip(f"NOT RUN: no multicast here ({error})")
    estimates, code = tmp_path / "estimates", code_of(FL, REASONS.index("thermocouple lost"))
    command = [sys.executable, "-m", "emb_daemon.cli.main", "uds", "--config", _CONFIGURATION, "--state", tmp_path]
    process = subprocess.Popen([*command, "--share", estimates, "-i", "udp_multicast", "-c", _GROUP], text=True,
                               stdout=subprocess.PIPE, env=processkit.environment(NUMBA_DISABLE_JIT="1"))  # fmt: skip
    told, reader = set(), EstimatesReader(estimates)
    try:
        assert "requests 0x710, responses 0x718" in process.stdout.readline()
        with _driven(calibration, estimates), _tester(_GROUP, "udp_multicast") as client:
            deadline = time.monotonic() + 60.0
            while not (found := client.get_dtc_snapshot_by_dtc_number(code, record_number=1).service_data.dtcs[0].snapshots):
                assert time.monotonic() < deadline, "no freeze frame"
                reader.look()
                told |= {_told(row) for row in reader.take()[1] if row["corner"] == FL}
            for _ in range(2):
                told |= {_told(row) for row in reader.take()[1] if row["corner"] == FL}
    finally:
        process.kill()
        process.wait()
    entry = TroubleMemory(tmp_path).entries[code]
    assert entry.status & CONFIRMED and entry.frame.encode() == found[0].data
    kept = tuple(getattr(entry.frame, name) for name in _SHARED)
    assert kept in told and None not in kept and kept[0] != kept[2]
    *forces, facts = struct.unpack(Frame.LAYOUT, found[0].data)[-5:]
    assert forces == [round(value) for value in kept[:4]]
    assert tuple(name for bit, name in enumerate(TABLE) if facts >> bit & 1) == kept[4]


def test_a_trouble_is_printed_once(monkeypatch, capsys):
    stopped, troubles = [], ["", "full", "full", "", "", "full"]

    class Troubled:
        trouble = ""

        def step(self):
            self.trouble = troubles.pop(0)
            stopped.extend([True] * (not troubles))

    monkeypatch.setattr(serving, "stop_signals", lambda: stopped)
    serving.serve(Troubled(), "at work")
    assert capsys.readouterr() == ("at work\n", "full\nfull\n")


def test_an_id_that_the_daemon_sends_is_refused(capsys):
    assert main(["uds", "--config", str(_CONFIGURATION), "--request-id", "0x200", "-i", "virtual", "-c", "none"]) == 2
    assert capsys.readouterr().err == "--request-id 0x200: expected an id that no other message uses\n"
