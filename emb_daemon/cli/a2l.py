"""emb-daemon a2l."""

import argparse
from pathlib import Path

EXAMPLE = "emb-daemon a2l --config /etc/emb_daemon/emb.yaml --output emb_daemon.a2l"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--config", type=Path, required=True, metavar="FILE", help="the daemon's configuration")
    parser.add_argument("--output", type=Path, required=True, metavar="FILE", help=".a2l")


def run(arguments: argparse.Namespace) -> int:
    from emb_daemon.atomic import write_atomically
    from emb_daemon.calibration.configuration import Setup
    from emb_daemon.cli.outputs import check_output
    from emb_daemon.workshop.a2l import VERSION, make_a2l

    check_output(arguments.output, [arguments.config], (".a2l",))
    write_atomically(arguments.output, make_a2l(Setup(arguments.config).calibrations))
    print(f"{arguments.output}: {VERSION}")
    return 0
