"""The best plain least squares fits to measured logs, beside which attribution and identification are judged.

Of logs with a load, the load over current, offset, friction and saturation; of a motor that turns free, the current over
acceleration, friction, speed, offset and a friction that falls with the speed; of logs without a current, the force over a
cubic of the angle, for both ways together and for each. Each is fitted to some logs and judged on others:

    python -m studies.plain --fit first.log --judge second.log --calibration calibration.yaml
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from emb_daemon.calibration.files import load_calibration
from emb_daemon.calibration.types import Calibration
from emb_daemon.diagnose.episodes import standing
from emb_daemon.errors import InputError
from emb_daemon.identify.steps.stiffness import cubic_of_each_way
from emb_daemon.logs.mapping import Mapping
from emb_daemon.logs.read import read_frames
from emb_daemon.offline import Log, load_log
from emb_daemon.offline.score import rmse

#: Share of the largest speed within which friction falls; samples over which an acceleration is taken: so many that quantised
#: speeds leave one.
_FALLS, _SAMPLES = 0.1, 5


def plain_fits(fitted: Sequence[Log], judged: Sequence[Log], calibration: Calibration) -> dict[str, float]:
    """RMS errors on the ``judged`` logs of fits to the ``fitted`` ones, by what is in them: N m, without a current N."""
    logs = [*fitted, *judged]
    if not any(log.samples["has_current"].any() for log in logs):
        return _errors(fitted, judged, _over_angle, {"cubic": 4, "cubic of each way": 8})
    motor = calibration.motor
    if any(np.nanmax(np.abs(log.force_N), initial=0.0) > 0.0 for log in logs):
        errors = _errors(fitted, judged, _over_current, {"constant and offset": 2, "friction": 4, "saturation": 5})
        return {name: motor.gear_gain_m_per_rad * error for name, error in errors.items()}
    fastest = max(float(np.quantile(np.abs(log.samples["speed"]), 0.99)) for log in logs)
    widths = {"inertia and friction": 2, "speed": 3, "offset": 4, "falling friction": 5}
    errors = _errors(fitted, judged, lambda log: _over_motion(log, fastest), widths)
    return {name: motor.torque_constant_Nm_per_A * error for name, error in errors.items()}


def _errors(fitted, judged, table, widths):
    (columns, wanted), (judge, measured) = (
        tuple(np.concatenate(parts) for parts in zip(*map(table, logs), strict=True)) for logs in (fitted, judged)
    )
    return {name: rmse(measured - judge[:, :n] @ np.linalg.lstsq(columns[:, :n], wanted)[0]) for name, n in widths.items()}


def _over_current(log):
    known, i, v = np.isfinite(log.force_N) & log.samples["has_current"], log.samples["current_q"], log.samples["speed"]
    table = np.column_stack([i, np.ones(len(i)), np.tanh(v / 0.5), v, i * np.abs(i)])
    return table[known], log.force_N[known]


def _over_motion(log, fastest):
    s, v = log.samples, log.samples["speed"]
    smooth = np.convolve(v, np.full(_SAMPLES, 1.0 / _SAMPLES), "same")
    acceleration, way = np.gradient(smooth, 1e-9 * s["time_ns"]), np.sign(v)
    table = np.column_stack([acceleration, way, v, np.ones(len(v)), way * np.exp(-np.abs(v) / (_FALLS * fastest))])
    # Where attribution judges it, too: friction holds a motor that stands, whatever its current.
    turns = ~standing(log.time_s, s["angle"]) & s["has_current"]
    turns[:_SAMPLES] = turns[-_SAMPLES:] = False
    return table[turns], s["current_q"][turns]


def _over_angle(log):
    known = np.isfinite(log.force_N)
    return cubic_of_each_way(log.samples["angle"])[known], log.force_N[known]


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--fit", type=Path, nargs="+", required=True, metavar="LOG")
    parser.add_argument("--judge", type=Path, nargs="+", required=True, metavar="LOG")
    parser.add_argument("--calibration", type=Path, required=True, metavar="FILE")
    parser.add_argument("--mapping", type=Path, metavar="FILE", help="of another rig's tables")
    arguments = parser.parse_args(argv)
    try:
        read = Mapping(arguments.mapping).read if arguments.mapping else read_frames
        fitted, judged = ([load_log(path, read=read) for path in paths] for paths in (arguments.fit, arguments.judge))
        errors = plain_fits(fitted, judged, load_calibration(arguments.calibration))
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    for name, error in errors.items():
        print(f"{name:20s} {error:.4g}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
