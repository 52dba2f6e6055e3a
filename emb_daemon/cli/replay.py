"""emb-daemon replay."""

import argparse
import sys
from pathlib import Path

EXAMPLE = "emb-daemon replay stop.log.gz --calibration config/calibration.yaml --output estimates.csv"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("logs", nargs="+", type=Path, metavar="LOG", help=".log, .log.gz, .asc, .blf, .trc or .mf4")
    parser.add_argument("--calibration", type=Path, metavar="FILE", help="default: the shipped one, of the simulated rig A")
    parser.add_argument("--mapping", type=Path, metavar="FILE", help="YAML that maps another rig's DBC to our signals")
    parser.add_argument("--corner", default="FL", help="FL, FR, RL or RR (default FL)")
    parser.add_argument("--pad-thickness", type=float, metavar="MM", help="thickness of the pads mounted, if not the file's")
    parser.add_argument(
        "--measured-torque", action="store_true", help="heat the pads with the rig's brake torque sensor, which no car has"
    )
    parser.add_argument(
        "--state", type=Path, metavar="DIR", help="adapt: read what was learned from DIR, learn, and keep it there"
    )
    parser.add_argument(
        "--output",
        type=Path,
        metavar="FILE",
        help="estimates as .csv, .parquet or .signals.mf4, or the frames that the daemon would have sent as .log, .blf, .asc, "
        ".trc or .mf4",
    )
    parser.add_argument("--report", type=Path, metavar="FILE.html", help="a page to look at: forces, errors, heat, events")
    parser.add_argument("--json", action="store_true", help="error figures as JSON")


def run(arguments: argparse.Namespace) -> int:
    import json

    import msgspec
    import numpy as np

    from emb_daemon.calibration.files import calibration_hash, load_calibration
    from emb_daemon.errors import InputError
    from emb_daemon.logs.mapping import Mapping
    from emb_daemon.logs.read import read_frames
    from emb_daemon.logs.write import FRAME_ENDINGS, TABLE_ENDINGS, ending_of, table_columns, write_frames, write_table
    from emb_daemon.replay import Replay
    from emb_daemon.resources import resource

    output = arguments.output
    ending = ending_of(output) if output else None
    if output and ending not in TABLE_ENDINGS + FRAME_ENDINGS:
        raise InputError(f"{output}: unknown ending, expected one of {', '.join(TABLE_ENDINGS + FRAME_ENDINGS)}")
    if output and not output.parent.is_dir():
        raise InputError(f"{output}: no such folder: {output.parent}")
    if arguments.report and not arguments.report.absolute().parent.is_dir():
        raise InputError(f"{arguments.report}: no such folder: {arguments.report.absolute().parent}")
    calibration = load_calibration(arguments.calibration or resource("config/calibration.yaml"))
    if arguments.pad_thickness is not None:
        calibration = msgspec.structs.replace(calibration, pad_thickness_mm=arguments.pad_thickness)
    read = Mapping(arguments.mapping).read if arguments.mapping else read_frames
    replay = Replay(calibration, arguments.corner, arguments.measured_torque, arguments.state, read)
    if ending in FRAME_ENDINGS:
        if arguments.report:
            raise InputError(f"--report: expected together with a table ({', '.join(TABLE_ENDINGS)}) or without --output")
        if arguments.measured_torque:
            raise InputError("--measured-torque: the daemon has no such input, so there are no frames it would have sent")
        write_frames(output, np.concatenate([part for log in arguments.logs for part in replay.frames(log)]))
        return 0
    results = [replay.run(log) for log in arguments.logs]
    if output:
        tables = [table_columns(result.estimates, 1e-9 * result.time_ns) for result in results]
        write_table(output, {name: np.concatenate([table[name] for table in tables]) for name in tables[0]})
    if arguments.report:
        from emb_daemon.adapt.memory import Memory
        from emb_daemon.report.replay import replay_page

        described = f"{arguments.calibration or 'the shipped one'}, {calibration.actuator}, {calibration_hash(calibration)}"
        learned = Memory(arguments.state).read(arguments.corner) if arguments.state else None
        page = replay_page(results, arguments.corner, described, learned, calibration)
        page.write(arguments.report)
    report = [result.figures() for result in results]
    if arguments.json:
        json.dump({"logs": report}, sys.stdout, indent=1)
        print()
    else:
        for figures in report:
            _print(figures)
    return 0


def _print(report: dict) -> None:
    print(f"{report['log']}: {report['samples']} samples, {report['seconds']:.1f} s")
    forces, temperatures = report["force_N"], report["temperature_K"]
    if not forces and not temperatures:
        print("  no reference signals in this log")
    for unit, group in (("N", {k: v for k, v in forces.items() if isinstance(v, dict)}), ("K", temperatures)):
        for name, figures in group.items():
            _line(name, figures, unit)
            for condition, part in figures.get("conditions", {}).items():
                _line(f"  {condition}", part, unit)
    if forces:
        print(f"  inside two sigma: {100 * forces['inside_two_sigma']:.1f} %")


def _line(name: str, figures: dict, unit: str) -> None:
    if figures["samples"]:
        print(
            f"  {name:<22} RMSE {figures['rmse']:8.2f} {unit}   bias {figures['bias']:8.2f}   "
            f"95 % {figures['p95']:8.2f}   max {figures['max']:8.2f}"
        )
