"""Is an estimate ever silently wrong? Drives on which something is not as calibrated, judged phase by phase.

    python -m studies.silent service ../shared/rig/service [--logs NAME,NAME] [--cut T] [--json]
        logs of a (simulated) rig with reference force: nothing, one thing, changed; training from 242 to 284 s.
    python -m studies.silent grid [--faults NAME,NAME | --pair NAME,NAME] [--count N] [--seed S] [--drives] [--json]
        drives of our own simulated car, with one fault or change each, and with pairs of them (`studies.faults`).
    python -m studies.silent grid --stranger DIR/SEED ...
        the same with another brake and the calibration that `python -m studies.strangers --seeds SEED --kept DIR` made of it.
    python -m studies.silent injected LOG --calibration FILE [--faults NAME,NAME] [--count N] [--seed S] [--drives] [--json]
        a log of any brake with reference force, with the faults of sensors and bus put into its frames.

The table in docs/safety.md holds the present figures.

Other logs are judged as one phase. Every log is run through the daemon's own pipeline with adaptation, in a folder of its own.
"""

import argparse
import sys
import tempfile
import time
from collections.abc import Iterable
from pathlib import Path

import msgspec
import numpy as np

from emb_daemon.calibration.files import load_calibration
from emb_daemon.errors import InputError
from emb_daemon.logs.read import read_frames
from emb_daemon.replay import Replay
from emb_daemon.resources import resource
from studies.phases import (
    HEADINGS,
    LEARNED_RMSE_N,
    LEARNED_USEFUL,
    NOMINAL_USEFUL,
    NOMINAL_WORSE,
    POWER_ON_S,
    Phase,
    first_flag_s,
    judge,
    line,
)

#: When the service logs' training begins and ends, s.
_TRAINING_S = (242.0, 284.0)
#: Begin of the change of a service log, s, if not at the start.
_ONSET_S = {"contact_plus_40um": 80.0, "current_offset_later": 60.0, "resolver_frozen": 61.27, "wheel_frames_lost": 20.0}
#: Changes that driving and training must have healed afterwards.
_HEALED = ("pads_6p5mm", "compound_stiffer", "contact_plus_40um", "current_offset_later", "disc_growth")
#: RMSE of `nominal` by phase, N, by the estimator as it was before this study.
_NOMINAL_RMSE_N = {"before": 31.5, "training": 35.5, "after": 34.7}
#: Between these lines of docs/safety.md stands the table that `grid --table` writes.
_BEGIN, _END = "<!-- detection times: begin -->", "<!-- detection times: end -->"


def run_frames(path: Path, calibration, frames: np.ndarray, begin_ns: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times (s, since ``begin_ns``), ESTIMATE rows and reference force (N) of the log ``path``, of which only these ``frames``
    are heard, with adaptation."""
    with tempfile.TemporaryDirectory() as state:
        result = Replay(calibration, state=Path(state), read=lambda _: frames).run(path)
    return 1e-9 * (result.time_ns - begin_ns), result.estimates, result.force_N


def run_log(path: Path, calibration, cut_s: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The same of a log from ``cut_s`` on."""
    frames = read_frames(path)
    begin_ns = int(frames["time_ns"][0])
    return run_frames(path, calibration, frames[frames["time_ns"] - begin_ns >= 1e9 * cut_s], begin_ns)


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


def _print_json(figures: dict) -> None:
    """Print JSON with null for values that are not finite."""
    print(msgspec.json.format(msgspec.json.encode(figures), indent=1).decode())


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
        onset = max(_ONSET_S.get(name, 0.0), time_s[0] + POWER_ON_S)
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
        _print_json({"failing": failing, "phases": total, "logs": report})
    else:
        print(f"{failing} of {total} phases fail")
    return failing


def _tabulate(reports: list[dict]) -> list[dict]:
    """Verdicts of drives by family; pairs are one family."""
    groups: dict[str, list[dict]] = {}
    for report in reports:
        groups.setdefault("pairs" if "+" in report["family"] else report["family"], []).append(report)
    table = []
    for family, drives in groups.items():
        phases = [phase for drive in drives for phase in drive["phases"]]
        after = [phase for phase in phases if phase["name"] == "after"]
        told = [drive["first_flag_s"] for drive in drives]
        table.append(
            {
                "family": family,
                "drives": len(drives),
                "failing_drives": sum(any(phase["failed"] for phase in drive["phases"]) for drive in drives),
                "phases": len(phases),
                "failing_phases": sum(bool(phase["failed"]) for phase in phases),
                "silent_large": sum("silent beyond 1 kN" in phase["failed"] for phase in phases),
                "worst_silent_N": max(phase["worst_silent_N"] for phase in phases),
                "trained": sum(drive["trained"] for drive in drives),
                "flagged": int(np.isfinite(told).sum()),
                "first_flag_s": float(np.nanmedian(told)) if np.isfinite(told).any() else np.nan,
                "latest_flag_s": float(np.nanmax(told)) if np.isfinite(told).any() else np.nan,
                "after_rmse_N": float(np.median([phase["rmse_N"] for phase in after])) if after else np.nan,
                "after_useful": float(np.median([phase["useful"] for phase in after])) if after else np.nan,
            }
        )
    return table


def _print_families(table: list[dict]) -> None:
    print(f"{'family':<29}{'drives':>7}{'fail':>6}{'phases':>8}{'fail':>6}{'>1 kN':>6}{'worst':>10}{'trained':>8}"
          f"{'flagged':>9}{'median':>8}{'latest':>8}{'RMSE after':>12}{'useful after':>13}")  # fmt: skip
    for row in table:
        print(
            f"{row['family']:<29}{row['drives']:>7}{row['failing_drives']:>6}{row['phases']:>8}{row['failing_phases']:>6}"
            f"{row['silent_large']:>6}{row['worst_silent_N']:>8.3g} N{row['trained']:>8}{row['flagged']:>9}"
            f"{row['first_flag_s']:>6.1f} s{row['latest_flag_s']:>6.1f} s{row['after_rmse_N']:>10.3g} N"
            f"{100 * row['after_useful']:>11.1f} %"
        )


def _write_table(page: Path, table: list[dict], options: str) -> None:
    """The section of a page between its two `detection times` comments, anew. Raises InputError: the page has no such
    comments."""
    text = page.read_text()
    head, begin, rest = text.partition(_BEGIN)
    _, end, tail = rest.partition(_END)
    if not end:
        raise InputError(f"{page}: expected the lines {_BEGIN} and {_END}")
    rows = [
        f"| {row['family'].replace('_', ' ')} | {row['flagged']} of {row['drives']} | {_seconds(row['first_flag_s'])} | "
        f"{_seconds(row['latest_flag_s'])} | {row['failing_phases']} of {row['phases']} | {row['silent_large']} | "
        f"{row['worst_silent_N']:.0f} |"
        for row in table
    ]
    lines = [
        f"Written by `python -m studies.silent grid {options} --table {page}`.",
        "",
        "| fault or change | flagged | first flag, median s | latest, s | failing phases | beyond 1 kN | worst unflagged, N |",
        "|---|---|---|---|---|---|---|",
        *rows,
    ]
    page.write_text(head + begin + "\n" + "\n".join(lines) + "\n" + end + tail)


def _seconds(value: float) -> str:
    return "" if np.isnan(value) else f"{value:.1f}"


def _families(given: str | None, usual: Iterable[str]) -> list[str]:
    """Names of families that are ``given``, comma-separated, or by the module that holds them; the ``usual`` ones if none are.
    Raises InputError: an unknown name."""
    from studies import senders, unlisted
    from studies.grid import FAMILIES

    modules = {"unlisted": unlisted.FAMILIES, "senders": senders.FAMILIES}
    chosen = [family for name in given.split(",") for family in modules.get(name, [name])] if given else list(usual)
    if unknown := sorted(set(chosen) - set(FAMILIES)):
        raise InputError(
            f"fault {', '.join(unknown)}: expected {', '.join(modules)} for all of those, or {', '.join(FAMILIES)}"
        )
    return chosen


def grid(arguments: argparse.Namespace) -> int:
    """Drives of the simulated car; returns the number of phases that fail."""
    from studies import faults
    from studies.grid import brake_of, pairs_of, run_grid

    brake_of(arguments.stranger)

    chosen = _families(arguments.faults or arguments.pair, faults.FAMILIES)
    if arguments.pair:
        tasks = [(tuple(chosen), number) for number in range(arguments.first, arguments.first + arguments.count)]
    else:
        tasks = [((name,), number) for name in chosen for number in range(arguments.first, arguments.first + arguments.count)]
        pairs = arguments.pairs if arguments.pairs is not None else 0 if arguments.faults else 100
        tasks += [(pair, number) for number, pair in enumerate(pairs_of(pairs, arguments.seed, chosen))]
    begun = time.monotonic()
    table, reports = _collect(
        run_grid(tasks, arguments.seed, arguments.stranger, arguments.processes, arguments.drawn), arguments
    )
    if arguments.table:
        drawn = {"count": arguments.count, "pairs": arguments.pairs, "seed": arguments.seed}
        options = " ".join(f"--{name} {value}" for name, value in drawn.items() if value is not None)
        _write_table(arguments.table, table, options)
    return _print_drives(table, reports, arguments, time.monotonic() - begun)


def injected(arguments: argparse.Namespace) -> int:
    """A log with faults in its frames; returns the number of phases that fail."""
    from studies import faults, unlisted
    from studies.grid import FAMILIES
    from studies.injected import judge_injected

    calibration = load_calibration(arguments.calibration)
    chosen = _families(arguments.faults, faults.FAMILIES | unlisted.FAMILIES)
    begun, begin_ns = time.monotonic(), int(read_frames(arguments.log)["time_ns"][0])

    def run(frames):
        return run_frames(arguments.log, calibration, frames, begin_ns)

    tasks = ((name, number) for name in chosen for number in range(arguments.count))
    verdicts = (
        judge_injected(arguments.log, calibration, FAMILIES[name], name, number, arguments.seed, run) for name, number in tasks
    )
    table, reports = _collect((verdict for verdict in verdicts if verdict), arguments)
    return _print_drives(table, reports, arguments, time.monotonic() - begun)


def _collect(verdicts: Iterable[dict], arguments: argparse.Namespace) -> tuple[list[dict], list[dict]]:
    """Verdicts by family, and all as they came; prints them as they come if asked to."""
    reports = []
    if arguments.drives:
        print(f"  {HEADINGS}")
    for report in verdicts:
        reports.append(report)
        if arguments.drives:
            flag = report["first_flag_s"]
            told = "never flagged" if np.isnan(flag) else f"first flag after {flag:.2f} s"
            told += f", trained {report['trained']} times"
            print(f"{report['family']} {report['number']}: {report['size']} from {report['onset_s']:.1f} s, {told}")
            print(*(f"  {line(Phase(**phase))}" for phase in report["phases"]), sep="\n", flush=True)
    return _tabulate(reports), reports


def _print_drives(table: list[dict], reports: list[dict], arguments: argparse.Namespace, seconds: float) -> int:
    """All figures; returns the number of phases that fail."""
    failing, total = sum(row["failing_phases"] for row in table), sum(row["phases"] for row in table)
    if arguments.json:
        figures = {"seed": arguments.seed, "failing": failing, "phases": total, "families": table, "drives": reports}
        _print_json(figures)
    else:
        _print_families(table)
        drives = sum(row["failing_drives"] for row in table)
        summary = f"{failing} of {total} phases, {drives} of {len(reports)} drives fail"
        print(f"seed {arguments.seed}: {summary}; {seconds:.0f} s")
    return failing


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m studies.silent", description=__doc__.split("\n")[0])
    commands = parser.add_subparsers(required=True)
    logs = commands.add_parser("service", help="logs of a rig with reference force")
    logs.add_argument("paths", nargs="+", type=Path, metavar="FOLDER|LOG")
    logs.add_argument("--logs", metavar="NAME,NAME", help="only these logs of the folder")
    logs.add_argument("--cut", type=float, default=0.0, metavar="T", help="begin T s into the log: power comes in the middle")
    logs.add_argument("--calibration", type=Path, metavar="FILE", help="default: the shipped one, of the simulated rig A")
    logs.set_defaults(run=service)
    drives = commands.add_parser("grid", help="drives of our own simulated car")
    drives.add_argument(
        "--faults", metavar="NAME,NAME", help="only these families, or all of `unlisted` or `senders`, and no pairs"
    )
    drives.add_argument("--pair", metavar="NAME,NAME", help="only drives with both of these")
    drives.add_argument("--count", type=int, default=18, metavar="N", help="drives of each family (default 18)")
    drives.add_argument("--first", type=int, default=0, metavar="N", help="number of the first (default 0)")
    drives.add_argument("--pairs", type=int, metavar="N", help="drives with two faults (default 100, none with --faults)")
    drives.add_argument("--stranger", type=Path, metavar="DIR/SEED", help="a brake of `studies.strangers`, not our own")
    drives.add_argument("--drawn", action="store_true", help="how and when is braked is drawn, too")
    drives.add_argument("--processes", type=int, default=2, metavar="N")
    drives.add_argument("--table", type=Path, metavar="FILE.md", help="write the table of detection times into this page")
    drives.set_defaults(run=grid)
    inside = commands.add_parser("injected", help="a log of any brake, with faults put into its frames")
    inside.add_argument("log", type=Path, metavar="LOG")
    inside.add_argument("--calibration", type=Path, metavar="FILE", required=True)
    inside.add_argument("--faults", metavar="NAME,NAME", help="only these, or all of `unlisted` or `senders`")
    inside.add_argument("--count", type=int, default=2, metavar="N", help="of each family (default 2)")
    inside.set_defaults(run=injected)
    for command in (drives, inside):
        command.add_argument("--seed", type=int, default=1, metavar="S")
        command.add_argument("--drives", action="store_true", help="print every drive")
    for command in (logs, drives, inside):
        command.add_argument("--json", action="store_true")
        command.add_argument("--strict", action="store_true", help="exit status 1 if a phase fails")
    arguments = parser.parse_args(argv)
    try:
        failing = arguments.run(arguments)
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    return int(arguments.strict and failing > 0)


if __name__ == "__main__":
    sys.exit(main())
