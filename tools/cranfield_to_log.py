"""Runs of the Cranfield ball screw as logs that `emb-daemon diagnose` reads, and the torque balance to start from.

    python tools/cranfield_to_log.py data/raw/normal.csv --runs 1 2 3 4 5 --output normal
    emb-daemon diagnose normal/*.log --calibration normal/calibration.yaml --output normal/found

C. Ruiz-Cárcel, A. Starr, Data-Based Detection and Diagnosis of Faults in Linear Actuators, IEEE Transactions on
Instrumentation and Measurement 67(9), 2018, doi 10.1109/TIM.2018.2814067; as tables at github.com/BlueAsuka/Rocket-RAG,
commit 2942a7e, folder data/raw (no licence stated; not copied here). A ball screw of 5 mm lead moves to and fro against a
constant load of -40, 20 or 40 kgf, ten runs of five strokes each way; another actuator makes the load. It is a brake's motor
and gear with a clamp force that does not depend on the angle: there are no pads, and the clearance never closes.

What the set says, and how it becomes the torque path's:

    nut position (set point less its error), over the lead: motor angle. The direction that works against the load clamps, so
    that the force is positive: for 20 and 40 kgf the angle runs against the position.
    current of the drive's supply, which has no sign and does not go to zero: the share above that of standstill, with the sign
    of the motion. While the nut is to stand the drive holds it with a current that says nothing of the load, and in the first
    second of a stroke it charges and catches up: not measured.
    load: reference force, N; where it shall not be known it is left out (--without-load).

All is sampled at 25 Hz. The nut moves at 24 mm/s, steadily, so that the way between two samples is known: both are drawn
straight to the wire's 250 Hz.
"""

import argparse
import csv
import sys
from pathlib import Path

import numpy as np
from no_pads import convert, parser_of, starting_calibration

from emb_daemon.calibration.parameters import moved
from emb_daemon.calibration.types import Calibration
from emb_daemon.errors import InputError
from emb_daemon.logs.resample import fill_missing, frames_of
from emb_daemon.logs.series import Series

LEAD_M = 5e-3
GEAR_GAIN_M_PER_RAD = LEAD_M / (2.0 * np.pi)
NEWTON_PER_KGF = 9.80665
#: A first guess: torque per ampere of supply, N m/A; Coulomb friction, N m; of screw and rotor, kg m2.
NOMINAL_CONSTANT, NOMINAL_COULOMB, NOMINAL_INERTIA = 1.5, 0.7, 3e-5
#: Supply current of the drive while the nut stands, A: the middle of the normal runs'.
STANDSTILL_A = 0.36
#: Speed of the set point (mm/s) from which the nut is to move, and time of a stroke from which its current has settled, s.
_MOVING_MM_PER_S, _SETTLED_S = 1.0, 1.0
_CYCLE_S = 0.004


def read(path: Path) -> dict[tuple[int, int], dict[str, np.ndarray]]:
    """Columns by load (kgf) and run: ``time`` s, ``set`` and ``error`` mm, ``current`` A, strokes one after the other. Raises
    InputError: not a table of the set."""
    names = {"set_point": "set", "position_error": "error", "current": "current", "time": "time"}
    found: dict[tuple[int, int], dict[str, list[float]]] = {}
    try:
        with path.open(newline="") as file:
            for row in csv.DictReader(file):
                part = found.setdefault((int(row["load"]), int(row["run"])), {name: [] for name in names.values()})
                for theirs, ours in names.items():
                    part[ours].append(float(row[theirs]))
    except (OSError, KeyError, ValueError) as error:
        raise InputError(f"{path}: not a table of the Cranfield set ({error})") from None
    runs = {key: {name: np.array(values) for name, values in part.items()} for key, part in found.items()}
    for part in runs.values():
        # Each of the five to and fro begins at zero.
        step = float(np.median(np.diff(part["time"])))
        part["time"] = step * np.arange(len(part["time"]))
    return runs


def frames(part: dict[str, np.ndarray], load_kgf: int, with_load: bool = True) -> np.ndarray:
    """CAN frames of one run."""
    clamping = -1.0 if load_kgf > 0 else 1.0
    speed = np.gradient(part["set"], part["time"])
    moving = np.abs(speed) > _MOVING_MM_PER_S
    begins = np.flatnonzero(moving & (np.diff(np.sign(speed), prepend=0.0) != 0.0))
    since = part["time"] - part["time"][begins[np.maximum(np.searchsorted(begins, np.arange(len(speed)), "right") - 1, 0)]]
    moving &= since >= _SETTLED_S
    angle = clamping * 1e-3 * (part["set"] - part["error"]) / GEAR_GAIN_M_PER_RAD
    current = clamping * np.sign(speed) * np.maximum(part["current"] - STANDSTILL_A, 0.0)
    fine = np.arange(part["time"][0], part["time"][-1], _CYCLE_S)
    # No current where a neighbour has none.
    known = np.interp(fine, part["time"], moving.astype(float)) == 1.0
    stamps = np.rint(1e9 * (1.0 + fine)).astype(np.int64)

    def series(values: np.ndarray) -> Series:
        return Series.of(stamps, values)

    messages = {
        "EMB_FL_Resolver": fill_missing("EMB_FL_Resolver", {"MotorAngle": series(np.interp(fine, part["time"], angle))}),
        "EMB_FL_Current": {"CurrentQ": series(np.where(known, np.interp(fine, part["time"], current), np.nan))},
        "VEH_WheelSpeed": {"WheelSpeedFL": 0.0},
    }
    if with_load:
        messages["RIG_FL_Force"] = {"ClampForceRef": abs(load_kgf) * NEWTON_PER_KGF, "DiscTempRef": 20.0}
    return frames_of(messages)


def calibration_to_start_from() -> Calibration:
    """The calibration of a first guess."""
    start = starting_calibration(
        "Cranfield",
        torque_constant_Nm_per_A=NOMINAL_CONSTANT,
        inertia_kg_m2=NOMINAL_INERTIA,
        coulomb_Nm=NOMINAL_COULOMB,
        presliding_angle_rad=0.5,
        gear_gain_m_per_rad=GEAR_GAIN_M_PER_RAD,
        maximum_speed_rad_per_s=100.0,
    )
    return moved(start, {"stiffness.maximum_force_N": 500.0})


def _logs_and_start(arguments: argparse.Namespace) -> tuple[dict[str, np.ndarray], Calibration]:
    runs = {key: part for key, part in read(arguments.table).items() if key[1] in arguments.runs}
    logs = {f"run{run}_{load}kgf": frames(part, load, not arguments.without_load) for (load, run), part in runs.items()}
    return logs, calibration_to_start_from()


def main(argv: list[str] | None = None) -> int:
    parser = parser_of(__doc__)
    parser.add_argument("table", type=Path, help="normal.csv, backlash1.csv, ...")
    parser.add_argument("--runs", type=int, nargs="+", default=list(range(1, 11)), metavar="N", help="1 to 10 (all)")
    parser.add_argument("--without-load", action="store_true", help="leave the reference force out")
    return convert(parser.parse_args(argv), _logs_and_start)


if __name__ == "__main__":
    sys.exit(main())
