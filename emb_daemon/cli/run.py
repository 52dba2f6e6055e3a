"""emb-daemon run."""

import argparse
import os
import signal
import sys
from pathlib import Path

from emb_daemon.cli.options import add_bus_arguments, add_mapping_argument, add_path, bus_options, open_mapping

EXAMPLE = "emb-daemon run --config /etc/emb_daemon/emb.yaml -i socketcan -c can0"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_path(parser, "--config", "configuration, such as config/emb.yaml", required=True)
    add_mapping_argument(parser)
    add_path(parser, "--share", "share the estimates of every tick in FILE, in a folder kept in memory; uds and xcp read it")
    add_bus_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    # python-can imports asammdf, and with it pandas, wherever it is installed: a third of the daemon's memory and start-up
    # time for a file format that it never reads.
    sys.modules.setdefault("asammdf", None)
    from emb_daemon.ahead import library

    # Before modules with kernels are imported. Logged at once: if the library is needed, numba's import may fail.
    if refusal := library.load():
        print(refusal, file=sys.stderr)
    from emb_daemon.adapt.memory import hold, state_directory
    from emb_daemon.calibration.configuration import Setup
    from emb_daemon.jit import compiled_for_the_next_start
    from emb_daemon.runtime.daemon import Daemon
    from emb_daemon.runtime.journal import log, set_up_logging
    from emb_daemon.runtime.reading import Reader
    from emb_daemon.runtime.realtime import set_up, settle_memory
    from emb_daemon.runtime.systemd import ServiceManager

    setup = Setup(arguments.config)
    configuration = setup.configuration
    set_up_logging(configuration.log_level)
    log.info("%s", library.description())
    reader = Reader()
    reader.begin()
    state = state_directory(configuration.state_directory, arguments.config.parent)
    if state:
        # Two daemons would overwrite each other's learned values.
        hold(state)
    bus, keyless = _open_bus(arguments, setup, state)
    daemon = Daemon(setup, bus, ServiceManager(), state, reader)
    daemon.pipeline.distrust(keyless)
    if arguments.share:
        daemon.share(arguments.share)
    signal.signal(signal.SIGHUP, lambda *_: daemon.reload())
    daemon.warm_up()
    if compiled_for_the_next_start():
        log.info("kernels compiled, starting again with them: the compiler would keep twice the daemon's memory")
        reader.close()
        _start_again()
    if arguments.share and configuration.xcp.calibrate:
        daemon.take_pages(arguments.share)
    # Not earlier: while kernels are compiled a signal ends the process at once.
    signal.signal(signal.SIGTERM, lambda *_: daemon.stop())
    signal.signal(signal.SIGINT, lambda *_: daemon.stop())
    realtime = configuration.realtime
    for line in set_up(realtime.lock_memory, realtime.fifo_priority, realtime.cpu):
        log.info("%s", line)
    settle_memory()
    try:
        daemon.run()
    finally:
        bus.close()
        reader.close()
    return 0


def _open_bus(arguments: argparse.Namespace, setup, state: Path | None):
    """The bus, and the corners whose keys are missing (`runtime.secured.secure`)."""
    from emb_daemon.runtime.bus import open_bus

    options = bus_options(arguments, setup.configuration.bus)
    if arguments.mapping:
        from emb_daemon.logs.live import open_mapped

        bus = open_mapped(options, open_mapping(arguments.mapping), setup.layout)
    else:
        ids = [int(can_id) for can_id in range(2048) if setup.layout["slot"][0, can_id] != -1]
        ids += [can_id for link in setup.links[0] for can_id in (link.authentication_id, link.freshness_id)]
        bus = open_bus(**options, ids=ids)
    if setup.keys is None:
        return bus, ()
    from emb_daemon.runtime.secured import secure

    return secure(bus, setup, state)


def _start_again() -> None:
    """Replace this process by the same command."""
    # A handler does not survive exec, and without one the signal would end the process. Ignoring it does survive.
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])
