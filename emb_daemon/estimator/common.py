"""The share that no motion shows: pads, motor and rotor that are all stronger by the same share than believed.

The torque tells stiffness over torque constant, and inertia over torque constant; a share common to all three changes
neither, and only what is known of each beforehand limits it. A filter's priors are normal, and wrong where it matters: a
torque constant that is three standard deviations off and an inertia that is four off do not belong to the calibrated brake,
and its pads need not either. Here each of the three is as the calibration says, or another's, so that the common share has a
mixture of normal distributions.
"""

from math import exp, sqrt

from emb_daemon.estimator.unknown import GAIN_REACH, GAIN_SIGMA, INERTIA_SIGMA, SCALE_JUMP
from emb_daemon.jit import Record, njit
from emb_daemon.models.fusion import GAIN, INERTIA, SCALE

#: Inertia of another unit of one drawing, share.
_ANOTHER_ROTOR = 0.1
#: Odds that pads differ from the calibration's in small ways, and that motor, rotor or a whole unit are others, as those of
#: the hypotheses (`estimator.hypotheses`): one in eight, and one of 34. Of 4100 stretches of ten seconds of drives with one
#: fault each, 55 have a share of force error beyond three standard deviations without this, and 19 to 25 with it, whether
#: these odds are doubled or halved.
_PADS, _OTHERS = exp(-2.0), exp(-3.5)


@njit
def _odds(pads, motor, rotor):
    if pads and motor and rotor:
        return _OTHERS
    return (_PADS if pads else 1.0) * (_OTHERS if motor else 1.0) * (_OTHERS if rotor else 1.0)


@njit
def common_variance(stiffness: float, gain: float, inertia: float, stiffness_sigma: float) -> float:
    """Mean square of the common share.

    Args:
        stiffness, gain, inertia: what is believed of each beside the calibration, shares.
        stiffness_sigma: standard deviation of the calibration's own stiffness, share.
    """
    total = square = 0.0
    for kind in range(8):
        pads, motor, rotor = kind & 1 != 0, kind & 2 != 0, kind & 4 != 0
        a = (SCALE_JUMP if pads else stiffness_sigma) ** -2
        b = (GAIN_REACH if motor else GAIN_SIGMA) ** -2
        c = (_ANOTHER_ROTOR if rotor else INERTIA_SIGMA) ** -2
        information = a + b + c
        mean = -(a * stiffness + b * gain + c * inertia) / information
        cost = a * stiffness * stiffness + b * gain * gain + c * inertia * inertia - information * mean * mean
        likelihood = _odds(pads, motor, rotor) * sqrt(a * b * c / information) * exp(-0.5 * cost)
        total += likelihood
        square += likelihood * (mean * mean + 1.0 / information)
    return square / total if total > 0.0 else SCALE_JUMP * SCALE_JUMP


@njit
def weigh_common(s: Record, p: Record) -> None:
    """Take in what the first hypothesis believes now."""
    s.common = common_variance(s.scale - 1.0, s.error[GAIN], s.error[INERTIA], p.stiffness_relative_sigma)


@njit
def common_sigma(s: Record, p: Record) -> float:
    """Standard deviation of the force, share, that the common share adds to what the filter and the stiffness path hold."""
    counted = s.covariance[SCALE, SCALE] + p.stiffness_relative_sigma * p.stiffness_relative_sigma
    return sqrt(max(s.common - counted, 0.0))
