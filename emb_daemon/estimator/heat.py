"""Heat of one corner's pads and disc from sample to sample: what heats them, and what the estimate tells of them."""

from math import exp

import numpy as np

from emb_daemon.effects import paths as effects
from emb_daemon.effects.terms import unsure_heat
from emb_daemon.estimator.paths import pads_rise
from emb_daemon.estimator.records import DEPTHS_M
from emb_daemon.estimator.restart import follow_heat
from emb_daemon.estimator.wheel import disc_speed
from emb_daemon.jit import Record, hypot, njit
from emb_daemon.models import thermal
from emb_daemon.models.thermal import NODES, at_depth, disc_loss, friction_power, heat_step, mean_temperature, stiffness_factor
from emb_daemon.models.wheel import TURNING_RAD_PER_S
from emb_daemon.wire.contract import CYCLE_S

#: Clamp force from which pads and disc exchange heat by contact, N.
TOUCHING_N = 200.0
#: Rise of pads over that of their backing plates while heat is on its way: the pad's own resistance over that to the plate's
#: surroundings.
_BEHIND_PLATES = 4.0
#: By how much pads of a car under way may be hotter than their plates show yet, K: one stop from motorway speed, or some from
#: less, heats a disc by as much.
_UNDER_WAY_K = 100.0
#: By which thermocouples of a brake at rest differ: their tolerance (IEC 60584, class 1: 1.5 K each) and noise, K.
_PLATES_SPREAD_K = 3.0
#: Time by which a vehicle status that is sent at all has been heard, s: its cycle and half as much. Its ambient temperature
#: tells whether the plates were warm at the start.
_HEARD_S = 0.15
#: Disc speed that is assumed where nothing tells of it, for what it may have heated, rad/s: 110 km/h.
_UNSEEN_RAD_PER_S = 100.0
#: Time between conduction steps, s: twelve samples, less half a sample against rounding.
_HEAT_STEP_S = 0.046
#: Change of a backing plate, K, that no steel makes between two heat steps.
_JUMP_K = 10.0
#: Change of the pad's mean temperature, K, that its backing plate must show once heat has had the time to get there.
_SHOWN_K = 20.0


@njit
def _start_heat(s, t, m):
    """Profiles out of the backing plates alone: right for pads at rest, and as uncertain as the plates are off the caliper.

    The disc takes the plates' mean and the pads lie between.
    """
    if s.rested_s > 0.0:
        _tell_temperatures(s, t)
        follow_heat(s, t, m)
        _tell_temperatures(s, t)
        _begin_watch(s, m)
        s.factor = stiffness_factor(t, pads_rise(s, t), s.history)
        return
    s.disc = 0.5 * (m.inner_backplate + m.outer_backplate)
    for node in range(NODES):
        share = t.node_position[node] / t.thickness
        s.pads[0, node] = s.disc + share * (m.inner_backplate - s.disc)
        s.pads[1, node] = s.disc + share * (m.outer_backplate - s.disc)
    _widen_start(s, m, m.caliper)
    _tell_temperatures(s, t)
    _begin_watch(s, m)
    s.history = pads_rise(s, t)
    s.factor = stiffness_factor(t, s.history, s.history)


@njit
def _widen_start(s, m, around):
    """Plates that are not as warm as what is ``around`` them (degC) tell of heat on its way, not of how long it has been; of a
    car that is under way not even how much."""
    apart = abs(s.disc - around) - _PLATES_SPREAD_K
    uncertainty = _BEHIND_PLATES * max(apart, 0.0)
    under_way = (m.has_wheel_speed and m.wheel_speed > TURNING_RAD_PER_S) or (m.has_status and m.vehicle_speed > 0.0)
    if apart > 0.0 and under_way:
        uncertainty = max(uncertainty, _UNDER_WAY_K)
    s.temperature_sigma, s.history_sigma = max(s.temperature_sigma, uncertainty), max(s.history_sigma, uncertainty)


@njit
def _begin_watch(s, m):
    s.plate[0], s.plate[1] = m.inner_backplate, m.outer_backplate
    s.plate_mean[0], s.plate_mean[1] = s.mean[0], s.mean[1]
    s.ambient = m.ambient if m.has_status else s.disc
    s.temperature_known = True


@njit
def _tell_temperatures(s, t):
    for side in range(2):
        s.mean[side] = mean_temperature(s.pads[side], t.node_position)
        for index in range(len(DEPTHS_M)):
            s.depth[side, index] = at_depth(s.pads[side], t.node_position, DEPTHS_M[index])


@njit
def _watch_plates(s, t, m, dt):
    """Whether the thermocouples can be true; widens the uncertainty of the pads' temperature by what a false one may hide, K.

    A reading that repeats to the bit is stuck once the pad has been hotter or colder than when it last moved for as long as
    heat takes through the pad, L^2/(4 a), by `_SHOWN_K` in the mean over that time. A reading that jumps is one of two that
    cannot both be true. One that drifts as slowly as plates do is not seen.
    """
    conducting = 0.25 * t.thickness * t.thickness * t.density * t.specific_heat / t.conductivity
    stuck = False
    for side in range(2):
        reading = (m.inner_backplate if side == 0 else m.outer_backplate) if m.has_thermocouple else np.nan
        step = abs(reading - s.plate[side])
        if step == 0.0:
            s.unanswered[side] += dt * (s.mean[side] - s.plate_mean[side])
        else:
            s.unanswered[side], s.plate_mean[side] = 0.0, s.mean[side]
        if step > _JUMP_K:
            s.temperature_sigma = max(s.temperature_sigma, step)
        stuck = stuck or abs(s.unanswered[side]) > _SHOWN_K * conducting
        s.plate[side] = reading
    s.plate_stuck = stuck
    if stuck:
        s.temperature_sigma = max(s.temperature_sigma, _SHOWN_K)


@njit
def _flow(s, t, e, m):
    """Let the heat of the time since the last heat step flow, and find the stiffness factor anew."""
    dt = s.heat_time
    wheel_speed = s.heat_travel / dt
    # Without vehicle status the last ambient temperature stands: it changes slowly, and a jump would cool the disc.
    if m.has_status:
        s.ambient = m.ambient
    ambient = s.ambient
    # Without thermocouples the backing plates follow the pads' own last nodes: no heat passes.
    inner = m.inner_backplate if m.has_thermocouple else s.pads[0, NODES - 1]
    outer = m.outer_backplate if m.has_thermocouple else s.pads[1, NODES - 1]
    _watch_plates(s, t, m, dt)
    inner, outer = effects.backplates(e, s.effects, inner, outer, dt)
    power = s.heat_energy / dt
    conduct(s, t, e, inner, outer, ambient, power, wheel_speed, dt, thermal.LONGEST_S)
    _tell_temperatures(s, t)
    rise = pads_rise(s, t)
    forgotten = exp(-dt / t.history_time)
    s.history = forgotten * s.history + (1.0 - forgotten) * rise
    s.factor = stiffness_factor(t, rise, s.history)
    # A wrong start dies out as the disc, which stores most of it, cools.
    s.temperature_sigma *= exp(-dt * disc_loss(t, s.disc, ambient, wheel_speed, 1.0) / t.disc_heat_capacity)
    s.history_sigma *= forgotten
    if e.terms.count > 0:
        surface, plates = 0.5 * (s.pads[0, 0] + s.pads[1, 0]), 0.5 * (inner + outer)
        of_pads, of_disc = unsure_heat(s.effects.terms, t, surface, s.disc, plates, ambient, power, wheel_speed, s.touching)
        pads = 2.0 * t.area * t.thickness * t.density * t.specific_heat
        s.temperature_sigma += dt * hypot(of_pads / pads, of_disc / t.disc_heat_capacity)
    s.heat_time = s.heat_energy = s.heat_travel = 0.0


@njit
def conduct(
    s: Record, t: Record, e: Record, inner: float, outer: float, ambient: float, power: float, wheel_speed: float, dt: float,
    longest: float,
) -> None:  # fmt: skip
    """Pads and disc after ``dt`` seconds of friction ``power`` (W), with what effects make of their balance."""
    altered = effects.heat_balance(e, s.effects, dt)
    s.disc = heat_step(t, s.pads, s.disc, inner, outer, ambient, power, s.touching, wheel_speed, dt, s.work, longest, altered)
    s.disc += effects.disc_change(e, s.effects, t.disc_heat_capacity, s.disc, ambient, dt)


@njit
def heat(s: Record, p: Record, m: Record) -> None:
    """Pads and disc up to this sample, heated by what the last estimate says.

    A conduction step costs more than all the rest: one serves several samples, as long as the pads' contact stays the same.
    """
    t = p.thermal
    wheel_speed, speed_sigma = disc_speed(s.wheel, m)
    if not s.temperature_known:
        s.factor = 1.0
        if m.has_thermocouple:
            _start_heat(s, t, m)
        return
    if m.has_status and not s.ambient_heard:
        s.ambient_heard = True
        if m.cycle * CYCLE_S < _HEARD_S and not s.resumed:
            _widen_start(s, m, m.ambient)
    touching = s.fused > TOUCHING_N
    if touching != s.touching and s.heat_time > 0.0:
        _flow(s, t, p.effects, m)
    s.touching = touching
    if not np.isfinite(wheel_speed):
        wheel_speed, speed_sigma = 0.0, _UNSEEN_RAD_PER_S
    s.heat_time += m.dt
    s.heat_travel += wheel_speed * m.dt
    s.power = 0.0
    if touching and wheel_speed > TURNING_RAD_PER_S:
        if np.isnan(m.brake_torque):
            surface = 0.5 * (s.pads[0, 0] + s.pads[1, 0])
            fade = effects.pad_friction(p.effects, s.effects, surface)
            s.power = friction_power(t, s.fused, wheel_speed, surface) * fade
        else:
            s.power = max(m.brake_torque, 0.0) * wheel_speed
        s.heat_energy += s.power * m.dt
    if touching and speed_sigma > 0.0:
        # Braking heat that an uncertain wheel speed hides counts in the temperature's sigma.
        unseen = friction_power(t, s.fused, speed_sigma, 0.5 * (s.pads[0, 0] + s.pads[1, 0]))
        s.temperature_sigma += unseen * m.dt / t.disc_heat_capacity
    if s.heat_time >= _HEAT_STEP_S:
        _flow(s, t, p.effects, m)


@njit
def tell(s: Record, out: Record) -> None:
    known = s.temperature_known
    for side in range(2):
        out.surface[side] = s.pads[side, 0] if known else np.nan
        out.mean[side] = s.mean[side] if known else np.nan
        for index in range(len(DEPTHS_M)):
            out.depth[side, index] = s.depth[side, index] if known else np.nan
    out.disc = s.disc if known else np.nan
