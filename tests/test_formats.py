"""Logs in and out: every format back and forth on a rig log, other rigs' logs through a mapping file, a truck's MDF4 log."""

import json
import math

import can
import cantools
import numpy as np
import pyarrow.parquet
import pytest
from foreignkit import load_mapped, write_mapping

from emb_daemon.cli.main import main
from emb_daemon.errors import InputError, InputErrors
from emb_daemon.logs.columns import Decoder
from emb_daemon.logs.mapping import Mapping
from emb_daemon.logs.read import read_frames, read_log
from emb_daemon.logs.write import write_frames
from emb_daemon.offline import load_log
from emb_daemon.resources import resource
from emb_daemon.wire.frames import EXTENDED, REMOTE
from emb_daemon.wire.layout import load_database

_THEIR_DBC = """VERSION ""
BU_: RIG
BO_ 2566844161 Actuator: 8 RIG
 SG_ Position : 7|32@0- (0.01,0) [0|0] "deg" RIG
 SG_ Speed : 39|32@0- (0.01,0) [0|0] "rpm" RIG

BO_ 801 Inverter: 6 RIG
 SG_ Iq : 0|16@1- (5,0) [0|0] "mA" RIG
 SG_ Load : 16|32@1- (0.0001,0) [0|0] "kN" RIG

BO_ 802 Climate: 8 RIG
 SG_ Inner : 0|16@1+ (0.05,0) [0|0] "K" RIG
 SG_ Outer : 16|16@1+ (0.05,0) [0|0] "K" RIG
 SG_ Nameless : 32|16@1+ (1,0) [0|0] "" RIG
"""

_MAPPING = """
format: 1
dbc: their.dbc
signals:
  EMB_FL_Resolver.MotorAngle: {signal: Actuator.Position}
  EMB_FL_Resolver.MotorSpeed: {signal: Actuator.Speed}
  EMB_FL_Current.CurrentQ: {signal: Inverter.Iq, scale: -1.0}
  EMB_FL_Thermocouple.InnerBackplateTemp: {signal: Climate.Inner}
  EMB_FL_Thermocouple.OuterBackplateTemp: {signal: Climate.Outer}
  EMB_FL_Thermocouple.CaliperTemp: {signal: Climate.Inner, offset: -1.5}
  VEH_WheelSpeed.WheelSpeedFL: {value: 0.0}
  RIG_FL_Force.ClampForceRef: {signal: Inverter.Load}
"""


def _write_rig(folder, mapping: str = _MAPPING) -> None:
    (folder / "their.dbc").write_text(_THEIR_DBC)
    (folder / "mapping.yaml").write_text(mapping)


@pytest.fixture(scope="module")
def log(rig):
    return rig / "static" / "sine_5Hz.log.gz"


@pytest.fixture
def foreign(log, tmp_path):
    """The rig's log of another rig: extended id, big-endian, other units, a reversed current, dots in its name, no E2E."""
    _write_rig(tmp_path)
    theirs = cantools.database.load_file(tmp_path / "their.dbc")
    ours = load_log(log)
    frames = []

    def put(time_ns, name, **values):
        message = theirs.get_message_by_name(name)
        data = message.encode(values)
        frames.append(can.Message(1e-9 * time_ns, message.frame_id, message.is_extended_frame, data=data, channel=1))

    for sample, time_ns, force in zip(ours.samples, ours.time_ns, ours.force_N, strict=True):
        put(time_ns, "Actuator", Position=math.degrees(sample["angle"]), Speed=sample["speed"] * 30.0 / math.pi)
        put(time_ns, "Inverter", Iq=-1e3 * sample["current_q"], Load=0.0 if math.isnan(force) else 1e-3 * force)
        if sample["has_thermocouple"]:
            kelvin = sample["inner_backplate"] + 273.15
            put(time_ns + 200_000, "Climate", Inner=kelvin, Outer=kelvin, Nameless=0)
    path = tmp_path / "day.1.of.2.blf"
    with can.BLFWriter(tmp_path / "x.blf") as writer:
        for frame in frames:
            writer(frame)
    (tmp_path / "x.blf").rename(path)
    return path


def test_another_rigs_log_gives_the_same_samples(foreign, log, tmp_path):
    ours = load_log(log)
    theirs = load_mapped(foreign)
    assert abs(len(theirs.samples) - len(ours.samples)) <= 1
    count = min(len(theirs.samples), len(ours.samples))
    assert np.abs(theirs.samples["angle"] - ours.samples["angle"])[:count].max() < 3e-4
    assert np.abs(theirs.samples["speed"] - ours.samples["speed"])[:count].max() < 0.03
    assert np.all(theirs.samples["dt"][1:] == 0.004)
    assert np.abs(theirs.samples["current_q"] - ours.samples["current_q"])[:count].max() < 0.02
    # A thermocouple is heard when its frame comes; between frames there is noise of some tenths of a kelvin.
    warm = theirs.samples["inner_backplate"][100:count] - ours.samples["inner_backplate"][100:count]
    assert np.abs(np.mean(warm)) < 0.1 and np.abs(warm).max() < 1.5
    assert np.abs(theirs.samples["inner_backplate"] - theirs.samples["caliper"])[100:].max() == pytest.approx(1.5, abs=0.11)
    assert np.nanmax(np.abs(theirs.force_N - ours.force_N)[:count]) <= 0.2


def test_another_rigs_log_is_judged_like_ours(foreign, log, tmp_path, capsys):
    # A bench says that its disc stands, and that nobody brakes or parks.
    status = "".join(f"  VEH_Status.{name}: {{value: 0.0}}\n" for name in ("VehicleSpeed", "ParkBrake", "BrakeRequest"))
    status += "  VEH_Status.AmbientTemp: {value: 22.0}\n"
    (tmp_path / "mapping.yaml").write_text(_MAPPING + status)
    figures = []
    for arguments in ([str(log)], [str(foreign), "--mapping", str(tmp_path / "mapping.yaml")]):
        assert main(["replay", *arguments, "--json"]) == 0
        figures.append(json.loads(capsys.readouterr().out)["logs"][0]["force_N"]["fused"]["rmse"])
    assert figures[1] == pytest.approx(figures[0], rel=0.05)


def test_a_reference_that_is_not_mapped_is_absent_and_not_zero(foreign, tmp_path, capsys):
    log = load_mapped(foreign)
    assert np.isfinite(log.reference.clamp_force_N).all() and len(log.reference.clamp_force_N) > 1000
    assert np.isnan(log.reference.disc_C).all() and np.isnan(log.reference.brake_torque_Nm).all()
    table = tmp_path / "out.parquet"
    mapping = str(tmp_path / "mapping.yaml")
    assert main(["replay", str(foreign), "--mapping", mapping, "--output", str(table), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["logs"][0]["temperature_K"] == {}
    references = [name for name in pyarrow.parquet.read_table(table).column_names if "_ref_" in name]
    assert references == ["clamp_force_ref_N"]


@pytest.mark.parametrize("period_ms", [1.0, 3.0, 10.0])
def test_other_sampling_rates_are_brought_to_ours(tmp_path, period_ms):
    """A steady 20 rad/s ramp sampled at another rate is the same ramp at 250 Hz."""
    _write_rig(tmp_path)
    message = cantools.database.load_file(tmp_path / "their.dbc").get_message_by_name("Actuator")
    with can.BLFWriter(tmp_path / "ramp.blf") as writer:
        for number in range(int(2000 / period_ms)):
            time_s = 1e-3 * period_ms * number
            data = message.encode({"Position": math.degrees(20.0 * time_s), "Speed": 20.0 * 30.0 / math.pi})
            writer(can.Message(1_790_000_000 + time_s, message.frame_id, True, data=data, channel=1))
    samples = load_mapped(tmp_path / "ramp.blf").samples
    assert 490 <= len(samples) <= 500 and np.all(samples["dt"][1:] == 0.004)
    assert np.abs(np.diff(samples["angle"]) - 0.08).max() < 6e-4


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("{signal: Actuator.Position}", "{signal: Inverter.Iq}", "Inverter.Iq is in 'mA'; expected rad, deg"),
        (
            "{signal: Actuator.Position}",
            "{signal: Climate.Nameless}",
            "is in no unit; expected rad, deg, °, mrad, rev, turn; state `unit:`",
        ),
        ("{signal: Actuator.Position}", "{signal: Actuator.Place}", "no such message and signal"),
        ("{signal: Actuator.Position}", "{signal: Inverter.Position}", "did you mean Actuator.Position?"),
        (
            "VEH_WheelSpeed.WheelSpeedFL: {value: 0.0}",
            "VEH_Status.ParkBrake: {signal: Inverter.Iq}",
            "is in 'mA'; expected none, 1, -; of a number without one state `unit: \"1\"`",
        ),
        ("{signal: Actuator.Position}", "{signal: Actuator.Position, unit: furlong}", "is in 'furlong'; expected rad"),
        ("{signal: Actuator.Position}", "{signal: Actuator.Position, value: 3.0}", "either signal"),
        ("{signal: Actuator.Position}", "{signal: Actuator.Position, factor: 3.0}", "unknown key"),
        ("EMB_FL_Resolver.MotorAngle", "EMB_FL_ClampForce.ClampForce", "expected Message.Signal of what the daemon receives"),
        ("EMB_FL_Resolver.MotorAngle", "EMB_FL_Resolver.Angle", "no such signal to map"),
        ("VEH_WheelSpeed.WheelSpeedFL: {value: 0.0}", "VEH_Status.AmbientTemp: {value: 20.0}", "ParkBrake: missing"),
        ("dbc: their.dbc", "dbc: none.dbc", "no such file"),
        ("{value: 0.0}", "{value: 400.0}", "signals.VEH_WheelSpeed.WheelSpeedFL: value: 400; expected 0 to 204.75 rad/s"),
    ],
)
def test_a_faulty_mapping_is_refused_with_its_key(tmp_path, old, new, expected):
    assert old in _MAPPING
    _write_rig(tmp_path, _MAPPING.replace(old, new))
    with pytest.raises((InputError, InputErrors), match=None) as caught:
        Mapping(tmp_path / "mapping.yaml")
    assert expected in str(caught.value)


def test_a_log_without_the_mapped_frames_is_named(log, tmp_path):
    _write_rig(tmp_path)
    with pytest.raises(InputError, match=r"no value of Actuator\.Position"):
        Mapping(tmp_path / "mapping.yaml").read(log)


#: A truck's DBC as it is sold: groups whose sender is 254, anyone.
_TRUCK_DBC = """VERSION ""
BU_: T
BO_ 2364540158 EEC1: 8 T
 SG_ EngineSpeed : 24|16@1+ (0.125,0) [0|8031.875] "rpm" T

BO_ 2566844926 CCVS1: 8 T
 SG_ Speed : 8|16@1+ (0.00390625,0) [0|250.996] "km/h" T
 SG_ Brake : 28|2@1+ (1,0) [0|3] "" T
"""
_TRUCK_MAPPING = """format: 1
dbc: truck.dbc
signals:
  EMB_FL_Resolver.MotorSpeed: {signal: EEC1.EngineSpeed}
  VEH_WheelSpeed.WheelSpeedFL: {signal: CCVS1.Speed, unit: rad/s, scale: 0.5}
"""


def _truck(folder, senders=(0x00,), priority=3) -> str:
    """A second of a truck's bus: 800 rpm of each sender, and from the middle on a wheel speed that is not available."""
    (folder / "truck.dbc").write_text(_TRUCK_DBC)
    (folder / "truck.yaml").write_text(_TRUCK_MAPPING)
    lines = []
    for tick in range(100):
        stamp, speed = f"({tick / 100:.6f}) can0", "000A" if tick < 50 else "FFFF"
        lines += [f"{stamp} {(priority << 26) | 0xF00400 | sender:08X}#0A00FF0019FFFFFF" for sender in senders]
        lines.append(f"{stamp} 18FEF131#FF{speed}FFFFFFFFFF")
    (folder / "truck.log").write_text("\n".join(lines) + "\n")
    return str(folder / "truck.log")


@pytest.mark.parametrize("priority", [3, 6])
def test_a_j1939_group_is_read_whoever_sends_it(tmp_path, priority):
    """SAE J1939-21: priority and sender are no part of what a frame means; J1939-71: 0xFFFF is no speed of 65535."""
    path = _truck(tmp_path, priority=priority)
    frames = Mapping(tmp_path / "truck.yaml").read(path)
    speed = Decoder().columns(frames, "EMB_FL_Resolver")["MotorSpeed"]
    assert speed[10:-10] == pytest.approx(800.0 * math.pi / 30.0, abs=0.02)
    wheel = Decoder().columns(frames, "VEH_WheelSpeed")
    assert wheel["WheelSpeedFL"] == pytest.approx(5.0, abs=0.05)
    assert 1e-9 * (wheel["time_ns"][-1] - frames["time_ns"][0]) < 0.75, "what is not available is not carried on"


def test_a_j1939_group_of_two_senders_is_not_mixed(tmp_path):
    path = _truck(tmp_path, senders=(0x00, 0x21))
    with pytest.raises(InputError, match="EEC1 comes from several senders, as 0xcf00400, 0xcf00421"):
        Mapping(tmp_path / "truck.yaml").read(path)
    (tmp_path / "truck.dbc").write_text(_TRUCK_DBC.replace("2364540158", str(0x8CF00421)))
    assert len(Mapping(tmp_path / "truck.yaml").read(path)) > 200


def test_a_dbc_of_other_people_may_overlap_and_be_utf8(tmp_path, capsys):
    path = _truck(tmp_path)
    more = ' SG_ Overlap : 20|16@1+ (1,0) [0|0] "" T\n SG_ Place : 0|16@1+ (1,0) [0|0] "°" T\n'
    broken = _TRUCK_DBC.replace("\nBO_ 2566844926", more + "\nBO_ 2566844926").replace('"rpm"', '"U/min"')
    (tmp_path / "truck.dbc").write_text(broken, encoding="utf-8")
    speed = Decoder().columns(Mapping(tmp_path / "truck.yaml").read(path), "EMB_FL_Resolver")["MotorSpeed"]
    assert speed[10:-10] == pytest.approx(800.0 * math.pi / 30.0, abs=0.02)
    mapping = _TRUCK_MAPPING + "  EMB_FL_Resolver.MotorAngle: {signal: EEC1.Place}\n"
    (tmp_path / "truck.yaml").write_text(mapping)
    angle = Decoder().columns(Mapping(tmp_path / "truck.yaml").read(path), "EMB_FL_Resolver")["MotorAngle"]
    assert angle == pytest.approx(math.radians(10.0), abs=1e-3)
    for wrong, said in (("EEC1.EnginSpeed", "did you mean EEC1.EngineSpeed"), ("CCVS1.Breke", "did you mean CCVS1.Brake")):
        (tmp_path / "truck.yaml").write_text(mapping.replace("EEC1.EngineSpeed", wrong))
        assert main(["check", "--mapping", str(tmp_path / "truck.yaml")]) == 2
        assert said in capsys.readouterr().err
    (tmp_path / "truck.yaml").write_text(mapping)
    (tmp_path / "truck.dbc").write_text(broken.replace('0|16@1+ (1,0) [0|0] "°', '60|16@1+ (1,0) [0|0] "°'), encoding="utf-8")
    assert main(["check", "--mapping", str(tmp_path / "truck.yaml")]) == 2
    assert "EEC1.Place: the rig's DBC contradicts itself" in capsys.readouterr().err


def test_a_multiplexer_of_an_unknown_number_is_no_value(tmp_path):
    (tmp_path / "x.dbc").write_text(
        'VERSION ""\nBU_: T\nBO_ 256 M: 8 T\n SG_ Which M : 0|8@1+ (1,0) [0|0] "" T\n'
        ' SG_ Angle m1 : 8|16@1+ (0.01,0) [0|0] "rad" T\n'
    )
    mapping = write_mapping(tmp_path, "dbc: x.dbc", MotorAngle="signal: M.Angle")
    lines = [f"({0.002 * tick:.6f}) can0 100#{1 + tick % 2:02X}{'D007' if tick % 2 == 0 else 'FFFF'}" for tick in range(200)]
    (tmp_path / "x.log").write_text("\n".join(lines) + "\n")
    angle = Decoder().columns(mapping.read(tmp_path / "x.log"), "EMB_FL_Resolver")["MotorAngle"]
    assert len(angle) > 90 and angle == pytest.approx(20.0, abs=0.01)


_FAULTY = """VERSION ""
BU_: T
BO_ 256 M: 8 T
 SG_ Angle : 0|16@1+ (0.01,0) [0|0] "rad" T
 SG_ 0_COUNTER : 16|8@1+ (1,0) [0|0] "" T

BO_ 1275 2017_5: 8 T
 SG_ Angle2 : 0|16@1+ (0.01,0) [0|0] "rad" T

BO_ 316494249 Long: 8 T
 SG_ Speed : 0|16@1- (0.01,0) [0|0] "rad/s" T

BO_ 1074005561 Impossible: 8 T
 SG_ Speed : 0|16@1- (0.01,0) [0|0] "rad/s" T

CM_ "a comment without its end"
BO_ 257 Last: 8 T
 SG_ Iq : 0|16@1- (0.01,0) [0|0] "A" T

VAL_ 256 Gone 0 "no" 1 "yes" ;
VAL_ 316494249 Speed 0 "stands" ;
"""


def test_a_dbc_with_faults_that_other_tools_accept_is_read(tmp_path, capsys):
    """As those that enthusiasts keep of cars: one in six is refused by cantools for what nobody maps."""
    (tmp_path / "x.dbc").write_text(_FAULTY)
    signals = {"MotorAngle": "signal: M.Angle", "MotorSpeed": "signal: Long.Speed", "CurrentQ": "signal: Last.Iq"}
    mapping, lines = write_mapping(tmp_path, "dbc: x.dbc", **signals), []
    for tick in range(500):
        at = f"({0.004 * tick:.6f}) can0"
        lines += [f"{at} 100#D007000000000000", f"{at} 12DD51A9#0000000000000000", f"{at} 101#6400000000000000"]
    (tmp_path / "x.log").write_text("\n".join(lines) + "\n")
    told, faulty_lines = capsys.readouterr().err, (f"line {number} is no DBC's" for number in (5, 7, 16))
    assert all(left_out in told for left_out in (*faulty_lines, "BO_ 1074005561", "says of Gone, not in"))
    # What was of a message that is left out is not of the one before.
    assert {signal.name for signal in mapping.databases[None].get_message_by_name("M").signals} == {"Angle"}
    found = mapping.read(tmp_path / "x.log")
    assert Decoder().columns(found, "EMB_FL_Resolver")["MotorAngle"] == pytest.approx(20.0, abs=0.01)
    assert Decoder().columns(found, "EMB_FL_Current")["CurrentQ"][5:] == pytest.approx(1.0, abs=0.02)
    (tmp_path / "x.dbc").write_text("this is\nno DBC at all\n" * 100)
    with pytest.raises(InputError, match=r"x\.dbc: not a readable DBC"):
        Mapping(tmp_path / "mapping.yaml")


def test_of_a_motor_that_stands_what_is_not_in_the_log_is_named(tmp_path):
    (tmp_path / "x.dbc").write_text(_FAULTY)
    mapping = write_mapping(tmp_path, "dbc: x.dbc", MotorAngle="value: 0", WheelSpeedFL="signal: Long.Speed")
    (tmp_path / "x.log").write_text("(0.000000) can0 100#00\n(0.004000) can0 100#00\n")
    with pytest.raises(InputError, match=r"no value of Long.Speed \(0x12dd51a9\) in it, .*; found 0x100"):
        mapping.read(tmp_path / "x.log")


@pytest.mark.parametrize(
    ("choice", "is_value"),
    [
        ("SNA", False), ("Signal not available", False), ("LWS_invalid", False), ("Error Indicator", False),
        ("Init", False), ("nicht_verfuegbar", False), ("NotAvailable", False), ("TEMP_SNA", False),
        ("No_Fault", True), ("Not_Pressed", True), ("Maximum", True),
    ],
)  # fmt: skip
def test_what_the_dbc_calls_not_available_is_no_value(tmp_path, choice, is_value):
    """Sent as a number, 4095 would be a backing plate of 369.5 °C."""
    (tmp_path / "x.dbc").write_text(
        'VERSION ""\nBU_: T\nBO_ 256 M: 8 T\n SG_ Angle : 0|16@1+ (0.01,0) [0|0] "rad" T\n'
        f' SG_ Plate : 16|12@1+ (0.1,-40) [0|0] "degC" T\n\nVAL_ 256 Plate 4095 "{choice}" ;\n'
    )
    mapping = write_mapping(tmp_path, "dbc: x.dbc", MotorAngle="signal: M.Angle", InnerBackplateTemp="signal: M.Plate")
    lines = [f"({0.004 * tick:.6f}) can0 100#{'D007FF0F' if tick % 50 < 25 else 'D0075802'}00000000" for tick in range(500)]
    (tmp_path / "x.log").write_text("\n".join(lines) + "\n")
    found = Decoder().columns(mapping.read(tmp_path / "x.log"), "EMB_FL_Thermocouple")
    assert len(found["InnerBackplateTemp"]) > 10
    assert set(np.round(found["InnerBackplateTemp"], 1)) == ({20.0, 369.5} if is_value else {20.0})


def test_traces_of_canhacker_go_on_after_a_minute(tmp_path):
    lines = ["Time   ID     DLC Data                    Comment"]
    for tick in range(400):
        milliseconds = 59_000 + 4 * tick
        # Among them a stray, as this logger has.
        milliseconds = 4_093 if tick == 100 else milliseconds
        lines.append(f"{milliseconds // 1000 % 60:02d},{milliseconds % 1000:03d} 100      2 D0 07                    turned")
    lines += ["00,700 18FEF131 3 01 02 03", "00,710 200      4"]
    (tmp_path / "a.trc").write_text("\r\n".join(lines) + "\r\n")
    frames = read_log(tmp_path / "a.trc").frames
    assert len(frames) == 402 and set(frames["can_id"]) == {0x100, 0x200, 0x18FEF131}
    assert np.diff(np.delete(frames["time_ns"][:400], 100)).tolist() == [4_000_000] * 99 + [8_000_000] + [4_000_000] * 298
    assert frames["time_ns"][99] == frames["time_ns"][100]
    assert frames["data"][0] == 0x07D0
    assert frames["flags"][-2:].tolist() == [EXTENDED, REMOTE]


_SHOWN = """ (1709294400.000100)  can0  123   [8]  11 22 33 44 55 66 77 88
 (1709294400.010100)  can1  18FEF131   [2]  AB CD

 (1709294400.020100)  can0  RX - -  123   [8]  11 22 33 44 55 66 77 88   '.."3DUfw.'
 (1709294400.030100)  can0  123   [12]  01 02 03 04 05 06 07 08 09 0A 0B 0C
 (1709294400.040100)  can0  123   [0]  remote request
"""
_GVRET = """Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8
166064000,00000123,false,Rx,0,8,11,22,33,44,55,66,77,88,
166074000,18FEF131,true,Rx,1,2,AB,CD,
"""


_GVRET_BEFORE = _GVRET.replace("Dir,", "").replace(",Rx", "")


@pytest.mark.parametrize(("name", "text"), [("x.log", _SHOWN), ("x.txt", _SHOWN), ("x.csv", _GVRET), ("x.csv", _GVRET_BEFORE)])
def test_frames_as_candump_shows_them_and_savvycan_keeps_them(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    recorded = read_log(tmp_path / name)
    frames = recorded.frames
    assert frames["can_id"][:2].tolist() == [0x123, 0x18FEF131] and frames["flags"][:2].tolist() == [0, EXTENDED]
    assert frames["data"][:2].tolist() == [0x8877665544332211, 0xCDAB] and frames["length"][:2].tolist() == [8, 2]
    assert np.diff(frames["time_ns"][:2]) == 10_000_000
    assert recorded.channels[0] != recorded.channels[1]
    if text is _SHOWN:
        assert len(frames) == 5 and frames["data"][2] == frames["data"][0]
        assert recorded.payloads(np.array([3]))[0] == bytes(range(1, 13)) and frames["flags"][4] == REMOTE
    (tmp_path / name).write_text(text + "what is this\n")
    with pytest.raises(InputError, match=r"x\.\w+:\d: not a candump line"):
        read_log(tmp_path / name)


_TABLES_OF_FRAMES = {
    "a viewer's": "time,addr,bus,data\n166.064,0x123,0,0x1122334455667788\n166.074,0x18fef131,1,0xabcd\n",
    "bytes apart": "Time [ms];Chan;ID;Flags;DLC;D0;D1;D2;D3;D4;D5;D6;D7;Counter\n"
    "166064,0;0;123;;8;11;22;33;44;55;66;77;88;1\n166074,0;1;18FEF131;X;2;AB;CD;;;;;;;2\n",
    "a logger's": "# Logger: one\n# Time format: 4\nTimestamp;Type;Channel;ID;Data\n"
    "20260921T134000064;0;0;123;1122334455667788\n20260921T134000074;1;1;18fef131;abcd\n",
    "a script's": "timestamp_us\tArbitration_ID\tchannel\tData\n"
    "1709294400064000\t0x123\tcan0\t11 22 33 44 55 66 77 88\n1709294400074000\t0x18FEF131\tcan1\tAB CD\n",
}


@pytest.mark.parametrize("text", _TABLES_OF_FRAMES.values(), ids=list(_TABLES_OF_FRAMES))
def test_a_table_whose_header_names_time_id_and_bytes_is_one_of_frames(tmp_path, text):
    (tmp_path / "x.csv").write_text(text)
    recorded = read_log(tmp_path / "x.csv")
    frames = recorded.frames
    assert frames["can_id"].tolist() == [0x123, 0x18FEF131] and frames["flags"].tolist() == [0, EXTENDED]
    assert frames["data"].tolist() == [0x8877665544332211, 0xCDAB] and frames["length"].tolist() == [8, 2]
    assert np.diff(frames["time_ns"]) == pytest.approx(10_000_000, abs=1000)
    assert recorded.channels[0] != recorded.channels[1]
    (tmp_path / "x.csv").write_text(text + "what is this\n")
    with pytest.raises(InputError, match=rf"x\.csv:{text.count(chr(10)) + 1}: not a candump line"):
        read_log(tmp_path / "x.csv")


def test_ids_of_a_table_of_frames_may_be_decimal_and_short_ones_extended(tmp_path):
    """Of so many hexadecimal ids one has a letter. A frame of CAN FD is longer than eight bytes."""
    rows = [f"{0.01 * n:.2f},{256 + 7 * n},{n % 2},{'00' * 12 if n == 3 else '01'}" for n in range(9)]
    (tmp_path / "x.csv").write_text("\n".join(["Time,CAN ID,Extended,Data", *rows]) + "\n")
    recorded = read_log(tmp_path / "x.csv")
    frames = recorded.frames
    assert frames["can_id"].tolist() == [256 + 7 * n for n in range(9)]
    assert (frames["flags"] & EXTENDED > 0).tolist() == [n % 2 == 1 for n in range(9)] and frames["length"][3] == 12
    few = "\n".join(["Time,CAN ID,Data", "0.00,100,01", "0.01,200,01"]) + "\n"
    (tmp_path / "x.csv").write_text(few)
    assert read_log(tmp_path / "x.csv").frames["can_id"].tolist() == [0x100, 0x200]
    (tmp_path / "x.csv").write_text("Time,ID,D0,D1\n0.00,100,1,F\n")
    assert read_log(tmp_path / "x.csv").frames["data"].tolist() == [0x0F01]


def test_python_cans_table_has_its_bytes_in_base_64(tmp_path):
    with can.CSVWriter(tmp_path / "x.csv") as writer:
        writer.on_message_received(can.Message(timestamp=1.5, arbitration_id=0x123, is_extended_id=False, data=b"\x01\x02"))
    assert read_log(tmp_path / "x.csv").frames["data"].tolist() == [0x0201]


_ASC = """date Mon Jan 1 10:00:00.000 2026
base hex  timestamps {format}
no internal events logged
   {times[0]} 1  123             Rx   d 8 11 22 33 44 55 66 77 88
   {times[1]} Statistic: D 1 R 0 XD 0 XR 0 E 0 O 0 B 0.00%
   {times[2]} 1  123             Rx   d 8 11 22 33 44 55 66 77 89
   {times[3]} 1  18FEF131x       Rx   d 2 AB CD
"""
_CANDUMP = " ({times[0]})  can0  123   [1]  11\n ({times[1]})  can0  124   [1]  22\n ({times[2]})  can0  123   [1]  11\n"


@pytest.mark.parametrize(
    ("name", "text", "absolute", "relative"),
    [
        ("a.asc", _ASC, ["0.001000", "0.003000", "0.011000", "0.012000"], ["0.001000", "0.002000", "0.008000", "0.001000"]),
        ("a.log", _CANDUMP, ["000.000000", "000.009500", "000.010000"], ["000.000000", "000.009500", "000.000500"]),
    ],
)
def test_times_may_count_from_one_event_to_the_next(tmp_path, name, text, absolute, relative):
    found = []
    for kind, times in (("absolute", absolute), ("relative", relative)):
        (tmp_path / name).write_text(text.format(format=kind, times=times))
        found.append(read_log(tmp_path / name).frames)
    assert np.array_equal(*found)
    assert found[1]["time_ns"][-1] - found[1]["time_ns"][0] == round(1e9 * (float(absolute[-1]) - float(absolute[0])))


_PEAK_TABLE = """;$FILEVERSION=2.1
;   Message   Time    Type    ID     Rx/Tx

1;1059,900;1;Rx;DT;0123;-;8;11;22;33;44;55;66;77;88
2;1069,900;2;Tx;DT;18FEF131;-;2;AB;CD
3;1079,900;1;Rx;FD;0123;-;9;01;02;03;04;05;06;07;08;09;0A;0B;0C
4;1080,000;1;Rx;ER;-;-;5;04;00;02;00;00
5;1080,100;-;;EV;a word of its user
6;1089,900;1;Rx;RR;0123;-;3
"""


@pytest.mark.parametrize(
    "text", [_PEAK_TABLE, _PEAK_TABLE.replace(",", ".").replace(";", ","), _PEAK_TABLE.replace(";", "\t")]
)
def test_what_peak_converter_makes_of_a_trace_is_read(tmp_path, text):
    (tmp_path / "x.csv").write_text(text)
    recorded = read_log(tmp_path / "x.csv")
    frames = recorded.frames
    assert frames["can_id"].tolist() == [0x123, 0x18FEF131, 0x123, 0x123]
    assert frames["flags"][:2].tolist() == [0, EXTENDED] and frames["flags"][3] == REMOTE
    assert frames["data"][:2].tolist() == [0x8877665544332211, 0xCDAB]
    assert recorded.payloads(np.array([2]))[0] == bytes(range(1, 13))
    assert np.diff(frames["time_ns"]).tolist() == [10_000_000] * 3
    assert recorded.channels.tolist() == ["1", "2", "1", "1"]
    (tmp_path / "x.csv").write_text(text + "what is this\n")
    with pytest.raises(InputError, match=r"x\.csv:10: not a candump line"):
        read_log(tmp_path / "x.csv")


_TRACE_1_0 = """;  CAN activities
;----+-   ---+---  ----+---  +  -+ -- -- ...
     1)      1841      0123  8  11 22 33 44 55 66 77 88
     2)      1842      0008  4  ERROR 00 19 08 08
     3)      1843  FFFFFFFF  4  00 00 00 04 -- -- -- --  BUSLIGHT
     4)      1851  18FEF131  2  AB CD
"""
_TRACE_1_2 = """;$FILEVERSION=1.2
;$STARTTIME=39878.6772258947;
;---+--   ----+------  +  --+--  ----+---  +  -+ -- -- -- -- -- -- --
     1)      1841.000  1  Rx         0123  8  11 22 33 44 55 66 77 88
     2)      1842.000  1  Warng  FFFFFFFF  4  00 00 00 04  BUSLIGHT
     3)      1843.000  1  Error      0008  4  00 19 08 08
     4)      1851.000  1  Tx     18FEF131  2  AB CD
"""


@pytest.mark.parametrize("text", [_TRACE_1_0, _TRACE_1_2])
def test_old_traces_of_peak_are_read_with_their_errors(tmp_path, text):
    (tmp_path / "x.trc").write_text(text)
    frames = read_log(tmp_path / "x.trc").frames
    assert frames["can_id"].tolist() == [0x123, 0x18FEF131] and frames["flags"].tolist() == [0, EXTENDED]
    assert frames["data"].tolist() == [0x8877665544332211, 0xCDAB]
    assert np.diff(frames["time_ns"]) == pytest.approx(10_000_000, abs=1e3)


_BUSMASTER = """***BUSMASTER Ver 3.2.0***
***PROTOCOL CAN***
***[START LOGGING SESSION]***
***{0}***
***<Time><Tx/Rx><Channel><CAN ID><Type><DLC><DataBytes>***
23:59:59:9950 Rx 1 {1} s 8 {2}
0:0:0:0050 Tx 2 {3} x 2 {4}
00:00:00:015 Rx 1 {1} sr 8
***END DATE AND TIME 2:3:2024 0:0:1:0***
***[STOP LOGGING SESSION]***
"""


@pytest.mark.parametrize("name", ["x.log", "x.txt"])
@pytest.mark.parametrize("base", ["HEX", "DEC"])
def test_busmaster_logs_are_read_over_midnight_in_either_base(tmp_path, name, base):
    words = {"HEX": ("0x123", "11 22 33 44 55 66 77 88", "0x18FEF131", "AB CD")}
    words["DEC"] = ("291", "17 34 51 68 85 102 119 136", "419361073", "171 205")
    (tmp_path / name).write_text(_BUSMASTER.format(base, *words[base]))
    recorded = read_log(tmp_path / name)
    frames = recorded.frames
    assert frames["can_id"].tolist() == [0x123, 0x18FEF131, 0x123] and frames["flags"].tolist() == [0, EXTENDED, REMOTE]
    assert frames["data"][:2].tolist() == [0x8877665544332211, 0xCDAB] and frames["length"][:2].tolist() == [8, 2]
    assert np.diff(frames["time_ns"]).tolist() == [10_000_000, 10_000_000]
    assert recorded.channels.tolist() == ["1", "2", "1"]
    (tmp_path / name).write_text(_BUSMASTER.format(base, *words[base]) + "what is this\n")
    with pytest.raises(InputError, match=r"x\.\w+:11: not a candump line"):
        read_log(tmp_path / name)


@pytest.mark.parametrize("ending", [".asc", ".blf", ".trc", pytest.param(".mf4", marks=pytest.mark.trial), ".log"])
def test_a_log_is_known_by_how_it_begins(log, tmp_path, ending):
    frames = read_frames(log)[:400]
    write_frames(tmp_path / f"x{ending}", frames)
    for name in ("x.txt", "x.csv", "x"):
        (tmp_path / name).write_bytes((tmp_path / f"x{ending}").read_bytes())
        assert np.array_equal(read_frames(tmp_path / name)["data"], frames["data"])


def test_a_trucks_mdf4_log_is_read_whole_and_mapped(shared, tmp_path, monkeypatch):
    """402 s of a standing truck's J1939 bus (extended ids) as its logger wrote them. Nothing on it is a brake: a 16-bit signal
    of 10 Hz, whatever it means, is taken for our motor angle to see it arrive, sample by sample: nothing is invented between
    samples so far apart."""
    pytest.importorskip("asammdf", reason="NOT RUN: the mf4 extra is not installed")
    path = shared / "measured" / "road_can" / "truck_mf4" / "truck_j1939_402s.MF4"
    recorded = read_log(path)
    # Once is enough.
    monkeypatch.setattr("emb_daemon.logs.mapping.read_log", lambda _: recorded)
    frames = recorded.frames
    # The logger states channel and kind of id once for a group of frames, by a conversion without data.
    assert set(recorded.channels.tolist()) == {"1", "9"} and {0, EXTENDED} == set(frames["flags"].tolist())
    assert len(frames) == 150_411 and 400e9 < frames["time_ns"][-1] - frames["time_ns"][0] < 404e9
    (tmp_path / "truck.dbc").write_text(
        'VERSION ""\nBU_: T\nBO_ 2566206452 Battery: 8 T\n SG_ Word : 32|16@1+ (0.01,-5) [0|0] "rad" T\n'
    )
    write_mapping(tmp_path, "dbc: truck.dbc", MotorAngle="signal: Battery.Word", MotorSpeed="value: 0.0")
    mine = frames[frames["can_id"] == 0x18F533F4]
    words = (mine["data"] >> np.uint64(32) & np.uint64(0xFFFF)) * 0.01 - 5.0
    assert len(mine) == 3992 and np.ptp(words) > 50.0
    samples = load_log(path, read=Mapping(tmp_path / "mapping.yaml").read).samples
    expected = np.interp(samples["time_ns"], mine["time_ns"], words)
    assert len(samples) >= len(mine) - 1 and np.abs(samples["angle"] - expected).max() < 2e-3


@pytest.mark.parametrize("ending", [".log", ".asc", ".blf", ".trc", ".mf4"])
def test_sent_frames_survive_every_log_format(log, tmp_path, ending):
    if ending == ".mf4":
        pytest.importorskip("asammdf", reason="NOT RUN: the mf4 extra is not installed")
    reference, path = tmp_path / "reference.log", tmp_path / f"6.5mm.new{ending}"
    assert main(["replay", str(log), "--output", str(reference)]) == 0
    assert main(["replay", str(log), "--output", str(path)]) == 0
    expected, found = read_frames(reference), read_frames(path)
    assert np.array_equal(found["can_id"], expected["can_id"]) and np.array_equal(found["data"], expected["data"])
    shift = found["time_ns"] - expected["time_ns"]
    assert shift.max() - shift.min() <= 1_100_000
    assert sorted(tmp_path.iterdir()) == sorted([reference, path])


def test_tables_agree_with_each_other(log, tmp_path):
    import pyarrow.csv
    import pyarrow.parquet

    paths = [tmp_path / name for name in ("a.b.csv", "a.b.parquet")]
    for path in paths:
        assert main(["replay", str(log), "--output", str(path)]) == 0
    csv, parquet = pyarrow.csv.read_csv(paths[0]), pyarrow.parquet.read_table(paths[1])
    assert csv.column_names == parquet.column_names and csv.num_rows == parquet.num_rows == len(load_log(log).samples)
    for name in parquet.column_names:
        a, b = csv[name].to_numpy(), parquet[name].to_numpy()
        assert np.array_equal(a, b, equal_nan=a.dtype.kind == "f")


def test_a_measurement_has_units_comments_and_texts(log, tmp_path):
    asammdf = pytest.importorskip("asammdf", reason="NOT RUN: the mf4 extra is not installed")
    import pyarrow.parquet

    path, table = tmp_path / "run.1.signals.mf4", tmp_path / "run.parquet"
    for output in (path, table):
        assert main(["replay", str(log), "--output", str(output)]) == 0
    columns = pyarrow.parquet.read_table(table)
    with asammdf.MDF(path) as file:
        assert len(file.groups) == 1
        for name in set(columns.column_names) - {"time_s"}:
            signal = file.get(name)
            assert signal.comment, name
            units = {"N": "N", "Nm": "Nm", "C": "degC", "rad": "rad"}
            assert signal.unit == units.get(name.rpartition("_")[2], ""), name
            expected = columns[name].to_numpy()
            if expected.dtype.kind == "f":
                np.testing.assert_array_equal(signal.samples, expected)
            else:
                assert [text.decode() for text in signal.samples] == list(expected)
            stamps = file.header.start_time.timestamp() + signal.timestamps
            np.testing.assert_allclose(stamps, columns["time_s"].to_numpy(), rtol=0.0, atol=1e-6)


@pytest.mark.parametrize("ending", ["kcd", "sym"])
def test_a_bus_may_be_described_in_other_formats(tmp_path, ending):
    known = load_database(resource("dbc/emb.dbc"))
    path = tmp_path / f"emb.{ending}"
    path.write_text(getattr(known, f"as_{ending}_string")())
    found = load_database(path)
    assert {message.name: message.frame_id for message in found.messages} == {m.name: m.frame_id for m in known.messages}
