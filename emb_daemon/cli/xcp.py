"""emb-daemon xcp."""

import argparse

from emb_daemon.cli import options
from emb_daemon.cli.serving import serve

EXAMPLE = (
    "emb-daemon xcp --config /etc/emb_daemon/emb.yaml --udp 127.0.0.1:5555\n"
    "  emb-daemon xcp --config /etc/emb_daemon/emb.yaml --can -c can0"
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    options.add_path(parser, "--config", options.CONFIG_HELP, required=True)
    options.add_share_argument(parser)
    transport = parser.add_mutually_exclusive_group(required=True)
    transport.add_argument(
        "--udp",
        metavar="HOST:PORT",
        help="address to listen on; whoever reaches it can read, and write if the configuration allows it",
    )
    transport.add_argument(
        "--can", action="store_true", help="answer on CAN, on the bus of the options below or of the configuration"
    )
    options.add_id_arguments(parser, 0x720, 0x728)
    options.add_bus_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    from emb_daemon.calibration.configuration import Setup
    from emb_daemon.workshop.a2l import NAME, make_a2l, version_of
    from emb_daemon.workshop.measure import Measurement

    setup = Setup(arguments.config)
    calibrate = setup.configuration.xcp.calibrate
    transport, connection, where = _udp(arguments.udp) if arguments.udp else _can(arguments, setup)
    try:
        version, file = version_of(setup.calibrations, calibrate), make_a2l(setup.calibrations, connection, calibrate)
        measurement = Measurement(
            arguments.share, transport, version.encode(), NAME.encode(), file, setup.calibrations if calibrate else None
        )
        serve(measurement, f"XCP on {where}: {version}" + (", calibration" if calibrate else ""))
    finally:
        transport.close()
    return 0


def _udp(text: str):
    from emb_daemon.workshop.ifdata import over_udp
    from emb_daemon.workshop.measure import Udp

    host, port = options.host_and_port(text)
    transport = Udp(host, port)
    return transport, over_udp(host, transport.port), f"UDP {host}:{transport.port}"


def _can(arguments: argparse.Namespace, setup):
    import numpy as np

    from emb_daemon.runtime.bus import open_bus
    from emb_daemon.workshop.ifdata import over_can
    from emb_daemon.workshop.measure import Can

    layout = setup.layout[0]
    options.check_ids(arguments, {*layout["sent_id"].ravel().tolist(), *np.flatnonzero(layout["slot"] != -1).tolist()})
    of_bus = options.bus_options(arguments, setup.configuration.bus)
    transport = Can(open_bus(**of_bus, ids=[arguments.request_id]), arguments.request_id, arguments.response_id)
    connection = over_can(arguments.request_id, arguments.response_id, of_bus["bitrate"])
    return transport, connection, f"CAN {arguments.request_id:#x}, {arguments.response_id:#x}"
