"""Lag of the backing plates' thermocouples: they show what the plates were, not what they are."""

from math import exp

import numpy as np

from emb_daemon.effects.base import Effect, Parameter
from emb_daemon.jit import njit

#: Smoothing of the derivative that undoes the lag, s: readings come in steps of 0.1 K.
_SMOOTHING_S = 2.0

STATE = np.dtype([("known", "?"), ("inner", "f8"), ("outer", "f8")], align=True)


@njit
def term(p, s, inner, outer, dt):
    """What to add to both readings, K."""
    if p.lag_s == 0.0:
        return 0.0, 0.0
    if not s.known:
        s.known = True
        s.inner, s.outer = inner, outer
    share = 1.0 - exp(-dt / _SMOOTHING_S)
    s.inner += share * (inner - s.inner)
    s.outer += share * (outer - s.outer)
    rate = p.lag_s / _SMOOTHING_S
    return rate * (inner - s.inner), rate * (outer - s.outer)


EFFECT = Effect(
    name="thermocouple_lag",
    path="thermal",
    parameters=(Parameter("lag_s", "s", -5.0, 60.0, 5.0, "time constant of the thermocouples"),),
    equation="T → T + τ dT/dt",
    source="first-order sensor: Michalski et al., Temperature Measurement, 2nd ed., ch. 15",
    state=STATE,
    signal="pad_temperature",
    manoeuvre="fast heating from cold",
    placebo="disc",
)
