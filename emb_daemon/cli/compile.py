"""emb-daemon compile."""

import argparse
import hashlib
import os
import platform
import tempfile

from emb_daemon.ahead.library import TARGETS, default_path, installed_digest
from emb_daemon.cli.options import add_path
from emb_daemon.errors import InputError
from emb_daemon.resources import resource

EXAMPLE = "emb-daemon compile --target aarch64 --output kernels-aarch64.so"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    where = "library to write (%(default)s, where run looks), or .o for an object to link"
    add_path(parser, "--output", where, default=default_path())
    parser.add_argument(
        "--target", default=platform.machine(), metavar="MACHINE", help="x86_64 or aarch64, or its triple (this machine)"
    )


def run(arguments: argparse.Namespace) -> int:
    machine = arguments.target.partition("-")[0]
    if machine not in TARGETS:
        raise InputError(f"--target {arguments.target}: expected {' or '.join(TARGETS)}")
    # Code that numba has optimised is for this processor only, and code from its cache has no LLVM text.
    os.environ |= {"NUMBA_OPT": "0", "NUMBA_DISABLE_JIT": "0"}
    with tempfile.TemporaryDirectory() as empty:
        os.environ["NUMBA_CACHE_DIR"] = empty
        # Taken before the import: later changes of the sources are not in the library.
        sources = installed_digest()
        from emb_daemon.ahead.build import build
        from emb_daemon.jit import ENTRIES
        from emb_daemon.runtime import bus, daemon
        from emb_daemon.wire.layout import default_layout

        assert bus and daemon, "imported for their entry points"
        layouts = {hashlib.sha256(resource("dbc/emb.dbc").read_bytes()).hexdigest(): default_layout().tobytes()}
        build(list(ENTRIES.values()), sources, TARGETS[machine], arguments.output, layouts)
    print(f"{arguments.output}: kernels for {machine} ({TARGETS[machine].cpu})")
    return 0
