"""Runs of a geared robot motor against a torque sensor as logs that `emb-daemon diagnose` reads, and where to start from.

    python tools/tmotor_to_log.py SysID/system_id_test_2/log_adc_and_motor.csv --output tmotor
    emb-daemon diagnose tmotor/first_half.log --calibration tmotor/calibration.yaml --validate tmotor/second_half.log \\
        --output tmotor/found

Data at github.com/neurobionics/TMotorCANControl, commit bb8d071, folder src/TMotorCANControl/test/saved_logs/SysID (GPL-3; not
copied here): an AK80-9 on CAN, planetary gear of 9 inside, at 100 Hz: speed and current of the drive, a torque sensor on its
shaft, another motor holding against it. There is no angle. The sensor counts the other way round.

The mapping onto the torque path, with a gear gain gamma that is a choice (0.5 mm per radian) and nothing more: clamp force =
sensor torque / gamma. The torque constant to start from is the supplier's 0.105 N m/A times 9.
"""

import argparse
import sys
from pathlib import Path

import numpy as np
from embir_to_log import GEAR_GAIN_M_PER_RAD, whole_and_halves
from no_pads import convert, parser_of, starting_calibration

from emb_daemon.calibration.types import Calibration

CONSTANT_NM_PER_A = 0.945
#: At the shaft, of rotor and gear, kg m2; of the gear, N m; fastest, rad/s: orders of magnitude of the supplier's sheet.
NOMINAL_INERTIA, NOMINAL_COULOMB, FASTEST = 0.005, 0.3, 50.0

MAPPING = f"""# Columns of the test stand.
format: 1
time: {{signal: loop_time, unit: s}}
signals:
  EMB_FL_Resolver.MotorSpeed: {{signal: motor_measured_speed, unit: rad/s}}
  EMB_FL_Current.CurrentQ: {{signal: motor_measured_current, unit: A, mean_ms: 0}}
  VEH_WheelSpeed.WheelSpeedFL: {{value: 0}}
  RIG_FL_Force.ClampForceRef: {{signal: adc_measured_torque, unit: N, scale: {-1.0 / GEAR_GAIN_M_PER_RAD:g}}}
"""


def _logs_and_start(arguments: argparse.Namespace) -> tuple[dict[str, np.ndarray], Calibration]:
    return whole_and_halves(arguments.run, MAPPING, arguments.output), starting_calibration(
        "AK80-9",
        torque_constant_Nm_per_A=CONSTANT_NM_PER_A,
        inertia_kg_m2=NOMINAL_INERTIA,
        coulomb_Nm=NOMINAL_COULOMB,
        presliding_angle_rad=0.05,
        gear_gain_m_per_rad=GEAR_GAIN_M_PER_RAD,
        maximum_speed_rad_per_s=FASTEST,
    )


def main(argv: list[str] | None = None) -> int:
    parser = parser_of(__doc__)
    parser.add_argument("run", type=Path, help="one run, log_adc_and_motor.csv")
    return convert(parser.parse_args(argv), _logs_and_start)


if __name__ == "__main__":
    sys.exit(main())
