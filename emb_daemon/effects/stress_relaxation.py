"""Stress relaxation: at a held motor angle part of the pads' force decays, because they yield."""

from emb_daemon.effects.base import Effect, Parameter
from emb_daemon.effects.second_relaxation import STATE
from emb_daemon.jit import Record, njit
from emb_daemon.models.stiffness import first_order_lag


@njit
def term(p: Record, s: Record, value: float, dt: float) -> float:
    """Force in N above the static force ``value``: a Maxwell element beside the pads, whose dashpot follows with its time
    constant."""
    if p.share == 0.0:
        return 0.0
    s.force = first_order_lag(s.force, s.before, value, dt, p.time_constant_s)
    s.before = value
    return p.share * (value - s.force)


EFFECT = Effect(
    name="stress_relaxation",
    hook="force",
    term=term,
    parameters=(
        Parameter("share", "1", 0.0, 0.2, 0.05, "force of the element over the static force, at once"),
        Parameter("time_constant_s", "s", 0.05, 60.0, 0.5, "its time constant", (0.1, 0.3, 1.5, 8.0)),
    ),
    equation="F_r = w (F_s − v),  τ dv/dt + v = F_s",
    source="generalized Maxwell solid (Prony series); Ferry, Viscoelastic Properties of Polymers, 3rd ed., ch. 1 and 3",
    state=STATE,
    signal="time_clamped",
    manoeuvre="clamp hard and hold the motor: the force falls with the time constant",
    opposes="second_relaxation",
)
