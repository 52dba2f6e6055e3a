"""A rig of several buses, and ours on another rig's: simulated, heard, and beside its force sensor."""

import threading
import time

import can
import cantools
import foreignkit
import numpy as np
import pytest
import wirekit

from emb_daemon.cli.main import main
from emb_daemon.errors import InputError, InputErrors
from emb_daemon.logs.live import MappedBus, ReferenceBus, SeveralBuses, open_buses, open_mapped
from emb_daemon.logs.mapping import Mapping
from emb_daemon.logs.simulated import SimulatedRig
from emb_daemon.monitor.listener import Listener, broadcast_ids
from emb_daemon.monitor.view import summary
from emb_daemon.offline import load_log
from emb_daemon.offline.log import log_of
from emb_daemon.wire.frames import FRAME
from emb_daemon.wire.layout import default_layout

#: Both buses use the same id.
_DRIVE = """VERSION ""
BU_: RIG
BO_ 291 Drive: 8 RIG
 SG_ Angle : 0|32@1- (0.001,0) [0|0] "rad" RIG
 SG_ Current : 32|16@1- (0.01,0) [0|0] "A" RIG
"""
_BENCH = """VERSION ""
BU_: RIG
BO_ 291 Cell: 8 RIG
 SG_ Load : 0|32@1- (0.1,0) [0|0] "N" RIG
"""
_MAPPING = """
format: 1
buses:
  inverter: {dbc: drive.dbc, channel: %s}
  bench: {dbc: bench.dbc, channel: %s}
signals:
  EMB_FL_Resolver.MotorAngle: {bus: inverter, signal: Drive.Angle}
  EMB_FL_Current.CurrentQ: {bus: inverter, signal: Drive.Current}
  RIG_FL_Force.ClampForceRef: {bus: bench, signal: Cell.Load}
"""


#: Of the one bus.
_ALONE = "format: 1\ndbc: drive.dbc\nsignals:\n  EMB_FL_Resolver.MotorAngle: {signal: Drive.Angle}\n"


def _mapping(folder, first="can0", second="can1", text=_MAPPING) -> Mapping:
    (folder / "drive.dbc").write_text(_DRIVE)
    (folder / "bench.dbc").write_text(_BENCH)
    (folder / "mapping.yaml").write_text(text % (first, second) if "%s" in text else text)
    return Mapping(folder / "mapping.yaml")


def _messages(columns: dict, channels=("can0", "can1")) -> list[can.Message]:
    drive = cantools.database.load_string(_DRIVE, "dbc").get_message_by_name("Drive")
    cell = cantools.database.load_string(_BENCH, "dbc").get_message_by_name("Cell")
    found = []
    for row, time_s in enumerate(columns["time_s"]):
        motion = {"Angle": columns["angle_rad"][row], "Current": columns["current_A"][row]}
        for channel, data in zip(
            channels, (drive.encode(motion), cell.encode({"Load": columns["force_N"][row]})), strict=True
        ):
            found.append(can.Message(100.0 + time_s, 291, False, data=data, channel=channel))
    return found


@pytest.fixture(scope="module")
def columns():
    return foreignkit.sampled(foreignkit.truth(foreignkit.random(seconds=1.5)), 250.0)


@pytest.mark.parametrize(("name", "first", "second"), [("a.log", "can0", "can1"), ("a.asc", 1, 2), ("a.blf", 1, 2)])
def test_the_same_id_on_two_buses_means_two_messages(columns, tmp_path, name, first, second):
    mapping = _mapping(tmp_path, first, second)
    numbered = ("can0", "can1") if name == "a.log" else (0, 1)
    with can.Logger(tmp_path / name) as log:
        for message in _messages(columns, numbered):
            log(message)
    log = load_log(tmp_path / name, read=mapping.read)
    assert np.abs(log.samples["angle"] - columns["angle_rad"]).max() < 0.002
    assert np.nanmax(np.abs(log.force_N - columns["force_N"])) < 0.2
    with pytest.raises(InputError, match=r"nothing of channel can7, which .* names; found "):
        load_log(tmp_path / name, read=_mapping(tmp_path, first, "can7").read)
    one = _MAPPING.partition("buses:")[0] + "dbc: drive.dbc\n" + _MAPPING[_MAPPING.index("signals:") :]
    one = "\n".join(line.replace("bus: inverter, ", "") for line in one.splitlines() if "Cell" not in line)
    with pytest.raises(InputError, match=r"Drive \(0x123\) comes from channels .*, and not the same; name the right one"):
        load_log(tmp_path / name, read=_mapping(tmp_path, text=one).read)


def test_a_message_that_a_gateway_copies_is_read_once(columns, tmp_path):
    with can.Logger(tmp_path / "a.log") as log:
        for message in _messages(columns)[::2]:
            log(message)
            message.timestamp, message.channel = message.timestamp + 2e-4, "can1"
            log(message)
    log = load_log(tmp_path / "a.log", read=_mapping(tmp_path, text=_ALONE).read)
    # Without a current the last sample still waits for one.
    assert len(log.samples) == len(columns["time_s"]) - 1
    assert np.abs(log.samples["angle"] - columns["angle_rad"][:-1]).max() < 0.002


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (_MAPPING.replace("bus: bench, ", ""), "bus: expected one of inverter, bench"),
        (_MAPPING.replace("bus: bench", "bus: other"), "bus: expected one of inverter, bench"),
        (_MAPPING.replace("Cell.Load", "Drive.Angle"), "the rig's DBC has no such message and signal"),
        (_MAPPING.replace("buses:", "dbc: drive.dbc\nbuses:"), "expected dbc or buses"),
    ],
)
def test_a_bus_is_named_where_there_are_several(tmp_path, wrong, said):
    with pytest.raises(InputErrors, match=said):
        _mapping(tmp_path, text=wrong)


def test_several_live_buses_are_received_by_channel(columns, tmp_path):
    mapping = _mapping(tmp_path, "several_a", "several_b")
    bus = MappedBus(open_buses({"interface": "virtual", "channel": "several_a"}, mapping), mapping)
    senders = {name: can.Bus(interface="virtual", channel=f"several_{name}") for name in "ab"}
    rows = []
    try:
        for drive, cell in zip(*[iter(_messages(columns))] * 2, strict=True):
            senders["b"].send(cell)
            senders["a"].send(drive)
            assert bus.wait(1.0)
            time.sleep(0.0005)
            rows += bus.drain().tolist()
        bus.send(wirekit.frame("EMB_FL_ClampForce", 0))
        assert senders["a"].recv(1.0).arbitration_id == 0x200 and senders["b"].recv(0.05) is None
    finally:
        bus.close()
        for sender in senders.values():
            sender.shutdown()
    angles = log_of(np.array(rows, FRAME)).samples["angle"]
    assert len(angles) > 10 and np.isin(np.round(angles, 2), np.round(columns["angle_rad"], 2)).mean() > 0.9


def test_two_of_ours_from_one_of_theirs_keep_their_scales(tmp_path):
    text = _ALONE + "  EMB_FR_Resolver.MotorAngle: {signal: Drive.Angle, scale: -2.0}\n"
    bus = MappedBus(SeveralBuses({}), _mapping(tmp_path, text=text))
    drive = cantools.database.load_string(_DRIVE, "dbc").get_message_by_name("Drive")
    frame = can.Message(0.0, 291, False, data=drive.encode({"Angle": 3.0, "Current": 0.0}))
    frames = np.array([row for cycle in range(1, 4) for row in bus.heard(frame, cycle * 4_000_000)], FRAME)
    angles = {corner: log_of(frames, corner).samples["angle"][-1] for corner in ("FL", "FR")}
    assert angles == pytest.approx({"FL": 3.0, "FR": -6.0}, abs=0.002)


def test_ids_of_the_daemon_are_not_taken_on_a_rig(tmp_path, capsys):
    _mapping(tmp_path, text=_ALONE)
    (tmp_path / "drive.dbc").write_text(_DRIVE.replace("BO_ 291 Drive", "BO_ 512 Drive"))
    mapping = Mapping(tmp_path / "mapping.yaml")
    with pytest.raises(InputErrors, match="Drive of the rig has id 0x200, with which the daemon sends"):
        open_mapped({"interface": "virtual"}, mapping, default_layout())
    arguments = ["check", "--mapping", str(mapping.path), "--config", "config/emb.yaml"]
    assert main(arguments) == 2 and "id 0x200" in capsys.readouterr().err
    (tmp_path / "drive.dbc").write_text(_DRIVE)
    assert main(arguments) == 0


class _Wire:
    """A python-can bus that keeps what is sent."""

    def __init__(self):
        self.sent: list[can.Message] = []

    def fileno(self):
        raise NotImplementedError

    def send(self, message):
        self.sent.append(message)


def test_simulated_messages_in_the_rigs_format_are_read_back_equal(tmp_path):
    mapping = Mapping(foreignkit.write_rig(tmp_path))
    wire = _Wire()
    rig, back = SimulatedRig(wire, mapping, []), MappedBus(_Wire(), mapping)
    sent = {
        "EMB_FL_Resolver": {"MotorAngle": -12.5, "MotorSpeed": 31.0},
        "EMB_FL_Current": {"CurrentQ": 7.25, "CurrentD": 0.0, "DcBusVoltage": 13.0},
        "EMB_FL_Thermocouple": {"InnerBackplateTemp": 85.0, "OuterBackplateTemp": 20.0, "CaliperTemp": 20.0},
    }
    rows = []
    for cycle in range(3):
        rig.send(np.concatenate([wirekit.frame(name, 0, cycle, **values) for name, values in sent.items()]))
        for message in wire.sent:
            assert message.is_extended_id and message.is_fd
            rows += back.heard(message, 1_000_000_000 + cycle * 4_000_000)
        wire.sent.clear()
    sample = log_of(np.array(rows, FRAME)).samples[-1]
    assert (sample["angle"], sample["speed"]) == pytest.approx((-12.5, 31.0), abs=0.02)
    assert sample["current_q"] == pytest.approx(7.25, abs=0.01)


def test_simulate_and_monitor_take_a_mapping(tmp_path, capsys):
    """The car on the rig's bus, its force sensor beside what a daemon broadcasts."""
    mapping, threads = foreignkit.write_rig(tmp_path), threading.active_count()
    listening = can.Bus(interface="virtual", channel="rigs", fd=True)
    bus = ["-i", "virtual", "-c", "rigs", "--mapping", str(mapping)]
    monitor = ReferenceBus(listening, Mapping(mapping), broadcast_ids())
    assert main(["simulate", "--corners", "1", "--seconds", "0.4", "--reference", *bus]) == 0
    broadcast = can.Bus(interface="virtual", channel="rigs")
    force = int(wirekit.frame("EMB_FL_ClampForce", 0, ClampForce=5.0, ClampForceSigma=0.1)["data"][0])
    broadcast.send(can.Message(0.0, 0x200, False, data=force.to_bytes(8, "little")))
    listener = Listener()
    listener.receive(monitor.drain())
    now = time.monotonic_ns()
    state = listener.corners[0].state(now)
    assert state["clamp_force_kN"] == 5.0 and abs(state["clamp_force_ref_kN"]) < 0.2
    assert "(reference " in summary(listener, now)[0]
    assert listener.corners[0].state(now + 1_000_000_000)["clamp_force_ref_kN"] is None
    for left in (broadcast, listening):
        left.shutdown()
    assert main(["monitor", "--once", "-i", "virtual", "--mapping", str(_columns(tmp_path))]) == 2
    assert "expected one with `dbc` for a live bus" in capsys.readouterr().err
    assert threading.active_count() <= threads


def _columns(folder):
    (folder / "columns.yaml").write_text(foreignkit.COLUMNS)
    return folder / "columns.yaml"
