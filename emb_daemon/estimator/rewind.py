"""Going back to what was known some stops ago, when a fault of the signals is found that may have been there since.

A current or an angle that comes late, or through a filter, is found after a few strokes, and undone. What these strokes have
taught of contact, pads, motor and friction was wrong: a current that is filtered by 8 ms has passed for pads a quarter
stiffer (tests/test_rewind.py).
"""

import numpy as np

from emb_daemon.estimator.hypotheses import fold, open_all
from emb_daemon.estimator.paths import disc_warmth
from emb_daemon.estimator.unknown import LATE_CYCLES
from emb_daemon.jit import Record, njit, sq
from emb_daemon.models.fusion import CONTACT, CREEPS, GROWTH, LATE, OFFSET, SCALE, STATES, copy_errors

#: Stops to go back: a filter shows in one to three strokes, and those that swing count as stops each. Of 132 phases of three
#: recorded logs with currents and angles that are late or filtered (`studies.silent injected --count 8 --seed 12 --faults
#: current_filtered,current_delayed,resolver_delayed,angle_filtered`) 18 fail without going back, 13 with three stops and 9
#: with six.
STOPS = 6

#: What was known at the end of a stop: the first hypothesis's errors and their covariance, and what the model had taken over.
LEARNED = np.dtype(
    [
        ("error", "f8", (STATES,)),
        ("covariance", "f8", (STATES, STATES)),
        *((name, "f8") for name in ("contact_angle", "scale", "growth", "jumps", "contact_walk")),
        ("creep", "f8", (len(CREEPS),)),
    ],
    align=True,
)


@njit
def _copy(a, s):
    copy_errors(a.error, a.covariance, s.error, s.covariance)
    a.contact_angle, a.scale, a.growth, a.jumps = s.contact_angle, s.scale, s.growth, s.jumps
    a.contact_walk = s.contact_walk
    for i in range(len(CREEPS)):
        a.creep[i] = s.creep[i]


@njit
def keep_all(s: Record) -> None:
    """At the start, or after going back: every stop in the store gets what is known now."""
    for i in range(STOPS):
        _copy(s.learned[i], s)


@njit
def keep(s: Record) -> None:
    """Keep what is known at the end of a stop."""
    for i in range(STOPS - 1):
        _copy(s.learned[i], s.learned[i + 1])
    _copy(s.learned[STOPS - 1], s)


@njit
def go_back(s: Record, p: Record) -> None:
    """Return to what was known `STOPS` stops ago, with all hypotheses of a change opened anew."""
    # Neither a delay nor a filter changes what the clearance shows of the offset.
    offset, variance = s.error[OFFSET], s.covariance[OFFSET, OFFSET]
    _know(s, s.learned[0])
    for i in range(STATES):
        s.covariance[OFFSET, i] = s.covariance[i, OFFSET] = 0.0
        s.covariance[LATE, i] = s.covariance[i, LATE] = 0.0
    s.error[OFFSET], s.covariance[OFFSET, OFFSET] = offset, variance
    s.error[LATE], s.covariance[LATE, LATE] = 0.0, sq(LATE_CYCLES)
    keep_all(s)
    open_all(s, p)


@njit
def forget_stroke(s: Record, p: Record) -> None:
    """Know what was known at the end of the last stop, and suspect nothing."""
    _know(s, s.learned[STOPS - 1])
    open_all(s, p)


@njit
def _know(s, a):
    """Know no more than ``a``, a LEARNED record."""
    s.rewinds += 1
    copy_errors(s.error, s.covariance, a.error, a.covariance)
    s.error[CONTACT], s.error[SCALE] = a.contact_angle - s.contact_angle, a.scale / s.scale - 1.0
    s.error[GROWTH] = a.growth - s.growth
    for i in range(len(CREEPS)):
        s.error[CREEPS[i]] = a.creep[i] - s.creep[i]
    fold(s, disc_warmth(s), True)
    s.jumps, s.contact_walk, s.contact_age_s = a.jumps, a.contact_walk, 0.0
