"""Calibrating over XCP: a page is checked like a file, takes effect between ticks in a car that stands, and leaves nothing."""

import contextlib
import copy
import shutil
import struct
import threading
import time
from pathlib import Path

import adaptkit
import msgspec
import pytest
from test_xcp import _master

from emb_daemon.calibration.configuration import Setup
from emb_daemon.calibration.files import calibration_hash, load_calibration, save_calibration
from emb_daemon.calibration.parameters import CLEARANCE, TORQUE_CONSTANT, moved, value_of
from emb_daemon.calibration.types import to_parameters
from emb_daemon.cli.main import main
from emb_daemon.runtime.bus import open_bus
from emb_daemon.runtime.daemon import Daemon
from emb_daemon.runtime.pages import Answer, Page, PageClient, Request, socket_path
from emb_daemon.runtime.rawcan import socket_pair
from emb_daemon.runtime.shared import EstimatesReader
from emb_daemon.wire import layout as wire
from emb_daemon.workshop import ifdata, xcp
from emb_daemon.workshop.a2l import NAME, make_a2l, version_of
from emb_daemon.workshop.image import VERSION_ADDRESS, Image
from emb_daemon.workshop.measure import Can, Measurement, Udp
from emb_daemon.workshop.pages import FILES, SEGMENT_ADDRESS, WORKING, Segment, address_of, numbers
from emb_daemon.workshop.xcp import ON_CAN, ON_UDP, Slave

CONFIG = Path(__file__).parent.parent / "config"
SHIPPED = load_calibration(CONFIG / "calibration.yaml")
NUMBERS = numbers({"FL": SHIPPED})
HASH = calibration_hash(SHIPPED)
RANGE, NOT_NOW = b"\xfe\x22", b"\xfe\x33"


def page(values, corner="FL", file=HASH) -> Page:
    return Page({corner: values}, {corner: file})


def place(key) -> int:
    return address_of(NUMBERS.index(("FL", key)))


def rest(pipeline) -> None:
    """As if FL had just been heard, released, in a car that stands."""
    pipeline.corners["started"][0], pipeline.corners["predicted"][0], pipeline.corners["sample_ns"][0] = True, 0, 10**10
    pipeline.receptions["time_ns"][[wire.VEHICLE_STATUS, wire.WHEEL_SPEED]] = 10**10 - 10**8
    pipeline.receptions["values"][[wire.VEHICLE_STATUS, wire.WHEEL_SPEED]] = 0.0


def write_files(path):
    shutil.copy(CONFIG / "calibration.yaml", path)
    (path / "emb.yaml").write_text("format: 1\ncorners: {FL: {calibration: calibration.yaml}}\nxcp: {calibrate: true}\n")
    return path


@pytest.fixture
def folder(tmp_path):
    return write_files(tmp_path)


@pytest.fixture(scope="module")
def setup(tmp_path_factory):
    return Setup(write_files(tmp_path_factory.mktemp("setup")) / "emb.yaml")


@pytest.fixture
def daemon(folder, setup):
    bus, theirs = socket_pair()
    here = copy.copy(setup)
    here.path, here.parameters = folder / "emb.yaml", setup.parameters.copy()
    made = Daemon(here, theirs, state=folder / "state")
    made._adaptation._threaded = False
    made.share(folder / "estimates")
    made.take_pages(folder / "estimates")
    rest(made.pipeline)
    yield made
    made._listener.close()
    bus.close(), theirs.close()


def follow(daemon, until, seconds=20.0):
    """What the loop does from tick to tick."""
    end = time.monotonic() + seconds
    while not until():
        assert time.monotonic() < end, "not in time"
        daemon._follow_reload()
        time.sleep(0.001)


def ask(daemon, request: Page) -> Answer:
    asked, answers = Request(request), []
    thread = threading.Thread(target=lambda: answers.append(asked.wait()), daemon=True)
    thread.start()
    daemon.ask_page(asked)
    follow(daemon, lambda: answers)
    return answers[0]


def in_use(daemon) -> bytes:
    return daemon.pipeline.parameters[0].tobytes()


def of(values) -> bytes:
    return to_parameters(moved(SHIPPED, values)).tobytes()


# --- The daemon ---------------------------------------------------------------------------------------------------------


def test_a_page_is_used_as_a_file_with_its_numbers_would_be(daemon, folder, caplog):
    values = {CLEARANCE: 7.0, TORQUE_CONSTANT: 1.02 * value_of(SHIPPED, TORQUE_CONSTANT)}
    daemon.pipeline.states[0]["force"] = 123.0
    assert ask(daemon, page(values)) == Answer()
    assert in_use(daemon) == of(values) and daemon.pipeline.states[0]["force"] == 0.0, "as after a restart"
    assert "2 numbers differ from the file" in caplog.text
    reader = EstimatesReader(folder / "estimates")
    reader.look()
    assert reader.on_page
    # The same again changes nothing; fewer numbers are fewer numbers; none is the file.
    daemon.pipeline.corners["started"][0], daemon.pipeline.states[0]["force"] = True, 5.0
    assert ask(daemon, page(values)) == Answer() and daemon.pipeline.states[0]["force"] == 5.0
    assert ask(daemon, page({CLEARANCE: 7.0})) == Answer() and in_use(daemon) == of({CLEARANCE: 7.0})
    rest(daemon.pipeline)
    assert ask(daemon, Page({}, {})) == Answer() and in_use(daemon) == of({}) and not reader.on_page


@pytest.mark.parametrize("request_, said", [
    (page({CLEARANCE: -1.0}), f"corner FL: {CLEARANCE}: -1.0 outside"),
    (page({CLEARANCE: float("inf")}), f"corner FL: {CLEARANCE}: inf outside"),
    (page({"thermal.friction.force_N[1]": 1e9}), "ascending"),
    (page({"adaptation.parking_force_N": 1.0}), "adaptation.parking_force_N: not a number that a page may set"),
    (page({"motor.colour": 1.0}), "motor.colour: not a number that a page may set"),
    (page({CLEARANCE: 7.0}, "RR"), "corner RR: not estimated"),
    (page({CLEARANCE: 7.0}, file="another"), "corner FL: the calibration file has changed since the page was made"),
    (Page({"FL": {CLEARANCE: 7.0}}, {}), "corner FL: the calibration file has changed since the page was made"),
])  # fmt: skip
def test_what_no_file_may_hold_is_refused_and_nothing_changes(daemon, caplog, request_, said):
    answer = ask(daemon, request_)
    assert said in answer.refused and not answer.later and in_use(daemon) == of({})
    assert f"page refused: {answer.refused}" in caplog.text


def moving(pipeline):
    pipeline.receptions["values"][wire.VEHICLE_STATUS, wire.VEHICLE_SPEED] = 0.3


def turning(pipeline):
    pipeline.receptions["values"][wire.WHEEL_SPEED, 0] = 2.0


def braking(pipeline):
    pipeline.receptions["values"][wire.VEHICLE_STATUS, wire.BRAKE_REQUEST] = 10.0


def clamped(pipeline):
    pipeline.states[0]["contact"]["engaged"] = True


def silent(pipeline):
    pipeline.corners["predicted"][0] = 1


def not_started(pipeline):
    pipeline.corners["started"][0] = False


def no_status(pipeline):
    pipeline.receptions["time_ns"][wire.VEHICLE_STATUS] = 10**10 - 3 * 10**9


@pytest.mark.parametrize("circumstance, said", [
    (moving, "the vehicle moves"), (turning, "wheel FL turns"), (braking, "braking is requested"),
    (clamped, "corner FL is not released"), (silent, "corner FL sends no samples"),
    (not_started, "corner FL sends no samples"),
    (no_status, "no vehicle status is received"),
])  # fmt: skip
def test_a_page_is_taken_or_left_only_at_rest(daemon, caplog, circumstance, said):
    circumstance(daemon.pipeline)
    assert ask(daemon, page({CLEARANCE: 7.0})) == Answer(said, later=True) and in_use(daemon) == of({})
    assert f"page refused: {said}" in caplog.text
    if circumstance is moving:
        rest(daemon.pipeline)
        assert ask(daemon, page({CLEARANCE: 7.0})) == Answer()
        rest(daemon.pipeline)
        circumstance(daemon.pipeline)
        assert ask(daemon, Page({}, {})) == Answer(said, later=True) and in_use(daemon) == of({CLEARANCE: 7.0})


def test_after_reading_the_loop_gets_time_to_receive(daemon):
    silent(daemon.pipeline)
    request = Request(page({CLEARANCE: 7.0}))
    daemon.ask_page(request)
    follow(daemon, lambda: request.read_ns)
    assert in_use(daemon) == of({})
    rest(daemon.pipeline)
    follow(daemon, lambda: daemon._page is None)
    assert request.wait() == Answer() and in_use(daemon) == of({CLEARANCE: 7.0})


def test_pages_are_taken_one_after_the_other(daemon):
    silent(daemon.pipeline)
    first, second = Request(page({CLEARANCE: 7.0})), Request(page({CLEARANCE: 8.0}))
    daemon.ask_page(first)
    follow(daemon, lambda: first.read_ns)
    daemon.ask_page(second)
    daemon._follow_reload()
    for value in (7.0, 8.0):
        rest(daemon.pipeline)
        follow(daemon, lambda value=value: in_use(daemon) == of({CLEARANCE: value}))
    assert first.wait() == second.wait() == Answer()


def test_a_page_that_could_not_be_checked_is_refused(daemon, monkeypatch):
    """Whatever ends the check."""
    monkeypatch.setattr("emb_daemon.runtime.pages.moved", lambda *_, **__: 1 / 0)
    monkeypatch.setattr(threading, "excepthook", lambda _: None)
    assert ask(daemon, page({CLEARANCE: 7.0})).refused == "could not be checked" and in_use(daemon) == of({})


@pytest.mark.parametrize(("asked_s", "taken"), [(1, True), (4, False)])
def test_a_page_that_was_checked_too_late_is_refused(daemon, asked_s, taken):
    """Whoever asked for it no longer waits."""
    request = Request(page({CLEARANCE: 7.0}))
    request.asked_ns -= asked_s * 10**9
    daemon.ask_page(request)
    follow(daemon, lambda: daemon._asked is None and daemon._page is None)
    assert request.wait().later != taken and in_use(daemon) == of({CLEARANCE: 7.0} if taken else {})


def test_a_reload_that_waits_comes_first(daemon, folder):
    save_calibration(moved(SHIPPED, {CLEARANCE: 8.0}), folder / "calibration.yaml")
    daemon.pipeline.states[0]["started"] = True
    clamped(daemon.pipeline)
    daemon.reload()
    follow(daemon, lambda: daemon._waiting)
    assert "a reload is waiting" in ask(daemon, page({CLEARANCE: 7.0}, file=calibration_hash(load_calibration(
        folder / "calibration.yaml")))).refused  # fmt: skip


def test_a_reload_goes_back_to_the_file(daemon):
    ask(daemon, page({CLEARANCE: 7.0}))
    daemon.reload()
    follow(daemon, lambda: in_use(daemon) == of({}))
    assert not daemon._on_page


def test_a_page_ends_even_if_the_file_is_faulty_by_then(daemon, folder, caplog):
    ask(daemon, page({CLEARANCE: 7.0}))
    (folder / "calibration.yaml").write_text("[")
    daemon.reload()
    follow(daemon, lambda: in_use(daemon) == of({}))
    assert "the old one stays" in caplog.text and not daemon._on_page
    daemon.reload()
    follow(daemon, lambda: daemon._reader is None and not daemon._reload_wanted)
    assert in_use(daemon) == of({})


def test_nothing_is_learned_or_written_on_a_page(daemon, folder):
    state = folder / "state"
    daemon._adaptation._stores[0] = adaptkit.accepted(daemon._adaptation._stores[0])
    daemon._adaptation._memory.save(daemon._adaptation._stores[0])
    daemon._adaptation.restore(daemon.pipeline.parameters)
    learned = in_use(daemon)
    daemon.pipeline.states[0]["started"] = True
    daemon._adaptation._keep_snapshot(0, daemon.pipeline.states[0], daemon.pipeline.parameters[0])
    before = {path.name: path.read_bytes() for path in state.iterdir()}
    assert len(before) == 2 and learned != of({})
    ask(daemon, page({CLEARANCE: 7.0}))
    assert in_use(daemon) == of({CLEARANCE: 7.0}), "what was learned belongs to the file's calibration"
    assert not daemon._adaptation.limits["enabled"][0]
    daemon.pipeline.states[0]["started"] = True
    daemon._adaptation.close(daemon.pipeline.states, daemon.pipeline.parameters)
    assert {path.name: path.read_bytes() for path in state.iterdir()} == before
    rest(daemon.pipeline)
    assert ask(daemon, Page({}, {})) == Answer()
    assert in_use(daemon) == learned and daemon._adaptation.limits["enabled"][0]
    daemon.pipeline.states[0]["started"] = True
    daemon._adaptation.close(daemon.pipeline.states, daemon.pipeline.parameters)
    assert {path.name: path.read_bytes() for path in state.iterdir()} != before, "the file's are kept again"


# --- The socket ---------------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def looping(daemon):
    stopped = threading.Event()

    def loop():
        while not stopped.is_set():
            daemon._follow_reload()
            rest(daemon.pipeline)
            time.sleep(0.001)

    thread = threading.Thread(target=loop, daemon=True)
    thread.start()
    try:
        yield
    finally:
        stopped.set()
        thread.join()


def wait(condition, seconds=20.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "not in time"
        time.sleep(0.005)


def test_a_page_ends_with_its_client_and_the_next_client_may_ask(daemon, folder):
    path = socket_path(folder / "estimates")
    assert path.stat().st_mode & 0o777 == 0o600
    with looping(daemon):
        for clearance in (7.0, 8.0):
            client = PageClient(path)
            assert client.ask(page({CLEARANCE: clearance})) == Answer()
            assert in_use(daemon) == of({CLEARANCE: clearance})
            client.close()
            wait(lambda: in_use(daemon) == of({}))


def test_a_malformed_page_is_refused_and_the_next_is_accepted(daemon, folder, caplog):
    path, client = socket_path(folder / "estimates"), PageClient(socket_path(folder / "estimates"))
    with looping(daemon):
        for content in (b"{", b"[" * 100_000, b'{"values": {"FL": {"a": null}}, "files": {}}', b'{"values": {}}', b"\xff"):
            assert b"not understood" in client._exchange(content)
        assert client.ask(page({CLEARANCE: float("nan")})).refused
        assert in_use(daemon) == of({}) and client.ask(page({CLEARANCE: 7.0})) == Answer()
    assert "page refused: not understood" in caplog.text
    client.close()
    daemon._listener.close()
    assert not path.exists() and client.ask(page({})).later, "no daemon"
    wait(lambda: "pages" not in [thread.name for thread in threading.enumerate()])


def test_without_a_segment_commands_that_write_are_unknown(tmp_path):
    assert not Setup(CONFIG / "emb.yaml").configuration.xcp.calibrate
    slave = Slave(Image(b""), ON_UDP, lambda: 0, b"", b"")
    assert slave.answer(b"\xff\x00")[1] == 4, "acquisition alone"
    for code in (0xF0, 0xEF, 0xEE, 0xED, 0xEC, 0xEB, 0xEA, 0xE9, 0xE8, 0xE7, 0xE6, 0xE5, 0xE4, 0xD2, 0xD0):
        assert slave.answer(bytes([code]) + bytes(20)) == bytes([0xFE, xcp.UNKNOWN])


# --- Packets ------------------------------------------------------------------------------------------------------------


class _Bench:
    """A slave whose daemon answers as told; ``asked`` are the pages."""

    def __init__(self, transport=ON_UDP):
        self.asked, self.says, self.on_page = [], Answer(), False
        self.segment = Segment({"FL": SHIPPED}, self._ask, lambda: self.on_page)
        self.slave = Slave(Image(b""), transport, lambda: 0, b"", b"", self.segment)
        self.slave.answer(b"\xff\x00")

    def _ask(self, asked):
        self.asked.append(asked.values)
        if not self.says.refused:
            self.on_page = bool(asked.values)
        return self.says

    def do(self, layout, *values, data=b""):
        return self.slave.answer(struct.pack("<" + layout, *values) + data)

    def write(self, key, value):
        return self.do("BBBBI", 0xED, 8, 0, 0, place(key), data=struct.pack("<d", value))

    def read(self, key):
        return struct.unpack("<d", self.do("BBBBI", 0xF4, 8, 0, 0, place(key))[1:])[0]

    def use(self, number, mode=1):
        return self.do("BBBB", 0xEB, mode, 0, number)

    def used(self):
        return self.do("BBB", 0xEA, 1, 0)[3]


@pytest.mark.parametrize("transport, command, said", [
    (ON_UDP, "ff 00", "05 80 fc 78 05 01 01"), (ON_CAN, "ff 00", "05 80 08 08 00 01 01"), (ON_UDP, "fd", "00 00 00 00 00"),
    (ON_UDP, "fb", "00 00 00 00 00 00 00"), (ON_UDP, "da", "93 10 00 04 00 00 00"), (ON_UDP, "d9", "01 ff 01 00 34 01 00"),
    (ON_CAN, "d9", "01 07 01 00 52 01 00"), (ON_UDP, "d7 00 00 00", "84 10 02 04 06 00"), (ON_UDP, "e9", "01 00"),
    (ON_UDP, "e8 01 00 00 00", "02 00 00 00 00"), (ON_UDP, "e7 00 00 00", "3f 00"), (ON_UDP, "e7 00 00 01", "0f 00"),
])  # fmt: skip
def test_answers_have_the_bytes_of_the_standard(transport, command, said):
    assert _Bench(transport).slave.answer(bytes.fromhex(command)).hex(" ") == f"ff {said}"


def test_setting_the_working_page_asks_the_daemon_and_the_files_page_is_unchanged():
    bench = _Bench()
    assert bench.write(CLEARANCE, 7.0) == b"\xff" and not bench.asked and bench.used() == FILES
    assert bench.read(CLEARANCE) == 7.0
    assert bench.use(FILES, 2) == b"\xff" and bench.read(CLEARANCE) == SHIPPED.contact.clearance_rad
    assert bench.write(CLEARANCE, 8.0) == b"\xfe\x23", "the files' page"
    assert bench.use(WORKING, 0x83) == b"\xff" and bench.asked == [{"FL": {CLEARANCE: 7.0}}] and bench.used() == WORKING
    bench.on_page = False
    assert bench.used() == FILES, "a reload, or another daemon"


def test_a_refusal_of_the_daemon_is_reported_and_the_page_stays():
    bench = _Bench()
    for later, error in ((False, RANGE), (True, NOT_NOW)):
        bench.says = Answer("why", later)
        bench.write(CLEARANCE, 7.0)
        assert bench.use(WORKING) == error and bench.used() == FILES and bench.read(CLEARANCE) == 7.0


def test_a_number_on_the_page_in_use_takes_effect_whole_or_not_at_all():
    bench = _Bench(ON_CAN)
    assert bench.use(WORKING) == b"\xff" and bench.used() == WORKING
    bench.asked.clear()
    content = struct.pack("<d", 7.0)
    assert bench.do("BxxBI", 0xF6, 0, place(CLEARANCE)) == b"\xff"
    assert bench.do("BB", 0xF0, 6, data=content[:6]) == b"\xff" and not bench.asked, "half a number"
    assert bench.do("BB", 0xF0, 2, data=content[6:]) == b"\xff" and bench.asked == [{"FL": {CLEARANCE: 7.0}}]
    bench.says = Answer("why")
    bench.do("BxxBI", 0xF6, 0, place(CLEARANCE))
    assert bench.do("BB", 0xF0, 6, data=b"\xff" * 6) == b"\xff"
    assert bench.do("BB", 0xF0, 2, data=b"\xff" * 2) == RANGE
    assert bench.segment.read(place(CLEARANCE), 8) == content, "undone"


def test_the_working_page_can_be_filled_from_the_files_unless_it_is_used():
    bench = _Bench()
    bench.write(CLEARANCE, 7.0)
    assert bench.do("BBBBB", 0xE4, 0, FILES, 0, WORKING) == b"\xff" and bench.read(CLEARANCE) == SHIPPED.contact.clearance_rad
    bench.write(CLEARANCE, 7.0)
    bench.use(WORKING)
    assert bench.do("BBBBB", 0xE4, 0, FILES, 0, WORKING) == b"\xfe\x23"
    assert bench.do("BBBBB", 0xE4, 0, WORKING, 0, FILES) == b"\xfe\x23"


@pytest.mark.parametrize("command, code", [
    ("eb 00 00 00", xcp.MODE_NOT_VALID), ("eb 05 00 00", xcp.MODE_NOT_VALID), ("eb 01 01 00", xcp.SEGMENT_NOT_VALID),
    ("eb 01 00 02", xcp.PAGE_NOT_VALID), ("ea 03 00", xcp.MODE_NOT_VALID), ("e7 00 00 02", xcp.PAGE_NOT_VALID),
    ("e8 02 00 00 00", xcp.OUT_OF_RANGE), ("e4 00 02 00 00", xcp.PAGE_NOT_VALID), ("f0 01 00", xcp.ACCESS_DENIED),
    ("ed 08 00 00 00 10 00 00 00 00 00 00 00 00 00 00", xcp.ACCESS_DENIED), ("ed 00 00 00 00 00 10 00", xcp.OUT_OF_RANGE),
    ("ed 08 00 00 00 00 10 00 00", xcp.SYNTAX), ("ed 01 00 01 00 00 10 00 00", xcp.ACCESS_DENIED),
    ("ed 08 00 00 ff ff 0f 00 00 00 00 00 00 00 00 00", xcp.ACCESS_DENIED),
])  # fmt: skip
def test_what_cannot_be_written_is_refused(command, code):
    bench = _Bench()
    assert bench.slave.answer(bytes.fromhex(command)) == bytes([0xFE, code]) and not bench.asked


# --- A master, the server, the daemon -----------------------------------------------------------------------------------


@contextlib.contextmanager
def served(daemon, folder, transport):
    setup = Setup(folder / "emb.yaml")
    version, file = version_of(setup.calibrations, True), make_a2l(setup.calibrations, ifdata.over_udp("localhost", 1), True)
    measurement = Measurement(folder / "estimates", transport, version.encode(), NAME.encode(), file, setup.calibrations)
    stopped = threading.Event()

    def run():
        while not stopped.is_set():
            measurement.step()

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    try:
        with looping(daemon):
            yield version
    finally:
        stopped.set()
        thread.join()
        transport.close()
        measurement._pages.close()


def test_a_master_calibrates_over_udp(daemon, folder, caplog, capsys):
    pytest.importorskip("pyxcp", reason="NOT RUN: pyxcp is not installed")
    from pyxcp.master.errorhandler import SystemExit as Refused

    transport = Udp("127.0.0.1", 0)
    with served(daemon, folder, transport) as version:
        with _master("Eth", host="127.0.0.1", port=transport.port, protocol="UDP") as (master, _):
            assert master.slaveProperties.supportsCalpag
            master.setMta(VERSION_ADDRESS)
            assert bytes(master.fetch(len(version))) == version.encode()
            assert master.getPagProcessorInfo().maxSegments == 1
            assert [master.getSegmentInfo(0, 0, what, 0).basicInfo for what in (0, 1)] == [SEGMENT_ADDRESS, 8 * len(NUMBERS)]
            assert master.getSegmentInfo(1, 0, 0, 0).maxPages == 2
            assert master.getPageInfo(0, WORKING).properties.xcp_write_access_with_ecu
            assert not master.getPageInfo(0, FILES).properties.xcp_write_access_with_ecu
            master.setMta(place(CLEARANCE))
            master.download(struct.pack("<d", 7.0))
            assert in_use(daemon) == of({}) and master.getCalPage(1, 0) == FILES
            master.setCalPage(0x83, 0, WORKING)
            assert in_use(daemon) == of({CLEARANCE: 7.0}) and master.getCalPage(1, 0) == WORKING
            with pytest.raises(Refused, match="ERR_OUT_OF_RANGE"):
                master.shortDownload(place(CLEARANCE), 0, struct.pack("<d", -1.0))
            assert in_use(daemon) == of({CLEARANCE: 7.0}) and "page refused: corner FL" in caplog.text
            master.shortDownload(place(CLEARANCE), 0, struct.pack("<d", 8.0))
            assert in_use(daemon) == of({CLEARANCE: 8.0})
            master.setCalPage(1, 0, FILES)
            assert in_use(daemon) == of({})
            master.setCalPage(1, 0, WORKING)
        time.sleep(0.1)
        assert in_use(daemon) == of({CLEARANCE: 8.0}), "a tool may leave: the car is driven without it"
    with looping(daemon):
        wait(lambda: in_use(daemon) == of({}))
    assert "page refused: corner FL" in capsys.readouterr().err


def test_a_master_calibrates_over_can(daemon, folder, request):
    pytest.importorskip("pyxcp", reason="NOT RUN: pyxcp is not installed")
    transport = Can(open_bus("virtual", request.node.name, [0x720]), 0x720, 0x728)
    options = {"interface": "virtual", "channel": request.node.name, "can_id_master": 0x720, "can_id_slave": 0x728}
    with served(daemon, folder, transport), _master("CAN", **options) as (master, _):
        master.setCalPage(0x83, 0, WORKING)
        master.setMta(place(CLEARANCE))
        for part in (slice(0, 6), slice(6, 8)):
            assert in_use(daemon) == of({})
            master.download(struct.pack("<d", 7.0)[part])
        assert in_use(daemon) == of({CLEARANCE: 7.0})
        master.setMta(place(CLEARANCE))
        assert bytes(master.fetch(8)) == struct.pack("<d", 7.0)


# --- The A2L file -------------------------------------------------------------------------------------------------------


_COMMANDS = xcp.READING | xcp.CALIBRATING
_AT_UDP = {"XCP_ON_UDP_IP": [256, 5555, {"ADDRESS": "192.168.1.10"}]}
_AT_CAN = {"XCP_ON_CAN": [256, {"CAN_ID_MASTER": 0x720, "CAN_ID_SLAVE": 0x728, "BAUDRATE": 500000}]}


def test_a_tool_connects_and_calibrates_from_the_file_alone(folder):
    pya2l = pytest.importorskip("pya2l", reason="NOT RUN: pya2ldb is not installed")
    from pya2l import model

    assert main(["a2l", "--config", str(folder / "emb.yaml"), "--output", str(folder / "e.a2l"),
                 "--udp", "192.168.1.10:5555"]) == 0  # fmt: skip
    session = pya2l.import_a2l(str(folder / "e.a2l"), in_memory=True, progress_bar=False, loglevel="ERROR")
    [over_udp] = session.parse_ifdata(session.query(model.Module).one().if_data)
    over_can = session._ifdata_parser.parse(ifdata.module_block(ifdata.over_can(0x720, 0x728, 500000), True).strip())
    for parsed, layer, transport in ((over_udp, ON_UDP, _AT_UDP), (over_can, ON_CAN, _AT_CAN)):
        content = parsed["XCP"]
        assert {name: content[name] for name in transport} == transport and content["PAG"] == [1]
        assert content["PROTOCOL_LAYER"][8:10] == [layer.max_cto, layer.max_dto]
        assert [event[2] for event in content["DAQ"][-1]["EVENT"]] == [0, 1, 2, 3]
        # What the file says is there, is.
        slave = _Bench(layer).slave
        for name in content["PROTOCOL_LAYER"][-1]["OPTIONAL_CMD"]:
            assert slave.answer(bytes([_COMMANDS[name].code])) != bytes([0xFE, xcp.UNKNOWN]), name
    segment = session.query(model.MemorySegment).one()
    assert (segment.address, segment.size) == (SEGMENT_ADDRESS, 8 * len(NUMBERS))
    [[*_, numbered]] = [entry["XCP"]["SEGMENT"] for entry in session.parse_ifdata(segment.if_data)]
    assert [(number, write) for number, *_, write in numbered["PAGE"]] == [
        (WORKING, "XCP_WRITE_ACCESS_DONT_CARE"), (FILES, "XCP_WRITE_ACCESS_NOT_ALLOWED")]  # fmt: skip
    written = {entry.name: entry for entry in session.query(model.Characteristic) if ".page." in entry.name}
    pages = Segment({"FL": SHIPPED}, None, None)
    assert len(written) == len(NUMBERS)
    for name, entry in written.items():
        [value] = struct.unpack("<d", pages.read(entry.address, 8))
        assert value == value_of(SHIPPED, name.removeprefix("FL.page."))
        assert entry.lowerLimit <= value <= entry.upperLimit and not entry.read_only
    conversion = session.query(model.CompuMethod).filter_by(name=written[f"FL.page.{CLEARANCE}"].conversion).one()
    assert conversion.unit == "rad" and written[f"FL.page.{CLEARANCE}"].lowerLimit == 0.0
    assert session.query(model.Epk).one().identifier == version_of({"FL": SHIPPED}, True)
    session.close()


def test_the_codes_of_commands_are_the_standards():
    types = pytest.importorskip("pyxcp.types", reason="NOT RUN: pyxcp is not installed")
    for name, command in _COMMANDS.items():
        assert int(types.Command[name]) == command.code


def test_another_layout_of_numbers_has_another_version():
    without = msgspec.structs.replace(SHIPPED, effects={})
    assert version_of({"FL": SHIPPED}, True) != version_of({"FL": without}, True)
    assert version_of({"FL": SHIPPED}, False) == version_of({"FL": without}, False)
