"""The daemon with four corners for a given time: fails if memory grows, or if more samples are not answered than in a
thousand, and in a thousand more for each thousandth of its periods that an empty loop beside it misses.

Run as ``python tests/soak.py SECONDS``.
"""

import sys

from emb_daemon.bench.loop import measure_loop

#: Growth of resident memory over the whole run that is no leak, KiB: pages touched late.
_GROWTH_KIB = 4096
#: Share of samples that may go unanswered.
_UNANSWERED = 0.001


def main() -> int:
    result = measure_loop(4, float(sys.argv[1]))
    first, last = result["resident_KiB"]
    answered = result["answers"]["answered"] / max(result["answers"]["samples"], 1)
    print(
        f"{result['ticks']} ticks, {result['missed']} missed (an empty loop: {result['empty_loop']['missed']}), "
        f"{100 * answered:.3f} % of samples answered, {last / 1024:.1f} MiB resident, {(last - first) / 1024:+.2f} MiB"
    )
    faults = []
    # What keeps an empty loop from its CPU keeps the car and the daemon from theirs.
    held_up = result["empty_loop"]["missed"] / max(result["ticks"], 1)
    if answered < 1.0 - _UNANSWERED - held_up:
        faults.append("samples were not answered")
    if last - first > _GROWTH_KIB:
        faults.append("memory grew")
    print("; ".join(faults) or "held")
    return bool(faults)


if __name__ == "__main__":
    sys.exit(main())
