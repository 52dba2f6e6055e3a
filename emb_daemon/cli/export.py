"""emb-daemon export."""

import argparse

from emb_daemon.ahead.library import default_path
from emb_daemon.atomic import write_atomically
from emb_daemon.cli.options import add_path, check_output

EXAMPLE = "emb-daemon export --calibration calibration.yaml --output brake.fmu"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_path(parser, "--calibration", "calibration of the actuator", required=True)
    add_path(parser, "--output", "file to write; .h: C header, .fmu: FMI 3.0 co-simulation", required=True)
    add_path(parser, "--kernels", "for .fmu: library that compile made (%(default)s)", default=default_path())


def run(arguments: argparse.Namespace) -> int:
    from emb_daemon.calibration.files import load_calibration

    check_output(arguments.output, [arguments.calibration, arguments.kernels], (".h", ".fmu"))
    calibration = load_calibration(arguments.calibration)
    if arguments.output.suffix == ".h":
        from emb_daemon.interface.header import header

        write_atomically(arguments.output, header(calibration).encode())
    else:
        from emb_daemon.interface.fmu import make_fmu

        write_atomically(arguments.output, make_fmu(calibration, arguments.kernels))
    print(f"{arguments.output}: {calibration.actuator}")
    return 0
