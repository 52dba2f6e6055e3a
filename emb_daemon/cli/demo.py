"""emb-daemon demo."""

import argparse
from pathlib import Path

from emb_daemon.cli.options import add_path, check_output
from emb_daemon.errors import InputError

EXAMPLE = "emb-daemon demo --corners 4 --seconds 30"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--corners", type=int, choices=range(1, 5), default=4, metavar="N", help="1 to 4 brakes, FL first (4)")
    parser.add_argument("--seconds", type=float, default=30.0, metavar="S", help="length of the drive (30)")
    add_path(parser, "--picture", "where to save it", default=Path("emb-daemon-demo.png"))


def run(arguments: argparse.Namespace) -> int:
    from emb_daemon.demo.session import run_demo

    if not 1.0 <= arguments.seconds <= 3600.0:
        raise InputError(f"--seconds {arguments.seconds:g}: expected 1 to 3600")
    check_output(arguments.picture, [])
    return run_demo(arguments.corners, arguments.seconds, arguments.picture)
