"""An effect of one's own in one file: the caliper warms up and widens, so the pads touch later.

Run it like emb-daemon; all commands, the estimator and calibration files then include the effect:

python examples/own_effect.py diagnose FIT_LOG --calibration FILE --validate LOG --output DIR
"""

import sys

import numpy as np

from emb_daemon.effects.base import Effect, Parameter
from emb_daemon.jit import njit

STATE = np.dtype([("known", "?"), ("start_C", "f8")], align=True)


@njit
def term(p, s, m):
    """Growth of disc and pads against the caliper since power-on, m; negative, because the caliper widens."""
    if p.widening_um_per_K == 0.0 or not m.has_thermocouple:
        return 0.0
    if not s.known:
        s.known = True
        s.start_C = m.caliper
    return -1e-6 * p.widening_um_per_K * (m.caliper - s.start_C)


EFFECT = Effect(
    name="caliper_widening",
    hook="thickness",
    term=term,
    parameters=(Parameter("widening_um_per_K", "µm/K", -2.0, 5.0, 0.5, "how much wider a warmer caliper is"),),
    equation="θ → θ − w (T_caliper − T_start) / γ",
    source="steel, 100 mm between the abutments, 1.2e-5 1/K: 1.2 µm/K",
    state=STATE,
    signal="caliper_temperature",
    manoeuvre="heat the brake, then clamp repeatedly while the caliper cools more slowly than the disc",
)

if __name__ == "__main__":
    from emb_daemon.effects.own import extend

    extend(EFFECT)
    from emb_daemon.cli.main import main

    sys.exit(main())
