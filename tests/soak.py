"""The daemon with four corners for a given time: fails if samples are not answered or memory grows.

Run as ``python tests/soak.py SECONDS``.
"""

import sys

from emb_daemon.bench.loop import measure_loop

#: Growth of resident memory over the whole run that is no leak, KiB: pages touched late.
_GROWTH_KIB = 4096


def main() -> int:
    result = measure_loop(4, float(sys.argv[1]))
    first, last = result["resident_KiB"]
    answered = result["answers"]["answered"] / max(result["answers"]["samples"], 1)
    print(
        f"{result['ticks']} ticks, {result['missed']} missed (an empty loop: {result['empty_loop']['missed']}), "
        f"{100 * answered:.3f} % of samples answered, {last / 1024:.1f} MiB resident, {(last - first) / 1024:+.2f} MiB"
    )
    faults = []
    if answered < 0.999:
        faults.append("samples were not answered")
    if last - first > _GROWTH_KIB:
        faults.append("memory grew")
    print("; ".join(faults) or "held")
    return bool(faults)


if __name__ == "__main__":
    sys.exit(main())
