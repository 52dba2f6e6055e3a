"""Both force paths with the temperatures of an earlier run, at a twentieth of the whole step's cost.

A fit computes hundreds of times how a force parameter changes the force. It hardly changes the temperatures, but conduction
and the filter are nearly the whole cost of a step. So the whole step is run once at the present parameters, its results that
the paths use are stored, and parameters are changed with these held.
"""

import numpy as np

from emb_daemon.effects import paths as effects
from emb_daemon.effects.terms import SIGNALS
from emb_daemon.estimator.paths import rest, shift_zero, stiffness_path, torque_path
from emb_daemon.estimator.records import STATE
from emb_daemon.estimator.resolver import remember_motion, restore_motion
from emb_daemon.jit import njit
from emb_daemon.models.thermal import stiffness_factor
from emb_daemon.offline.run import HEAT, TRACE, run_step


@njit
def _run(samples, parameters, states, heat, out, signals):
    p, s = parameters[0], states[0]
    s.started = True
    s.angle, s.slid_angle, s.speed = samples[0].angle, samples[0].angle, samples[0].speed
    s.friction_variance = 1.0
    s.gear_zero = samples[0].angle
    s.contact_angle = s.gear_zero + p.clearance
    rest(s, p, -p.clearance, 1.0)
    for row in range(len(samples)):
        m, h, o = samples[row], heat[row], out[row]
        s.disc, s.power, s.temperature_known = h.disc, h.power, h.temperature_known
        s.mean[0], s.mean[1] = h.mean[0], h.mean[1]
        s.pads[0, 0], s.pads[1, 0] = h.surface[0], h.surface[1]
        s.winding, s.housing = h.winding, h.housing
        if h.zero_moved != 0.0:
            if h.may_come_back and not (row > 0 and heat[row - 1].may_come_back):
                remember_motion(s)
            shift_zero(s, h.zero_moved)
            if h.came_back:
                restore_motion(s)
        rise = 0.5 * (h.mean[0] + h.mean[1]) - p.thermal.reference
        stiffness_path(s, p, m, stiffness_factor(p.thermal, rise, h.history) if h.temperature_known else 1.0)
        if len(signals) > 0:
            signals[row] = s.effects.terms.signal
        s.contact_angle += h.contact_moved
        s.past_contact -= h.contact_moved
        s.force -= s.slope * h.contact_moved
        o.force = s.force
        o.torque, o.leverage, _ = torque_path(s, p, m)
        if h.zero_moved != 0.0 or h.may_come_back:
            o.torque = np.nan
        factor = effects.torque_constant(p.effects, s.effects, m, s.disc, s.temperature_known, 0.0)
        o.torque_constant = p.torque_constant * factor
        s.angle, s.speed = m.angle, m.speed


def run_with_heat(samples: np.ndarray, parameters: np.void) -> tuple[np.ndarray, np.ndarray]:
    """TRACE rows of the whole step with `held` parameters, and its HEAT rows."""
    heat = np.zeros(len(samples), HEAT)
    return run_step(samples, parameters, heat), heat


def run_held(samples: np.ndarray, parameters: np.void, heat: np.ndarray) -> np.ndarray:
    """TRACE rows with force, torque, leverage and torque constant; the rest of them is zero."""
    out = np.zeros(len(samples), TRACE)
    _run(samples, np.atleast_1d(parameters), np.zeros(1, STATE), heat, out, np.zeros((0, len(SIGNALS))))
    return out


def follow_signals(samples: np.ndarray, parameters: np.void, heat: np.ndarray) -> np.ndarray:
    """Signals of terms (`effects.terms.SIGNALS`) at each sample of a held run; NaN where unknown."""
    watching = parameters.copy()
    watching["effects"]["terms"]["count"] = max(watching["effects"]["terms"]["count"], 1)
    signals = np.zeros((len(samples), len(SIGNALS)))
    _run(samples, np.atleast_1d(watching), np.zeros(1, STATE), heat, np.zeros(len(samples), TRACE), signals)
    return signals
