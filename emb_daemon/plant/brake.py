"""Motor, gear, friction, pads and caliper of one corner: differential equations in steps of a quarter millisecond."""

from math import cos, exp, sin

import numpy as np

from emb_daemon.jit import Record, njit
from emb_daemon.plant.records import CURVE_TERMS, HISTORY, SUBSTEP_S, SUBSTEPS, TRAVEL_POINTS

#: Temperature (degC) at which effects of heat are zero, and at which magnets have their full strength.
COLD_C, _MAGNETS_C = 22.0, 25.0
#: Signals that drawn effects may follow, and their usual sizes.
SIGNALS = (
    "brake_torque", "disc_temperature", "surface_temperature", "clamp_force", "motor_speed", "current", "force_rate",
    "disc_speed", "pad_temperature", "friction_power",
)  # fmt: skip
_BRAKE_NM, _RISE_K, _FORCE_N, _SPEED_RAD_PER_S, _CURRENT_A, _RATE_N_PER_S = 1000.0, 50.0, 10000.0, 100.0, 20.0, 50000.0
_DISC_RAD_PER_S, _POWER_W = 40.0, 30000.0
#: Shapes of drawn effects: a power, a saturation, an onset at the signal's usual size.
POWER, SATURATION, ONSET = range(3)


@njit
def equivalent_angle(p: Record, angle: float) -> float:
    """Angle (rad) by which a constant gear would have moved the pads as far; everything behind the gear depends on it."""
    if p.travel[TRAVEL_POINTS - 1] == 0.0:
        return angle
    return _along(angle, p.travel_angle, p.travel) / p.gear_gain


@njit
def slope_at(p: Record, angle: float) -> float:
    """Slope of `equivalent_angle`, by differences over two intervals of the table; 1 for a constant gear."""
    reach = p.travel_angle[1]
    return (equivalent_angle(p, angle + reach) - equivalent_angle(p, angle - reach)) / (2.0 * reach) if reach > 0.0 else 1.0


@njit
def gear_load(p: Record, s: Record) -> float:
    """Force (N) of pads and release spring on the gear's output."""
    return s.force + p.release_spring * p.gear_gain * max(equivalent_angle(p, s.angle), 0.0)


@njit
def motor_angle(p: Record, x: float) -> float:
    """Motor angle (rad) at which `equivalent_angle` is ``x``."""
    if p.travel[TRAVEL_POINTS - 1] == 0.0:
        return x
    return _along(x * p.gear_gain, p.travel, p.travel_angle)


@njit
def _along(x, xs, ys):
    """Linear between the points of a rising table, and extrapolated beyond them."""
    i = min(max(np.searchsorted(xs, x) - 1, 0), TRAVEL_POINTS - 2)
    return ys[i] + (x - xs[i]) * (ys[i + 1] - ys[i]) / (xs[i + 1] - xs[i])


@njit
def static_curve(p: Record, x: float) -> float:
    """Cold static clamp force (N) at ``x`` rad past contact."""
    if x <= 0.0:
        return 0.0
    force = 0.0
    for order in range(CURVE_TERMS - 1, -1, -1):
        force = (force + p.curve[order]) * x
    return force


@njit
def static_angle(p: Record, force: float) -> float:
    """Angle past contact (rad) at which the cold static curve reaches ``force`` N, by bisection."""
    if force <= 0.0:
        return 0.0
    high = 1.0
    while static_curve(p, high) < force and high < 1e3:
        high *= 2.0
    low = 0.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        if static_curve(p, middle) < force:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)


@njit
def _signal(s, which):
    """Absolute value of one of `SIGNALS`, over its usual size."""
    return (
        abs(s.brake_torque) / _BRAKE_NM,
        max(s.disc - COLD_C, 0.0) / _RISE_K,
        max(0.5 * (s.surface[0] + s.surface[1]) - COLD_C, 0.0) / _RISE_K,
        max(s.force, 0.0) / _FORCE_N,
        abs(s.speed) / _SPEED_RAD_PER_S,
        abs(s.current) / _CURRENT_A,
        abs(s.force_rate) / _RATE_N_PER_S,
        abs(s.wheel_speed) / _DISC_RAD_PER_S,
        max(s.pad_mean - COLD_C, 0.0) / _RISE_K,
        abs(s.brake_torque * s.wheel_speed) / _POWER_W,
    )[which]


@njit
def _apply_shape(e, x):
    if e.shape == SATURATION:
        return 1.0 - exp(-x)
    if e.shape == ONSET:
        return max(x - 1.0, 0.0)
    return x**e.exponent


@njit
def drawn_amount(e: Record, s: Record, lagged: Record, dt: float) -> float:
    """Amount that one drawn effect adds; called every ``dt`` s. ``lagged``: its own of the state's ``drawn``."""
    if e.size == 0.0:
        return 0.0
    value = e.size * _apply_shape(e, _signal(s, int(e.signal)))
    if e.other >= 0.0:
        value *= _signal(s, int(e.other))
    if e.lag_s > 0.0:
        lagged.amount += dt / e.lag_s * (value - lagged.amount)
        return lagged.amount
    return value


@njit
def growth(p: Record, s: Record) -> float:
    """Motor angle (rad) by which pads and disc are thicker than when cold and new: thickness variation over the turn, growth
    with the disc's temperature, less wear."""
    e = p.effects
    thickness = 1e-6 * e.disc_thermal_expansion.growth_um_per_K * (s.disc - p.curve_temperature) - s.wear
    if s.uneven_disc:
        v, uneven = e.disc_thickness_variation, 0.0
        cosines = v.order_1_cosine_um, v.order_2_cosine_um, v.order_3_cosine_um, v.order_4_cosine_um
        sines = v.order_1_sine_um, v.order_2_sine_um, v.order_3_sine_um, v.order_4_sine_um
        for k in range(4):
            uneven += cosines[k] * cos((k + 1) * s.wheel_angle)
            uneven += sines[k] * sin((k + 1) * s.wheel_angle)
        thickness += 1e-6 * uneven
    return thickness / p.gear_gain


@njit
def _friction_level(p, s):
    """Sliding friction torque of the gear (N m), without direction (thesis 4-1)."""
    e = p.effects
    level = p.offset_friction + p.load_friction * slope_at(p, s.angle) * gear_load(p, s)
    if e.stribeck_friction.rise != 0.0:
        level *= 1.0 + e.stribeck_friction.rise * exp(-abs(s.speed) / e.stribeck_friction.speed_rad_per_s)
    level *= 1.0 + e.friction_asymmetry.asymmetry * s.friction
    level *= max(1.0 + drawn_amount(e.drawn_gear_friction, s, s.drawn.gear_friction, SUBSTEP_S), 0.1)
    return level * max(1.0 - e.cold_grease.per_K * (s.caliper - COLD_C), 0.1)


@njit
def _cold_viscosity(p, s):
    """Viscous friction (N m s/rad) of grease below 22 degC: oil doubles its viscosity every 10 K or so (ASTM D341)."""
    viscous = p.effects.cold_grease.viscous_Nms_per_rad
    if viscous == 0.0:
        return 0.0
    return viscous * (2.0 ** (0.1 * max(COLD_C - s.caliper, 0.0)) - 1.0)


@njit
def move_motor(p: Record, s: Record, demand: float) -> None:
    """One sub-step of current, motor and gear under a current ``demand`` in A."""
    e, drawn, h = p.effects, s.drawn, SUBSTEP_S
    if s.latched:
        s.current -= s.current * h / (p.current_time + h)
        s.speed = s.speed_integral = 0.0
        return
    # Back-EMF: near the top speed the supply drives no further current in the direction of motion.
    room = p.maximum_current * min(max((1.06 * p.maximum_speed - abs(s.speed)) / (0.1 * p.maximum_speed), 0.0), 1.0)
    if demand * s.speed > 0.0:
        demand = min(max(demand, -room), room)
    demand = min(max(demand, -p.maximum_current), p.maximum_current)
    s.current += (demand - s.current) * h / (p.current_time + h)
    fade = e.torque_constant_fade
    warm = s.caliper + fade.disc_share * (s.disc - s.caliper) + s.magnet_rise - _MAGNETS_C
    factor = 1.0 - fade.fade_per_K * warm + drawn_amount(e.drawn_torque_constant, s, drawn.torque_constant, h)
    factor -= e.torque_saturation.loss_per_A2 * s.current * s.current
    if e.motor_heat_fade.fade_per_A2 != 0.0:
        s.motor_heat += h / e.motor_heat_fade.time_constant_s * (s.current * s.current - s.motor_heat)
        factor -= e.motor_heat_fade.fade_per_A2 * s.motor_heat
    torque = p.torque_constant * factor * s.current
    load = p.gear_gain * slope_at(p, s.angle) * gear_load(p, s)
    load *= 1.0 + drawn_amount(e.drawn_gear_gain, s, drawn.gear_gain, h)
    mesh = e.gear_mesh_ripple
    if mesh.cosine != 0.0 or mesh.sine != 0.0:
        phase = mesh.order_per_turn * (p.released_angle + s.angle)
        load *= 1.0 + mesh.cosine * cos(phase) + mesh.sine * sin(phase)
    level = _friction_level(p, s)
    turning = p.presliding_damping * (1.0 - s.friction * s.friction) + e.viscous_friction.viscous_Nms_per_rad
    turning += _cold_viscosity(p, s)
    resistance = level * s.friction + turning * s.speed
    cogging = e.cogging_torque
    if cogging.cosine_Nm != 0.0 or cogging.sine_Nm != 0.0:
        phase = cogging.order_per_turn * (p.released_angle + s.angle)
        resistance += cogging.cosine_Nm * cos(phase) + cogging.sine_Nm * sin(phase)
    before = s.speed
    s.speed += h * (torque - load - resistance) / p.inertia
    # Symplectic integration: the friction spring neither gains nor loses energy numerically.
    travel = h * s.speed
    s.angle += travel
    direction = 1.0 if travel > 0.0 else -1.0
    # Dahl 1968, exact for the travel of this step.
    s.friction = direction + (s.friction - direction) * exp(-abs(travel) / p.presliding_angle)
    mean_travel = 0.5 * h * (before + s.speed)
    s.motor_work += torque * mean_travel
    s.friction_loss += resistance * mean_travel
    s.clamp_work += load * mean_travel


@njit
def _settle(state, before, now, time_constant):
    """State of a first-order lag after one sub-step, by the trapezoidal rule."""
    share = 0.5 * SUBSTEP_S / time_constant
    return ((1.0 - share) * state + share * (before + now)) / (1.0 + share)


@njit
def clamp(p: Record, s: Record) -> None:
    """One sub-step of the clamp force: backlash, static curve, slip, relaxations.

    The first relaxation is the thesis's (3.3.2): force lags the motor angle, so that a fast stroke returns more work to the
    motor than it took. It describes measured forces, not a passive material."""
    e = p.effects
    angle = equivalent_angle(p, s.angle)
    if e.spindle_lead_error.amplitude_um != 0.0:
        error = sin(e.spindle_lead_error.order_per_turn * angle + e.spindle_lead_error.phase_rad)
        angle += 1e-6 * e.spindle_lead_error.amplitude_um / p.gear_gain * error
    half = 0.5 * e.backlash.play_rad
    s.driven_angle = min(max(s.driven_angle, angle - half), angle + half)
    # The clearance is the motor angle until contact when closing.
    x = s.driven_angle + half + growth(p, s)
    x += 1e-6 * drawn_amount(e.drawn_thickness, s, s.drawn.thickness, SUBSTEP_S) / p.gear_gain
    x -= p.contact_angle
    s.static_force = static_curve(p, x)
    hysteresis, further = e.stiffness_hysteresis, e.second_hysteresis
    travel = max(x, 0.0) - max(s.past_contact, 0.0)
    if hysteresis.share != 0.0:
        s.slip = min(max(s.slip + travel / hysteresis.slip_angle_rad, -1.0), 1.0)
    if further.share != 0.0:
        s.further_slip = min(max(s.further_slip + travel / further.slip_angle_rad, -1.0), 1.0)
    s.past_contact = x
    drive = s.stiffness_factor * s.static_force * (1.0 + hysteresis.share * s.slip + further.share * s.further_slip)
    coupled = e.brake_torque_coupling.per_Nm * s.brake_torque
    if e.fastest_closing.share != 0.0:
        s.fastest = max(s.fastest * (1.0 - SUBSTEP_S / e.fastest_closing.recovery_s), s.speed)
        coupled += e.fastest_closing.share * (s.fastest / _SPEED_RAD_PER_S) ** e.fastest_closing.exponent
    drive *= 1.0 + coupled + drawn_amount(e.drawn_stiffness, s, s.drawn.stiffness, SUBSTEP_S)
    excitation = drive
    if e.second_relaxation.share != 0.0:
        s.slow = _settle(s.slow, s.drive, drive, e.second_relaxation.time_constant_s)
        excitation += e.second_relaxation.share * (s.slow - drive)
    if e.third_relaxation.share != 0.0:
        before, s.settled = s.settled, excitation
        s.slower = _settle(s.slower, before, s.settled, e.third_relaxation.time_constant_s)
        excitation += e.third_relaxation.share * (s.slower - s.settled)
    if e.stress_relaxation.share != 0.0:
        s.yielding = _settle(s.yielding, s.drive, drive, e.stress_relaxation.time_constant_s)
        excitation += e.stress_relaxation.share * (drive - s.yielding)
    if e.slow_stress_relaxation.share != 0.0:
        s.yielding_slowly = _settle(s.yielding_slowly, s.drive, drive, e.slow_stress_relaxation.time_constant_s)
        excitation += e.slow_stress_relaxation.share * (drive - s.yielding_slowly)
    if e.clamp_creep.share != 0.0:
        s.creep = _settle(s.creep, s.drive, drive, e.clamp_creep.time_constant_s)
        excitation += e.clamp_creep.share * (s.creep - drive)
    # Pads push only: those that have given way lose contact.
    excitation = max(excitation, 0.0)
    force = _settle(s.force, s.excitation, excitation, p.relaxation_time)
    s.force_rate = (force - s.force) / SUBSTEP_S
    s.force, s.drive, s.excitation = force, drive, excitation


@njit
def _earlier(s, history, delay):
    """A recorded value as it was ``delay`` s ago, or the oldest."""
    steps = min(max(delay / SUBSTEP_S, 0.0), HISTORY - 2.0)
    whole = int(steps)
    share = steps - whole
    return (1.0 - share) * history[(s.history_at - whole) % HISTORY] + share * history[(s.history_at - whole - 1) % HISTORY]


@njit
def delayed_angle(p: Record, s: Record) -> float:
    """Angle that the resolver measures now: the motor angle ``signal_delay`` ago."""
    return _earlier(s, s.angle_history, p.effects.signal_delay.delay_s)


@njit
def delayed_mean_current(p: Record, s: Record) -> float:
    """Current that the sensor measures now: the mean over a cycle that ended ``current_delay`` ago."""
    delay, total = p.effects.current_delay.delay_s, 0.0
    for step in range(SUBSTEPS):
        total += _earlier(s, s.current_history, delay + step * SUBSTEP_S)
    return total / SUBSTEPS
