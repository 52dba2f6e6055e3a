"""The effects of one path together, as `estimator.step` calls them."""

from emb_daemon.effects import (
    backlash,
    cogging_torque,
    current_offset,
    disc_radiation,
    disc_thermal_expansion,
    disc_thickness_variation,
    friction_asymmetry,
    friction_coefficient_fade,
    gear_mesh_ripple,
    pad_wear,
    second_relaxation,
    signal_delay,
    stiffness_hysteresis,
    stribeck_friction,
    thermocouple_lag,
    torque_constant_fade,
    viscous_friction,
)
from emb_daemon.jit import njit


@njit
def thickness(e, s, m, disc, disc_known, power):
    """What disc and pads have gained since power-on in the pads' way, m."""
    wheel_speed = m.wheel_speed if m.has_wheel_speed else 0.0
    return (
        disc_thickness_variation.term(
            e.disc_thickness_variation, s.disc_thickness_variation, m.wheel_pulse, m.has_wheel_pulse, wheel_speed, m.dt
        )
        + disc_thermal_expansion.term(e.disc_thermal_expansion, s.disc_thermal_expansion, disc, disc_known)
        - pad_wear.term(e.pad_wear, s.pad_wear, power, m.dt)
    )


@njit
def motor_angle(e, s, m):
    """What the spindle is ahead of the measured motor angle, rad."""
    return signal_delay.term(e.signal_delay, m.speed) + backlash.term(e.backlash, s.backlash, m.angle)


@njit
def static_force(e, s, static, travel, dt):
    """Static clamp force (N) with hysteresis and slow relaxation after ``travel`` rad in contact."""
    drive = static * (1.0 + stiffness_hysteresis.term(e.stiffness_hysteresis, s.stiffness_hysteresis, travel))
    return drive + second_relaxation.term(e.second_relaxation, s.second_relaxation, drive, dt)


@njit
def motor_torque(e, m, torque_constant, travel, mean_speed, disc, disc_known):
    """Motor torque (N m) that reaches the gear."""
    fade = torque_constant_fade.term(e.torque_constant_fade, m.caliper, m.has_thermocouple, disc, disc_known)
    torque = torque_constant * (1.0 + fade) * (m.current_q + current_offset.term(e.current_offset))
    return (
        torque - viscous_friction.term(e.viscous_friction, mean_speed) - cogging_torque.term(e.cogging_torque, m.angle, travel)
    )


@njit
def gear(e, angle, travel, mean_speed, friction_mean):
    """Factors on the gear gain and on gear friction."""
    friction = 1.0 + stribeck_friction.term(e.stribeck_friction, mean_speed)
    friction += friction_asymmetry.term(e.friction_asymmetry, friction_mean)
    return 1.0 + gear_mesh_ripple.term(e.gear_mesh_ripple, angle, travel), friction


@njit
def backplates(e, s, inner, outer, dt):
    """Temperatures (degC) of the backing plates from what their thermocouples show."""
    more_inner, more_outer = thermocouple_lag.term(e.thermocouple_lag, s.thermocouple_lag, inner, outer, dt)
    return inner + more_inner, outer + more_outer


@njit
def friction_factor(e, surface):
    """Factor on the coefficient of friction of the pads."""
    return friction_coefficient_fade.term(e.friction_coefficient_fade, surface)


@njit
def disc_cooling(e, heat_capacity, disc, ambient, dt):
    """Change of the disc temperature (K) by what the disc model lacks."""
    return disc_radiation.term(e.disc_radiation, heat_capacity, disc, ambient, dt)
