"""Results of a training: values of the calibration's own keys, and the bounds within which they are accepted.

Learned values are a partial calibration, applied by `calibration.parameters.moved`. They are held to the same bounds when a
training is accepted and when a file is read.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from emb_daemon.calibration.curves import neighbours
from emb_daemon.calibration.parameters import CLEARANCE, LOAD_FRICTION, OFFSET_FRICTION, PRESLIDING_ANGLE, moved, value_of
from emb_daemon.calibration.types import Calibration, to_parameters
from emb_daemon.errors import InputError
from emb_daemon.models.stiffness import characteristic_curve, travel_at

STIFFNESS_SIGMA = "noise.stiffness_N"
STIFFNESS_RELATIVE_SIGMA = "noise.stiffness_relative"

#: Share by which the presliding angle may grow more than friction, whose angle it is over the stiffness of gear and bearings:
#: a choice. In slow strokes a current that comes a cycle late looks like friction that turns over within twice the angle, an
#: angle that comes late like a quarter of it (`test_adapt.py::test_a_current_of_another_cycle_is_no_other_friction`). And
#: angle (rad), three counts of a resolver of 12 bit, that nobody sees.
_SOFTER_GEAR, _SEEN_RAD = 0.25, 0.005
#: Number of points of the travel at which a curve is checked.
TRAVELS = 40


@dataclass
class Evaluation:
    """Outcome of one training's evaluation."""

    outcome: int  #: ACCEPTED or the reason for the rejection; ``note`` gives its numbers, if any
    note: str = ""
    values: dict[str, float] = field(default_factory=dict)  #: by the calibration's keys, as ``sigmas``
    sigmas: dict[str, float] = field(default_factory=dict)
    contact_angle: float = np.nan  #: on the resolver's present zero, rad; ``contact_sigma`` for the learned curve, rad
    contact_sigma: float = np.nan
    #: ``torque_error`` and ``torque_error_sigma``: error of the torque path by magnets and current sensor, as a share of the
    #: force.
    torque_error: float = 0.0
    torque_error_sigma: float = np.nan
    #: ``inertia_error`` and ``inertia_sigma``: error of the calibration's inertia, as a share of it.
    inertia_error: float = 0.0
    inertia_sigma: float = np.nan
    evidence: dict[str, float] = field(default_factory=dict)  #: figures for people, by name


def curve_terms(calibration: Calibration) -> int:
    """Number of coefficients of the curve that a training determines."""
    curves = calibration.stiffness.curves
    return min(len(curves[index].coefficients) for index in neighbours(curves, calibration.pad_thickness_mm))


def curve_values(calibration: Calibration, coefficients: Sequence[float] | np.ndarray) -> dict[str, float]:
    """Values that make ``coefficients`` the curve of the mounted pads: both curves next to their thickness are set to it."""
    curves, values = calibration.stiffness.curves, {}
    for index in neighbours(curves, calibration.pad_thickness_mm):
        for term in range(len(curves[index].coefficients)):
            value = float(coefficients[term]) if term < len(coefficients) else 0.0
            values[f"stiffness.curves[{index}].coefficients[{term}]"] = value
    return values


def learned_keys(calibration: Calibration) -> set[str]:
    """Keys of everything that a training determines. The clearance is missing if the released position was not seen."""
    names = {CLEARANCE, LOAD_FRICTION, OFFSET_FRICTION, PRESLIDING_ANGLE, STIFFNESS_SIGMA, STIFFNESS_RELATIVE_SIGMA}
    return names | curve_values(calibration, ()).keys()


def why_out_of_bounds(calibration: Calibration, values: dict[str, float]) -> str:
    """Which learned ``values`` are impossible for a brake with this calibration, in words; empty if none."""
    limits, keys = calibration.adaptation, learned_keys(calibration)
    if wrong := (values.keys() | {CLEARANCE}) ^ keys:
        return f"{', '.join(sorted(wrong))}: missing, or not a learned value"
    try:
        p = to_parameters(moved(calibration, values, checked=True))
    except InputError as error:
        return "; ".join(str(error).splitlines())
    high = calibration.training_force_N
    friction = calibration.friction.offset_Nm + calibration.friction.load_m_per_rad * high
    own_curve = any(values[key] != value_of(calibration, key) for key in curve_values(calibration, ()))
    presliding = calibration.friction.presliding_angle_rad
    least_relative = limits.torque_constant_relative if own_curve else calibration.noise.stiffness_relative
    bounds = [
        ("travel to full force, rad", travel_at(high, p["curve"]), *_possible_travel(calibration)),
        ("load friction, m/rad", p["load_friction"], 0.0, limits.maximum_friction_share * p["gear_gain"]),
        (
            "friction at full force, N m",
            p["offset_friction"] + p["load_friction"] * high,
            *((1.0 + change) * friction for change in (-limits.friction_change, limits.friction_change)),
        ),
        (
            "presliding angle, rad",
            p["presliding_angle"],
            (1.0 - limits.friction_change) * presliding if presliding > _SEEN_RAD else 0.0,
            (1.0 + _SOFTER_GEAR) * (1.0 + limits.friction_change) * max(presliding, _SEEN_RAD),
        ),
        (STIFFNESS_SIGMA, p["stiffness_sigma"], calibration.noise.stiffness_N, high),
        (STIFFNESS_RELATIVE_SIGMA, p["stiffness_relative_sigma"], least_relative, 1.0),
        (
            "change of clearance, rad",
            abs(p["clearance"] - calibration.contact.clearance_rad),
            0.0,
            limits.clearance_change_rad,
        ),
    ]
    for name, value, low, highest in bounds:
        if not low <= value <= highest:
            return f"{name}: {value:.4g}, expected {low:.4g} to {highest:.4g}"
    travels = travel_at(high, p["curve"]) * np.arange(1, TRAVELS + 1) / TRAVELS
    if any(characteristic_curve(travel, p["curve"])[1] <= 0.0 for travel in travels):
        return "stiffness.curves: the force does not rise with the travel"
    return ""


def _possible_travel(calibration: Calibration) -> tuple[float, float]:
    """Bounds of the travel (rad) to full force: stiffest and softest pads of the calibration, and the difference that another
    compound can make."""
    curves, change = calibration.stiffness.curves, calibration.adaptation.curve_change
    travels = [travel_at(calibration.training_force_N, np.array(curve.coefficients)) for curve in curves]
    return (1.0 - change) * min(travels), (1.0 + change) * max(travels)


def with_learned(calibration: Calibration, values: dict[str, float] | None) -> Calibration:
    """The calibration in use: with the learned ``values``, if there are any and learning is enabled."""
    return moved(calibration, values) if values and calibration.adaptation.enabled else calibration
