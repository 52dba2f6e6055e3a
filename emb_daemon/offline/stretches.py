"""Rows of a log that follow one another."""

import numpy as np


def stretches_of(holds: np.ndarray) -> np.ndarray:
    """First row, and the row after the last, of each stretch in which a mask of shape (n,) holds; shape (stretches, 2)."""
    return np.flatnonzero(np.diff(np.concatenate([[False], holds, [False]]).astype(np.int8))).reshape(-1, 2)


def without_gaps(rows: np.ndarray, values: np.ndarray) -> list[np.ndarray]:
    """``values``, one for each of ascending ``rows``, parted where these do not follow one another."""
    return np.split(values, np.flatnonzero(np.diff(rows) != 1) + 1)
