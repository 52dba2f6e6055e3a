"""Both force paths of one corner, and what acts on them: motor angle to force, motor torque to force."""

from math import exp, pi, sqrt

import numpy as np

from emb_daemon.effects import paths as effects
from emb_daemon.estimator.uneven import way_per_rad
from emb_daemon.jit import Record, njit, sq
from emb_daemon.models.fusion import CONTACT
from emb_daemon.models.gear import through_gear
from emb_daemon.models.lateness import beyond_speeds, friction_since, remember, turned_within
from emb_daemon.models.stiffness import characteristic_curve, first_order_lag, mean_slope, travel_at
from emb_daemon.models.torque import (
    NOISE_TURNS_BACK,
    friction_state,
    resolution,
    slid_angle,
    turned_back,
    turned_unseen,
    unexplained_torque,
    within_count,
)
from emb_daemon.models.wheel import TURNING_RAD_PER_S
from emb_daemon.wire.contract import CYCLE_S

#: Time between two samples up to which none is missing, s.
ONE_CYCLE_S = 1.5 * CYCLE_S
#: Vibration dissolves what is known of the friction state at this rate while the motor stands, 1/s.
DISSOLVING_PER_S = 0.05
#: Torque force is unusable where its denominator nears zero (self-locking), as a share of the gear gain.
SELF_LOCKING = 0.2
#: Standard deviations of the way that noisy speeds add up to from which it is one.
_CERTAINLY = 3.0
#: Share of friction's turning over that counts as its standard deviation where it is not known whether the gear slides: of all
#: or nothing, one being as likely as the other.
_SLID = 0.5
#: Ways between two reversals, over the presliding angle, that are small swings: friction has not turned over in them.
_SHORT = 1.0
#: Half a count of a 4096-count resolver.
FLICKER_RAD = 0.0008
#: Count of an angle, rad, above which it hides which way friction holds: of 10 bit a turn. Resolvers of 14 bit and more seem
#: to have up to 2.9 mrad by their least steps, on the logs of rigs that are simulated by others.
COARSE_RAD = 2.0 * pi / 1024.0
#: Time constants of what pads creep beyond the calibration, s: between a stroke and a stop, and a few stops.
_CREEP_S = (1.0, 8.0)
#: A time after which everything has settled, s.
_LONG_S = 1e6
#: Share of the largest force that ordinary stops reach: a third of the deceleration that tyres allow.
_ORDINARY = 0.3
#: Chance that such a stop has just ended at a start of which no snapshot tells, and at one of a daemon that ran just before.
#: Guesses: most of the former are of parked cars, and the first is the most that leaves the start of the shipped calibration,
#: whose pads relax by a tenth, below the 300 N that are reported.
AT_A_START, AFTER_A_RESTART = 0.25, 0.5
#: Share of the stiffness path's noise below which what pads may remember counts no more: it adds half a per cent to sigma.
_FORGOTTEN = 0.1
#: Standard deviation of the contact angle, rad, from which the curve's slope is taken as a mean over it.
UNCERTAIN_CONTACT_RAD = 0.05


@njit
def turned(s: Record, p: Record, angle: float) -> tuple[float, float]:
    """Equivalent angle (rad) of a motor angle, and its slope; a constant gear's is the motor angle itself."""
    if p.gear.step == 0.0:
        return angle, 1.0
    past_zero, slope = through_gear(p.gear, angle - s.gear_zero)
    return s.gear_zero + past_zero, slope


@njit
def disc_warmth(s: Record) -> float:
    """How much warmer the disc is than when its growth began to count, K."""
    return s.disc - s.growth_start if s.temperature_known else 0.0


@njit
def pads_rise(s: Record, t: Record) -> float:
    """By how much (K) the pads are warmer than those of the calibration, whose heat parameters are ``t``."""
    return 0.5 * (s.mean[0] + s.mean[1]) - t.reference


@njit
def position(s: Record, p: Record, m: Record) -> float:
    """Equivalent angle past contact at this sample, rad; advances the effects that act on it."""
    e, state, before = p.effects, s.effects, s.angle + s.ahead
    remember(s.lately, m.speed, m.dt)
    s.ahead = turned_within(s.lately, s.late + effects.known_delay(e))
    s.travel = m.angle + s.ahead - before
    effects.look(e.terms, s, p, m)
    gained = effects.thickness(e, state, m, s.disc, s.temperature_known, s.power, m.dt)
    s.swelled, s.gained = abs(gained - s.gained), gained
    grown = s.growth * disc_warmth(s)
    late = turned_within(s.lately, s.late)
    angle, s.gear_slope = turned(s, p, m.angle + late + effects.motor_angle(e, state, m, s.lately, m.dt))
    return angle + gained / p.gear_gain + grown - s.contact_angle


@njit
def stiffness_path(s: Record, p: Record, m: Record, factor: float) -> None:
    """Stiffness path: advances the dynamic force and its slope."""
    x = position(s, p, m)
    dt = m.dt
    if dt > ONE_CYCLE_S:
        # Over a gap only the end of the way is known, from the speed; the lag depends on it most.
        dt = min(0.5 * m.dt, 2.0 * p.relaxation_time)
        _deform(s, p, x - dt * m.speed * s.gear_slope, m.dt - dt, factor)
    _deform(s, p, x, dt, factor)


@njit
def _deform(s, p, x, dt, factor):
    """Advance the force: the pads move at a constant speed to ``x`` rad past contact within ``dt`` s."""
    static, slope = characteristic_curve(x, p.curve)
    travel = max(x, 0.0) - max(s.past_contact, 0.0)
    s.past_contact = x
    variance = s.covariance[CONTACT, CONTACT]
    if variance > UNCERTAIN_CONTACT_RAD * UNCERTAIN_CONTACT_RAD:
        slope = mean_slope(x, sqrt(variance), p.curve)
    drive = effects.static_force(p.effects, s.effects, factor * static, travel, dt)
    if s.memory_sigma > 0.0:
        _follow_memory(s, p, factor * static, travel, dt, drive)
    for i in range(len(_CREEP_S)):
        s.held[i] += (1.0 - exp(-dt / _CREEP_S[i])) * (drive - s.held[i])
        slope *= 1.0 - s.creep[i]
    drive = max(drive + crept(s, drive), 0.0)
    relaxation_time = p.relaxation_time * effects.relaxation_time(p.effects, s.effects, travel, dt)
    s.force = first_order_lag(s.force, s.drive, drive, dt, relaxation_time)
    s.slope = first_order_lag(s.slope, s.drive_slope, factor * slope, dt, relaxation_time)
    s.drive = drive
    s.drive_slope = factor * slope


@njit
def ordinary_stop(p: Record, chance: float) -> float:
    """Force (N) whose square is the mean square of that of an ordinary stop, if there was one with that ``chance``."""
    return sqrt(chance) * _ORDINARY * p.maximum_force


@njit
def doubt_memory(s: Record, p: Record, held: float, rested_s: float) -> None:
    """What the pads remember is unknown: a stop of ``held`` N or less ended ``rested_s`` s ago. With effects of slow
    relaxation that is force which neither angle nor torque of a released brake shows."""
    travel = travel_at(held, p.curve)
    if np.isfinite(travel):
        effects.static_force(p.effects, s.held_effects, held, travel, _LONG_S)
        effects.static_force(p.effects, s.held_effects, 0.0, -travel, rested_s)
        s.memory_sigma = held


@njit
def _follow_memory(s, p, static, travel, dt, drive):
    """Standard deviation of the force by what the pads may remember: anything from what is believed, ``drive`` N, to what they
    would if they had been held."""
    for port in range(len(s.effects.terms.added)):
        s.held_effects.terms.added[port] = s.effects.terms.added[port]
    held = effects.static_force(p.effects, s.held_effects, static, travel, dt)
    sigma = abs(held - drive) / sqrt(3.0)
    s.memory_sigma = sigma if sigma > _FORGOTTEN * p.stiffness_sigma else 0.0


@njit
def crept(s: Record, drive: float) -> float:
    """Force (N) by which pads that creep differ from those that are held with ``drive`` N for ever."""
    total = 0.0
    for i in range(len(_CREEP_S)):
        total += s.creep[i] * (s.held[i] - drive)
    return total


@njit
def follow_creep(s: Record) -> None:
    """Take in with what force the present stop has held the pads so far."""
    for i in range(len(_CREEP_S)):
        s.held_now[i] = max(s.held_now[i], s.held[i])


@njit
def count_creep(s: Record) -> None:
    """A stop has ended: what it held the pads with beyond earlier ones counts as shown by half, because what the torque leaves
    open of one slow stroke it leaves open of its release, too."""
    for i in range(len(_CREEP_S)):
        s.held_shown[i] += 0.5 * max(s.held_now[i] - s.held_shown[i], 0.0)
        s.held_now[i] = 0.0


@njit
def untold_creep(s: Record) -> float:
    """Standard deviation (N) of what the learned creep takes from, or adds to, a force that is held for longer, or with more,
    than any stop before: in short stops pads that creep look like others that are stiffer, and those keep their force."""
    square = 0.0
    for i in range(len(_CREEP_S)):
        square += sq(s.creep[i] * max(s.held[i] - s.held_shown[i], 0.0))
    return sqrt(square)


@njit
def still_to_gain(s: Record, creep: int) -> float:
    """Force (N) that pads still gain, or lose, if all of it creeps with time constant number ``creep``."""
    return s.held[creep] - s.drive


@njit
def rest(s: Record, p: Record, x: float, factor: float) -> None:
    """Bring the stiffness path to where it settles ``x`` rad past contact."""
    s.past_contact = x
    _deform(s, p, x, _LONG_S, factor)


@njit
def doubt_friction(s: Record, angle: float) -> None:
    """The motor stands at ``angle`` rad, and which way friction holds it is unknown."""
    s.slid_angle = angle
    s.friction_state, s.friction_variance = 0.0, 1.0


@njit
def _stand(s, m):
    """The motor stands at a first sample."""
    s.started = True
    s.angle, s.speed = m.angle, m.speed
    doubt_friction(s, m.angle)


@njit
def shift_zero(s: Record, moved: float) -> None:
    """Refer all stored angles to a zero that has moved by ``moved`` rad since the last sample."""
    s.angle += moved
    s.angle_before += moved
    s.slid_angle += moved
    shift_places(s, moved)


@njit
def shift_places(s: Record, moved: float) -> None:
    """Refer where contact, teeth and poles are to a zero that had moved by ``moved`` rad before the last sample."""
    s.contact_angle += moved
    s.contact_anchor += moved
    s.start_angle += moved
    s.lowest += moved
    s.gear_zero += moved
    s.zero_moved += moved
    for i in range(len(s.learned)):
        s.learned[i].contact_angle += moved


@njit
def settle_paths(s: Record, p: Record, m: Record, factor: float) -> None:
    """Bring both paths of a STATE to rest at a first sample, the motor standing: forces settled, friction unknown."""
    _stand(s, m)
    rest(s, p, position(s, p, m), factor)


@njit
def begin_paths(s: Record, p: Record, m: Record, factor: float) -> None:
    """The same of pads that have not settled: effects go on from what they remember."""
    _stand(s, m)
    s.past_contact = position(s, p, m)
    static, slope = characteristic_curve(s.past_contact, p.curve)
    s.force = s.drive = effects.static_force(p.effects, s.effects, factor * static, 0.0, 0.0)
    s.slope = s.drive_slope = factor * slope
    for i in range(len(s.held)):
        s.held[i] = s.drive


@njit
def _slid(s, p, angle, travel, count, dt):
    """Angle (rad) that the gear has slid through, with the motor at ``angle`` after ``travel`` rad, in counts of ``count``.

    A noisy angle goes back and forth, and friction that followed it would turn over and over while the motor stands: what the
    torque then says of friction would pass for a change of the brake. Of noise that is known by its turning back, friction
    follows what is more than its own presliding."""
    s.turned_back = turned_back(s.turned_back, s.direction, travel, dt)
    if travel != 0.0:
        s.direction = travel
    if s.straying.creeps and s.wander.drift != 0.0:
        # The angle strays: it does not slide the gear, and what friction carries at rest stays unknown.
        s.slid_angle += travel
        return 0.0
    noise = p.presliding_angle if s.turned_back > NOISE_TURNS_BACK else 0.0
    before = s.slid_angle
    s.slid_angle = slid_angle(before, angle, max(noise, FLICKER_RAD, 0.5 * count))
    return s.slid_angle - before


@njit
def _unseen(s, p, m):
    """Way (rad) that a motor which seems to stand or to creep may have gone to and fro in this sample: as far as the gear's
    friction yields to an uneven disc, but no further than there and back over a count in each turn of the wheel."""
    friction = p.offset_friction + p.load_friction * s.force * s.gear_slope
    if not m.has_wheel_speed or m.wheel_speed <= TURNING_RAD_PER_S or friction <= 0.0:
        return 0.0
    turned = m.wheel_speed * m.dt
    swung = s.drive_slope * s.swelled + p.gear_gain * s.gear_slope * way_per_rad(s.uneven) * turned
    return min(p.presliding_angle * swung / friction, 4.0 * FLICKER_RAD * turned / (2.0 * pi))


@njit
def _swings(s, p, slid):
    """Whether the gear, which has ``slid`` on by so many rad, goes back where it came from, and by less than turns friction
    over."""
    if slid * s.swing < 0.0:
        s.swing_before, s.swing = abs(s.swing), 0.0
    s.swing += slid
    return slid != 0.0 and abs(s.swing) <= s.swing_before < _SHORT * p.presliding_angle


@njit
def torque_path(s: Record, p: Record, m: Record) -> tuple[float, float, float]:
    """Torque path over the cycle that ends at this sample.

    Returns (torque left to the clamp force in N m, its leverage gamma + mu s in m/rad, variance of the friction state);
    the torque is NaN where it says nothing.
    """
    mean = s.friction_mean = _friction_over_cycle(s, p, m)
    read = m.angle + s.ahead
    # Teeth and poles stay where they are when the resolver's zero moves.
    angle = read - s.zero_moved
    e, state, mean_speed, travel = p.effects, s.effects, 0.5 * (m.speed + s.speed), s.travel
    s.gear_gain = effects.gear_gain(e, state, angle, travel, mean_speed, mean, s.past_contact, s.force, m.dt)
    s.gear_friction = effects.gear_friction(e, state, angle, travel, mean_speed, mean, s.past_contact, s.force, m.dt)
    s.motor_torque = p.torque_constant * m.current_q
    # What the motor gives to the gear comes out as work: friction is that of the load that the reduction sees.
    middle, slope = turned(s, p, read - 0.5 * travel)
    s.spring_force = p.spring * p.gear_gain * max(middle - s.gear_zero, 0.0)
    leverage = (p.gear_gain * s.gear_gain + p.load_friction * s.gear_friction * mean) * slope
    if not m.has_current or m.dt <= 0.0 or leverage < SELF_LOCKING * p.gear_gain * slope:
        return np.nan, leverage, 1.0
    s.motor_torque = effects.motor_torque(
        e, state, m, p.torque_constant, angle, travel, mean_speed, s.disc, s.temperature_known
    )
    offset_friction = p.offset_friction * s.gear_friction
    torque = unexplained_torque(s.motor_torque, p.inertia, m.speed - s.speed, m.dt, offset_friction, mean)
    turning = p.presliding_sigma * (1.0 - mean * mean)
    torque -= leverage * s.spring_force
    return torque, leverage, s.friction_variance + turning * turning


@njit
def _friction_over_cycle(s, p, m):
    """Mean of the friction state over the cycle that ends at this sample; follows the state and its variance."""
    # Friction turns over with the motor, not with an angle that is late; the noise of its speed at rest is no motion. A stop
    # that is abrupt passes for an age of up to half a cycle (1.8 ms from 140 rad/s): the speed beside it is a mean around it.
    known = effects.known_delay(p.effects)
    age = known + s.late if s.late > 0.5 * CYCLE_S else known
    early = turned_within(s.lately, min(age, 0.0))
    travel = m.angle - s.angle
    count = resolution(s.steps, travel, beyond_speeds(s.lately, travel, m.dt))
    if count <= COARSE_RAD:
        count = 0.0
    slid = _slid(s, p, m.angle + early, travel, count, m.dt)
    before, variance = s.friction_state, s.friction_variance
    s.friction_state, mean, s.friction_variance = friction_state(
        before, variance, slid, p.presliding_angle, DISSOLVING_PER_S, m.dt
    )
    if _swings(s, p, slid):
        # Of small swings this friction forgets what it carried, which a real contact may not (Dupont, Hayward, Armstrong,
        # Altpeter, IEEE Trans. Automatic Control 47(5), 2002): it is anywhere between.
        s.friction_variance = turned_unseen(variance, abs(slid), p.presliding_angle)
    if s.past_contact > 0.0:
        s.friction_variance = turned_unseen(s.friction_variance, _unseen(s, p, m), p.presliding_angle)
        if m.dt > ONE_CYCLE_S:
            # Over a gap nobody saw whether the motor went to and fro.
            s.friction_variance = 1.0
    if s.straying.creeps and slid != 0.0 and s.past_contact < 0.0:
        # Nor is it known whether an angle that moves while the speed, now and of late, shows nothing has slid it: nothing
        # drives the motor of an open brake, while that of a closed one follows pads and disc.
        s.friction_variance = min(sq(sqrt(variance) + _SLID * abs(s.friction_state - before)), 1.0)
    if slid == 0.0 and count > 0.0:
        # The motor may have gone back within a count, and friction with it.
        other = within_count(s.friction_state, count, p.presliding_angle)
        mean = 0.5 * (s.friction_state + other)
        s.friction_variance = max(s.friction_variance, sq(mean - other))
    if age > 0.0:
        mean = friction_since(s.lately, s.friction_state, mean, age, _CERTAINLY * p.speed_sigma, p.presliding_angle)
    return mean
