"""Speed of the disc, from those of wheel speed, wheel pulses and vehicle speed that are plausible."""

from math import exp, pi

import numpy as np

from emb_daemon.jit import Record, fields, njit
from emb_daemon.models.wheel import TURNING_RAD_PER_S
from emb_daemon.wire.contract import PULSE_MODULO, PULSES_PER_TURN

#: Speed above which a vehicle moves, m/s, as of a wheel.
_MOVING_M_PER_S = 0.5
#: Time over which pulses are counted into a speed, s.
_COUNTED_S = 0.25
#: Spread of a speed from so few pulses, share.
_PULSES_SHARE = 0.05
#: Number of pulses that a wheel with speed zero may still give while it comes to rest.
_TURNED_PULSES = 12.0
#: Time for which a wheel of a moving vehicle may stand, s: blocked, before anti-lock control releases it.
_BLOCKED_S = 1.0
#: Rolling radius of car tyres until this car's has been seen, m, its spread, and the time over which it is learned, s.
_RADIUS_M, _RADIUS_SHARE, _RADIUS_LEARNED_S = 0.31, 0.1, 10.0

WHEEL = np.dtype(
    [
        ("started", "?"),
        ("pulse", "f8"),
        ("pulse_speed", "f8"),
        ("radius", "f8"),
        ("turned", "f8"),
        ("contradicted_s", "f8"),
        ("contradicted", "?"),
        # Speed, rad/s, in place of a wheel speed that is lost or contradicted, NaN if nothing shows it, and how far
        # it may be off, share.
        *fields("f8", "instead instead_unsure"),
    ],
    align=True,
)


@njit
def disc_speed(w: Record, m: Record) -> tuple[float, float]:
    """Speed of the disc (rad/s) and its standard deviation; NaN and infinity if nothing shows it.

    Args:
        w: WHEEL record.
        m: SAMPLE record.
    """
    if not w.started:
        w.started, w.pulse, w.radius = True, np.nan, _RADIUS_M
    # Pulses over a gap without messages give no speed.
    steps = 0.0
    if m.has_wheel_pulse and np.isfinite(w.pulse) and m.dt > 0.0:
        steps = (m.wheel_pulse - w.pulse + PULSE_MODULO // 2) % PULSE_MODULO - PULSE_MODULO // 2
        share = 1.0 - exp(-m.dt / _COUNTED_S)
        w.pulse_speed += share * (steps * 2.0 * pi / PULSES_PER_TURN / m.dt - w.pulse_speed)
    elif not m.has_wheel_pulse:
        w.pulse_speed = 0.0
    w.pulse = m.wheel_pulse if m.has_wheel_pulse else np.nan
    by_pulses = abs(w.pulse_speed) if m.has_wheel_pulse else np.nan
    by_vehicle = m.vehicle_speed / w.radius if m.has_status else np.nan
    if not m.has_wheel_speed:
        w.contradicted, w.contradicted_s = False, 0.0
        return _without(w, by_pulses, by_vehicle)
    turning = m.wheel_speed > TURNING_RAD_PER_S
    if m.has_status and turning and m.vehicle_speed > 10.0 * _MOVING_M_PER_S:
        seen = m.vehicle_speed / m.wheel_speed
        if abs(seen / _RADIUS_M - 1.0) < 3.0 * _RADIUS_SHARE:
            w.radius += (1.0 - exp(-m.dt / _RADIUS_LEARNED_S)) * (seen - w.radius)
    moving = np.isnan(by_pulses) and by_vehicle * w.radius > _MOVING_M_PER_S
    w.contradicted_s = w.contradicted_s + m.dt if moving and not turning else 0.0
    w.turned = 0.0 if turning or w.pulse_speed < TURNING_RAD_PER_S else w.turned + steps
    w.contradicted = w.contradicted_s > _BLOCKED_S or w.turned > _TURNED_PULSES
    if w.contradicted:
        return _without(w, by_pulses, by_vehicle)
    return m.wheel_speed, 0.0


@njit
def _without(w, by_pulses, by_vehicle):
    if np.isfinite(by_pulses):
        w.instead, w.instead_unsure = by_pulses, _PULSES_SHARE
    else:
        w.instead, w.instead_unsure = by_vehicle, _RADIUS_SHARE
    if np.isfinite(w.instead):
        return w.instead, w.instead_unsure * w.instead
    return np.nan, np.inf
