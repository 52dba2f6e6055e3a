"""emb-daemon monitor."""

import argparse

EXAMPLE = "emb-daemon monitor -i socketcan -c can0\n  emb-daemon monitor -c can0 -i socketcan --once --json"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    from emb_daemon.cli.busoptions import add_bus_arguments

    parser.add_argument("--once", action="store_true", help="listen for two seconds, print one line per corner, end")
    parser.add_argument("--json", action="store_true", help="with --once: everything known, as JSON; null is what not to use")
    add_bus_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    import json
    import sys

    from emb_daemon.cli.busoptions import bus_options
    from emb_daemon.errors import InputError
    from emb_daemon.monitor.listener import Listener
    from emb_daemon.monitor.terminal import listen, watch
    from emb_daemon.runtime.bus import open_bus

    if arguments.json and not arguments.once:
        raise InputError("--json: expected together with --once")
    if not arguments.once and not sys.stdout.isatty():
        raise InputError("monitor: output is no terminal; for scripts there is --once, with or without --json")
    options = bus_options(arguments)
    bus = open_bus(**options, ids=Listener().ids)
    try:
        if not arguments.once:
            watch(bus, " ".join(str(options[name]) for name in ("interface", "channel") if options[name]))
            return 0
        listener, now = listen(bus)
    finally:
        bus.close()
    if arguments.json:
        json.dump({"corners": {corner.name: corner.state(now) for corner in listener.heard}}, sys.stdout, indent=1)
        print()
    else:
        from emb_daemon.monitor.view import summary

        print("\n".join(summary(listener, now)))
    return 0
