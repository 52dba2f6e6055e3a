"""The calibration's limits of adaptation as the record that compiled code reads."""

import numpy as np

from emb_daemon.adapt.records import LIMITS
from emb_daemon.calibration.types import Calibration


def to_limits(calibration: Calibration) -> np.void:
    """LIMITS record of a calibration."""
    a, limits = calibration.adaptation, np.zeros(1, LIMITS)[0]
    limits["enabled"] = a.enabled
    limits["minimum_ambient"], limits["maximum_ambient"] = a.minimum_ambient_C, a.maximum_ambient_C
    limits["maximum_rise"] = a.maximum_rise_K
    limits["high_force"], limits["coverage"] = calibration.training_force_N, a.coverage
    limits["dither_amplitude"], limits["dither_frequency"] = a.dither_amplitude_rad, a.dither_frequency_Hz
    limits["settling_time"], limits["answer_time"] = a.settling_time_s, a.answer_time_s
    limits["longest_training"] = a.longest_training_s
    limits["samples_per_range"] = a.samples_per_range
    limits["residual_ratio"] = a.residual_ratio
    limits["curve_change"], limits["friction_change"] = a.curve_change, a.friction_change
    limits["clearance_change"] = a.clearance_change_rad
    limits["maximum_friction_share"] = a.maximum_friction_share
    limits["maximum_sigma"], limits["pairs_difference"] = a.maximum_sigma_N, a.pairs_difference
    limits["torque_constant_sigma"] = a.torque_constant_relative
    limits["dynamics_sigma"] = calibration.noise.stiffness_N
    return limits
