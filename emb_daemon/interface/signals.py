"""The table of the estimator's inputs and outputs, for interfaces that name signals.

Inputs are named as `emb_daemon.api` names its arguments, outputs as replay names its columns: both state the unit.
"""

import re
from typing import NamedTuple

import numpy as np

from emb_daemon.estimator.records import DEPTHS_M, ESTIMATE, SAMPLE
from emb_daemon.wire.contract import MODES, SOURCES


class Signal(NamedTuple):
    """``field`` of a SAMPLE or an ESTIMATE, with its index if it is an array's; ``meaning`` in words; ``start`` is an input's
    value before anything was measured."""

    name: str
    field: str
    unit: str
    meaning: str
    start: float | bool | int = 0.0


_SOURCES = ", ".join(f"{code} {word}" for code, word in SOURCES.items())

INPUTS = (
    Signal("angle_rad", "angle", "rad", "motor angle, multi-turn, any zero, at the sample"),
    Signal("speed_rad_per_s", "speed", "rad/s", "motor speed at the sample"),
    Signal("current_A", "current_q", "A", "torque-producing current, mean over the 4 ms before the sample"),
    Signal("sensor_force_N", "sensor_force", "N", "force sensor of low range, where the calibration has one"),
    Signal("inner_backplate_C", "inner_backplate", "degC", "inner backing plate", 20.0),
    Signal("outer_backplate_C", "outer_backplate", "degC", "outer backing plate", 20.0),
    Signal("caliper_C", "caliper", "degC", "caliper", 20.0),
    Signal("ambient_C", "ambient", "degC", "ambient air", 20.0),
    Signal("wheel_speed_rad_per_s", "wheel_speed", "rad/s", "speed of the disc"),
    Signal("wheel_pulse", "wheel_pulse", "1", "pulses of the wheel, 96 a turn, modulo 4096"),
    Signal("vehicle_speed_m_per_s", "vehicle_speed", "m/s", "speed of the vehicle"),
    Signal("park_brake", "park_brake", "1", "0 released, 1 applied, 2 in transition, 3 fault"),
    Signal("brake_request", "brake_request", "1", "1 while the driver or a system brakes"),
    Signal("brake_torque_Nm", "brake_torque", "N.m", "torque of a rig's brake torque sensor; NaN if there is none",
           float("nan")),
    Signal("has_current", "has_current", "", "current_A is fresh", True),
    Signal("has_sensor_force", "has_sensor_force", "", "sensor_force_N is fresh", False),
    Signal("has_thermocouple", "has_thermocouple", "", "inner_backplate_C, outer_backplate_C and caliper_C are fresh", True),
    Signal("has_wheel_speed", "has_wheel_speed", "", "wheel_speed_rad_per_s is fresh", True),
    Signal("has_wheel_pulse", "has_wheel_pulse", "", "wheel_pulse is fresh", True),
    Signal("has_status", "has_status", "", "ambient_C, vehicle_speed_m_per_s, park_brake and brake_request are fresh", True),
    Signal("was_silent", "was_silent", "", "the motor's controller was silent for over 0.1 s: its zero may be another",
           False),
    Signal("is_prediction", "is_prediction", "", "there is no sample: predict from the last one", False),
    Signal("reasons_outside", "reasons", "", "bits of DegradedReasons that are known outside the estimator", 0),
)  # fmt: skip

OUTPUTS = (
    Signal("clamp_force_N", "force", "N", "clamp force, both paths fused"),
    Signal("clamp_force_sigma_N", "sigma", "N", "one standard deviation of clamp_force_N"),
    Signal("stiffness_force_N", "stiffness_force", "N", "from motor angle by the characteristic curve"),
    Signal("stiffness_force_sigma_N", "stiffness_sigma", "N", "one standard deviation of stiffness_force_N"),
    Signal("torque_force_N", "torque_force", "N", "from motor current by the torque balance; not a number without one"),
    Signal("torque_force_sigma_N", "torque_sigma", "N", "one standard deviation of torque_force_N"),
    Signal("ml_force_N", "ml_force", "N", "both paths weighted by their variances, without memory"),
    Signal("contact_angle_rad", "contact_angle", "rad", "motor angle at which the pads touch"),
    Signal("contact_angle_sigma_rad", "contact_sigma", "rad", "one standard deviation of contact_angle_rad"),
    Signal("stiffness_factor", "stiffness_factor", "1", "stiffness relative to the calibration"),
    *(Signal(f"{pad}_{part}_C", f"{part}[{side}]", "degC", f"{pad} pad, {words}")
      for side, pad in enumerate(("inner", "outer"))
      for part, words in (("surface", "friction surface"), ("mean", "mean over its thickness"))),
    *(Signal(f"{pad}_{1e3 * depth:.0f}mm_C", f"depth[{side}][{index}]", "degC",
             f"{pad} pad, {1e3 * depth:.0f} mm below the friction surface")
      for side, pad in enumerate(("inner", "outer")) for index, depth in enumerate(DEPTHS_M)),
    Signal("disc_C", "disc", "degC", "brake disc, lumped"),
    Signal("mode", "mode", "", "mode of the estimator: " + ", ".join(f"{code} {word}" for code, word in enumerate(MODES))),
    Signal("source", "source", "", f"source of clamp_force_N: {_SOURCES}"),
    Signal("reasons", "reasons", "", "reasons not to trust the estimate: bits of DegradedReasons"),
    Signal("facts", "facts", "", "what the estimator found, from which its reasons follow: bits; none in a prediction"),
)  # fmt: skip

#: Meaning of the fields that identify a SAMPLE.
BOOKKEEPING = {
    "time_ns": "of the sample, ns, on the caller's clock; copied into the estimate",
    "late_ns": "ns, in whole cycles, by which it came later than the promptest of its sender's; 0 if not known; copied",
    "cycle": "cycles of 4 ms since the first sample; copied",
    "elapsed_cycles": "cycles since the last call; copied",
    "age_cycles": "cycles since the last sample; 0 but for a prediction",
    "corner": "0 to 3 for FL, FR, RL, RR; copied",
    "counter": "of the sample's frames; copied",
    "dt": "s since the last sample, 0 at the first",
}


def field_of(record: np.dtype, path: str) -> tuple[np.dtype, int]:
    """Type and offset in bytes of a field such as ``depth[1][2]``."""
    name, *indices = re.findall(r"\w+", path)
    kind, offset = record.fields[name][:2]
    for position, index in enumerate(map(int, indices)):
        if not 0 <= index < kind.shape[position]:
            raise IndexError(path)
        offset += index * kind.base.itemsize * int(np.prod(kind.shape[position + 1 :]))
    return kind.base, offset


def describe(record: np.dtype, field: str) -> str:
    """Meaning of a field of SAMPLE or ESTIMATE, or of its elements, with unit; empty for fields that no interface has."""
    if record is SAMPLE and field in BOOKKEEPING:
        return BOOKKEEPING[field]
    table = {SAMPLE: INPUTS, ESTIMATE: OUTPUTS}[record]
    found = [signal for signal in table if signal.field.partition("[")[0] == field]
    if len(found) > 1:
        return ", ".join(signal.name for signal in found)
    return ", ".join(part for signal in found for part in (signal.meaning, signal.unit) if part not in ("", "1"))
