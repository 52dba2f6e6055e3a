"""Arguments that are paths."""

import argparse
from pathlib import Path
from typing import Any

#: Help text of --config where it is the daemon's, and of --calibration where it may be left out.
CONFIG_HELP = "the daemon's configuration"
CALIBRATION_HELP = "default: the shipped one, of the simulated rig A"


def add_path(parser: argparse._ActionsContainer, name: str, help: str, metavar: str = "FILE", **options: Any) -> None:
    """Add an argument that is a path; ``options`` as for `argparse`."""
    parser.add_argument(name, type=Path, metavar=metavar, help=help, **options)
