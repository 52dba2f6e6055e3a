"""A third, still slower relaxation: friction materials creep over decades of time, more than one element can describe."""

from emb_daemon.effects.base import Effect, Parameter
from emb_daemon.effects.second_relaxation import STATE, term

EFFECT = Effect(
    name="third_relaxation",
    hook="force",
    term=term,
    parameters=(
        Parameter("share", "1", 0.0, 0.5, 0.05, "share of the static force that follows more slowly still"),
        Parameter("time_constant_s", "s", 0.2, 300.0, 5.0, "its time constant", (1.5, 8.0, 40.0)),
    ),
    equation="F_r = w (v − F_s),  τ₃ dv/dt + v = F_s",
    source="generalized Maxwell solid (Prony series); Ferry, Viscoelastic Properties of Polymers, 3rd ed., ch. 3",
    state=STATE,
    signal="time_clamped",
    manoeuvre="step the motor and hold for a minute, then release and wait as long: the force creeps, then creeps back",
    beside="second_relaxation",
)
