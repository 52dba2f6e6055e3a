"""Pad wear: contact comes later because friction has removed material."""

import numpy as np

from emb_daemon.effects.base import Effect, Parameter, Placebo, of_another_episode
from emb_daemon.jit import Record, njit

STATE = np.dtype([("energy_MJ", "f8")], align=True)


@njit
def term(p: Record, s: Record, power: float, dt: float) -> float:
    """Thickness in m by which both pads have grown (wear is negative) since power-on by friction of ``power`` W."""
    if p.wear_um_per_MJ == 0.0:
        return 0.0
    s.energy_MJ += 1e-6 * power * dt
    return -1e-6 * p.wear_um_per_MJ * s.energy_MJ


EFFECT = Effect(
    name="pad_wear",
    hook="thickness",
    term=term,
    parameters=(Parameter("wear_um_per_MJ", "µm/MJ", -10.0, 100.0, 5.0, "both pads' wear per friction energy"),),
    equation="θ → θ − w ∫P dt / γ",
    source="Archard, J. Applied Physics 24, 1953",
    state=STATE,
    signal="energy",
    manoeuvre="clamp again after the disc has cooled: growth reverses, wear remains",
    placebos=(Placebo("friction energy of another episode", signal=of_another_episode),),
)
