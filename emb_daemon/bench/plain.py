"""The step as plain Python over numpy records: the same functions, not compiled.

Run as ``NUMBA_DISABLE_JIT=1 python -m emb_daemon.bench.plain SAMPLES PARAMETERS ESTIMATES``, numpy files; writes the
estimates and prints the CPU time of one step in us.
"""

import sys
import time

import numpy as np

from emb_daemon.offline import estimate


def main() -> None:
    samples, parameters = np.load(sys.argv[1]), np.load(sys.argv[2])
    begin = time.process_time()
    estimates = estimate(samples, parameters)
    taken = time.process_time() - begin
    np.save(sys.argv[3], estimates)
    print(1e6 * taken / len(samples))


if __name__ == "__main__":
    main()
