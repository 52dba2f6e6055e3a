"""Rate-independent hysteresis of pads and caliper: a Maxwell slip element whose force grows with the clamp force."""

import numpy as np

from emb_daemon.effects.base import Effect, Parameter
from emb_daemon.jit import Record, njit

STATE = np.dtype([("slip", "f8")], align=True)


@njit
def term(p: Record, s: Record, travel: float) -> float:
    """Relative force of the element after the pads moved by ``travel`` rad; ``s.slip`` is its stretch, -1 to 1."""
    if p.share == 0.0:
        return 0.0
    s.slip = min(max(s.slip + travel / p.slip_angle_rad, -1.0), 1.0)
    return p.share * s.slip


EFFECT = Effect(
    name="stiffness_hysteresis",
    hook="stiffness",
    term=term,
    parameters=(
        Parameter("share", "1", 0.0, 0.5, 0.03, "half width of the loop over the clamp force", drawn=(0.0, 0.2)),
        Parameter(
            "slip_angle_rad",
            "rad",
            0.05,
            100.0,
            1.0,
            "motor angle over which the element stretches before it slips",
            (0.3, 1.0, 3.0),
            drawn=(0.4, 2.0),
        ),
    ),
    equation="F_s → F_s (1 + h z),  dz = dθ/θ_slip held to ±1",
    source="Al-Bender, Lampaert, Swevers, The generalized Maxwell-slip model, IEEE Trans. Automatic Control 50(11), 2005",
    state=STATE,
    signal="clamp_force",
    manoeuvre="slow strokes both ways: hysteresis stays when the speed goes to zero",
)
