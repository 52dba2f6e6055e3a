"""A second, slower stress relaxation: pads yield over more than one decade of time."""

from emb_daemon.effects.base import Effect, Parameter
from emb_daemon.effects.stress_relaxation import STATE, term

EFFECT = Effect(
    name="slow_stress_relaxation",
    hook="force",
    term=term,
    parameters=(
        Parameter("share", "1", 0.0, 0.2, 0.05, "force of the element over the static force, at once"),
        Parameter("time_constant_s", "s", 0.1, 300.0, 5.0, "its time constant", (0.3, 1.5, 8.0, 40.0)),
    ),
    equation="F_r = w (F_s − v),  τ dv/dt + v = F_s",
    source="generalized Maxwell solid (Prony series); Ferry, Viscoelastic Properties of Polymers, 3rd ed., ch. 3",
    state=STATE,
    signal="time_clamped",
    manoeuvre="clamp hard and hold the motor for a minute: the force falls on",
    beside="stress_relaxation",
)
