"""Small dense least squares for compiled code: numba's own linear algebra would pull SciPy into the daemon."""

from math import sqrt

import numpy as np

from emb_daemon.jit import njit


@njit
def cholesky(a):
    """Factor the symmetric positive definite ``a`` (n, n) in place into its lower triangle; False if it is not."""
    n = len(a)
    for i in range(n):
        for j in range(i + 1):
            total = a[i, j]
            for k in range(j):
                total -= a[i, k] * a[j, k]
            if i == j:
                if not total > 0.0:
                    return False
                a[i, i] = sqrt(total)
            else:
                a[i, j] = total / a[j, j]
    return True


@njit
def back_substitute(factor, x):
    """Solve L L' y = x in place of ``x``, L being `cholesky`'s lower triangle."""
    n = len(x)
    for i in range(n):
        for k in range(i):
            x[i] -= factor[i, k] * x[k]
        x[i] /= factor[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            x[i] -= factor[k, i] * x[k]
        x[i] /= factor[i, i]


@njit
def inverse(a):
    """Inverse of a symmetric positive definite matrix; zeros if it is none. Scaled by its diagonal first."""
    n = len(a)
    scale, scaled, result = np.empty(n), np.empty((n, n)), np.zeros((n, n))
    for i in range(n):
        if not a[i, i] > 0.0:
            return result
        scale[i] = 1.0 / sqrt(a[i, i])
    for i in range(n):
        for j in range(n):
            scaled[i, j] = a[i, j] * scale[i] * scale[j]
    if not cholesky(scaled):
        return result
    column = np.empty(n)
    for j in range(n):
        column[:] = 0.0
        column[j] = 1.0
        back_substitute(scaled, column)
        for i in range(n):
            result[i, j] = column[i] * scale[i] * scale[j]
    return result
