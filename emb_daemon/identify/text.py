"""Numbers and logs as reports write them."""

import numpy as np


def with_sigma(value: float, sigma: float | None, factor: float = 1.0) -> str:
    """Value ± sigma, with the digits that sigma makes meaningful."""
    value *= factor
    if sigma is None or not np.isfinite(sigma) or sigma <= 0.0:
        return f"{value:.5g}"
    sigma *= factor
    digits = max(0, 1 - int(np.floor(np.log10(sigma))))
    return f"{value:.{digits}f} ± {sigma:.{digits}f}"


def rounded(value: float, digits: int = 4) -> float:
    """To so many significant digits."""
    return float(f"{value:.{digits}g}")


def stem(name: str) -> str:
    """A log's name without folder and endings."""
    return name.rsplit("/", 1)[-1].split(".log")[0]
