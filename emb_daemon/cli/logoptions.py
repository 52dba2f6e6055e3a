"""How a command reads logs: as they are, or through a mapping file."""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from emb_daemon.cli.paths import add_path

if TYPE_CHECKING:
    from emb_daemon.logs.mapping import Mapping

#: Help text of LOG.
LOG_HELP = (
    ".log, .log.gz, .asc, .blf, .trc or .mf4; with --mapping also tables (.csv, .xlsx, .parquet, .mat, .h5, .tdms, .json, …) "
    "and measurements (.mf4)"
)


def add_mapping_argument(parser: argparse.ArgumentParser, required: bool = False) -> None:
    add_path(parser, "--mapping", "YAML file that maps another rig's signals to the daemon's", required=required)


def open_mapping(path: Path) -> "Mapping":
    """A `logs.mapping.Mapping`; prints to stderr which signals its rig does not measure."""
    from emb_daemon.logs.mapping import Mapping

    mapping = Mapping(path)
    for note in mapping.notes:
        print(note, file=sys.stderr)
    return mapping


def log_reader(mapping: Path | None) -> Callable:
    """Function that reads a log's FRAME array from its path.

    Raises:
        InputErrors: the mapping file is faulty.
    """
    from emb_daemon.logs.read import read_frames

    return open_mapping(mapping).read if mapping else read_frames
