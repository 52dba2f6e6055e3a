"""A second, slower relaxation: part of the pads' force settles after the first time constant is over."""

import numpy as np

from emb_daemon.effects.base import Effect, Parameter
from emb_daemon.jit import Record, njit
from emb_daemon.models.stiffness import first_order_lag

STATE = np.dtype([("force", "f8"), ("before", "f8")], align=True)


@njit
def term(p: Record, s: Record, value: float, dt: float) -> float:
    """Force in N that is still to come: share of the static force ``value`` that lags with the time constant."""
    if p.share == 0.0:
        return 0.0
    s.force = first_order_lag(s.force, s.before, value, dt, p.time_constant_s)
    s.before = value
    return p.share * (s.force - value)


EFFECT = Effect(
    name="second_relaxation",
    hook="force",
    term=term,
    parameters=(
        Parameter("share", "1", 0.0, 0.5, 0.1, "share of the static force that follows slowly", drawn=(0.0, 0.5)),
        Parameter("time_constant_s", "s", 0.05, 60.0, 0.5, "its time constant", (0.3, 1.5, 8.0), drawn=(0.2, 5.0)),
    ),
    equation="F_r = w (v − F_s),  τ₂ dv/dt + v = F_s",
    source="standard linear solid; Ferry, Viscoelastic Properties of Polymers, 3rd ed., ch. 1",
    state=STATE,
    signal="time_clamped",
    manoeuvre="step the motor and hold: the force creeps with its own time constant",
)
