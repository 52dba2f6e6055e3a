"""A rig that nobody here built: its brake, its bus and its logs, at any sampling rate, with the true force known.

The brake obeys the thesis's models with the shipped calibration's parameters; bus, ids, units and signs are its own: 29-bit
ids, CAN FD frames of up to 64 bytes, big-endian signals, degrees and rpm, a current of the other sign, one thermocouple in
kelvin.
"""

import datetime
import functools
import re
from dataclasses import dataclass
from pathlib import Path

import brake
import can
import cantools
import msgspec
import numpy as np
import pyarrow
import pyarrow.csv
import pyarrow.parquet
import wirekit
from scipy.signal import lfilter

import emb_daemon
from emb_daemon.calibration.files import dump_calibration
from emb_daemon.calibration.types import Calibration, to_parameters
from emb_daemon.identify.example import FILES
from emb_daemon.logs.mapping import Mapping
from emb_daemon.offline import Log, load_log

#: Step of the truth, s; every sampling rate is a whole part of it.
FINE_S = 0.0005
START_S = 1_790_000_000.0

DBC = """VERSION ""
BU_: RIG
BO_ 2566844161 Drive: 64 RIG
 SG_ Position : 263|32@0- (0.01,0) [0|0] "deg" RIG
 SG_ Speed : 311|32@0- (0.01,0) [0|0] "rpm" RIG
 SG_ Iq : 399|16@0- (5,0) [0|0] "mA" RIG

BO_ 2566844162 Bench: 24 RIG
 SG_ Load : 128|32@1- (0.0001,0) [0|0] "kN" RIG
 SG_ Plate : 96|16@1+ (0.05,0) [0|0] "K" RIG

BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN","reserved","J1939PG","StandardCAN_FD","ExtendedCAN_FD";
BA_DEF_DEF_ "VFrameFormat" "StandardCAN";
BA_ "VFrameFormat" BO_ 2566844161 5;
BA_ "VFrameFormat" BO_ 2566844162 5;
"""

#: The same of a table of the rig's columns, see `sampled`.
MAPPING, DATASHEET = ((FILES / name).read_text() for name in ("mapping.yaml", "datasheet.yaml"))
COLUMNS = re.sub(r"dbc: .*", "time: {signal: time_s}", MAPPING)
for _signal, _column in (
    ("Drive.Position", "angle_rad, unit: rad"),
    ("Drive.Speed", "speed_rad_per_s, unit: rad/s"),
    ("Drive.Iq, scale: -1.0", "current_A, unit: A"),
    ("Bench.Plate", "plate_C, unit: degC"),
    ("Bench.Load", "force_N, unit: N"),
):
    COLUMNS = COLUMNS.replace(_signal, _column)


@dataclass(frozen=True)
class Truth:
    """What the brake did, every `FINE_S`: angle rad, speed rad/s, current A (mean over the step), force N."""

    angle: np.ndarray
    speed: np.ndarray
    current: np.ndarray
    force: np.ndarray

    @property
    def time_s(self) -> np.ndarray:
        return FINE_S * np.arange(len(self.angle))


@functools.cache
def calibration() -> Calibration:
    """The shipped calibration without effects: this brake has none."""
    return msgspec.structs.replace(emb_daemon.shipped_calibration(), effects={})


def parameters() -> np.void:
    """PARAMETERS record of the brake."""
    return brake.ideal(np.atleast_1d(to_parameters(calibration())))


def slow(top_rad: float = 20.0, seconds: float = 24.0) -> np.ndarray:
    """Motor angles of two slow clamps to ``top_rad`` past contact and releases, beginning and ending with 0.4 s of rest."""
    phase = np.clip((np.arange(round(seconds / FINE_S)) * FINE_S - 0.4) / (seconds - 0.8), 0.0, 1.0)
    return (parameters()["clearance"] + top_rad) * (1.0 - np.cos(4.0 * np.pi * phase)) / 2.0


def random(top_rad: float = 20.0, seconds: float = 10.0, seed: int = 1) -> np.ndarray:
    """Motor angles after 0.4 s of rest: a random target every 100 ms, reached as a motor of 40 rad/s reaches it."""
    rng, rest = np.random.default_rng(seed), round(0.4 / FINE_S)
    count = round(seconds / FINE_S)
    targets = parameters()["clearance"] + rng.uniform(-0.05, 1.0, count) * top_rad
    held = np.where(np.arange(count) < rest, 0.0, targets[(np.arange(count) // round(0.1 / FINE_S))])
    decay = np.exp(-40.0 * FINE_S)
    return lfilter([1.0 - decay], [1.0, -decay], lfilter([1.0 - decay], [1.0, -decay], held))


def truth(angle: np.ndarray | None = None) -> Truth:
    """Stops of ordinary driving, or any motion given every `FINE_S`."""
    p = parameters()
    rows, force = brake.samples(p, brake.stops(p, 4, dt=FINE_S) if angle is None else angle, dt=FINE_S)
    return Truth(rows["angle"], rows["speed"], rows["current_q"], force)


def sampled(of: Truth, rate_Hz: float, means: bool = True) -> dict[str, np.ndarray]:
    """Columns as the rig's instruments give them: current a mean over the sampling period, or instantaneous."""
    rng = np.random.default_rng(1)
    step = round(1.0 / rate_Hz / FINE_S)
    rows = np.arange(step, len(of.angle), step)
    total = np.concatenate([[0.0], np.cumsum(of.current)])
    current = (total[rows + 1] - total[rows + 1 - step]) / step if means else of.current[rows]
    count = 2.0 * np.pi / 4096
    return {
        "time_s": of.time_s[rows],
        "angle_rad": np.round(of.angle[rows] / count) * count,
        "speed_rad_per_s": of.speed[rows] + rng.normal(0.0, 0.3, len(rows)),
        "current_A": current + rng.normal(0.0, 0.2, len(rows)),
        "plate_C": np.full(len(rows), 22.0),
        "force_N": of.force[rows] + rng.normal(0.0, 20.0, len(rows)),
    }


def columns_of(time_s: np.ndarray, **measured: np.ndarray) -> dict[str, np.ndarray]:
    """Columns of what is measured at these times; what is not is zero, plates are at 22 degC."""
    others = {"angle_rad": 0.0, "speed_rad_per_s": 0.0, "current_A": 0.0, "plate_C": 22.0, "force_N": 0.0}
    return {"time_s": time_s} | {name: value + 0.0 * time_s for name, value in (others | measured).items()}


def write_rig(folder: Path, mapping: str = MAPPING) -> Path:
    """DBC, mapping and calibration of the rig in ``folder``; returns the mapping's path."""
    (folder / "rig.dbc").write_text(DBC)
    (folder / "mapping.yaml").write_text(mapping)
    (folder / "calibration.yaml").write_text(_calibration_file())
    return folder / "mapping.yaml"


def load_mapped(path: Path) -> Log:
    """The log of a file through the mapping that lies beside it."""
    return load_log(path, read=Mapping(path.parent / "mapping.yaml").read)


def read(folder: Path, columns: dict[str, np.ndarray], mapping: str = COLUMNS) -> Log:
    """The log of a table of columns."""
    write_rig(folder, mapping)
    return load_mapped(write_table(folder / "a.parquet", columns))


#: Messages of the signals that `write_mapping` is given.
_MESSAGES = {
    "MotorAngle": "EMB_FL_Resolver", "MotorSpeed": "EMB_FL_Resolver", "CurrentQ": "EMB_FL_Current",
    "InnerBackplateTemp": "EMB_FL_Thermocouple", "OuterBackplateTemp": "EMB_FL_Thermocouple",
    "ClampForceRef": "RIG_FL_Force", "InnerPadTemp2mm": "RIG_FL_InnerPad",
    "VehicleSpeed": "VEH_Status", "BrakeRequest": "VEH_Status", "ParkBrake": "VEH_Status", "AmbientTemp": "VEH_Status",
    "WheelSpeedFL": "VEH_WheelSpeed",
}  # fmt: skip


def write_mapping(folder: Path, head: str, **signals: str) -> Mapping:
    """A mapping with the line ``head``, and of each signal what stands in its braces."""
    lines = [f"  {_MESSAGES[name]}.{name}: {{{mapped}}}" for name, mapped in signals.items()]
    (folder / "mapping.yaml").write_text("\n".join(["format: 1", head, "signals:", *lines]) + "\n", encoding="utf-8")
    return Mapping(folder / "mapping.yaml")


@functools.cache
def _calibration_file() -> str:
    return dump_calibration(calibration())


def write_campaign(folder: Path, **motions: np.ndarray) -> Path:
    """Campaign, datasheet, mapping and tables of 500 Hz of the motions given: ``curve…`` are slow clamps, others random."""
    p = parameters()
    write_rig(folder, COLUMNS)
    for name, angle in motions.items():
        write_table(folder / f"{name}.parquet", sampled(truth(angle), 500.0))
    stated = {
        "gear_gain_m_per_rad": p["gear_gain"],
        "motor_torque_constant_Nm_per_A": 1.05 * p["torque_constant"],
        "motor_torque_constant_tolerance": 0.15,
        "lumped_inertia_kg_m2": 0.95 * p["inertia"],
        "max_motor_speed_rad_per_s": 300.0,
        "rated_clamp_force_N": 20000.0,
        "pad_clearance_rad": 1.1 * p["clearance"],
    }
    sheet = functools.reduce(lambda text, key: re.sub(rf"{key}: \S+", f"{key}: {stated[key]:g}", text), stated, DATASHEET)
    (folder / "datasheet.yaml").write_text(sheet)
    parts = {"curves": [n for n in motions if n.startswith("curve")], "random": [n for n in motions if n.startswith("random")]}
    lines = [f"{part}: [{', '.join(f'{{log: {name}.parquet}}' for name in names)}]" for part, names in parts.items()]
    (folder / "campaign.yaml").write_text("rig: foreign\ndatasheet: datasheet.yaml\n" + "\n".join(lines))
    return folder / "campaign.yaml"


def write_table(path: Path, columns: dict[str, np.ndarray]) -> Path:
    """The columns as .csv, .parquet or the channels of a measurement (.mf4), by ending."""
    if path.suffix == ".mf4":
        from asammdf import MDF, Signal

        with MDF() as file:
            file.header.start_time = datetime.datetime.fromtimestamp(START_S, datetime.UTC)
            file.append([Signal(v, columns["time_s"], name=name) for name, v in columns.items() if name != "time_s"])
            return Path(file.save(path))
    table = pyarrow.table(columns)
    (pyarrow.csv.write_csv if path.suffix == ".csv" else pyarrow.parquet.write_table)(table, path)
    return path


def our_frames(columns: dict[str, np.ndarray]) -> np.ndarray:
    """The columns in our own layout, at the rig's rate: FRAME array without slow messages."""
    parts = []
    for row, (time_s, angle, speed, current) in enumerate(zip(*list(columns.values())[:4], strict=True)):
        time_ns = round(1e9 * (START_S + time_s))
        parts += [
            wirekit.frame("EMB_FL_Resolver", time_ns, row % 15, MotorAngle=angle, MotorSpeed=speed),
            wirekit.frame("EMB_FL_Current", time_ns + 100_000, row % 15, CurrentQ=current, CurrentD=0.0, DcBusVoltage=13.0),
        ]
    return np.concatenate(parts)


def write_log(path: Path, columns: dict[str, np.ndarray]) -> Path:
    """The columns on the rig's CAN FD bus."""
    database = cantools.database.load_string(DBC, "dbc")
    drive, bench = database.get_message_by_name("Drive"), database.get_message_by_name("Bench")
    with can.Logger(path) as writer:
        for time_s, angle, speed, current, plate, force in zip(*columns.values(), strict=True):
            values = {"Position": np.degrees(angle), "Speed": speed * 30.0 / np.pi, "Iq": -1e3 * current}
            for message, data in (
                (drive, drive.encode(values, strict=False)),
                (bench, bench.encode({"Load": 1e-3 * force, "Plate": plate + 273.15}, strict=False)),
            ):
                writer(can.Message(START_S + time_s, message.frame_id, True, data=data, is_fd=True, channel=1))
    return path
