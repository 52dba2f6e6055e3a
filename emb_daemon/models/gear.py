"""A gear whose travel is not proportional to its angle: ball and roller ramps, cams.

Everything that moves with the pads (contact, characteristic curve, hysteresis, thickness) is expressed in equivalent angle:
the angle by which a constant gear of the calibration's gear gain would move the pads as far. Only the torque depends on the
gear's own slope, dx/dθ over the gear gain (virtual work). So one brake model serves both kinds of gear.
"""

import numpy as np

from emb_daemon.jit import Floats, Record, njit
from emb_daemon.models.stiffness import travel_at

#: Number of intervals into which the range of a travel table is divided; tables in datasheets have fewer points.
INTERVALS = 64

#: ``step`` rad between nodes, 0 for a constant gear; equivalent angle (rad) at each and its ``slope``.
GEAR = np.dtype([("step", "f8"), ("turned", "f8", (INTERVALS + 1,)), ("slope", "f8", (INTERVALS + 1,))], align=True)


@njit
def through_gear(gear: Record, angle: float) -> tuple[float, float]:
    """Equivalent angle (rad) at ``angle`` rad past the released position, and its slope: cubic between the nodes (Hermite),
    straight outside of them."""
    if gear.step == 0.0:
        return angle, 1.0
    place = angle / gear.step
    node = min(max(int(place), 0), INTERVALS - 1)
    t = min(max(place - node, 0.0), 1.0)
    start, end = gear.turned[node], gear.turned[node + 1]
    first, last = gear.step * gear.slope[node], gear.step * gear.slope[node + 1]
    rise = end - start
    square, cubic = 3.0 * rise - 2.0 * first - last, first + last - 2.0 * rise
    slope = (first + (2.0 * square + 3.0 * cubic * t) * t) / gear.step
    return start + (first + (square + cubic * t) * t) * t + slope * (angle - (node + t) * gear.step), slope


@njit
def all_through_gear(gear: Record, angles: Floats) -> tuple[Floats, Floats]:
    """Equivalent angles (rad) of angles past the released position, and slopes there, shape (n,) each."""
    turned, slopes = np.empty(len(angles)), np.empty(len(angles))
    for row, angle in enumerate(angles):
        turned[row], slopes[row] = through_gear(gear, angle)
    return turned, slopes


@njit
def back_through_gear(gear: Record, turned: float) -> float:
    """Angle (rad) past the released position of an equivalent angle ``turned`` (rad)."""
    if gear.step == 0.0:
        return turned
    low, high = 0.0, INTERVALS * gear.step
    if turned <= 0.0:
        return turned / gear.slope[0]
    if turned >= gear.turned[INTERVALS]:
        return high + (turned - gear.turned[INTERVALS]) / gear.slope[INTERVALS]
    for _ in range(40):
        middle = 0.5 * (low + high)
        if through_gear(gear, middle)[0] < turned:
            low = middle
        else:
            high = middle
    return high


@njit
def steepest(gear: Record) -> tuple[float, float]:
    """Least and largest slope."""
    if gear.step == 0.0:
        return 1.0, 1.0
    least = most = gear.slope[0]
    for slope in gear.slope:
        least, most = min(least, slope), max(most, slope)
    return least, most


@njit
def most_of_spring(p: Record) -> float:
    """Force (N) of the release spring at the largest clamp force; PARAMETERS record ``p``."""
    if p.spring == 0.0:
        return 0.0
    return p.spring * p.gear_gain * (p.clearance + travel_at(p.maximum_force, p.curve))


def rising_slopes(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Slopes at the points (x, y) of a rising curve with which a cubic between them rises too, shape (n,), n ≥ 3 (Fritsch and
    Butland, SIAM J. Sci. Stat. Comput. 5(2), 1984)."""
    width = np.diff(x)
    chord = np.diff(y) / width
    before, after = 2.0 * width[1:] + width[:-1], width[1:] + 2.0 * width[:-1]
    slopes = np.empty(len(x))
    slopes[1:-1] = (before + after) / (before / chord[:-1] + after / chord[1:])
    for end, inner in ((0, 1), (-1, -2)):
        # Through three points, which is never too steep for a rising cubic, and flat by nine tenths at most.
        straight = chord[end] + (chord[end] - chord[inner]) * width[end] / (width[end] + width[inner])
        slopes[end] = max(straight, 0.1 * chord[end])
    return slopes


def fill_gear(gear: np.void, angle_rad: np.ndarray, turned_rad: np.ndarray) -> None:
    """Fill a GEAR record from points of a travel table in equivalent angle; none leave it constant."""
    if not len(angle_rad):
        return
    slopes = rising_slopes(angle_rad, turned_rad)
    at = np.linspace(0.0, angle_rad[-1], INTERVALS + 1)
    cell = np.clip(np.searchsorted(angle_rad, at, side="right") - 1, 0, len(angle_rad) - 2)
    width, rise = np.diff(angle_rad)[cell], np.diff(turned_rad)[cell]
    t, first, last = (at - angle_rad[cell]) / width, slopes[cell] * width, slopes[cell + 1] * width
    square, cubic = 3.0 * rise - 2.0 * first - last, first + last - 2.0 * rise
    gear["step"] = at[1]
    gear["turned"] = turned_rad[cell] + (first + (square + cubic * t) * t) * t
    gear["slope"] = (first + (2.0 * square + 3.0 * cubic * t) * t) / width
