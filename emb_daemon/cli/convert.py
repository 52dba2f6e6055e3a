"""emb-daemon convert."""

import argparse
from pathlib import Path

from emb_daemon.cli.logoptions import LOG_HELP, add_mapping_argument, log_reader
from emb_daemon.cli.outputs import check_output

EXAMPLE = "emb-daemon convert bench.csv --mapping my_rig.yaml --output bench.log"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("log", type=Path, metavar="LOG", help=LOG_HELP)
    add_mapping_argument(parser, required=True)
    parser.add_argument("--output", type=Path, required=True, metavar="FILE", help=".log, .blf, .asc, .trc or .mf4")


def run(arguments: argparse.Namespace) -> int:
    from emb_daemon.logs.write import FRAME_ENDINGS, write_frames

    check_output(arguments.output, [arguments.log, arguments.mapping], FRAME_ENDINGS)
    frames = log_reader(arguments.mapping)(arguments.log)
    write_frames(arguments.output, frames)
    print(f"{arguments.output}: {len(frames)} frames, {1e-9 * float(frames['time_ns'][-1] - frames['time_ns'][0]):.1f} s")
    return 0
