"""emb-daemon convert."""

import argparse

from emb_daemon.cli.options import LOG_HELP, add_mapping_argument, add_path, check_output, log_reader

EXAMPLE = "emb-daemon convert bench.csv --mapping my_rig.yaml --output bench.log"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_path(parser, "log", LOG_HELP, "LOG")
    add_mapping_argument(parser, required=True)
    add_path(parser, "--output", ".log, .blf, .asc, .trc or .mf4", required=True)


def run(arguments: argparse.Namespace) -> int:
    from emb_daemon.logs.write import FRAME_ENDINGS, write_frames

    check_output(arguments.output, [arguments.log, arguments.mapping], FRAME_ENDINGS)
    frames = log_reader(arguments.mapping)(arguments.log)
    write_frames(arguments.output, frames)
    print(f"{arguments.output}: {len(frames)} frames, {1e-9 * float(frames['time_ns'][-1] - frames['time_ns'][0]):.1f} s")
    return 0
