"""A loop that does nothing 250 times a second, to show which deadlines the machine itself misses.

Run as ``python empty.py SECONDS PRIORITY``, without the package; prints a JSON line.
"""

import json
import os
import sys
import time

PERIOD_NS = 4_000_000


def main() -> None:
    seconds, priority = float(sys.argv[1]), int(sys.argv[2])
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except OSError:
        priority = 0
    late, missed = [], 0
    end = time.monotonic_ns() + int(1e9 * seconds)
    deadline = time.monotonic_ns() + PERIOD_NS
    while deadline < end:
        time.sleep(max(0.0, 1e-9 * (deadline - time.monotonic_ns())))
        behind = time.monotonic_ns() - deadline
        late.append(behind)
        missed += behind // PERIOD_NS
        deadline += PERIOD_NS * (1 + behind // PERIOD_NS)
    late.sort()
    result = {"ticks": len(late), "missed": missed, "fifo": bool(priority)}
    for name, share in (("p50_us", 0.5), ("p99_us", 0.99)):
        result[name] = late[int(share * (len(late) - 1))] / 1e3
    print(json.dumps(result))


if __name__ == "__main__":
    main()
