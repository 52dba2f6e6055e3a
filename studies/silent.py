"""Is an estimate ever silently wrong? Drives on which something is not as calibrated, judged phase by phase.

    python -m studies.silent service ../shared/rig/service [--logs NAME,NAME] [--cut T] [--json]
        logs of a (simulated) rig with reference force: nothing, one thing, changed; training from 242 to 284 s.

Other logs are judged as one phase. Every log is run through the daemon's own pipeline with adaptation, in a folder of its own.
"""

import argparse
import json
import sys
import tempfile
from pathlib import Path

import numpy as np

from emb_daemon.calibration.files import load_calibration
from emb_daemon.errors import InputError
from emb_daemon.logs.read import read_frames
from emb_daemon.replay import Replay
from emb_daemon.resources import resource
from studies.phases import HEADINGS, LEARNED_RMSE_N, LEARNED_USEFUL, NOMINAL_USEFUL, NOMINAL_WORSE, first_flag_s, judge, line

#: When the service logs' training begins and ends, s.
_TRAINING_S = (242.0, 284.0)
#: When the change of a service log begins, s, where not at the start.
_ONSET_S = {"contact_plus_40um": 80.0, "current_offset_later": 60.0, "resolver_frozen": 61.27, "wheel_frames_lost": 20.0}
#: Changes that driving and training must have healed afterwards.
_HEALED = ("pads_6p5mm", "compound_stiffer", "contact_plus_40um", "current_offset_later", "disc_growth")
#: RMSE of `nominal` by phase, N, by the estimator as it was before this study.
_NOMINAL_RMSE_N = {"before": 31.5, "training": 35.5, "after": 34.7}
#: Flags of the first moments, s, are of power-on: slow inputs have not been heard yet.
_POWER_ON_S = 0.5


def run_log(path: Path, calibration, cut_s: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times (s, on the log's clock), ESTIMATE rows and reference force (N) of a log from ``cut_s`` on, with adaptation."""

    def read(log):
        frames = read_frames(log)
        return frames[frames["time_ns"] - frames["time_ns"][0] >= 1e9 * cut_s]

    with tempfile.TemporaryDirectory() as state:
        result = Replay(calibration, state=Path(state), read=read).run(path)
    time_s = 1e-9 * (result.time_ns - result.time_ns[0]) + cut_s
    return time_s, result.estimates, result.force_N


def judge_log(name: str, time_s: np.ndarray, estimates: np.ndarray, force_N: np.ndarray, service: bool) -> list:
    """The phases of one log: before, during and after training, or all of it."""
    if not service:
        return [judge("all", time_s, estimates, force_N)]
    begin, end = _TRAINING_S
    spans = {"before": time_s < begin, "training": (time_s >= begin) & (time_s < end), "after": time_s >= end}
    phases = []
    for phase, rows in spans.items():
        useful = rmse = None
        if name == "nominal":
            useful = NOMINAL_USEFUL if phase != "training" else None
            rmse = NOMINAL_WORSE * _NOMINAL_RMSE_N[phase]
        elif name in _HEALED and phase == "after":
            useful, rmse = LEARNED_USEFUL, LEARNED_RMSE_N
        if rows.any():
            phases.append(judge(phase, time_s[rows], estimates[rows], force_N[rows], useful, rmse))
    return phases


def service(arguments: argparse.Namespace) -> int:
    """Every log of a folder, or single logs; returns the number of phases that fail."""
    calibration = load_calibration(arguments.calibration or resource("config/calibration.yaml"))
    paths = sorted(path for given in arguments.paths for path in (given.glob("*.log*") if given.is_dir() else [given]))
    chosen = arguments.logs.split(",") if arguments.logs else None
    report, failing, total = [], 0, 0
    for path in paths:
        name = path.name.split(".")[0]
        if chosen and name not in chosen:
            continue
        time_s, estimates, force_N = run_log(path, calibration, arguments.cut)
        phases = judge_log(name, time_s, estimates, force_N, path.parent.name == "service")
        onset = max(_ONSET_S.get(name, 0.0), time_s[0] + _POWER_ON_S)
        flagged_s = first_flag_s(time_s, estimates, onset)
        report.append({"log": name, "first_flag_s": flagged_s, "phases": [phase.as_dict() for phase in phases]})
        failing += sum(bool(phase.failed) for phase in phases)
        total += len(phases)
        if not arguments.json:
            told = "never flagged" if np.isnan(flagged_s) else f"first flag {flagged_s:.2f} s after {onset:.1f} s"
            print(f"{name}: {told}\n  {HEADINGS}", *(f"  {line(phase)}" for phase in phases), sep="\n", flush=True)
    if not total:
        raise InputError(f"{', '.join(map(str, arguments.paths))}: no such logs")
    if arguments.json:
        json.dump({"failing": failing, "phases": total, "logs": report}, sys.stdout, indent=1)
        print()
    else:
        print(f"{failing} of {total} phases fail")
    return failing


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m studies.silent", description=__doc__.split("\n")[0])
    commands = parser.add_subparsers(required=True)
    logs = commands.add_parser("service", help="logs of a rig with reference force")
    logs.add_argument("paths", nargs="+", type=Path, metavar="FOLDER|LOG")
    logs.add_argument("--logs", metavar="NAME,NAME", help="only these logs of the folder")
    logs.add_argument("--cut", type=float, default=0.0, metavar="T", help="begin T s into the log: power comes in the middle")
    logs.add_argument("--calibration", type=Path, metavar="FILE", help="default: the shipped one, of the simulated rig A")
    logs.add_argument("--json", action="store_true")
    logs.set_defaults(run=service)
    arguments = parser.parse_args(argv)
    try:
        arguments.run(arguments)
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
