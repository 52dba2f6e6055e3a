"""A second Maxwell slip element: parts of pads and caliper slip after different travels, which bends the sides of the loop."""

from emb_daemon.effects.base import Effect, Parameter
from emb_daemon.effects.stiffness_hysteresis import STATE, term

EFFECT = Effect(
    name="second_hysteresis",
    hook="stiffness",
    term=term,
    parameters=(
        Parameter("share", "1", 0.0, 0.2, 0.02, "half width of its loop over the clamp force"),
        Parameter(
            "slip_angle_rad", "rad", 0.05, 20.0, 0.3, "motor angle over which it stretches before it slips", (0.1, 0.3, 5.0)
        ),
    ),
    equation="F_s → F_s (1 + h₂ z₂),  dz₂ = dθ/θ_slip held to ±1",
    source="Al-Bender, Lampaert, Swevers, The generalized Maxwell-slip model, IEEE Trans. Automatic Control 50(11), 2005",
    state=STATE,
    signal="clamp_force",
    manoeuvre="slow strokes both ways, long ones and short ones in the middle of them",
    beside="stiffness_hysteresis",
)
