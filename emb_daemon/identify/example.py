"""A campaign to start from: files of a made-up rig with another bus than ours, to be replaced by one's own one by one."""

from pathlib import Path

import numpy as np

from emb_daemon.atomic import write_atomically
from emb_daemon.calibration.files import load_calibration
from emb_daemon.errors import InputError
from emb_daemon.plant.derive import plant_from_calibration
from emb_daemon.plant.scenarios import Schedule, curve, random_angle, rest, simulate_log, stop
from emb_daemon.resources import resource

_DBC = """VERSION ""
BU_: RIG
BO_ 2566844161 Drive: 16 RIG
 SG_ Position : 7|32@0- (0.01,0) [0|0] "deg" RIG
 SG_ Speed : 39|32@0- (0.01,0) [0|0] "rpm" RIG
 SG_ Iq : 71|16@0- (5,0) [0|0] "mA" RIG

BO_ 801 Bench: 8 RIG
 SG_ Load : 0|32@1- (0.0001,0) [0|0] "kN" RIG
 SG_ Plate : 32|16@1+ (0.05,0) [0|0] "K" RIG

BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN","reserved","J1939PG","StandardCAN_FD","ExtendedCAN_FD";
BA_DEF_DEF_ "VFrameFormat" "StandardCAN";
BA_ "VFrameFormat" BO_ 2566844161 5;
"""

MAPPING = """# Where each of our signals comes from; see docs/mapping.md. What is left out is not measured, and is said.
format: 1
dbc: rig.dbc
signals:
  EMB_FL_Resolver.MotorAngle: {signal: Drive.Position}
  EMB_FL_Resolver.MotorSpeed: {signal: Drive.Speed}
  # Positive current clamps; a mean since the last frame if nothing else is said (mean_ms).
  EMB_FL_Current.CurrentQ: {signal: Drive.Iq, scale: -1.0}
  # The only thermocouple.
  EMB_FL_Thermocouple.InnerBackplateTemp: {signal: Bench.Plate}
  # A bench whose disc stands and whose brake begins released.
  VEH_WheelSpeed.WheelSpeedFL: {value: 0}
  VEH_WheelPulse.WheelPulseFL: {value: 0}
  VEH_Status.ParkBrake: {value: 0}
  VEH_Status.BrakeRequest: {value: 0}
  VEH_Status.VehicleSpeed: {value: 0}
  VEH_Status.AmbientTemp: {value: 22}
  # The force sensor: to identify and to judge, never an input of the estimator.
  RIG_FL_Force.ClampForceRef: {signal: Bench.Load}
"""

_CAMPAIGN = """# Which log plays which part; see docs/campaign.md.
rig: example
corner: FL
datasheet: datasheet.yaml
pad_thickness_mm: 10.0
curves:                       # slow clamp and release
  - {log: slow.log}
random:                       # a new motor angle every 100 ms
  - {log: random_1.log}
  - {log: random_2.log}
"""

DATASHEET = """# What the supplier states; see docs/campaign.md. Identification may find other values, within the tolerances.
actuator:
  gear_gain_m_per_rad: 3.98e-5        # clamp travel per radian of the motor
  motor_torque_constant_Nm_per_A: 0.052
  motor_torque_constant_tolerance: 0.05
  lumped_inertia_kg_m2: 1.1e-4        # at the motor
  max_motor_speed_rad_per_s: 210.0
  rated_clamp_force_N: 30000.0
  pad_clearance_rad: 7.5              # motor angle between released position and contact
resolver: {counts_per_revolution: 4096}
pad:
  thickness_mm: 10.0
  frontal_area_m2: 0.0046
  density_kg_per_m3: 2450.0
  specific_heat_J_per_kgK: 1200.0
  conductivity_W_per_mK: 1.2
disc:
  mass_kg: 5.6
  specific_heat_J_per_kgK: 480.0
  effective_radius_m: 0.131
  cooling_area_m2: 0.19
  conductivity_W_per_mK: 50.0
friction_coefficient: 0.39
"""


def write_example(folder: Path) -> list[Path]:
    """Write DBC, mapping, datasheet, campaign and logs of a simulated rig; returns their paths.

    Raises:
        InputError: the folder is there and not empty, or cannot be made.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"{folder}: expected an empty folder, or none yet")
    folder.mkdir(parents=True, exist_ok=True)
    texts = {"rig.dbc": _DBC, "mapping.yaml": MAPPING, "campaign.yaml": _CAMPAIGN, "datasheet.yaml": DATASHEET}
    for name, text in texts.items():
        write_atomically(folder / name, text.encode())
    plant = plant_from_calibration(load_calibration(resource("config/calibration.yaml")), seed=7)
    rng = np.random.default_rng(7)
    motions = {
        "slow": rest(0.5) + curve(plant, seconds=24.0),
        "random_1": rest(0.5) + random_angle(plant, 15.0, rng, high_N=25000.0),
        "random_2": rest(0.5) + random_angle(plant, 15.0, rng, high_N=25000.0),
        "stops": rest(1.0) + stop(8000.0, 4.0) + rest(1.0) + stop(20000.0, 4.0) + rest(1.0),
    }
    logs = [_record(folder / f"{name}.log", plant, motion, seed) for seed, (name, motion) in enumerate(motions.items())]
    return [*(folder / name for name in texts), *logs]


def _record(path: Path, plant: np.void, motion: Schedule, seed: int) -> Path:
    """What the rig's bus would carry of a motion, in can-utils' format."""
    import cantools

    from emb_daemon.offline import log_of

    motion.drives["wheel_speed"] = 0.0
    log = log_of(simulate_log(plant, motion, seed=seed)[0])
    database = cantools.database.load_string(_DBC, "dbc")
    drive, bench = (database.get_message_by_name(name) for name in ("Drive", "Bench"))
    lines = []
    for sample, time_s, force_N in zip(log.samples, log.time_s, np.nan_to_num(log.force_N), strict=True):
        values = {
            "Position": np.degrees(sample["angle"]),
            "Speed": sample["speed"] * 30.0 / np.pi,
            "Iq": -1e3 * sample["current_q"] if sample["has_current"] else 0.0,
        }
        lines.append(f"({1.79e9 + time_s:.6f}) can0 {drive.frame_id:08X}##1{drive.encode(values).hex().upper()}\n")
        plate_C = sample["inner_backplate"] if sample["has_thermocouple"] else 22.0
        values = {"Load": 1e-3 * force_N, "Plate": plate_C + 273.15}
        lines.append(f"({1.79e9 + time_s + 4e-4:.6f}) can0 {bench.frame_id:03X}#{bench.encode(values).hex().upper()}\n")
    write_atomically(path, "".join(lines).encode())
    return path
