"""emb-daemon diagnose."""

import argparse
import json

from emb_daemon.atomic import write_atomically
from emb_daemon.cli.options import add_mapping_argument, add_path, log_reader
from emb_daemon.cli.progress import progress
from emb_daemon.errors import InputError

EXAMPLE = "emb-daemon diagnose fit.log.gz --calibration config/calibration.yaml --validate val.log.gz --output found"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_path(parser, "logs", "logs to find effects in", "FIT_LOG", nargs="+")
    add_path(parser, "--calibration", "calibration to start from", required=True)
    add_path(parser, "--validate", "logs for validation only (default: episodes left out)", "LOG", nargs="+", default=[])
    add_path(parser, "--output", "folder for calibration.yaml, report.json, report.html", "DIR", required=True)
    add_mapping_argument(parser)
    parser.add_argument("--corner", default="FL", help="FL, FR, RL or RR (default FL)")


def run(arguments: argparse.Namespace) -> int:
    from rich.console import Console

    from emb_daemon.calibration.files import load_calibration, save_calibration
    from emb_daemon.diagnose.diagnosis import diagnose
    from emb_daemon.diagnose.page import page
    from emb_daemon.diagnose.report import report
    from emb_daemon.diagnose.text import table, verdict
    from emb_daemon.offline import corner_index, load_log

    corner_index(arguments.corner)
    calibration = load_calibration(arguments.calibration)
    read = log_reader(arguments.mapping)
    with progress("reading logs") as show:
        logs = [load_log(path, arguments.corner, read) for path in [*arguments.logs, *arguments.validate]]
        try:
            arguments.output.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{arguments.output}: cannot be a folder for results: {error.strerror}") from None
        fit_logs, judges = logs[: len(arguments.logs)], logs[len(arguments.logs) :]
        diagnosis = diagnose(fit_logs, calibration, judges, lambda text, share: show(share, text))
    save_calibration(diagnosis.calibration, arguments.output / "calibration.yaml")
    text = json.dumps(report(diagnosis), indent=1, ensure_ascii=False)
    write_atomically(arguments.output / "report.json", text.encode())
    write_atomically(arguments.output / "report.html", page(diagnosis).encode())
    # Equations have square brackets and names of terms colons, which are no markup.
    console = Console(markup=False, emoji=False)
    console.print(verdict(diagnosis))
    console.print(table(diagnosis))
    console.print(f"calibration, report.html and report.json are in {arguments.output}", highlight=False)
    return 0
