"""Characteristic curves over pad thickness: between and beyond the measured ones, and whether they rise."""

from bisect import bisect_left
from typing import Annotated

import numpy as np
from msgspec import Meta

from emb_daemon.calibration.fields import Positive, Struct, usual
from emb_daemon.errors import InputError, InvalidValue
from emb_daemon.estimator.records import CURVE_TERMS

#: How far curves are extrapolated beyond the measured thicknesses, as a share of the nearest interval; and the least
#: compliance of a coefficient there, as a share of the nearest measured one, because a straight line would cross zero.
_CARRIED_ON, _LEAST_COMPLIANCE = 0.5, 0.5


class Curve(Struct, kw_only=True):
    """Characteristic curve of one pad thickness: F = sum of coefficients[n] x^(n+1), x in rad past contact."""

    #: Thickness of the pads, friction material alone.
    pad_thickness_mm: Positive
    #: N/rad, N/rad^2, N/rad^3 and so on (thesis A0, A1, A2).
    coefficients: Annotated[tuple[Annotated[float, usual(1e-3)], ...], Meta(min_length=1, max_length=CURVE_TERMS)]

    def __post_init__(self) -> None:
        if self.coefficients[0] <= 0.0:
            raise InvalidValue("the first coefficient (N/rad) must be positive: force rises from contact")

    @property
    def of_all_terms(self) -> np.ndarray:
        """The coefficients, shape (CURVE_TERMS,)."""
        return np.array([*self.coefficients, *[0.0] * (CURVE_TERMS - len(self.coefficients))])


def thickness_range(curves: tuple[Curve, ...]) -> tuple[float, float]:
    """Thinnest and thickest pads in mm for which `curve_at` gives a curve."""
    thicknesses = [curve.pad_thickness_mm for curve in curves]
    if len(curves) == 1:
        # A single curve is used for the mounted pads, whatever their thickness.
        return 0.0, np.inf
    below, above = (_CARRIED_ON * (thicknesses[k + 1] - thicknesses[k]) for k in (0, -2))
    return max(thicknesses[0] - below, 0.0), thicknesses[-1] + above


def neighbours(curves: tuple[Curve, ...], pad_thickness_mm: float) -> range:
    """Indices of the curves between which that of a pad thickness lies, or of the nearest two beyond; of a single one."""
    upper = bisect_left(curves, pad_thickness_mm, 1, max(len(curves) - 1, 1), key=lambda curve: curve.pad_thickness_mm)
    return range(upper - 1, min(upper + 1, len(curves)))


def rising_force(coefficients: np.ndarray) -> float:
    """Force in N up to which a characteristic curve rises from contact; infinite if it never falls."""
    if coefficients[0] <= 0.0:
        return 0.0
    if np.all(coefficients >= 0.0):
        return np.inf
    turns = np.roots((coefficients * np.arange(1, len(coefficients) + 1))[::-1])
    turns = turns.real[(np.abs(turns.imag) <= 1e-9 * np.abs(turns)) & (turns.real > 0.0)]
    if not len(turns):
        return np.inf
    return float(np.polyval([*coefficients[::-1], 0.0], turns.min()))


def curve_at(curves: tuple[Curve, ...], pad_thickness_mm: float) -> np.ndarray:
    """Coefficients of the characteristic curve at a pad thickness, shape (CURVE_TERMS,).

    The reciprocal of each coefficient is linear between measured thicknesses, and beyond them by at most half the nearest
    interval: pads and caliper are compliances in series, so compliance grows linearly with thickness. If a coefficient changes
    its sign between the two thicknesses, all coefficients are interpolated linearly instead. Raises InputError: the thickness
    is too far from the measured ones."""
    if len(curves) == 1:
        return curves[0].of_all_terms
    low, high = thickness_range(curves)
    if not low <= pad_thickness_mm <= high:
        raise InputError(
            f"pad_thickness_mm: {pad_thickness_mm} is too far from the measured thicknesses; expected {low:g} to {high:g}"
        )
    thinner, thicker = (curves[index] for index in neighbours(curves, pad_thickness_mm))
    share = (pad_thickness_mm - thinner.pad_thickness_mm) / (thicker.pad_thickness_mm - thinner.pad_thickness_mm)
    below, above = thinner.of_all_terms, thicker.of_all_terms
    used = (below != 0.0) | (above != 0.0)
    if np.any(below[used] * above[used] <= 0.0):
        return below + share * (above - below)
    compliance = 1.0 / below[used] * (1.0 - share) + 1.0 / above[used] * share
    nearest = 1.0 / (below if share < 0.5 else above)[used]
    curve = np.zeros(CURVE_TERMS)
    curve[used] = 1.0 / np.where(compliance / nearest < _LEAST_COMPLIANCE, _LEAST_COMPLIANCE * nearest, compliance)
    return curve
