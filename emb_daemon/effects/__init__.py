"""Effects that the thesis's models lack, one file each, and their registry.

An effect's file holds its parameters (a numpy record, exactly neutral at zero), its state, the compiled term that the
running estimator calls (grouped by path in `paths`), and an `Effect` that says on which path it acts and what physics
allows.
"""

import numpy as np

from emb_daemon.effects import (
    backlash,
    cogging_torque,
    current_offset,
    disc_radiation,
    disc_thermal_expansion,
    disc_thickness_variation,
    friction_asymmetry,
    friction_coefficient_fade,
    gear_mesh_ripple,
    pad_wear,
    second_relaxation,
    signal_delay,
    stiffness_hysteresis,
    stribeck_friction,
    thermocouple_lag,
    torque_constant_fade,
    viscous_friction,
)
from emb_daemon.effects.base import Effect

REGISTRY: tuple[Effect, ...] = (
    disc_thickness_variation.EFFECT,
    disc_thermal_expansion.EFFECT,
    pad_wear.EFFECT,
    torque_constant_fade.EFFECT,
    current_offset.EFFECT,
    viscous_friction.EFFECT,
    stribeck_friction.EFFECT,
    friction_asymmetry.EFFECT,
    gear_mesh_ripple.EFFECT,
    cogging_torque.EFFECT,
    stiffness_hysteresis.EFFECT,
    second_relaxation.EFFECT,
    signal_delay.EFFECT,
    backlash.EFFECT,
    friction_coefficient_fade.EFFECT,
    disc_radiation.EFFECT,
    thermocouple_lag.EFFECT,
)

EFFECT_PARAMETERS = np.dtype([(effect.name, effect.parameter_record) for effect in REGISTRY], align=True)
EFFECT_STATES = np.dtype([(effect.name, effect.state) for effect in REGISTRY if effect.state is not None], align=True)
