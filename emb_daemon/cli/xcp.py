"""emb-daemon xcp."""

import argparse
from pathlib import Path

from emb_daemon.cli.busoptions import add_bus_arguments, add_id_arguments, host_and_port
from emb_daemon.cli.serving import serve

EXAMPLE = (
    "emb-daemon xcp --config /etc/emb_daemon/emb.yaml --share /run/emb_daemon/estimates --udp 127.0.0.1:5555\n"
    "  emb-daemon xcp --config /etc/emb_daemon/emb.yaml --share /run/emb_daemon/estimates --can -c can0"
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--config", type=Path, required=True, metavar="FILE", help="the daemon's configuration")
    parser.add_argument("--share", type=Path, required=True, metavar="FILE", help="as given to emb-daemon run")
    transport = parser.add_mutually_exclusive_group(required=True)
    transport.add_argument("--udp", metavar="HOST:PORT", help="address to be reached at; whoever reaches it can read")
    transport.add_argument("--can", action="store_true", help="on the bus of the options below, or of the configuration")
    add_id_arguments(parser, 0x720, 0x728)
    add_bus_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    from emb_daemon.calibration.configuration import Setup
    from emb_daemon.workshop.a2l import NAME, VERSION, make_a2l
    from emb_daemon.workshop.measure import Measurement

    setup = Setup(arguments.config)
    file = make_a2l(setup.calibrations)
    transport, where = _udp(arguments.udp) if arguments.udp else _can(arguments, setup)
    try:
        measurement = Measurement(arguments.share, transport, VERSION.encode(), NAME.encode(), file)
        serve(measurement, f"XCP on {where}: {VERSION}")
    finally:
        transport.close()
    return 0


def _udp(text: str):
    from emb_daemon.workshop.measure import Udp

    host, port = host_and_port("--udp", text)
    transport = Udp(host, port)
    return transport, f"UDP {host}:{transport.port}"


def _can(arguments: argparse.Namespace, setup):
    import numpy as np

    from emb_daemon.cli.busoptions import bus_options, check_ids
    from emb_daemon.runtime.bus import open_bus
    from emb_daemon.workshop.measure import Can

    layout = setup.layout[0]
    check_ids(arguments, {*layout["sent_id"].ravel().tolist(), *np.flatnonzero(layout["slot"] != -1).tolist()})
    bus = open_bus(**bus_options(arguments, setup.configuration.bus), ids=[arguments.request_id])
    return Can(bus, arguments.request_id, arguments.response_id), f"CAN {arguments.request_id:#x}, {arguments.response_id:#x}"
