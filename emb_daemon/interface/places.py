"""Where each number of a calibration stands in the estimator's PARAMETERS record."""

from typing import NamedTuple

import numpy as np

from emb_daemon.calibration.parameters import keys, moved, parameter
from emb_daemon.calibration.types import Calibration, to_parameters
from emb_daemon.errors import InputError
from emb_daemon.estimator.records import CURVE_TERMS, PARAMETERS


class Place(NamedTuple):
    """A number's ``key`` (`calibration.parameters`) and ``offset`` in bytes; value, unit and bounds as the file has them."""

    key: str
    offset: int
    value: float
    unit: str
    low: float
    high: float


def _words(calibration: Calibration) -> np.ndarray:
    return np.frombuffer(to_parameters(calibration).tobytes(), np.float64)


def places(calibration: Calibration) -> list[Place]:
    """Every number of the file that the estimator uses unchanged, in the record's order.

    They are found by changing one number after the other, so that only `to_parameters` defines where they go. Of the
    characteristic curves, which are interpolated, the mounted pads' coefficients are given as ``stiffness.curve[0]`` on."""
    before, found = _words(calibration), []
    for key in keys(calibration):
        if key.startswith(("stiffness.curves", "terms", "adaptation")):
            continue
        known = parameter(calibration, key)
        value = known.value + known.step
        try:
            after = _words(moved(calibration, {key: value}))
        except InputError:
            continue
        changed = np.flatnonzero(before.view(np.int64) != after.view(np.int64))
        if len(changed) == 1 and before[changed[0]] == known.value and after[changed[0]] == value:
            found.append(Place(key, 8 * int(changed[0]), known.value, known.unit, known.low, known.high))
    curve = PARAMETERS.fields["curve"][1]
    for index in range(CURVE_TERMS):
        unit = "N/rad" if index == 0 else f"N/rad^{index + 1}"
        value = float(before[curve // 8 + index])
        found.append(Place(f"stiffness.curve[{index}]", curve + 8 * index, value, unit, -np.inf, np.inf))
    return sorted(found, key=lambda place: place.offset)
