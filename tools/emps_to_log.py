"""The EMPS benchmark as logs that `emb-daemon diagnose` reads, and the torque balance to start from.

    python tools/emps_to_log.py DATA_EMPS.mat DATA_EMPS_PULSES.mat --output emps
    emb-daemon diagnose emps/first_half.log --calibration emps/calibration.yaml \\
        --validate emps/second_half.log emps/pulses.log --output emps/found

A. Janot, M. Gautier, M. Brunot, Data Set and Reference Models of EMPS, Nonlinear System Identification Benchmarks, 2019
(nonlinearbenchmark.org; not copied here): a DC motor drives a carriage over a ball screw. It is a brake's motor and gear
in the clearance: the clamp force is known to be zero, and is written as the reference.

The mapping onto the torque path, with a gear gain gamma that is a choice (0.5 mm per radian) and nothing more:

    motor angle = q / gamma        motor torque = gamma x force, force = gtau x vir
    torque-producing current = 10 A per volt of drive input, so that K_m = gamma gtau / 10
    inertia = gamma^2 x mass       Coulomb torque = gamma x Coulomb force

Measured at 1 kHz, written at the wire's 250 Hz: the current of a sample is the mean of the drive input over the 4 ms before
it, as the wire contract wants it. The set has no speed: it is the position's derivative, smoothed forwards and backwards
(zero phase) like the published identification does it.
"""

import argparse
import sys
from pathlib import Path

import numpy as np
from no_pads import convert, parser_of, starting_calibration

from emb_daemon.calibration.types import Calibration
from emb_daemon.errors import InputError
from emb_daemon.logs.resample import frames_of
from emb_daemon.logs.series import Series
from emb_daemon.wire.contract import CYCLE_NS

GEAR_GAIN_M_PER_RAD = 5e-4
AMPERE_PER_VOLT = 10.0
#: Where the identification of the thesis starts from: what a datasheet would say, not what was published.
NOMINAL_MASS_KG, NOMINAL_COULOMB_N = 80.0, 30.0
#: Corner (Hz) of the zero-phase filter of position and drive input, and samples at 1 kHz for each sample on the wire.
_CORNER_HZ = 60.0
_DECIMATION = 4


def read(path: Path) -> dict[str, np.ndarray]:
    """Columns of an EMPS file. Raises InputError: not an EMPS file."""
    from scipy.io import loadmat

    try:
        data = loadmat(path)
        columns = {name: np.asarray(data[name], float).ravel() for name in ("t", "qm", "vir", "gtau")}
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except (KeyError, ValueError) as error:
        raise InputError(f"{path}: not an EMPS file (t, qm, vir, gtau expected): {error}") from None
    return columns


def frames(columns: dict[str, np.ndarray], begin: float = 0.0, end: float = 1.0) -> np.ndarray:
    """CAN frames of a part of a run, from share ``begin`` to share ``end``."""
    from scipy.signal import butter, sosfiltfilt

    rate = 1.0 / np.median(np.diff(columns["t"]))
    low_pass = butter(4, _CORNER_HZ, fs=rate, output="sos")
    position = sosfiltfilt(low_pass, columns["qm"])
    speed = np.gradient(position, 1.0 / rate)
    drive = sosfiltfilt(low_pass, columns["vir"])
    count = len(position)
    rows = np.arange(max(int(begin * count), _DECIMATION), int(end * count), _DECIMATION)
    mean = np.cumsum(np.concatenate([[0.0], drive]))
    # Trapezoidal mean over the four intervals that end at the sample.
    current = (mean[rows + 1] - mean[rows + 1 - _DECIMATION] + 0.5 * (drive[rows - _DECIMATION] - drive[rows])) / _DECIMATION
    stamps = 1_000_000_000 + CYCLE_NS * np.arange(len(rows))

    def series(values: np.ndarray) -> Series:
        return Series.of(stamps, values)

    motion = {"MotorAngle": position[rows] / GEAR_GAIN_M_PER_RAD, "MotorSpeed": speed[rows] / GEAR_GAIN_M_PER_RAD}
    return frames_of(
        {
            "EMB_FL_Resolver": {name: series(values) for name, values in motion.items()},
            "EMB_FL_Current": {"CurrentQ": series(AMPERE_PER_VOLT * current).averaged()},
            "RIG_FL_Force": {"ClampForceRef": 0.0, "DiscTempRef": 20.0},
        }
    )


def in_units_of_the_carriage(calibration: Calibration) -> dict[str, float]:
    """Mass kg, viscous N s/m, Coulomb N and offset N of a calibration that diagnose has written."""
    gamma, effects = GEAR_GAIN_M_PER_RAD, calibration.effects
    torque = calibration.motor.torque_constant_Nm_per_A
    return {
        "mass_kg": calibration.motor.inertia_kg_m2 / gamma**2,
        "viscous_Ns_per_m": effects.get("viscous_friction", {}).get("viscous_Nms_per_rad", 0.0) / gamma**2,
        "coulomb_N": calibration.friction.offset_Nm / gamma,
        # The published model has force = ... + offset; ours adds a current on the other side.
        "offset_N": -effects.get("current_offset", {}).get("offset_A", 0.0) * torque / gamma,
    }


def _logs_and_start(arguments: argparse.Namespace) -> tuple[dict[str, np.ndarray], Calibration]:
    run, pulses, gamma = read(arguments.run), read(arguments.pulses), GEAR_GAIN_M_PER_RAD
    logs = {"first_half": frames(run, 0.0, 0.5), "second_half": frames(run, 0.5, 1.0), "pulses": frames(pulses)}
    return logs, starting_calibration(
        "EMPS",
        torque_constant_Nm_per_A=gamma * float(run["gtau"][0]) / AMPERE_PER_VOLT,
        inertia_kg_m2=gamma**2 * NOMINAL_MASS_KG,
        coulomb_Nm=gamma * NOMINAL_COULOMB_N,
        presliding_angle_rad=0.1,
        gear_gain_m_per_rad=gamma,
        maximum_speed_rad_per_s=1000.0,
    )


def main(argv: list[str] | None = None) -> int:
    parser = parser_of(__doc__)
    parser.add_argument("run", type=Path, help="DATA_EMPS.mat")
    parser.add_argument("pulses", type=Path, help="DATA_EMPS_PULSES.mat")
    return convert(parser.parse_args(argv), _logs_and_start)


if __name__ == "__main__":
    sys.exit(main())
