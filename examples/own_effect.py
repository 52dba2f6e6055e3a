"""An effect of one's own in one file: the caliper warms up and widens, so the pads touch later.

Run it as you run emb-daemon; every command, the estimator and the calibration file then know the effect:

python examples/own_effect.py diagnose FIT_LOG --calibration FILE --validate LOG --output DIR
"""

import sys

import numpy as np

from emb_daemon.effects import paths
from emb_daemon.effects.base import Effect, Parameter
from emb_daemon.effects.own import extend
from emb_daemon.jit import njit

STATE = np.dtype([("known", "?"), ("start_C", "f8")], align=True)


@njit
def term(p, s, m):
    """Growth of the caliper in m since power-on; exactly zero at zero parameters."""
    if p.widening_um_per_K == 0.0 or not m.has_thermocouple:
        return 0.0
    if not s.known:
        s.known = True
        s.start_C = m.caliper
    return 1e-6 * p.widening_um_per_K * (m.caliper - s.start_C)


EFFECT = Effect(
    name="caliper_widening",
    path="stiffness",
    parameters=(Parameter("widening_um_per_K", "µm/K", -2.0, 5.0, 0.5, "how much wider a warmer caliper is"),),
    equation="θ → θ − w (T_caliper − T_start) / γ",
    source="steel, 100 mm between the abutments, 1.2e-5 1/K: 1.2 µm/K",
    state=STATE,
    signal="caliper_temperature",
    manoeuvre="heat the brake, then clamp repeatedly while the caliper cools more slowly than the disc",
)

package_thickness = paths.thickness


@njit
def thickness(e, s, m, disc, disc_known, power):
    """What disc and pads have gained, less what the caliper has gained."""
    gained = package_thickness(e, s, m, disc, disc_known, power)
    return gained - term(e.caliper_widening, s.caliper_widening, m)


extend(EFFECT, thickness=thickness)

from emb_daemon.cli.main import main  # noqa: E402  after the effect is known

if __name__ == "__main__":
    sys.exit(main())
