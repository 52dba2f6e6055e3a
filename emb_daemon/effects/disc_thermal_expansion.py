"""Thermal expansion of the disc: it grows towards the pads, so contact comes earlier when it is hot."""

import numpy as np

from emb_daemon.effects.base import Effect, Parameter, Placebo, of_another_episode
from emb_daemon.jit import Record, njit

STATE = np.dtype([("known", "?"), ("start_C", "f8")], align=True)


@njit
def term(p: Record, s: Record, disc: float, disc_known: bool) -> float:
    """Growth of the disc in m since power-on, where the contact angle was set."""
    if p.growth_um_per_K == 0.0 or not disc_known:
        return 0.0
    if not s.known:
        s.known = True
        s.start_C = disc
    return 1e-6 * p.growth_um_per_K * (disc - s.start_C)


EFFECT = Effect(
    name="disc_thermal_expansion",
    hook="thickness",
    term=term,
    parameters=(
        Parameter(
            "growth_um_per_K", "µm/K", -1.0, 2.0, 0.25, "growth of disc and pads between the pistons", drawn=(-1.0, 2.0)
        ),
    ),
    equation="θ → θ + g (T_disc − T_start) / γ",
    source="thesis 10.2; grey iron, 26 mm, 1.0e-5 1/K: 0.26 µm/K",
    state=STATE,
    signal="disc_temperature",
    manoeuvre="heat the disc, then clamp repeatedly while it cools: wear remains, growth reverses",
    placebos=(Placebo("disc temperature of another episode", signal=of_another_episode),),
)
