"""emb-daemon a2l."""

import argparse

from emb_daemon.cli.options import CONFIG_HELP, add_id_arguments, add_path, host_and_port

EXAMPLE = "emb-daemon a2l --config /etc/emb_daemon/emb.yaml --output emb_daemon.a2l --udp 192.168.1.10:5555"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_path(parser, "--config", CONFIG_HELP, required=True)
    add_path(parser, "--output", "A2L file to write", required=True)
    transport = parser.add_mutually_exclusive_group()
    transport.add_argument("--udp", metavar="HOST:PORT", help="address of the XCP server, to be stated in the file")
    transport.add_argument("--can", action="store_true", help="state in the file that the XCP server is on CAN")
    add_id_arguments(parser, 0x720, 0x728)
    parser.add_argument("-b", "--bitrate", type=int, help="bit/s of that bus (default: the configuration's)")


def run(arguments: argparse.Namespace) -> int:
    from emb_daemon.atomic import write_atomically
    from emb_daemon.calibration.configuration import Setup
    from emb_daemon.cli.options import check_output
    from emb_daemon.workshop.a2l import make_a2l, version_of
    from emb_daemon.workshop.ifdata import over_can, over_udp

    check_output(arguments.output, [arguments.config], (".a2l",))
    setup, connection = Setup(arguments.config), None
    if arguments.udp:
        connection = over_udp(*host_and_port(arguments.udp))
    elif arguments.can:
        bitrate = arguments.bitrate or setup.configuration.bus.bitrate
        connection = over_can(arguments.request_id, arguments.response_id, bitrate)
    calibrate = setup.configuration.xcp.calibrate
    write_atomically(arguments.output, make_a2l(setup.calibrations, connection, calibrate))
    print(f"{arguments.output}: {version_of(setup.calibrations, calibrate)}")
    return 0
