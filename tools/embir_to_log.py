"""Runs of the EMBiR actuator dynamometer as logs that `emb-daemon diagnose` reads, and the torque balance to start from.

    python tools/embir_to_log.py futek_data/futek_test_27_04_2021_16-28-22.csv --output embir
    emb-daemon diagnose embir/first_half.log --calibration embir/calibration.yaml --validate embir/second_half.log \\
        --output embir/found

K. Urs, C. E. Adu, E. J. Rouse, T. Y. Moore, Design and Characterization of 3D Printed, Open-Source Actuators for Legged
Locomotion, IROS 2022; data at github.com/karthikurs/actuator-dynamometer, commit 1ab6e56, folder futek_data (no licence
stated; not copied here). Two motors face to face through a torque sensor: the first one's current, angle and speed are an
actuator's, the sensor is the load that it works against.

The mapping onto the torque path, with a gear gain gamma that is a choice (0.5 mm per radian) and nothing more:

    clamp force = sensor torque / gamma        torque constant: the drive's own, as its calibration log has it

There are no pads, so that the clearance never closes. The drive samples its current at 60 to 200 Hz as a value of the moment.
"""

import argparse
import re
import sys
from pathlib import Path

import numpy as np
from no_pads import convert, parser_of, starting_calibration

from emb_daemon.atomic import write_atomically
from emb_daemon.calibration.types import Calibration
from emb_daemon.errors import InputError
from emb_daemon.logs.mapping import Mapping

GEAR_GAIN_M_PER_RAD = 5e-4
#: As a datasheet would give them: inertia of rotor and coupling, kg m2; motor friction, N m.
NOMINAL_INERTIA, NOMINAL_COULOMB = 1e-4, 0.02

MAPPING = """# Columns of the EMBiR dynamometer.
format: 1
time: {{signal: "time [s]", unit: s}}
signals:
  EMB_FL_Resolver.MotorAngle: {{signal: "a1 position [rad]", unit: rad}}
  EMB_FL_Resolver.MotorSpeed: {{signal: "a1 velocity [rad/s]", unit: rad/s}}
  EMB_FL_Current.CurrentQ: {{signal: "a1 q-axis [A]", unit: A, mean_ms: 0}}
  VEH_WheelSpeed.WheelSpeedFL: {{value: 0}}
  RIG_FL_Force.ClampForceRef: {{signal: "{sensor}", unit: N, scale: {newton_per_Nm:g}}}
"""


def read_header(path: Path) -> tuple[float, str]:
    """Values that a run's header states: the first motor's torque constant, N m/A, and the torque sensor's column. Raises
    InputError: not a run with both."""
    with path.open(errors="replace") as file:
        header = file.read(4000)
    constant, sensor = re.search(r"kt_1 = ([\d.]+)", header), re.search(r",(tr[sd]605\S* torque \[Nm\])", header)
    if not constant or not sensor:
        raise InputError(f"{path}: no torque constant (kt_1 = ...) or no torque sensor: not a run of the EMBiR dynamometer")
    return float(constant.group(1)), sensor.group(1)


def whole_and_halves(run: Path, mapping: str, folder: Path) -> dict[str, np.ndarray]:
    """FRAME arrays of a run as this mapping reads it, which is left in ``folder``. Raises InputError, OSError: it cannot be
    read with it."""
    write_atomically(folder / "mapping.yaml", mapping.encode())
    frames = Mapping(folder / "mapping.yaml").read(run)
    half = np.searchsorted(frames["time_ns"], frames["time_ns"][[0, -1]].mean())
    return {"run": frames, "first_half": frames[:half], "second_half": frames[half:]}


def _logs_and_start(arguments: argparse.Namespace) -> tuple[dict[str, np.ndarray], Calibration]:
    constant, sensor = read_header(arguments.run)
    mapping = MAPPING.format(sensor=sensor, newton_per_Nm=1.0 / GEAR_GAIN_M_PER_RAD)
    return whole_and_halves(arguments.run, mapping, arguments.output), starting_calibration(
        "EMBiR",
        torque_constant_Nm_per_A=constant,
        inertia_kg_m2=NOMINAL_INERTIA,
        coulomb_Nm=NOMINAL_COULOMB,
        presliding_angle_rad=0.05,
        gear_gain_m_per_rad=GEAR_GAIN_M_PER_RAD,
        maximum_speed_rad_per_s=250.0,
    )


def main(argv: list[str] | None = None) -> int:
    parser = parser_of(__doc__)
    parser.add_argument("run", type=Path, help="one run, futek_test_*.csv")
    return convert(parser.parse_args(argv), _logs_and_start)


if __name__ == "__main__":
    sys.exit(main())
