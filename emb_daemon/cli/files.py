"""emb-daemon files."""

import argparse
import sys

from emb_daemon.errors import InputError
from emb_daemon.resources import resource

EXAMPLE = "emb-daemon files dbc/emb.dbc >emb.dbc"

_FOLDERS = ("dbc", "config", "systemd", "completion")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "name", nargs="?", metavar="NAME", help="file whose content is printed; without one, all names and paths"
    )


def run(arguments: argparse.Namespace) -> int:
    names = [
        str(path.relative_to(resource(folder).parent))
        for folder in _FOLDERS
        for path in sorted(resource(folder).rglob("*"))
        if path.is_file()
    ]
    if arguments.name is None:
        for name in names:
            print(f"{name:42} {resource(name)}")
        return 0
    if arguments.name not in names:
        raise InputError(f"{arguments.name}: no such file; expected one of {', '.join(names)}")
    sys.stdout.write(resource(arguments.name).read_text(encoding="utf-8"))
    return 0
