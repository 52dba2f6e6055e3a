"""emb-daemon bench."""

import argparse

EXAMPLE = "emb-daemon bench --seconds 120"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seconds", type=float, default=20.0, metavar="S", help="how long each number of corners runs (20)")
    parser.add_argument("--corners", type=int, nargs="+", choices=(1, 2, 4), default=[1, 2, 4], metavar="N", help="1, 2, 4")
    parser.add_argument("--json", action="store_true", help="figures as JSON")


def run(arguments: argparse.Namespace) -> int:
    import json

    from emb_daemon.bench.logs import measure_logs
    from emb_daemon.bench.loop import cyclictest, machine, measure_loop

    result = {"machine": machine(), "cyclictest": cyclictest(min(arguments.seconds, 10.0))}
    result["loops"] = [measure_loop(corners, arguments.seconds) for corners in arguments.corners]
    result["logs"] = measure_logs()
    result["verdict"] = _verdict(result)
    if arguments.json:
        print(json.dumps(result, indent=1))
    else:
        _print(result)
    return 0


def _verdict(result: dict) -> list[dict]:
    """Each budget with what was measured; ``met`` says whether the machine holds it."""
    loop, logs = result["loops"][-1], result["logs"]
    corners = loop["corners"]
    wake = loop["empty_loop"]["p99_us"]
    budgets = [
        (f"tick of {corners} corners, p99", loop["tick"]["p99_us"], 500.0, "us"),
        ("sample to answer, p99, above the empty loop's wake-up", loop["answers"]["p99_us"] - wake, 600.0, "us"),
        (f"core share of {corners} corners", 100.0 * loop["core_share"], 12.0, "%"),
        ("ticks missed beyond the empty loop's", loop["missed"] - loop["empty_loop"]["missed"], 0.0, ""),
        ("resident memory", loop["resident_KiB"][1] / 1024.0, 250.0, "MiB"),
        ("compiled step", logs["step_us"], 3.0, "us"),
        ("real time over replay time", 1000.0 / logs["replay_times_real_time"], 1.0, "ms per s"),
    ]
    return [
        {"budget": name, "measured": value, "limit": limit, "unit": unit, "met": value <= limit}
        for name, value, limit, unit in budgets
    ]


def _print(result: dict) -> None:
    print(result["machine"])
    if result["cyclictest"]:
        print("cyclictest at 250 Hz: p50 {p50_us:.0f} us, p99 {p99_us:.0f} us".format(**result["cyclictest"]))
    else:
        print("cyclictest: not installed (package rt-tests), or real-time priority refused")
    for loop in result["loops"]:
        empty = loop["empty_loop"]
        print(
            f"\n{loop['corners']} corners, {loop['seconds']:g} s, {loop['scheduling']}: {loop['ticks']} ticks, "
            f"{loop['missed']} missed; an empty loop beside it missed {empty['missed']}, "
            f"woke p50 {empty['p50_us']:.0f} us, p99 {empty['p99_us']:.0f} us late"
        )
        for name, figures in [("tick", loop["tick"]), *loop["parts"].items(), ("sample to answer", loop["answers"])]:
            print(f"  {name:<18} p50 {figures['p50_us']:7.1f} us   p99 {figures['p99_us']:7.1f} us")
        first, last = (value / 1024.0 for value in loop["resident_KiB"])
        print(f"  {100 * loop['core_share']:.1f} % of one core, {last:.0f} MiB resident ({last - first:+.1f} over the run)")
    logs = result["logs"]
    print(
        f"\nlogs: {logs['read_frames_per_s'] / 1e6:.2f} million frames/s read, "
        f"{logs['replay_frames_per_s'] / 1e6:.2f} replayed "
        f"({logs['replay_times_real_time']:.0f} times real time), step {logs['step_us']:.2f} us; "
        f"cantools frame by frame decodes {logs['cantools_decode_frames_per_s'] / 1e6:.2f} million/s"
    )
    print()
    for line in result["verdict"]:
        mark = "met    " if line["met"] else "NOT MET"
        print(f"{mark} {line['budget']}: {line['measured']:.3g} of {line['limit']:g} {line['unit']}")
