"""The brake controller of one corner: force over position over speed over current, on true signals.

The controller may use signals that no car can measure. The motion then has no errors of its own, and only the daemon is
tested.
"""

from emb_daemon.jit import Record, njit
from emb_daemon.plant.brake import gear_load, motor_angle, slope_at, static_angle
from emb_daemon.plant.records import ANGLE, FORCE, LATCH, SUBSTEP_S
from emb_daemon.wire.contract import CYCLE_S

#: Speed asked for per position error, 1/s; acceleration per speed error, 1/s, and per its integral, 1/s^2. Each loop is
#: several times slower than the one inside it; the current loop of `derive` takes 1 ms.
_POSITION_GAIN, _SPEED_GAIN, _SPEED_INTEGRAL = 40.0, 250.0, 8000.0
#: Largest acceleration asked of the motor, rad/s^2.
_ACCELERATION = 8000.0
#: Position error that is not corrected, rad, so that a clamped motor comes to rest against friction.
_AT_TARGET_RAD = 0.02
#: Share of a force error that is corrected, 1/s, and the most that this moves the position, rad.
_FORCE_INTEGRAL, _LARGEST_CORRECTION_RAD = 2.0, 4.0
#: Force error that is not corrected: 20 N and half a percent.
_FORCE_BAND_N, _FORCE_BAND = 20.0, 0.005


@njit
def set_target(p: Record, s: Record, mode: int, target: float, rate: float) -> None:
    """Position target for the coming cycle from a command."""
    s.target_rate = 0.0
    s.latched = mode == LATCH
    if mode == ANGLE:
        s.position_target, s.target_rate, s.force_correction = target, rate, 0.0
    elif mode == FORCE and target > 0.0:
        goal = static_angle(p, target)
        slope = target / max(goal, 0.5) * slope_at(p, s.angle)
        error = target - s.force
        band = _FORCE_BAND_N + _FORCE_BAND * target
        if abs(error) > band and abs(s.position_target - s.angle) < 0.5:
            correction = s.force_correction + CYCLE_S * _FORCE_INTEGRAL * error / slope
            s.force_correction = min(max(correction, -_LARGEST_CORRECTION_RAD), _LARGEST_CORRECTION_RAD)
        # The controller follows wear and growth, as if it found contact at each application. It does not follow how the disc's
        # thickness varies over the turn: that would then not show in the force.
        thicker = 1e-6 * p.effects.disc_thermal_expansion.growth_um_per_K * (s.disc - p.curve_temperature) - s.wear
        s.position_target = motor_angle(p, p.contact_angle - thicker / p.gear_gain + goal) + s.force_correction
    else:
        s.position_target, s.force_correction = 0.0, 0.0


@njit
def current_demand(p: Record, s: Record) -> float:
    """Current (A) that the position and speed loops ask for, one sub-step."""
    error = s.position_target - s.angle
    if abs(error) <= _AT_TARGET_RAD:
        error = 0.0
    else:
        error -= _AT_TARGET_RAD if error > 0.0 else -_AT_TARGET_RAD
    speed = min(max(_POSITION_GAIN * error + s.target_rate, -p.maximum_speed), p.maximum_speed)
    lag = speed - s.speed
    acceleration = _SPEED_GAIN * lag
    if abs(acceleration) < _ACCELERATION:
        # Without this limit the integral would wind up.
        s.speed_integral += SUBSTEP_S * _SPEED_INTEGRAL * p.inertia * lag
    acceleration = min(max(acceleration, -_ACCELERATION), _ACCELERATION)
    torque = p.gear_gain * slope_at(p, s.angle) * gear_load(p, s) + p.inertia * acceleration + s.speed_integral
    s.position_target += SUBSTEP_S * s.target_rate
    return torque / p.torque_constant
