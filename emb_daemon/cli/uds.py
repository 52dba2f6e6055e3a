"""emb-daemon uds."""

import argparse
import sys

from emb_daemon.cli import options
from emb_daemon.cli.serving import serve
from emb_daemon.errors import InputError

EXAMPLE = "emb-daemon uds --config /etc/emb_daemon/emb.yaml -i socketcan -c can0"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    options.add_path(parser, "--config", options.CONFIG_HELP, required=True)
    default = "$STATE_DIRECTORY, the configuration's, or /var/lib/emb_daemon"
    state = f"the daemon's state directory; trouble codes are stored there too (default: {default})"
    options.add_path(parser, "--state", state, "DIR")
    options.add_share_argument(parser)
    options.add_id_arguments(parser, 0x710, 0x718)
    options.add_bus_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    from emb_daemon.adapt.memory import state_directory
    from emb_daemon.calibration.configuration import Setup
    from emb_daemon.monitor.listener import broadcast_ids
    from emb_daemon.runtime.bus import open_bus
    from emb_daemon.workshop.serve import Diagnostics

    configuration = Setup(arguments.config).configuration
    listened = broadcast_ids()
    options.check_ids(arguments, listened)
    state = arguments.state or state_directory(configuration.state_directory or "/var/lib/emb_daemon", arguments.config.parent)
    if not state.is_dir():
        raise InputError(f"{state}: no such state directory; give it with --state")
    bus = open_bus(**options.bus_options(arguments, configuration.bus), ids=[*listened, arguments.request_id])
    try:
        diagnostics = Diagnostics(bus, arguments.config, state, arguments.request_id, arguments.response_id, arguments.share)
        if diagnostics.memory.warning:
            print(diagnostics.memory.warning, file=sys.stderr)
        serve(
            diagnostics, f"requests {arguments.request_id:#x}, responses {arguments.response_id:#x}, trouble codes in {state}"
        )
        diagnostics.memory.save()
    finally:
        bus.close()
    return 0
