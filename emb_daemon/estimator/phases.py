"""Which of the phases that the wheel's counter leaves open a disc of known thickness variation has.

A daemon that is started while the car drives, or has not heard the counter for long, knows the shape of the disc but not where
its crest is: a few phases are possible (`effects.paths.PHASES`). Each predicts another torque while the motor turns, and
Bayes' rule says how likely they are.

Of 380 phases of drives of two brakes whose discs vary by 12 to 19 um, started or started anew at any time (`studies.silent
grid --stranger`, seeds 143 and 146 of the brakes, 225 of the drives; the rules were chosen by other drives), 49 fail if the
first phase is believed, and 2 with this.
"""

from math import exp, log

import numpy as np

from emb_daemon.effects import paths as effects
from emb_daemon.effects.paths import PHASES
from emb_daemon.jit import Record, njit, sq
from emb_daemon.models.stiffness import first_order_lag

#: Standard deviations beyond which a torque says no more, as in `hypotheses`: sensors jump.
_GATE = 5.0
#: Least probability of a phase, so that one that was believed by mistake is left again: what it adds to sigma is 1/200 of the
#: disc's swing. And one from which what is left unexplained may be another disc's (`estimator.uneven`). Both by convention.
_LEAST, _DECIDED = 1e-5, 0.999

#: ``drive`` and ``force`` N: static force and force (with its lag) of each phase beside what is used; ``odds``: scratch.
OPEN_PHASES = np.dtype([("drive", "f8", (PHASES,)), ("force", "f8", (PHASES,)), ("odds", "f8", (PHASES,))], align=True)


@njit
def follow_phases(o: Record, s: Record, m: Record, slope: float, gear_gain: float, relaxation_time: float) -> None:
    """Advance what each phase does to the force by one sample; ``s``: states of the effects, ``slope`` N/rad of the static
    force."""
    if not effects.open_phases(s):
        return
    for phase in range(PHASES):
        drive = slope / gear_gain * effects.beside(s, phase)
        o.force[phase] = first_order_lag(o.force[phase], o.drive[phase], drive, m.dt, relaxation_time)
        o.drive[phase] = drive


@njit
def weigh_phases(o: Record, s: Record, leverage: float, without: float, variance: float) -> None:
    """Take a torque (N m) that the force in use leaves unexplained, and its variance."""
    best = -np.inf
    for phase in range(PHASES):
        misses = sq(without - leverage * o.force[phase]) / variance
        o.odds[phase] = log(effects.likely(s, phase)) - 0.5 * min(misses, sq(_GATE))
        best = max(best, o.odds[phase])
    total = 0.0
    for phase in range(PHASES):
        o.odds[phase] = max(exp(o.odds[phase] - best), _LEAST)
        total += o.odds[phase]
    for phase in range(PHASES):
        effects.believe(s, phase, o.odds[phase] / total)


@njit
def undecided(s: Record) -> bool:
    """Whether several phases are still likely."""
    if not effects.open_phases(s):
        return False
    most = 0.0
    for phase in range(PHASES):
        most = max(most, effects.likely(s, phase))
    return most <= _DECIDED
