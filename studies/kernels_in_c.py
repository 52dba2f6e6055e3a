"""What do compiled kernels cost over the same arithmetic in C?

    python -m studies.kernels_in_c

Times three kernels that a tick and the decoding of a log consist of, each against a plain C function beside it here: a Kalman
update of one hypothesis, the characteristic curve, and a frame's CRC. Each is called in a loop of its own language, both in
turn; printed are medians and their ratio. Exit status 1 if a result differs in a bit. Needs a C compiler.
"""

import ctypes
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from emb_daemon.jit import njit
from emb_daemon.models.fusion import STATES, update_errors, variance_along
from emb_daemon.models.stiffness import characteristic_curve
from emb_daemon.wire import e2e

_ROUNDS, _CALLS = 31, 20_000

#: Compiled as the kernels are: no fused multiply-add, for the processors of `emb-daemon compile`.
_OPTIONS = ("-O3", "-ffp-contract=off", "-march=x86-64-v2")
_SOURCE = f"""
#include <stdint.h>
enum {{ N = {STATES} }};
"""
_SOURCE += """
double update(double *x, double *P, double *gain, const double *h, long calls) {
    for (long call = 0; call < calls; call++) {
        for (int i = 0; i < N; i++) gain[i] = P[i] * h[0];
        for (int j = 1; j < N; j++)
            for (int i = 0; i < N; i++) gain[i] += P[j * N + i] * h[j];
        double total = 0.0;
        for (int i = 0; i < N; i++) total += h[i] * gain[i];
        double scale = 1.0 / (1.0 + total);
        for (int i = 0; i < N; i++) {
            x[i] += gain[i] * scale * 0.1;
            for (int j = 0; j < N; j++) P[i * N + j] -= gain[i] * gain[j] * scale;
        }
    }
    return x[0];
}

double curve(const double *xs, const double *a, int terms, long calls) {
    double sum = 0.0;
    for (long call = 0; call < calls; call++) {
        double x = xs[call], force = 0.0, slope = 0.0;
        for (int order = x <= 0.0 ? -1 : terms - 1; order >= 0; order--) {
            slope = slope * x + (order + 1) * a[order];
            force = (force + a[order]) * x;
        }
        sum += force + slope;
    }
    return sum;
}

double crc(const uint8_t *table, const uint64_t *data, long calls) {
    double sum = 0.0;
    for (long call = 0; call < calls; call++) {
        uint8_t value = table[table[0x23] ^ 0x01];
        for (int byte = 1; byte < 8; byte++) value = table[value ^ (uint8_t)(data[call] >> (8 * byte))];
        sum += value;
    }
    return sum;
}
"""


@njit
def _update(x, P, gain, h, calls):
    for _ in range(calls):
        variance = variance_along(P, h, gain)
        update_errors(x, P, gain, 0.1, 1.0 + variance)
    return x[0]


@njit
def _curve(xs, a, calls):
    total = 0.0
    for call in range(calls):
        force, slope = characteristic_curve(xs[call], a)
        total += force + slope
    return total


@njit
def _crc(data, calls):
    total = 0.0
    for call in range(calls):
        total += e2e.crc(0x123, data[call])
    return total


def _compiled(folder: Path) -> ctypes.CDLL:
    source, library = folder / "kernels.c", folder / "kernels.so"
    source.write_text(_SOURCE)
    subprocess.run(["cc", *_OPTIONS, "-shared", "-fPIC", "-o", library, source], check=True)
    functions = ctypes.CDLL(str(library))
    for name in ("update", "curve", "crc"):
        getattr(functions, name).restype = ctypes.c_double
    return functions


def _timed(call, state) -> tuple[float, float]:
    """Nanoseconds a call of the kernel, and what the loop returned."""
    begin = time.perf_counter()
    result = call(state)
    return (time.perf_counter() - begin) / _CALLS * 1e9, result


def main() -> int:
    rng = np.random.default_rng(0)
    root = rng.standard_normal((STATES, STATES))
    h, covariance = rng.standard_normal(STATES), root @ root.T
    xs, a = rng.uniform(-5.0, 40.0, _CALLS), np.array([60.0, 12.0, 0.3, -1e-3, 1e-6])
    data = rng.integers(0, 2**63, _CALLS).astype(np.uint64)
    table = np.ascontiguousarray(e2e._TABLE)

    def fresh():
        return np.zeros(STATES), covariance.copy(), np.zeros(STATES), h

    def place(*arrays):
        return [ctypes.c_void_p(array.ctypes.data) for array in arrays]

    with tempfile.TemporaryDirectory() as folder:
        c = _compiled(Path(folder))
        count = ctypes.c_long(_CALLS)
        pairs = {
            f"Kalman update, {STATES} states": (lambda s: _update(*s, _CALLS), lambda s: c.update(*place(*s), count)),
            "characteristic curve": (lambda _: _curve(xs, a, _CALLS), lambda _: c.curve(*place(xs, a), len(a), count)),
            "CRC of a frame": (lambda _: _crc(data, _CALLS), lambda _: c.crc(*place(table, data), count)),
        }
        same = True
        print(f"{'kernel':<28}{'numba, ns':>11}{'C, ns':>9}{'ratio':>8}")
        for name, (ours, theirs) in pairs.items():
            times = []
            ours(fresh())
            for _ in range(_ROUNDS):
                (one, result), (other, expected) = (_timed(call, fresh()) for call in (ours, theirs))
                times.append((one, other))
                same = same and result == expected
            one, other = np.median(times, axis=0)
            print(f"{name:<28}{one:>11.1f}{other:>9.1f}{np.median([a / b for a, b in times]):>8.2f}")
        print("results equal to the last bit" if same else "results differ")
    return 0 if same else 1


if __name__ == "__main__":
    sys.exit(main())
