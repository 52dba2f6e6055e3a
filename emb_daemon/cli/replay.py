"""emb-daemon replay."""

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path

from emb_daemon.cli import options
from emb_daemon.errors import InputError, tell
from emb_daemon.estimator.status import TABLE

#: Least share of a log's samples for a reason or fact in the summary; tables contain all reasons.
_LEAST_SHARE = 0.001
EXAMPLE = "emb-daemon replay stop.log.gz --calibration config/calibration.yaml --output estimates.csv"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    options.add_path(parser, "logs", options.LOG_HELP, "LOG", nargs="+")
    options.add_path(parser, "--calibration", options.CALIBRATION_HELP)
    options.add_mapping_argument(parser)
    parser.add_argument("--corner", default="FL", help="FL, FR, RL or RR (default FL), or all: every corner in the log")
    time = {"type": float, "metavar": "S"}
    begin = "give results from this time on, seconds of each log"
    parser.add_argument("--from", dest="start_s", default=0.0, help=begin, **time)
    parser.add_argument("--to", dest="end_s", default=float("inf"), help="stop at this time, seconds of each log", **time)
    parser.add_argument(
        "--pad-thickness", type=float, metavar="MM", help="thickness of the mounted pads, if not that of the calibration"
    )
    parser.add_argument(
        "--measured-torque", action="store_true", help="use the rig's brake torque sensor for the heat model (a car has none)"
    )
    options.add_path(parser, "--state", "adapt: read learned values from DIR, learn, and store them there", "DIR")
    options.add_path(parser, "--keys", "accept only authentic frames, and authenticate those of --output")
    frames = "the frames that the daemon would have sent as .log, .blf, .asc, .trc or .mf4"
    options.add_path(parser, "--output", f"estimates as .csv, .parquet or .signals.mf4, or {frames}")
    options.add_path(parser, "--report", "write an HTML report: forces, errors, temperatures, events", "FILE.html")
    parser.add_argument("--json", action="store_true", help="print error figures as JSON")


def run(arguments: argparse.Namespace) -> int:
    import numpy as np

    from emb_daemon.logs.write import FRAME_ENDINGS, ending_of, write_frames
    from emb_daemon.replay import Replay

    _check(arguments)
    calibration = _calibration(arguments)
    read, sign = options.log_reader(arguments.mapping), np.asarray
    if arguments.keys:
        read, sign = _secure(arguments, read)
    replay = Replay(
        calibration, arguments.corner, arguments.measured_torque, arguments.state, read, arguments.start_s, arguments.end_s
    )
    if arguments.output and ending_of(arguments.output) in FRAME_ENDINGS:
        write_frames(
            arguments.output, np.concatenate([sign(part).copy() for log in arguments.logs for part in replay.frames(log)])
        )
        return 0
    results = [result for log in arguments.logs for result in replay.run_corners(log)]
    for note in replay.notes:
        tell(note)
    if arguments.calibration:
        _warn_of_other_motor(results, calibration.motor)
    for result in results if arguments.measured_torque else ():
        if not np.isfinite(result.reference.brake_torque_Nm).any():
            raise InputError(f"{result.path}: no brake torque (BrakeTorqueRef) in it; expected without --measured-torque")
    if arguments.output:
        _write_table(arguments.output, results)
    if not calibration.contact.is_in_reach:
        # A load is none of these: of either sign, and of no angle.
        results = [replace(result, force_N=np.full(len(result.force_N), np.nan)) for result in results]
    if arguments.report:
        _write_report(arguments, results, replay.corners[0], calibration)
    report = [result.figures for result in results]
    if arguments.json:
        json.dump({"logs": report}, sys.stdout, indent=1)
        print()
    else:
        for figures in report:
            _print(figures)
    return 0


def _calibration(arguments: argparse.Namespace):
    """The calibration with the mounted pads; prints to stderr if it is that of another actuator, or not of a brake."""
    from emb_daemon.calibration.parameters import moved

    calibration = options.load_chosen(arguments.calibration)
    if arguments.pad_thickness is not None:
        calibration = moved(calibration, {"pad_thickness_mm": arguments.pad_thickness}, checked=True)
    if not calibration.contact.is_in_reach:
        clearance = calibration.contact.clearance_rad
        tell(
            f"{arguments.calibration}: contact.clearance_rad is {clearance:g} rad, so there is nothing to clamp; estimates "
            "are clamp forces, never negative, and no load judges them; `diagnose` takes a load of either sign"
        )
    if arguments.mapping and not arguments.calibration:
        tell(f"no --calibration: estimates are those of another actuator, {calibration.actuator}; identify makes this one's")
    return calibration


def _warn_of_other_motor(results, motor):
    """Print to stderr where current and motion of a log are not those of the calibration's ``motor``."""
    from emb_daemon.logs.currents import other_current, other_motor
    from emb_daemon.wire.layout import CORNERS

    for result in results:
        samples = result.samples
        lines = other_motor(samples, motor.torque_constant_Nm_per_A, motor.inertia_kg_m2)
        for line in lines or other_current(samples, result.force_N, motor):
            tell(f"{result.path}: {CORNERS[samples['corner'][0]]}: {line}")


def _secure(arguments: argparse.Namespace, read):
    """(``read``, restricted to authentic frames; function that authenticates frames), as in the daemon."""
    from emb_daemon.runtime.secured import Authentication, Freshness, FreshnessFile
    from emb_daemon.wire.keys import load_keys
    from emb_daemon.wire.secoc import load_links

    kept = FreshnessFile(arguments.state).load() if arguments.state else Freshness()
    authentication = Authentication(*load_links(), load_keys(arguments.keys), kept.next_trip())

    def read_authentic(path: Path):
        frames = authentication.verify(read(path))
        if not len(frames):
            raise InputError(f"{path}: contains only authentication frames")
        return frames

    return read_authentic, authentication.sign


def _check(arguments: argparse.Namespace) -> None:
    from emb_daemon.logs.write import FRAME_ENDINGS, TABLE_ENDINGS, ending_of
    from emb_daemon.replay import ALL

    output, report = arguments.output, arguments.report
    start_s, end_s = arguments.start_s, arguments.end_s
    if not 0.0 <= start_s < end_s:
        raise InputError(f"--from {start_s:g} --to {end_s:g}: expected 0 or more, and --to after --from")
    inputs = (*arguments.logs, arguments.calibration, arguments.mapping)
    if output:
        options.check_output(output, inputs, TABLE_ENDINGS + FRAME_ENDINGS)
    if report:
        options.check_output(report, inputs)
    if report and arguments.corner == ALL:
        raise InputError(f"--report: shows one corner; expected --corner FL, FR, RL or RR instead of {ALL}")
    if output and ending_of(output) in FRAME_ENDINGS:
        if report:
            raise InputError(f"--report: expected together with a table ({', '.join(TABLE_ENDINGS)}) or without --output")
        if arguments.measured_torque:
            raise InputError("--measured-torque: the daemon has no such input; expected a table as --output")


def _write_table(path: Path, results: list) -> None:
    """Rows in time order within each log; a column that only some logs have is empty in the others."""
    import numpy as np

    from emb_daemon.logs.write import reference_columns, table_columns, write_table

    tables = []
    for result in results:
        table = table_columns(result.estimates, 1e-9 * result.time_ns)
        tables.append(table | reference_columns(result.reference, result.estimates["time_ns"], result.force_N))
    names = dict.fromkeys(name for table in tables for name in table)
    empty = [np.full(len(table["time_s"]), np.nan) for table in tables]
    # The corners of a log follow one another; the drive's clock gives the order of all rows.
    order = np.argsort(np.concatenate([result.estimates["time_ns"] for result in results]), kind="stable")
    columns = {}
    for name in names:
        parts = [table.pop(name, none) for table, none in zip(tables, empty, strict=True)]
        columns[name] = np.concatenate(parts)[order]
    write_table(path, columns)


def _write_report(arguments: argparse.Namespace, results: list, corner: str, calibration) -> None:
    from emb_daemon.adapt.memory import Memory
    from emb_daemon.calibration.files import calibration_hash
    from emb_daemon.report.replay import replay_page

    described = f"{arguments.calibration or 'the shipped one'}, {calibration.actuator}, {calibration_hash(calibration)}"
    learned = Memory(arguments.state).read(corner) if arguments.state else None
    replay_page(results, corner, calibration, described, learned).write(arguments.report)


def _print(report: dict) -> None:
    print(f"{report['log']}, {report['corner']}: {report['samples']} samples, {report['seconds']:.1f} s")
    shares = report["reasons"] | ({"force invalid": report["invalid"]} if report["invalid"] else {})
    _shares("of the samples", shares)
    _shares("found", {TABLE[name].sentence: share for name, share in report["facts"].items()})
    forces, temperatures = report["force_N"], report["temperature_K"]
    if not forces and not temperatures:
        print("  no clamp force and no temperature reference to judge by")
    for unit, group in (("N", {k: v for k, v in forces.items() if isinstance(v, dict)}), ("K", temperatures)):
        for name, figures in group.items():
            _line(name, figures, unit)
            for condition, part in figures.get("conditions", {}).items():
                _line(f"  {condition}", part, unit)
    if forces:
        print(f"  inside two sigma: {100 * forces['inside_two_sigma']:.1f} %")


def _shares(what: str, shares: dict[str, float]) -> None:
    listed = [f"{word} {100.0 * share:.3g} %" for word, share in shares.items() if share >= _LEAST_SHARE]
    if listed:
        print(f"  {what}: {', '.join(listed)}")


def _line(name: str, figures: dict, unit: str) -> None:
    if figures["samples"]:
        print(
            f"  {name:<22} RMSE {figures['rmse']:8.2f} {unit}   bias {figures['bias']:8.2f}   "
            f"95 % {figures['p95']:8.2f}   max {figures['max']:8.2f}"
        )
