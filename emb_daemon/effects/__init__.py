"""Effects that the thesis does not model, one file each, and their registry.

An effect's file holds its parameters (a numpy record, exactly neutral at zero), its state, the compiled term that the
running estimator calls (composed by hook in `paths`), and an `Effect` that says where it enters and what physics allows.
"""

from importlib import import_module

import numpy as np

from emb_daemon.effects import terms
from emb_daemon.effects.base import Effect

#: Simpler causes first: of two that a log cannot distinguish, diagnose takes the first in this list. The terms of one hook
#: are added in the same order.
_NAMES = (
    "disc_thickness_variation",
    "disc_thermal_expansion",
    "pad_wear",
    "torque_constant_fade",
    "torque_saturation",
    "motor_heat_fade",
    "current_offset",
    "viscous_friction",
    "stribeck_friction",
    "friction_asymmetry",
    "gear_mesh_ripple",
    "cogging_torque",
    "stiffness_hysteresis",
    "second_hysteresis",
    "second_relaxation",
    "third_relaxation",
    "stress_relaxation",
    "slow_stress_relaxation",
    "signal_delay",
    "backlash",
    "friction_coefficient_fade",
    "disc_radiation",
    "thermocouple_lag",
)

REGISTRY: tuple[Effect, ...] = tuple(import_module(f"{__name__}.{name}").EFFECT for name in _NAMES)


def parameter_record(effects: tuple[Effect, ...]) -> np.dtype:
    """Parameters of all effects, by name, and of the terms that are not in the catalogue."""
    return np.dtype([*((effect.name, effect.parameter_record) for effect in effects), ("terms", terms.PARAMETERS)], align=True)


def state_record(effects: tuple[Effect, ...]) -> np.dtype:
    """States of all effects that have one, by name, and of the terms."""
    own = [(effect.name, effect.state) for effect in effects if effect.state is not None]
    return np.dtype([*own, ("terms", terms.STATE)], align=True)
