"""emb-daemon bench."""

import argparse
import json

from emb_daemon.errors import InputError

EXAMPLE = "emb-daemon bench --seconds 120"
_LEAST_S = 2.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seconds", type=float, default=20.0, metavar="S", help="how long each number of corners runs (20)")
    parser.add_argument("--corners", type=int, nargs="+", choices=(1, 2, 4), default=[1, 2, 4], metavar="N", help="1, 2 or 4")
    parser.add_argument("--json", action="store_true", help="figures as JSON")


def run(arguments: argparse.Namespace) -> int:
    if not arguments.seconds >= _LEAST_S:
        raise InputError(f"--seconds {arguments.seconds:g}: expected at least {_LEAST_S:g}: the first second does not count")
    from emb_daemon.ahead import library

    kernels = library.find()
    try:
        if kernels:
            library.check(kernels)
    except library.Refused as refusal:
        raise InputError(f"{kernels}: {refusal}") from None
    from emb_daemon.bench.loop import machine, measure_loop, measure_start
    from emb_daemon.bench.report import text, verdict

    # Fill the cache, so that only the cold start compiles.
    measure_start()
    result = {
        "machine": machine(),
        "loops": [measure_loop(corners, arguments.seconds) for corners in arguments.corners],
        "cold_start": measure_start(cold=True),
    }
    result["verdict"] = verdict(result)
    print(json.dumps(result, indent=1) if arguments.json else text(result))
    return 0
