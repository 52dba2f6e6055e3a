"""emb-daemon monitor."""

import argparse
import json
import sys

from emb_daemon.cli.options import add_bus_arguments, add_mapping_argument, add_path, bus_options, check_output, host_and_port
from emb_daemon.cli.serving import stop_signals
from emb_daemon.errors import InputError

EXAMPLE = (
    "emb-daemon monitor -i socketcan -c can0\n  emb-daemon monitor -c can0 -i socketcan --once --json\n"
    "  emb-daemon monitor -c can0 -i socketcan --web"
)

_PORT = 8250


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--once", action="store_true", help="listen for a second or two, print one line per corner, and end")
    parser.add_argument(
        "--json", action="store_true", help="with --once: print everything as JSON; values not to be used are null"
    )
    page = f"serve a page with live plots, and /metrics for Prometheus, to this machine only (port {_PORT})"
    parser.add_argument("--web", nargs="?", type=int, const=_PORT, metavar="PORT", help=page)
    add_path(parser, "--record", "record everything received into an MCAP file")
    parser.add_argument("--udp", metavar="HOST:PORT", help="send JSON datagrams, 50 a second, for PlotJuggler")
    text = "the file given to emb-daemon run as --share; --web, --record and --udp then say what the estimator finds, too"
    add_path(parser, "--share", text)
    add_mapping_argument(parser)
    add_bus_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    from emb_daemon.monitor.terminal import listen, watch

    handed_out = any(value is not None for value in (arguments.web, arguments.udp, arguments.record))
    _check(arguments, handed_out)
    options = bus_options(arguments)
    bus = _open_bus(arguments, options)
    title = " ".join(str(options[name]) for name in ("interface", "channel") if options[name])
    try:
        if handed_out:
            _hand_out(arguments, bus, title)
            return 0
        if not arguments.once:
            watch(bus, title)
            return 0
        listener, now = listen(bus)
    finally:
        bus.close()
    if arguments.json:
        json.dump({"corners": listener.states(now)}, sys.stdout, indent=1)
        print()
    else:
        from emb_daemon.monitor.view import summary

        print("\n".join(summary(listener, now)))
    return 0


def _check(arguments: argparse.Namespace, handed_out: bool) -> None:
    if arguments.json and not arguments.once:
        raise InputError("--json: expected together with --once")
    if handed_out and arguments.once:
        raise InputError("--once: expected without --web, --record and --udp")
    if arguments.share and not handed_out:
        raise InputError("--share: expected together with --web, --record or --udp")
    if arguments.web is not None and not 0 <= arguments.web <= 0xFFFF:
        raise InputError(f"--web {arguments.web}: expected a port, 0 to 65535; 0 is any that is free")
    if not arguments.once and not handed_out and not sys.stdout.isatty():
        raise InputError("monitor: the output is not a terminal; in scripts use --once, with or without --json")


def _open_bus(arguments: argparse.Namespace, options: dict):
    from emb_daemon.monitor.listener import broadcast_ids
    from emb_daemon.runtime.bus import open_bus

    if arguments.mapping:
        from emb_daemon.logs.live import ReferenceBus, open_buses
        from emb_daemon.logs.mapping import Mapping

        mapping = Mapping(arguments.mapping)
        return ReferenceBus(open_buses(options, mapping), mapping, broadcast_ids())
    return open_bus(**options, ids=broadcast_ids())


def _hand_out(arguments: argparse.Namespace, bus, title: str) -> None:
    """Serve browsers, Prometheus and PlotJuggler, and record, until the user ends it."""
    from emb_daemon.monitor.recording import Recording
    from emb_daemon.monitor.web import Datagrams, Web, hand_out
    from emb_daemon.runtime.shared import PresentEstimates

    receivers, stopped = [], stop_signals()
    if arguments.udp is not None:
        receivers.append(Datagrams(*host_and_port(arguments.udp)))
    if arguments.web is not None:
        receivers.append(Web(arguments.web, title))
        print(f"http://127.0.0.1:{receivers[-1].port}/", flush=True)
    if arguments.record is not None:
        check_output(arguments.record, [], (".mcap",))
        receivers.append(Recording(arguments.record))
    try:
        hand_out(bus, receivers, lambda: bool(stopped), PresentEstimates(arguments.share) if arguments.share else None)
    finally:
        for receiver in receivers:
            receiver.close()
