"""emb-daemon identify."""

import argparse
import sys
from pathlib import Path

EXAMPLE = "emb-daemon identify campaign.yaml --output calibration.yaml --report report"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("campaign", type=Path, metavar="CAMPAIGN.yaml", help="which log plays which part")
    parser.add_argument("--output", type=Path, required=True, metavar="CALIBRATION.yaml", help="calibration to write")
    parser.add_argument(
        "--report", type=Path, metavar="DIR", help="folder for report.html: every step with data, fit, residual"
    )


def run(arguments: argparse.Namespace) -> int:
    from emb_daemon.calibration.files import calibration_hash, save_calibration
    from emb_daemon.errors import InputError
    from emb_daemon.identify.campaign import load_campaign
    from emb_daemon.identify.run import identify
    from emb_daemon.identify.table import table

    if not arguments.output.parent.is_dir():
        raise InputError(f"{arguments.output}: no such folder: {arguments.output.parent}")
    campaign = load_campaign(arguments.campaign)
    result = _with_progress(lambda progress: identify(campaign, progress))
    for fault in campaign.faults:
        print(fault, file=sys.stderr)
    try:
        save_calibration(result.calibration, arguments.output)
        if arguments.report:
            from emb_daemon.identify.report import build

            arguments.report.mkdir(parents=True, exist_ok=True)
            build(result).write(arguments.report / "report.html")
    except OSError as error:
        raise InputError(f"{error.filename or arguments.output}: cannot be written: {error.strerror}") from None
    _print(table(result))
    print(f"{arguments.output}: calibration {calibration_hash(result.calibration)}, {result.seconds:.0f} s")
    return 0


def _print(lines) -> None:
    rows = [("RMSE on logs that fitted nothing", "", "thesis reports", "thesis form", "ours", "to reach", "")]
    for line in lines:
        verdict = {True: "met", False: "MISSED", None: ""}[line.met]
        thesis, ours = line.spread(line.thesis), line.spread(line.ours)
        rows.append((line.judged_on, line.unit, line.thesis_reports, thesis, ours, line.target, verdict))
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    for row in rows if lines else ():
        print("  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip())


def _with_progress(work):
    from rich.console import Console

    console = Console(stderr=True)
    if not console.is_terminal:
        return work(lambda share, text: None)
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (BarColumn(), TextColumn("{task.percentage:3.0f} %"), TimeElapsedColumn(), TextColumn("{task.description}"))
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task("", total=1.0)
        return work(lambda share, text: bar.update(task, completed=share, description=text))
