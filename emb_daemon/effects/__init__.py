"""Effects that the thesis's models lack, one file each, and their registry.

An effect's file holds its parameters (a numpy record, exactly neutral at zero), its state, the compiled term that the
running estimator calls, and an `Effect` that says on which path it acts and what physics allows.
"""

import numpy as np

from emb_daemon.effects import second_relaxation, signal_delay, stiffness_hysteresis
from emb_daemon.effects.base import Effect

REGISTRY: tuple[Effect, ...] = (
    stiffness_hysteresis.EFFECT,
    second_relaxation.EFFECT,
    signal_delay.EFFECT,
)

EFFECT_PARAMETERS = np.dtype([(effect.name, effect.parameter_record) for effect in REGISTRY], align=True)
EFFECT_STATES = np.dtype([(effect.name, effect.state) for effect in REGISTRY if effect.state is not None], align=True)
