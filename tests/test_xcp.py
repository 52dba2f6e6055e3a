"""Measurement over XCP: what pyxcp, a master that is not ours, reads and acquires; the A2L file as pya2l reads it."""

import contextlib
import struct
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule, run_state_machine_as_test

from emb_daemon.calibration.configuration import Setup
from emb_daemon.calibration.parameters import value_of
from emb_daemon.cli.main import main
from emb_daemon.estimator.records import ESTIMATE, SAMPLE
from emb_daemon.interface.signals import INPUTS, OUTPUTS
from emb_daemon.runtime import shared
from emb_daemon.runtime.bus import open_bus
from emb_daemon.runtime.daemon import Daemon, Pacer
from emb_daemon.runtime.rawcan import socket_pair
from emb_daemon.runtime.shared import EstimatesReader, SharedEstimates
from emb_daemon.wire.layout import CORNERS
from emb_daemon.workshop import xcp
from emb_daemon.workshop.a2l import NAME, VERSION, make_a2l
from emb_daemon.workshop.image import VERSION_ADDRESS, Image, address_of
from emb_daemon.workshop.measure import Can, Measurement, Udp
from emb_daemon.workshop.xcp import ON_CAN, ON_UDP, Slave

_CONFIGURATION = Path(__file__).parent.parent / "config" / "emb.yaml"
_NAMES = [signal.name for signal in INPUTS + OUTPUTS]
FL, RR = 0, 3


def _address(corner: int, name: str) -> int:
    return address_of(corner, _NAMES.index(name))


class _Loop:
    """What a daemon's loop tells, without the daemon: row ``n`` of a corner has a force of 1000 * corner + n."""

    def __init__(self, path: Path, parameters=None):
        self.pipeline = SimpleNamespace(
            samples=np.zeros(1024, SAMPLE),
            estimates=np.zeros(1024, ESTIMATE),
            parameters=Setup(_CONFIGURATION).parameters if parameters is None else parameters,
        )
        self.shared = SharedEstimates(path, self.pipeline)
        self.rows = 0

    def tell(self, count: int = 4) -> None:
        number, corner = np.divmod(np.arange(self.rows, self.rows + count), len(CORNERS))
        estimates = self.pipeline.estimates[:count]
        estimates["corner"], estimates["force"], estimates["time_ns"] = corner, 1000 * corner + number, 4_000_000 * number
        estimates["mode"], self.pipeline.samples["angle"][:count] = 1, -0.5 * number
        self.rows += count
        self.shared.write(count)


# --- What the loop tells ------------------------------------------------------------------------------------------------


class _Meanwhile:
    """A ring while whose rows are read, the loop goes on."""

    def __init__(self, ring, go_on):
        self.ring, self.go_on = ring, go_on

    def __getitem__(self, places):
        half = len(places) // 2
        first = self.ring[places[:half]]
        self.go_on()
        return np.concatenate([first, self.ring[places[half:]]])


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.sampled_from(["tell", "take", "overtake"]), st.integers(0, 3 * 1024)), max_size=20))
def test_every_row_is_taken_once_and_in_order_or_counted_as_lost(tmp_path_factory, steps):
    path = tmp_path_factory.mktemp("share") / "estimates"
    loop, reader = _Loop(path, parameters=np.zeros(4, shared.PARAMETERS)), EstimatesReader(path)
    reader.look()
    rings = reader._rings
    taken, missing = [], 0

    def tell(count):
        for start in range(0, count, 1024):
            loop.tell(min(1024, count - start))

    for step, count in [*steps, ("take", 0), ("take", 0)]:
        if step == "tell":
            tell(count)
            continue
        overtaking = iter([count] if step == "overtake" else [])
        reader._rings = [_Meanwhile(ring, lambda counts=overtaking: tell(next(counts, 0))) for ring in rings]
        samples, estimates, lost = reader.take()
        assert np.array_equal(estimates["force"] % 1000, -2 * samples["angle"] % 1000), "a row of two moments"
        missing += lost
        rows = [int(e["time_ns"]) // 4_000_000 * 4 + int(e["corner"]) for e in estimates]
        assert rows == list(range(len(taken) + missing, len(taken) + missing + len(rows)))
        taken += rows
    assert len(taken) + missing == loop.rows


def test_a_late_reader_gets_the_number_of_estimates_that_it_lost(tmp_path):
    loop, reader = _Loop(tmp_path / "estimates"), EstimatesReader(tmp_path / "estimates")
    reader.look()
    for _ in range(20):
        loop.tell(shared.ROWS // 8)
        assert reader.take()[2] == 0
    for _ in range(8):
        loop.tell(shared.ROWS // 8)
    assert sum(reader.take()[2] for _ in range(2)) > 0


def test_a_daemon_that_starts_anew_is_found_and_another_version_is_not_read(tmp_path):
    path = tmp_path / "estimates"
    reader = EstimatesReader(path)
    reader.look()
    samples, _, lost = reader.take()
    assert not reader.trouble and len(samples) == lost == 0
    for _ in range(2):
        loop = _Loop(path)
        reader.look()
        loop.tell(8)
        reader.take()
        assert len(reader.take()[1]) == 8
        assert np.array_equal(reader.parameters, loop.pipeline.parameters)
    path.unlink()
    path.write_bytes(b"x" * shared.SHARED.itemsize)
    reader.look()
    assert len(reader.take()[0]) == 0 and reader.trouble == f"{path}: written by another version of the daemon"


def test_the_daemon_shares_the_estimates_that_it_sends(tmp_path):
    here, there = socket_pair()
    daemon = Daemon(Setup(_CONFIGURATION), here)
    daemon.share(tmp_path / "estimates")
    reader = EstimatesReader(tmp_path / "estimates")
    reader.look()
    daemon.pipeline.begin(0)
    pacer = Pacer(0)
    daemon.tick(100_000_000, pacer)
    reader.take()
    samples, estimates, lost = reader.take()
    assert lost == 0 and estimates["corner"].tolist() == [0, 1, 2, 3]
    for told, sent in ((samples, daemon.pipeline.samples), (estimates, daemon.pipeline.estimates)):
        for name in told.dtype.names:
            np.testing.assert_array_equal(told[name], sent[name][: len(told)])
    here.close(), there.close()


def test_a_daemon_that_cannot_share_runs_all_the_same(tmp_path, caplog):
    here, there = socket_pair()
    daemon = Daemon(Setup(_CONFIGURATION), here)
    daemon.share(tmp_path / "none" / "estimates")
    assert "estimates are not shared" in caplog.text and "No such file" in caplog.text
    daemon.pipeline.begin(0)
    daemon.tick(100_000_000, Pacer(0))
    assert len(there.drain())
    here.close(), there.close()


# --- Packets ------------------------------------------------------------------------------------------------------------


def _slave(transport=ON_UDP) -> Slave:
    return Slave(Image(b"version"), transport, lambda: 5_000_000_000, b"name", b"the file")


_COMMANDS = [0xFF, 0xFE, *range(0xF0, 0xFE), *range(0xD0, 0xF0), 0xC7, 0x00]
_ERRORS = {0x00, 0x11, 0x20, 0x21, 0x22, 0x24, 0x27, 0x29, 0x2A, 0x30}


def _check(response: bytes, transport) -> None:
    assert 1 <= len(response) <= transport.max_cto
    assert response[0] == 0xFF or (response[0] == 0xFE and len(response) == 2 and response[1] in _ERRORS)


@given(st.sampled_from([ON_UDP, ON_CAN]), st.lists(st.tuples(st.sampled_from(_COMMANDS), st.binary(max_size=12)), max_size=40))
def test_any_packet_has_one_response(transport, packets):
    slave = _slave(transport)
    slave.answer(b"\xff\x00")
    for code, rest in packets:
        response = slave.answer(bytes([code]) + rest)
        if slave.connected or code == 0xFE:
            _check(response, transport) if response else None
        for corner in range(len(CORNERS)):
            assert all(len(packet) <= transport.max_dto for packet in slave.data(corner, 1))
    slave.answer(b"\xff\x00")
    assert slave.answer(b"\xfd")[:2] == b"\xff\x00"


class _Acquisition(RuleBasedStateMachine):
    """Commands of acquisition in any order, with numbers that are often right."""

    def __init__(self):
        super().__init__()
        self.transport = ON_CAN
        self.slave = _slave(ON_CAN)
        self.slave.answer(b"\xff\x00")

    def _ask(self, layout: str, *values: int) -> None:
        _check(self.slave.answer(struct.pack("<" + layout, *values)), self.transport)

    number, small = st.integers(0, 3), st.integers(0, 6)

    @rule(count=small)
    def allocate_lists(self, count):
        self._ask("B", 0xD6)
        self._ask("BxH", 0xD5, count)

    @rule(number=number, count=small)
    def allocate_odts(self, number, count):
        self._ask("BxHB", 0xD4, number, count)

    @rule(number=number, odt=small, count=small)
    def allocate_entries(self, number, odt, count):
        self._ask("BxHBB", 0xD3, number, odt, count)

    @rule(number=number, odt=small, entry=small, size=st.integers(0, 9), address=st.integers(0, 0x100))
    def write(self, number, odt, entry, size, address):
        self._ask("BxHBB", 0xE2, number, odt, entry)
        self._ask("BBBBI", 0xE1, 0xFF, size, 0, address)

    @rule(number=number, mode=st.sampled_from([0, 0x10]), event=small, prescaler=small)
    def set_mode(self, number, mode, event, prescaler):
        self._ask("BBHHBB", 0xE0, mode, number, event, prescaler, 0)

    @rule(number=number, mode=number)
    def start_stop_list(self, number, mode):
        self._ask("BBH", 0xDE, mode, number)

    @rule(mode=number)
    def start_stop(self, mode):
        self._ask("BB", 0xDD, mode)

    @invariant()
    def what_is_sent_fits_a_frame_and_comes_from_running_lists_alone(self):
        sent = [packet for corner in range(len(CORNERS)) for packet in self.slave.data(corner, 123_456_789)]
        assert all(0 < len(packet) <= self.transport.max_dto and packet[0] < self.transport.odts for packet in sent)
        assert self.slave.acquiring or not sent


def test_acquisition_commands_in_any_order_keep_the_state_machines_invariants():
    run_state_machine_as_test(_Acquisition, settings=settings(max_examples=40, stateful_step_count=30, deadline=None))


def test_without_a_session_only_connect_is_answered():
    slave = _slave()
    assert [slave.answer(packet) for packet in (b"", b"\xfd", b"\xf4\x04\0\0\0\0\0\0", b"\x12")] == [b""] * 4
    assert slave.answer(b"\xff\x00")[0] == 0xFF
    assert slave.answer(b"\xfe")[0] == 0xFF
    assert slave.answer(b"\xfd") == b""


@pytest.mark.parametrize("command, code", [
    ("fc", xcp.SYNCH), ("f0 04 00 00", xcp.UNKNOWN), ("f6 00", xcp.SYNTAX), ("f4 ff 00 00 00 00 00 00", xcp.OUT_OF_RANGE),
    ("f4 04 00 00 00 00 04 00", xcp.ACCESS_DENIED), ("f4 04 00 05 00 00 00 00", xcp.ACCESS_DENIED),
    ("d5 00 01 00", xcp.SEQUENCE), ("d4 00 00 00 01", xcp.SEQUENCE), ("d3 00 00 00 00 01", xcp.SEQUENCE),
    ("e1 ff 04 00 00 00 00 00", xcp.SEQUENCE), ("e2 00 00 00 00 00", xcp.OUT_OF_RANGE),
    ("dd 03", xcp.MODE_NOT_VALID), ("d7 00 04 00", xcp.OUT_OF_RANGE),
])  # fmt: skip
def test_wrong_commands_get_their_error_code(command, code):
    slave = _slave()
    slave.answer(b"\xff\x00")
    assert slave.answer(bytes.fromhex(command)) == bytes([0xFE, code])


def test_a_running_list_sends_and_is_not_changed_until_it_is_stopped():
    slave = _slave()
    for command in ("ff 00", "d6", "d5 00 01 00", "d4 00 00 00 01", "d3 00 00 00 00 01", "e2 00 00 00 00 00",
                    "e1 ff 04 00 00 00 00 00", "e0 00 00 00 00 00 01 00", "de 01 00 00"):  # fmt: skip
        assert slave.answer(bytes.fromhex(command))[0] == 0xFF, command
    assert slave.answer(b"\xfd")[1] == 0x40 and slave.acquiring
    for command in ("e2 00 00 00 00 00", "e1 ff 04 00 00 00 00 00", "e0 00 00 00 00 00 01 00", "d3 00 00 00 00 02"):
        assert slave.answer(bytes.fromhex(command)) == bytes([0xFE, xcp.DAQ_ACTIVE]), command
    assert len(list(slave.data(0, 1))) == 1
    for stop in ("de 00 00 00", "dd 00"):
        assert slave.answer(bytes.fromhex("de 01 00 00"))[0] == 0xFF and slave.acquiring
        assert slave.answer(bytes.fromhex(stop))[0] == 0xFF and not list(slave.data(0, 1)), stop


def test_a_list_that_no_frame_carries_is_not_started():
    slave = _slave(ON_CAN)
    for command in ("ff 00", "d6", "d5 00 01 00", "d4 00 00 00 01", "d3 00 00 00 00 02", "e2 00 00 00 00 00",
                    "e1 ff 04 00 00 00 00 00",
                    "e0 10 00 00 00 00 01 00", "de 02 00 00", "e1 ff 04 00 00 00 00 00"):  # fmt: skip
        assert slave.answer(bytes.fromhex(command))[0] == 0xFF, command
    for command in ("dd 01", "de 01 00 00"):
        assert slave.answer(bytes.fromhex(command)) == bytes([0xFE, xcp.DAQ_CONFIG]), command
    assert not slave.acquiring


# --- A master -----------------------------------------------------------------------------------------------------------


class _Served:
    """The server in a thread, and a loop that tells it something."""

    def __init__(self, path: Path, transport):
        setup = Setup(_CONFIGURATION)
        self.loop, self.transport = _Loop(path), transport
        self._file = make_a2l({"FL": setup.calibrations["FL"]})
        self.measurement = Measurement(path, transport, VERSION.encode(), NAME.encode(), self._file)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self):
        while not self._stop.is_set():
            self.measurement.step()

    def tell(self, moments: int) -> None:
        for _ in range(moments):
            self.loop.tell()
            time.sleep(0.004)
        time.sleep(0.2)

    def stop(self) -> None:
        self._stop.set()
        self._thread.join()
        self.transport.close()


@contextlib.contextmanager
def _master(layer: str, **options):
    """pyxcp's master; ``received`` gets its data packets."""
    from pyxcp.config import create_application_from_config, reset_application, set_application
    from pyxcp.master import Master
    from pyxcp.transport.transport_ext import FrameAcquisitionPolicy, FrameCategory

    class Keep(FrameAcquisitionPolicy):
        def __init__(self):
            super().__init__(None)
            self.received = []

        def feed(self, category, counter, timestamp, payload):
            if category in (FrameCategory.DAQ, FrameCategory.EVENT):
                self.received.append(bytes(payload))

        def finalize(self):
            pass

    application = create_application_from_config({"Transport": {layer: options}}, log_level=40)
    application.transport.timeout = 10.0
    set_application(application)
    policy = Keep()
    try:
        with Master(layer.lower(), config=application, policy=policy) as master:
            master.connect()
            yield master, policy.received
            master.disconnect()
    finally:
        reset_application()


def _acquire(master, names, prescaler=1):
    """Signals of each corner, one list a corner, one ODT a signal; the first with a time stamp."""
    master.freeDaq()
    master.allocDaq(len(CORNERS))
    for corner in range(len(CORNERS)):
        master.allocOdt(corner, len(names))
    for corner in range(len(CORNERS)):
        for odt in range(len(names)):
            master.allocOdtEntry(corner, odt, 1)
    for corner in range(len(CORNERS)):
        for odt, name in enumerate(names):
            master.setDaqPtr(corner, odt, 0)
            master.writeDaq(0xFF, 4, 0, _address(corner, name))
        master.setDaqListMode(0x10, corner, corner, prescaler, 0)
        assert master.startStopDaqList(2, corner).firstPid == corner * len(names)
    master.startStopSynch(1)


@pytest.fixture
def over_udp(tmp_path):
    pytest.importorskip("pyxcp", reason="NOT RUN: pyxcp is not installed")
    served = _Served(tmp_path / "estimates", Udp("127.0.0.1", 0))
    try:
        with _master("Eth", host="127.0.0.1", port=served.transport.port, protocol="UDP") as (master, received):
            yield served, master, received
    finally:
        served.stop()


def test_a_master_reads_the_version_signals_and_parameters(over_udp):
    served, master, _ = over_udp
    assert master.identifier(1) == NAME
    assert master.identifier(4).encode() == served._file
    master.setMta(VERSION_ADDRESS)
    assert bytes(master.fetch(len(VERSION))) == VERSION.encode()
    served.tell(11)
    assert struct.unpack("<f", master.shortUpload(4, _address(RR, "clamp_force_N"), 0)) == (3010.0,)
    assert struct.unpack("<I", master.shortUpload(4, _address(FL, "mode"), 0)) == (1,)
    offset = shared.PARAMETERS.fields["torque_constant"][1]
    expected = value_of(Setup(_CONFIGURATION).calibrations["RR"], "motor.torque_constant_Nm_per_A")
    assert struct.unpack("<d", master.shortUpload(8, 0x31000 + offset, 0)) == (expected,)


def test_a_master_learns_of_events_and_clock(over_udp):
    _, master, _ = over_udp
    information = master.getDaqInfo()
    assert [(event["name"], event["cycle"], str(event["unit"])) for event in information["channels"]] == [
        (name, 4, "EVENT_CHANNEL_TIME_UNIT_1MS") for name in CORNERS
    ]
    assert str(information["resolution"]["timestampMode"]["unit"]) == "DAQ_TIMESTAMP_UNIT_1US"
    before = time.monotonic_ns() // 1000
    assert (master.getDaqClock().timestamp - before) % 2**32 <= time.monotonic_ns() // 1000 - before


def test_a_master_acquires_every_estimate_without_loss(over_udp):
    served, master, received = over_udp
    _acquire(master, ("clamp_force_N", "angle_rad"))
    served.tell(500)
    master.startStopSynch(0)
    assert {packet[0] for packet in received} == set(range(8)), "an overload, or a packet of no list"
    for corner in range(len(CORNERS)):
        forces = [struct.unpack("<If", packet[1:]) for packet in received if packet[0] == 2 * corner]
        angles = [struct.unpack("<f", packet[1:])[0] for packet in received if packet[0] == 2 * corner + 1]
        assert len(forces) == len(angles) == 500
        assert forces == [(4000 * n, 1000.0 * corner + n) for n in range(len(forces))]
        assert angles == [-0.5 * n for n in range(len(angles))]


def test_a_prescaler_thins_out_and_a_master_that_ended_is_sent_nothing(over_udp):
    served, master, received = over_udp
    _acquire(master, ("clamp_force_N",), prescaler=5)
    served.tell(100)
    master.disconnect()
    assert [len([p for p in received if p[0] == corner]) for corner in range(len(CORNERS))] == [20] * 4
    count = len(received)
    served.tell(20)
    assert len(received) == count
    master.connect()


def test_lost_data_are_reported_to_the_master(over_udp):
    served, master, received = over_udp
    _acquire(master, ("clamp_force_N",))
    served.loop.tell(900)
    served.loop.tell(900)
    served.tell(5)
    assert bytes([0xFD, 0x06]) in [packet[:2] for packet in received]


def test_a_master_acquires_on_the_daemons_kind_of_bus(tmp_path, request):
    pytest.importorskip("pyxcp", reason="NOT RUN: pyxcp is not installed")
    bus = open_bus("virtual", request.node.name, [0x720])
    served = _Served(tmp_path / "estimates", Can(bus, 0x720, 0x728))
    options = {"interface": "virtual", "channel": request.node.name, "can_id_master": 0x720, "can_id_slave": 0x728}
    with _master("CAN", **options) as (master, received):
        assert master.slaveProperties.maxCto == master.slaveProperties.maxDto == 8
        offset = shared.PARAMETERS.fields["torque_constant"][1]
        master.setMta(0x1000 + offset)
        expected = value_of(Setup(_CONFIGURATION).calibrations["FL"], "motor.torque_constant_Nm_per_A")
        assert struct.unpack("<d", bytes(master.fetch(8))) == (expected,)
        _acquire(master, ("clamp_force_N", "clamp_force_sigma_N"))
        served.tell(100)
        master.startStopSynch(0)
    for corner in range(len(CORNERS)):
        forces = [struct.unpack("<Hf", packet[1:7]) for packet in received if packet[0] == 2 * corner]
        assert len(forces) == 100 and forces == [(40 * n, 1000.0 * corner + n) for n in range(len(forces))]
    served.stop()


def test_only_the_master_is_answered():
    import socket

    transport = Udp("127.0.0.1", 0)
    first, second = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
    where = ("127.0.0.1", transport.port)

    def hear(sender, datagram):
        sender.sendto(datagram, where)
        transport.wait(5.0)
        return transport.receive()

    assert hear(first, b"\1\0\0\0\xfd") == []
    assert hear(first, b"\2\0\0\0\xff\0\1\0\1\0\xfd") == [b"\xff\0", b"\xfd"]
    assert hear(second, b"\1\0\0\0\xfd") == []
    assert hear(first, b"\xff\xff\0\0\xfd") == [], "a packet that is not there"
    assert hear(first, b"\1\0") == []
    assert hear(second, b"\2\0\0\0\xff\0") == [b"\xff\0"], "who connects anew takes over"
    assert hear(first, b"\1\0\0\0\xfd") == []
    for end in (first, second, transport):
        end.close()


def test_a_master_whose_port_is_closed_is_forgotten(tmp_path):
    import socket

    transport = Udp("127.0.0.1", 0)
    measurement = Measurement(tmp_path / "estimates", transport, b"", b"", b"")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as tool:
        tool.sendto(b"\2\0\0\0\xff\0", ("127.0.0.1", transport.port))
        measurement.step()
        assert measurement._slave.connected
    transport.send([b"\xfd\x06"])
    for _ in range(3):
        measurement.step()
    assert not measurement._slave.connected
    transport.close()


# --- The A2L file -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def described(tmp_path_factory):
    pya2l = pytest.importorskip("pya2l", reason="NOT RUN: pya2ldb is not installed")
    folder = tmp_path_factory.mktemp("a2l")
    text = _CONFIGURATION.read_text()
    calibration = Path(_CONFIGURATION.parent / "calibration.yaml")
    (folder / "calibration.yaml").write_bytes(calibration.read_bytes())
    lines = [line for line in text.splitlines() if not line.strip().startswith(("FL:", "RL:", "RR:"))]
    (folder / "emb.yaml").write_text("\n".join(lines))
    assert main(["a2l", "--config", str(folder / "emb.yaml"), "--output", str(folder / "emb.a2l")]) == 0
    session = pya2l.import_a2l(str(folder / "emb.a2l"), in_memory=True, progress_bar=False, loglevel="ERROR")
    yield session
    session.close()


def test_the_file_describes_every_signal(described):
    from pya2l import model

    found = {entry.name: entry for entry in described.query(model.Measurement)}
    assert list(found) == [f"FR.{name}" for name in _NAMES]
    image, samples, estimates = Image(b""), np.zeros(1, SAMPLE), np.zeros(1, ESTIMATE)
    estimates["force"], estimates["reasons"], samples["angle"], samples["has_current"] = 12345.5, 0x8001, -7.25, True
    image.show(1, image.pages_of(samples, estimates)[0])
    for name, expected in (("clamp_force_N", 12345.5), ("angle_rad", -7.25), ("reasons", 0x8001), ("has_current", 1)):
        entry = found[f"FR.{name}"]
        layout = {"FLOAT32_IEEE": "<f", "ULONG": "<I"}[entry.datatype]
        content = image.read(0, entry.ecu_address.address, struct.calcsize(layout))
        assert struct.unpack(layout, content) == (expected,)


def test_the_file_describes_every_number_of_the_calibration_with_unit_and_bounds(described):
    from pya2l import model

    calibration = Setup(_CONFIGURATION).calibrations["FR"]
    image = Image(b"")
    image.parameters = Setup(_CONFIGURATION).parameters
    found = {entry.name: entry for entry in described.query(model.Characteristic)}
    assert len(found) > 300
    for name, entry in found.items():
        key = name.removeprefix("FR.")
        [value] = struct.unpack("<d", image.read(0, entry.address, 8))
        if not key.startswith("stiffness.curve["):
            assert value == value_of(calibration, key), key
        assert entry.lowerLimit <= value <= entry.upperLimit
        assert entry.read_only is not None, "nothing can be written"
    conversion = described.query(model.CompuMethod).filter_by(name=found["FR.motor.torque_constant_Nm_per_A"].conversion).one()
    assert conversion.unit == "N.m/A"


def test_the_file_has_words_for_codes_and_the_version_of_its_slave(described):
    from pya2l import model

    table = described.query(model.CompuVtab).filter_by(name="CT.mode").one()
    assert {int(pair.inVal): pair.outVal for pair in table.pairs}[4] == "fault"
    assert described.query(model.AddrEpk).one().address == VERSION_ADDRESS
    assert described.query(model.Epk).one().identifier == VERSION


# --- The command --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("arguments, said", [
    (["--udp", "5555"], "--udp 5555: expected HOST:PORT, such as 127.0.0.1:5555\n"),
    (["--can", "-i", "virtual", "-c", "x", "--request-id", "0x200"],
     "--request-id 0x200: expected an id that no other message uses\n"),
])  # fmt: skip
def test_wrong_addresses_are_refused(arguments, said, tmp_path, capsys):
    assert main(["xcp", "--config", str(_CONFIGURATION), "--share", str(tmp_path / "estimates"), *arguments]) == 2
    assert capsys.readouterr().err == said


@pytest.mark.parametrize("given", ["0x800", "-1", "tester"])
def test_an_invalid_id_is_refused_with_what_was_expected(given, capsys):
    with pytest.raises(SystemExit) as ended:
        main(["a2l", "--config", str(_CONFIGURATION), "--output", "x.a2l", f"--request-id={given}"])
    assert ended.value.code == 2
    assert capsys.readouterr().err.endswith(f"--request-id: {given}: expected an 11-bit CAN id, 0 to 0x7ff\n")
