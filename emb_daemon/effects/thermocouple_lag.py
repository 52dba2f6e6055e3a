"""Lag of the backing plates' thermocouples: they show the plates' earlier temperature."""

from math import exp

import numpy as np

from emb_daemon.effects.base import Effect, Parameter, Placebo, at_another_time
from emb_daemon.jit import Record, njit

#: Smoothing of the derivative that undoes the lag, s: readings come in steps of 0.1 K.
_SMOOTHING_S = 2.0

STATE = np.dtype([("known", "i8", 2), ("smoothed", "f8", 2)], align=True)


@njit
def term(p: Record, s: Record, side: int, value: float, dt: float) -> float:
    """Correction of the reading ``value``, K."""
    if p.lag_s == 0.0:
        return 0.0
    if s.known[side] == 0:
        s.known[side] = 1
        s.smoothed[side] = value
    s.smoothed[side] += (1.0 - exp(-dt / _SMOOTHING_S)) * (value - s.smoothed[side])
    return p.lag_s / _SMOOTHING_S * (value - s.smoothed[side])


EFFECT = Effect(
    name="thermocouple_lag",
    hook="backplate",
    term=term,
    parameters=(Parameter("lag_s", "s", -5.0, 60.0, 5.0, "time constant of the thermocouples"),),
    equation="T → T + τ dT/dt",
    source="first-order sensor: Michalski et al., Temperature Measurement, 2nd ed., ch. 15",
    state=STATE,
    signal="pad_temperature",
    manoeuvre="fast heating from cold",
    placebos=(Placebo("backing plates of another time", samples=at_another_time("inner_backplate", "outer_backplate")),),
)
