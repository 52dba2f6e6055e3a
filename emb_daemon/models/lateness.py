"""Age of the resolver's angle relative to the speed that comes with it, or of the speed, and error of the resolver's gain.

An angle that is late lags the integrated speed by age times speed; one of wrong gain, by a share of the way. Both are followed
over a tenth of a second and fitted together, because otherwise a gain error of seven hundredths looks like an age. Neither
signal can be ahead of the motor: where the angle leads, the speed went through a filter, as tracking loops and firmware have
them, and inertia would seem to need kilonewtons at the wrong time. What went into the filter takes the speed's place.
"""

from math import exp, sqrt

import numpy as np

from emb_daemon.jit import Record, fields, njit
from emb_daemon.wire.contract import CYCLE_S

#: Time over which angle and speed are followed, s: that of a stroke, in which neither an offset of the speed nor a slip of the
#: resolver adds up much. Time over which the normal equations forget, s: some stops; and standard deviation of the age to
#: which they remember, s: so that what changes while driving is found within a stroke or two.
_FOLLOWED_S, _KEPT_S, _PRECISE_S = 0.1, 60.0, 1e-4
#: Noise of the angle less integrated speed, rad, standard deviation: 0.3 rad/s of the speed, added up over the time above in
#: samples of 4 ms, make 0.004, a resolver's own error of ten arc minutes 0.003, counts 0.002. Number of samples with the same
#: error: those of the time above.
_NOISE_RAD, _ALIKE = 0.01, 25.0
#: Standard deviation of the age before anything is known, s: any moment of the last cycle of 4 ms. Largest age, s: sample,
#: frame and gateway each a cycle late; `plausibility` finds an older angle as a fault.
_AGE_S, _OLDEST_S = 0.002, 0.015
#: Standard deviation of a resolver's gain, share; and share of a stroke's way that the trapezoidal rule may miss: T² / 8 of an
#: acceleration of 8000 rad/s² at each of its two changes, on some 10 rad.
_GAIN, _MISSED = 0.02, 0.003
#: Standard deviations from which a gain error is certain.
_SURELY = 3.0
#: Difference (rad) beyond that of the largest age up to which a sample is used: ten times its noise. More is another fault.
_BEYOND_RAD = 0.1
#: Least and largest time constant of the speed's filter, s: a speed that is the mean of its cycle is half a cycle old, as it
#: was at calibration; through more than twelve cycles a stroke is not seen.
_WORTH_S, SLOWEST_S = 0.5 * CYCLE_S, 12.0 * CYCLE_S

#: ``apart``, ``gained`` and ``gone``: angle less integrated speed (rad), speed (rad/s) and way (rad), leaky. The others:
#: normal equations of age and gain, and their solution: ``age`` s, and ``gain``, the gain error if it is certain, or 0.
#: ``ahead`` s: by which the angle leads the speed, or lags it if negative, if that is certain, or 0. ``filtered`` s: time
#: constant of the speed's filter, which is undone; ``reported`` rad/s: the last speed as it came.
LATENESS = np.dtype(fields("f8", "apart gained gone ss sw ww as_ aw age gain ahead filtered reported"), align=True)


@njit
def unfilter(a: Record, m: Record) -> None:
    """Replace the speed of SAMPLE ``m`` by what went into its filter."""
    reported = m.speed
    if a.filtered > 0.0 and m.dt > 0.0:
        m.speed += a.filtered * (reported - a.reported) / m.dt
    a.reported = reported


@njit
def follow(a: Record, travel: float, turned: float, gained: float, dt: float) -> None:
    """Take one sample: ``travel`` rad by the angle, ``turned`` rad and ``gained`` rad/s by the speed, in ``dt`` s."""
    keep = exp(-dt / _FOLLOWED_S)
    a.apart = keep * a.apart + travel - turned
    a.gained = keep * a.gained + gained
    a.gone = keep * a.gone + turned
    leads = a.apart if a.gained > 0.0 else -a.apart
    if not -_OLDEST_S * abs(a.gained) - _BEYOND_RAD <= leads <= SLOWEST_S * abs(a.gained) + _BEYOND_RAD:
        return
    noise = _ALIKE * _NOISE_RAD * _NOISE_RAD
    old = min(exp(-dt / _KEPT_S), noise / (_PRECISE_S * _PRECISE_S) / max(a.ss, 1.0))
    a.ss = old * a.ss + a.gained * a.gained
    a.sw = old * a.sw + a.gained * a.gone
    a.ww = old * a.ww + a.gone * a.gone
    a.as_ = old * a.as_ + a.apart * a.gained
    a.aw = old * a.aw + a.apart * a.gone
    ss, ww = a.ss + noise / (_AGE_S * _AGE_S), a.ww + noise / (_GAIN * _GAIN)
    determinant = ss * ww - a.sw * a.sw
    age, gain = (a.aw * a.sw - a.as_ * ww) / determinant, abs(a.aw * ss - a.as_ * a.sw) / determinant
    a.age = min(max(age, 0.0), _OLDEST_S)
    a.gain = gain if gain > _MISSED + _SURELY * sqrt(noise * ss / determinant) else 0.0
    # Of a filter nothing is known before.
    determinant = (a.ss + noise / (SLOWEST_S * SLOWEST_S)) * ww - a.sw * a.sw
    ahead = (a.as_ * ww - a.aw * a.sw) / determinant
    a.ahead = ahead if abs(ahead) > _WORTH_S + _SURELY * sqrt(noise * ww / determinant) else 0.0


@njit
def find_filter(a: Record) -> bool:
    """Whether the speed's filter is found to be another, which is undone from the next sample on."""
    filtered = min(max(a.filtered + a.ahead, 0.0), SLOWEST_S)
    if filtered == a.filtered:
        return False
    # All that was followed so far was beside another speed.
    a.filtered = filtered
    a.age = a.gain = a.ahead = a.ss = a.sw = a.ww = a.as_ = a.aw = 0.0
    interrupt(a)
    return True


@njit
def interrupt(a: Record) -> None:
    """Begin to follow anew after a missing sample or a standstill."""
    a.apart = a.gained = a.gone = 0.0
