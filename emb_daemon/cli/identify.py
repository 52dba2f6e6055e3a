"""emb-daemon identify."""

import argparse
from pathlib import Path

from emb_daemon.cli.options import add_mapping_argument, add_path, check_output, open_mapping
from emb_daemon.cli.progress import progress
from emb_daemon.errors import InputError, tell

#: Exit status if the calibration is written although a log for it is missing or could not be used. Logs with thermocouples in
#: the pads may be missing, because many users have no such rig.
INCOMPLETE = 3
EXAMPLE = "emb-daemon identify campaign.yaml --output calibration.yaml --report report"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_path(parser, "campaign", "campaign file: which log was recorded for which purpose", "CAMPAIGN.yaml", nargs="?")
    add_mapping_argument(parser)
    add_path(parser, "--output", "calibration to write", "CALIBRATION.yaml")
    add_path(parser, "--report", "folder for report.html: every step with data, fit, residual", "DIR")
    add_path(parser, "--example", "only write the files of a simulated rig into DIR, to start from", "DIR")


def run(arguments: argparse.Namespace) -> int:
    from emb_daemon.calibration.files import calibration_hash, save_calibration
    from emb_daemon.identify.campaign import load_campaign
    from emb_daemon.identify.report import build
    from emb_daemon.identify.run import identify
    from emb_daemon.identify.steps import thermal
    from emb_daemon.identify.steps.attribution import words
    from emb_daemon.logs.read import read_with_digest

    if arguments.example:
        return _example(arguments.example)
    _check_outputs(arguments)
    read = open_mapping(arguments.mapping).read_with_digest if arguments.mapping else read_with_digest
    campaign = load_campaign(arguments.campaign, read)
    with progress() as show:
        result = identify(campaign, show)
    for fault in campaign.faults:
        tell(fault)
    save_calibration(result.calibration, arguments.output)
    if arguments.report:
        arguments.report.mkdir(parents=True, exist_ok=True)
        build(result).write(arguments.report / "report.html")
    _print(result.validations, result.thermal.figures)
    print(" ".join(filter(None, (words(result.attribution), thermal.words(result.thermal)))))
    missing = [fault for fault in campaign.faults if not fault.startswith("thermal")]
    also = f", without what {len(missing)} lines above say (exit status {INCOMPLETE})" if missing else ""
    print(f"{arguments.output}: calibration {calibration_hash(result.calibration)}, {result.seconds:.0f} s{also}")
    return INCOMPLETE if missing else 0


def _example(folder: Path) -> int:
    from emb_daemon.identify.example import write_example

    print("\n".join(map(str, write_example(folder))))
    print(
        "\nThese are files of a simulated rig. Next:\n"
        f"  emb-daemon identify {folder}/campaign.yaml --mapping {folder}/mapping.yaml --output {folder}/calibration.yaml"
    )
    return 0


def _check_outputs(arguments: argparse.Namespace) -> None:
    """Check the output paths before minutes of work."""
    if not arguments.campaign or not arguments.output:
        raise InputError("identify: expected CAMPAIGN.yaml and --output CALIBRATION.yaml, or --example DIR")
    check_output(arguments.output, [arguments.campaign, arguments.mapping])
    if arguments.report and arguments.report.exists() and not arguments.report.is_dir():
        raise InputError(f"{arguments.report}: is a file, expected a folder for the report")
    if arguments.report and arguments.report.resolve() == arguments.output.resolve():
        raise InputError(f"{arguments.report}: is the calibration's file, expected a folder for the report")


def _print(validations: list, temperatures: dict[str, float]) -> None:
    from emb_daemon.identify.validation import COLUMNS, rows

    lines = [["RMSE on logs that fitted nothing", *COLUMNS[1:]], *rows(validations)] if validations else []
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    for name, *cells in lines:
        print("  ".join([name.ljust(widths[0]), *(c.rjust(w) for c, w in zip(cells, widths[1:], strict=True))]))
    for name, value in temperatures.items():
        print(f"{name}: {value:.3g}")
