"""What is not known of a brake, as standard deviations: one table.

Each quantity that the force or the torque rests on has a prior, a walk (how it changes while nothing shows it), and a jump:
how far it may have changed at once, between two stops or in a workshop. `estimator.hypotheses` holds the brake that is as it
was against the brake in which something has jumped.
"""

from math import exp, sqrt

from emb_daemon.jit import Floats, Record, hypot, njit, sq
from emb_daemon.models.fusion import (
    CONTACT,
    COULOMB,
    CREEPS,
    FADE,
    FAST,
    GAIN,
    GROWTH,
    HOUSING,
    INERTIA,
    LATE,
    LOAD,
    NOISE,
    OFFSET,
    SCALE,
    SLOW,
    VISCOUS,
)

#: Contact angle: knock-back, uneven wear and a disturbed released position move the pads by some tens of micrometres between
#: two stops (Limpert, Brake Design and Safety, 3rd ed., ch. 5: 0.05 to 0.1 mm of run-out and knock-back), m.
_CONTACT_JUMP_M = 40e-6
#: Contact angle from one parking to the next start: pads settle by some micrometres, m.
_SETTLED_M = 5e-6
#: Contact angle by friction energy: pads wear (linings of 0.03 to 0.1 mm^3 per kJ and some 5000 mm^2: 5 to 20 um/MJ) and discs
#: grow by some 3 um/MJ more or less than a calibration knows, and by another amount in the next stop of some 60 kJ:
#: sqrt(2 (3 um/MJ)^2 0.06 MJ) per root of a MJ, m per root of a J.
_WORN_M_PER_SQRT_J = 1.0e-9
#: Stiffness: compressibility of pads of one size spreads by a fifth between compounds (ISO 6310), share.
SCALE_JUMP = 0.2
#: What a calibration's curve may be off by on its own brake, and what pads change by in an hour of use, share.
_SCALE, _SCALE_WALK_PER_SQRT_S = 0.001, 0.01 / 60.0
#: Creep beside the relaxation that the calibration knows, for each of its time constants: of the calibration's own pads, and
#: of others, which relax by some per cent of the force within seconds, shares. Of 36 phases with other creep that
#: `studies.silent grid --faults creep --count 12 --seed 5` draws 36 fail without and 10 with these states. With twice as much
#: of its own, other pads that never release are a fifth less accurate (tests/test_rig.py).
_CREEP, _CREEP_JUMP = 0.001, 0.03
#: Time in which heat that nobody knows of has become another: it leaves a pad within minutes, s.
_HEAT_CHANGES_S = 100.0
#: Kelvin below the calibration's temperature that its own days cover.
_MEASURED_K = 10.0
#: Growth of disc and pads: grey iron of 26 mm, 1.0e-5 1/K, m/K; and what a calibration without it leaves.
_GROWTH_JUMP_M_PER_K = 0.26e-6
#: Torque constant and current gain: datasheets state 2 to 3 %; a calibration's own is known better, and ages.
GAIN_SIGMA, GAIN_JUMP, _GAIN_WALK_PER_SQRT_S = 0.01, 0.03, 0.01 / 60.0
#: Offset of the motor torque at power-on: share of the torque that the largest force needs (Hall sensors: 0.5 to 1 % of a
#: range that is several times that current); and time in which it drifts as far again, s.
_OFFSET, _OFFSET_DRIFTS_S = 0.1, 36000.0
#: Inertia: rotor and screw do not change, but what a calibration makes of them is no better than this, share.
INERTIA_SIGMA = 0.02
#: Part of a cycle by which current and angle may be apart in time, one standard deviation: two sensors that sample at their
#: own moments of one cycle (uniform: 0.29); and time in which the difference becomes another, s: two clocks that are 50 ppm
#: apart, as crystals are, are a cycle apart after 80 s. Torque of a cycle in which it changes is off by the part of that
#: change, for as long as it changes: of 363 phases of drawn drives (`studies.silent grid --count 2 --pairs 0 --seed 401
#: --drawn`) 16 fail where that is noise of each sample, 13 where it is a state. A current that is a third of a cycle late
#: while a foot trembles has been taken for another contact, 1.5 kN off.
LATE_CYCLES, _LATE_DRIFTS_S = 0.3, 80.0
#: Gear friction at the calibration's temperature, share; and what wear or another lubricant may do to it.
_FRICTION, _FRICTION_JUMP, _FRICTION_WALK_PER_SQRT_S = 0.1, 0.5, 0.1 / 60.0
#: Rise of friction at low speed that a calibration without it leaves, and that wear or another lubricant bring (breakaway over
#: Coulomb friction 1.3 to 2: Armstrong-Helouvry et al., Automatica 30(7), 1994), shares; speed at which it has fallen to 1/e,
#: rad/s.
_SLOW, _SLOW_JUMP, SLOW_RAD_PER_S = 0.05, 0.5, 5.0
#: Base oil of greases thickens e-fold in this many kelvin below the calibration's temperature (Walther's law between -40 and
#: 20 degC: it doubles in ten), K; the speed torque of a warm gear at full speed over its Coulomb torque, and what another
#: lubricant makes of that (viscosity grades for gears reach from 32 to 460 mm2/s: ISO 3448).
_THICKENS_K, WARM_C, _VISCOUS, _VISCOUS_JUMP = 15.0, 15.0, 0.3, 1.5
#: Loss of motor torque at the temperature that the largest force's current, flowing for ever, would bring: magnets lose 0.1
#: %/K (Gieras, Permanent Magnet Motor Technology, 3rd ed., ch. 2) and a motor rated for seconds at that current would rise by
#: several hundred kelvin.
_FADE, _HOUSING = 0.4, 0.4
#: Heat paths of winding and housing, s; and share by which two lags miss what the motor's heat really does, over a time, s.
WINDING_S, HOUSING_S = 30.0, 300.0
_MISSED, _MISSED_S = 0.3, 10.0
#: How far a brake can be from its calibration at all, one standard deviation: contact angle (worn pads, a released position
#: that moved), m; stiffness (thinnest pads, another compound), creep and motor torque, shares.
_CONTACT_REACH_M, _SCALE_REACH, _CREEP_REACH, _GAIN_REACH = 100e-6, 0.3, 0.1, 0.05
#: The same of the inertia: another rotor of one drawing, share (as in `adapt.fit`); and of the speed torque of a warm gear at
#: full speed over its Coulomb torque: half of what the thickest of those greases makes of the thinnest's.
INERTIA_REACH, _VISCOUS_REACH = 0.1, 2.0
#: Standard deviations of how far a brake can be from its calibration beyond which it is not: what motor and friction then seem
#: to be is something else, which no hypothesis contains. Usable samples beyond three sigma, summed over 422 phases with
#: faults of sensors and bus (`studies.silent injected --count 3 --seed 9`, rig A, service nominal): 52 % with, 66 % without.
_IMPOSSIBLE = 3.0
#: A brake that is not its calibration's to the micrometre and does not hold still: contact angle, m, and how it walks while
#: the disc turns (run-out, wear and growth move pads by tens of micrometres within minutes) and, slower by the factor, while
#: it stands, m per root of a second; stiffness, which gains some 4 % with each millimetre that a lining wears, and its walk,
#: shares.
_DRIFT_CONTACT_M, _DRIFT_WALK_M_PER_SQRT_S, _DRIFT_STANDING = 10e-6, 3e-6, 0.3
DRIFT_SCALE, _DRIFT_SCALE_WALK_PER_SQRT_S, _DRIFT_CREEP = 0.05, 0.02 / 60.0, 0.01
#: The contact angle's walk once the brake is certainly no more what it was: a disc that one stop heats by 300 K grows by 80 um
#: (`_GROWTH_JUMP_M_PER_K`) within a minute. With less, a drift lags behind what moves the contact, and sigma with it.
_CHANGED_WALK_M_PER_SQRT_S = 10e-6
#: Bounds of what can be learned: beyond them it is a fault.
LEAST_SCALE, MOST_SCALE, MOST_CREEP = 0.3, 3.0, 0.5


@njit
def torque_offset(p: Record) -> float:
    """Standard deviation of the motor torque's offset at power-on, N m."""
    return _OFFSET * p.gear_gain * p.maximum_force


@njit
def contact_jump(p: Record) -> float:
    """Standard deviation of what the contact angle moves by at once, rad."""
    return _CONTACT_JUMP_M / p.gear_gain


@njit
def thickening(caliper: float) -> float:
    """Factor by which friction's prior is wider at ``caliper`` degC than at the calibration's temperature."""
    return exp(min(max(WARM_C - caliper, 0.0), 80.0) / _THICKENS_K)


@njit
def set_friction(P: Floats, p: Record, caliper: float) -> None:
    """Covariance of the gear friction of a brake at ``caliper`` degC that has not moved yet."""
    thick = thickening(caliper)
    P[LOAD, LOAD] = sq(p.torque_relative_sigma * p.gear_gain) + sq(_FRICTION * p.load_friction * thick)
    P[COULOMB, COULOMB] = sq(_FRICTION * p.offset_friction * thick)
    P[VISCOUS, VISCOUS] = sq(_VISCOUS * p.offset_friction / p.maximum_speed * thick)


@njit
def softening_sigma(p: Record, rise: float, temperature: float, history: float) -> float:
    """Standard deviation of the stiffness, share, of pads that are ``rise`` K warmer than those of the calibration, where that
    temperature and its memory have these, K."""
    known = p.thermal.softening * temperature + p.thermal.softening_history * history
    return hypot(known, p.thermal.softening_sigma * rise)


@njit
def add_softening(P: Floats, p: Record, rise: float, sigma: float) -> None:
    """What the temperature of pads that are first seen leaves open of the stiffness: they are ``rise`` K warmer than those of
    the calibration, give or take ``sigma`` K. Softening was identified on hot pads; what it says of colder ones is
    extrapolated."""
    unsure = max(-rise - _MEASURED_K, 0.0) + sigma
    P[SCALE, SCALE] += sq(softening_sigma(p, rise, unsure, unsure))


@njit
def set_priors(P: Floats, p: Record) -> None:
    """Covariance at power-on of a brake that is as its calibration says."""
    for i in range(len(P)):
        for j in range(len(P)):
            P[i, j] = 0.0
    P[FAST, FAST] = 1.0
    P[CONTACT, CONTACT] = sq(p.clearance_sigma)
    P[GAIN, GAIN] = sq(GAIN_SIGMA)
    P[NOISE, NOISE] = sq(p.torque_constant * p.current_sigma)
    P[OFFSET, OFFSET] = sq(torque_offset(p))
    P[SCALE, SCALE] = sq(_SCALE)
    for i in CREEPS:
        P[i, i] = sq(_CREEP)
    set_friction(P, p, WARM_C)
    P[INERTIA, INERTIA] = sq(INERTIA_SIGMA)
    P[SLOW, SLOW] = sq(_SLOW)
    P[LATE, LATE] = sq(LATE_CYCLES)
    P[FADE, FADE] = sq(_FADE)
    P[HOUSING, HOUSING] = sq(_HOUSING)


@njit
def offset_walk(p: Record, shown: float) -> float:
    """Variance, (N m)^2/s, that the torque's offset gains: a healthy current sensor's, and what stops have ``shown``."""
    return sq(torque_offset(p)) / _OFFSET_DRIFTS_S + shown


@njit
def set_walks(
    walked: Floats, p: Record, x: Floats, P: Floats, winding: float, housing: float, softening: float, power: float,
    shown: float, dt: float,
) -> None:  # fmt: skip
    """Variance that each state gains in ``dt`` s while nothing jumps. ``x`` errors and ``P`` their covariance, ``winding`` and
    ``housing`` heat, ``softening`` what of stiffness the pads' unknown temperature leaves open, W of friction ``power``,
    ``shown`` as in `offset_walk`."""
    # What the lags miss is a share of what heat does, not of what it might have done before driving showed it.
    faded = (sq(x[FADE]) + P[FADE, FADE]) * sq(winding) + (sq(x[HOUSING]) + P[HOUSING, HOUSING]) * sq(housing)
    walked[FAST] = walked[NOISE] = walked[FADE] = walked[HOUSING] = walked[GROWTH] = walked[INERTIA] = walked[SLOW] = 0.0
    walked[CONTACT] = sq(p.contact_walk) * dt + sq(_WORN_M_PER_SQRT_J / p.gear_gain) * power * dt
    walked[LATE] = max(sq(LATE_CYCLES) - P[LATE, LATE], 0.0) * dt / _LATE_DRIFTS_S
    walked[GAIN] = (sq(_GAIN_WALK_PER_SQRT_S) + sq(_MISSED) * faded / _MISSED_S) * dt
    walked[OFFSET] = offset_walk(p, shown) * dt
    walked[SCALE] = (sq(0.1 * _SCALE_WALK_PER_SQRT_S) + 2.0 * softening * softening / _HEAT_CHANGES_S) * dt
    for i in CREEPS:
        walked[i] = sq(0.1 * _SCALE_WALK_PER_SQRT_S) * dt
    walked[LOAD] = sq(_FRICTION_WALK_PER_SQRT_S * p.load_friction) * dt
    walked[COULOMB] = sq(_FRICTION_WALK_PER_SQRT_S * p.offset_friction) * dt
    walked[VISCOUS] = sq(_FRICTION_WALK_PER_SQRT_S * p.offset_friction / p.maximum_speed) * dt


@njit
def add_rest(P: Floats, p: Record, elapsed_s: float) -> None:
    """What a brake may have changed by while it was not watched for ``elapsed_s`` s: an hour's walk at least, and settling
    pads."""
    hour = max(elapsed_s, 3600.0)
    P[CONTACT, CONTACT] += sq(_SETTLED_M / p.gear_gain)
    P[GAIN, GAIN] += sq(_GAIN_WALK_PER_SQRT_S) * hour
    P[OFFSET, OFFSET] += sq(torque_offset(p)) * min(hour / _OFFSET_DRIFTS_S, 1.0)
    P[LOAD, LOAD] += sq(_FRICTION_WALK_PER_SQRT_S * p.load_friction) * hour
    P[COULOMB, COULOMB] += sq(_FRICTION_WALK_PER_SQRT_S * p.offset_friction) * hour
    # What sends the signals may have been started anew, too, and sample at another moment of the cycle.
    P[LATE, LATE] += sq(LATE_CYCLES)


@njit
def _draw_near(x, P, gain, state, distance, reach):
    """Kalman update with the prior knowledge that ``state`` is within ``reach`` (standard deviation) of the calibration, from
    which it is ``distance`` away now; both in the state's unit."""
    if P[state, state] <= 0.0:
        # A state without variance is held as exactly known: friction of a calibration without any, or growth in a hypothesis
        # without it.
        return
    s, innovation = P[state, state] + reach * reach, -distance
    for i in range(len(x)):
        gain[i] = P[i, state] / s
    for i in range(len(x)):
        x[i] += gain[i] * innovation
        for j in range(len(x)):
            P[i, j] -= gain[i] * gain[j] * s


@njit
def _gain_reach(x, winding, housing):
    """Standard deviation of the motor torque's error (share) that is possible at all: the usual reach, and as much again as
    heat explains."""
    return _GAIN_REACH + abs(x[FADE]) * winding + abs(x[HOUSING]) * housing


@njit
def stay_possible(
    x: Floats, P: Floats, gain: Floats, p: Record, contact_distance: float, scale: float, growth: float, creep: Floats,
    winding: float, housing: float,
) -> None:  # fmt: skip
    """Keep the errors within what a brake can be at all. ``contact_distance``: rad of the contact angle from the
    calibration's; ``scale``: stiffness over the calibration's; ``growth`` rad/K and ``creep`` (shares), zero as calibrated;
    ``winding`` and ``housing`` heat."""
    _draw_near(x, P, gain, CONTACT, contact_distance + x[CONTACT], _CONTACT_REACH_M / p.gear_gain)
    _draw_near(x, P, gain, SCALE, scale * (1.0 + x[SCALE]) - 1.0, _SCALE_REACH)
    _draw_near(x, P, gain, GROWTH, growth + x[GROWTH], 2.0 * _GROWTH_JUMP_M_PER_K / p.gear_gain)
    for i in range(len(CREEPS)):
        _draw_near(x, P, gain, CREEPS[i], creep[i] + x[CREEPS[i]], _CREEP_REACH)
    _draw_near(x, P, gain, GAIN, x[GAIN], _gain_reach(x, winding, housing))
    _draw_near(x, P, gain, OFFSET, x[OFFSET], torque_offset(p))
    _draw_near(x, P, gain, LOAD, x[LOAD], p.load_friction)
    _draw_near(x, P, gain, COULOMB, x[COULOMB], 2.0 * p.offset_friction)


@njit
def excess(x: Floats, p: Record, caliper: float, winding: float, housing: float) -> float:
    """Factor, 1 or more, on the standard deviation of a hypothesis with the errors ``x`` by which motor and friction would be
    what no such brake has, with a caliper of ``caliper`` degC and ``winding`` and ``housing`` heat. Its square is the excess
    of the squared distance from the calibration over what chance explains (Birge, Phys. Rev. 40, 1932)."""
    thick = thickening(caliper)
    far = abs(x[GAIN]) / _gain_reach(x, winding, housing)
    far = max(far, abs(x[INERTIA]) / INERTIA_REACH, abs(x[SLOW]) / _SLOW_JUMP)
    load = sqrt(sq(p.torque_relative_sigma * p.gear_gain) + sq(thick * p.load_friction))
    if load > 0.0:
        far = max(far, abs(x[LOAD]) / load)
    if p.offset_friction > 0.0:
        coulomb = thick * p.offset_friction
        viscous = abs(x[VISCOUS]) * p.maximum_speed / _VISCOUS_REACH
        far = max(far, 0.5 * abs(x[COULOMB]) / coulomb, viscous / coulomb)
    return sqrt(max(1.0 + far * far - _IMPOSSIBLE * _IMPOSSIBLE, 1.0))


@njit
def add_stiffness_jumps(P: Floats, p: Record) -> None:
    """What may have changed at once between motor angle and force."""
    P[CONTACT, CONTACT] += sq(contact_jump(p))
    P[SCALE, SCALE] += sq(SCALE_JUMP)


@njit
def add_growth(P: Floats, p: Record) -> None:
    """A disc that grows with heat, which the calibration does not know."""
    P[GROWTH, GROWTH] += sq(_GROWTH_JUMP_M_PER_K / p.gear_gain)


@njit
def add_creep(P: Floats) -> None:
    """Pads that creep otherwise than the calibration knows."""
    for i in CREEPS:
        P[i, i] += sq(_CREEP_JUMP)


@njit
def add_drift(P: Floats, p: Record) -> None:
    """What a brake in service may differ by from its calibration without anything having happened to it."""
    P[CONTACT, CONTACT] += sq(_DRIFT_CONTACT_M / p.gear_gain)
    P[SCALE, SCALE] += sq(DRIFT_SCALE)
    add_growth(P, p)
    for i in CREEPS:
        P[i, i] += sq(_DRIFT_CREEP)


@njit
def add_drift_walks(walked: Floats, p: Record, turning: bool, changed: bool, dt: float) -> None:
    """Variance that such a brake's contact and stiffness gain in ``dt`` s beside `set_walks`; ``turning``: the disc;
    ``changed``: the brake is certainly no more what it was, by a drift or something else."""
    walk = _CHANGED_WALK_M_PER_SQRT_S if changed else _DRIFT_WALK_M_PER_SQRT_S
    walked[CONTACT] += sq(walk / p.gear_gain * (1.0 if turning else _DRIFT_STANDING)) * dt
    walked[SCALE] += sq(_DRIFT_SCALE_WALK_PER_SQRT_S) * dt


@njit
def add_torque_jumps(P: Floats, p: Record) -> None:
    """What may have changed at once between motor current and force."""
    P[GAIN, GAIN] += sq(GAIN_JUMP)
    P[OFFSET, OFFSET] += sq(torque_offset(p))
    P[LOAD, LOAD] += sq(_FRICTION_JUMP * p.load_friction)
    P[COULOMB, COULOMB] += sq(_FRICTION_JUMP * p.offset_friction)
    P[SLOW, SLOW] += sq(_SLOW_JUMP)
    P[VISCOUS, VISCOUS] += sq(_VISCOUS_JUMP * p.offset_friction / p.maximum_speed)
