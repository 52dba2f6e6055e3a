"""The share that no motion shows: pads, motor and rotor that are all stronger by the same share than believed.

The torque tells stiffness over torque constant, and inertia over torque constant; a share common to all three changes
neither, and only what is known of each beforehand limits it. A filter's priors are normal, and wrong where it matters: a
torque constant that is three standard deviations off and an inertia that is four off do not belong to the calibrated brake,
and its pads need not either. Here each of the three is as the calibration says, or another's, or all three are those of
another unit, so that the common share has a mixture of normal distributions. Rotor and pads are no others later if a stop has
shown that they are the calibration's; a motor may fade.
"""

from math import exp, sqrt

from emb_daemon.estimator.hypotheses import PRIOR_ODDS, PROVEN, likeliest
from emb_daemon.estimator.unknown import DRIFT_SCALE, GAIN_JUMP, GAIN_SIGMA, INERTIA_REACH, INERTIA_SIGMA, SCALE_JUMP
from emb_daemon.jit import Record, njit, sq
from emb_daemon.models.fusion import GAIN, INERTIA, SCALE

#: Torque constant of magnets that have lost strength or of a wrong current sensor, share (as in `adapt.fit`).
_ANOTHER_MOTOR = 0.1
#: Odds that pads differ from the calibration's in small ways, and that motor, rotor or a whole unit are others, as those of
#: the hypotheses (`estimator.hypotheses`): one in eight, and one of 34. Of 444 phases that `studies.silent grid` draws
#: (--faults nominal,pads_thickness,pads_compound,tolerance,torque_constant,current_gain,gear_wear --count 10, seeds 22 and
#: 23) 41 fail without this and 26 with it.
PADS_ODDS, OTHERS_ODDS = exp(-2.0), exp(-3.5)
#: Standard deviation of the stiffness of pads that are the calibration's, that differ in small ways, and that are others,
#: shares; odds of each over those of the second.
_PADS_SIGMA, _PADS_SHARE = (0.0, DRIFT_SCALE, SCALE_JUMP), (1.0, 1.0, OTHERS_ODDS / PADS_ODDS)
#: Kind that is another unit, after the combinations of the three; least error of a calibration's stiffness, share.
_UNIT, _LEAST = 12, 1e-4
#: Least share of what is known of the inertia that motion has shown.
_UNSHOWN = 1e-3
#: Time after which the common share is weighed again within a stop, s: a stroke.
_FOLLOWED_S = 0.5


@njit
def common_variance(
    stiffness: float, gain: float, inertia: float, stiffness_variance: float, inertia_variance: float, pads_odds: float,
    rotor_odds: float, unit_odds: float,
) -> tuple[float, float, float, float]:  # fmt: skip
    """Mean square of the common share, and the odds by it that the pads, the rotor, and the unit are others.

    Args:
        stiffness, gain, inertia: what is believed of each beside the calibration, shares.
        stiffness_variance: of what is believed and of the calibration's own stiffness; ``inertia_variance``: of the former.
        pads_odds, rotor_odds, unit_odds: odds beforehand.
    """
    total = square = of_pads = of_rotor = of_unit = 0.0
    for kind in range(_UNIT + 1):
        unit = kind == _UNIT
        pads = 2 if unit else kind % 3
        motor, rotor = unit or (kind // 3) & 1 != 0, unit or kind >= 6
        odds = (pads_odds if pads else 1.0) * _PADS_SHARE[pads]
        odds *= (OTHERS_ODDS if motor else 1.0) * (rotor_odds if rotor else 1.0)
        gain_sigma = _ANOTHER_MOTOR if motor else GAIN_SIGMA
        if unit:
            # Its torque constant is within the datasheet's tolerance.
            odds, gain_sigma = unit_odds, GAIN_JUMP
        a = 1.0 / (stiffness_variance + _PADS_SIGMA[pads] * _PADS_SIGMA[pads])
        b = 1.0 / (gain_sigma * gain_sigma)
        c = 1.0 / (inertia_variance + sq(INERTIA_REACH if rotor else INERTIA_SIGMA))
        information = a + b + c
        mean = -(a * stiffness + b * gain + c * inertia) / information
        cost = a * stiffness * stiffness + b * gain * gain + c * inertia * inertia - information * mean * mean
        likelihood = odds * sqrt(a * b * c / information) * exp(-0.5 * cost)
        total += likelihood
        square += likelihood * (mean * mean + 1.0 / information)
        if unit:
            of_unit = likelihood
        else:
            of_pads += likelihood if pads else 0.0
            of_rotor += likelihood if rotor else 0.0
    if total <= 0.0:
        return SCALE_JUMP * SCALE_JUMP, pads_odds, rotor_odds, unit_odds
    return square / total, _to_odds(of_pads, total), _to_odds(of_rotor, total), _to_odds(of_unit, total)


@njit
def _to_odds(part, total):
    return part / max(total - part, 1e-9 * total)


@njit
def forget_common(s: Record) -> None:
    """Begin with the calibration alone: prior odds for pads, rotor and unit."""
    s.common = s.common_before = 0.0
    s.pads_odds, s.rotor_odds, s.unit_odds = PADS_ODDS, OTHERS_ODDS, OTHERS_ODDS


@njit
def _weighed(s, p, x, P, pads_odds, rotor_odds, unit_odds):
    """`common_variance` of a hypothesis with the errors ``x`` and their covariance ``P``."""
    own = P[SCALE, SCALE] + sq(max(p.stiffness_relative_sigma, _LEAST))
    stiffness = s.scale * (1.0 + x[SCALE]) - 1.0
    # Of the inertia only what motion has shown counts: its prior is no evidence that the rotor is the calibration's.
    shown = max(1.0 - P[INERTIA, INERTIA] / sq(INERTIA_SIGMA), _UNSHOWN)
    rotor, unsure = x[INERTIA] / shown, P[INERTIA, INERTIA] / shown
    return common_variance(stiffness, x[GAIN], rotor, own, unsure, pads_odds, rotor_odds, unit_odds)


@njit
def weigh_common(s: Record, p: Record) -> None:
    """Take in what the first hypothesis believes after a stop."""
    x, P = s.error, s.covariance
    _, pads, rotor, unit = _weighed(s, p, x, P, PADS_ODDS, OTHERS_ODDS, OTHERS_ODDS)
    s.pads_odds = max(min(s.pads_odds, pads), exp(PRIOR_ODDS))
    s.rotor_odds, s.unit_odds = min(s.rotor_odds, rotor), min(s.unit_odds, unit)
    s.common_before, _, _, _ = _weighed(s, p, x, P, s.pads_odds, s.rotor_odds, s.unit_odds)
    s.common = s.common_before


@njit
def follow_common(s: Record, p: Record, dt: float) -> None:
    """Within a stop, every `_FOLLOWED_S`: weigh the common share by a change that is proven but for the release, because a
    stop may be long, or the first. The odds of other pads, rotors and units are kept at the stop's end only."""
    s.common_age_s += dt
    if s.common_age_s > _FOLLOWED_S:
        s.common_age_s, s.common, a = 0.0, s.common_before, likeliest(s)
        if a.log_odds > PROVEN:
            common, _, _, _ = _weighed(s, p, a.error, a.covariance, s.pads_odds, s.rotor_odds, s.unit_odds)
            s.common = max(s.common_before, common)


@njit
def common_sigma(s: Record, p: Record) -> float:
    """Standard deviation of the force, share, that the common share adds to what the filter and the stiffness path hold."""
    counted = s.covariance[SCALE, SCALE] + p.stiffness_relative_sigma * p.stiffness_relative_sigma
    return sqrt(max(s.common - counted, 0.0))
