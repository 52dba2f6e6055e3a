"""The estimator over the samples of a log: the whole step, or its two force paths alone.

One convention for the start, the estimator's own at power-on: at the first sample the motor stands, contact lies
``parameters["clearance"]`` ahead of its angle, forces have settled there, friction is unknown and nothing is hot. A caller who
knows the contact angle sets the clearance to ``contact_angle - samples["angle"][0]``. Because forces start settled, a part of
a log may begin clamped; a released brake starts at zero force, as in the whole step, so that paths and whole step give the
same forces to the last bit (`tests/test_offline.py`).

Fits change PARAMETERS; records are small, so that callers copy and change them freely.
"""

import numpy as np

from emb_daemon.adapt.adaptation import Adaptation
from emb_daemon.effects import paths as effects
from emb_daemon.estimator.answer import answer
from emb_daemon.estimator.paths import settle_paths, stiffness_path, torque_path
from emb_daemon.estimator.records import ESTIMATE, STATE, new_state
from emb_daemon.estimator.resolver import came_back, may_come_back
from emb_daemon.estimator.step import step
from emb_daemon.jit import fields, njit

#: The two force paths at each sample. ``force`` N by the stiffness path; ``torque`` N m left to the clamp force over the cycle
#: that ends here (NaN where the current says nothing), its ``leverage`` m/rad, mean friction state over the cycle (-1 to 1)
#: and the state's variance.
PATHS = np.dtype(
    [("force", "f8"), ("torque", "f8"), ("leverage", "f8"), ("friction_mean", "f8"), ("friction_variance", "f8")], align=True
)

#: The whole step at each sample: ``force`` N by the stiffness path, ``torque`` and ``leverage`` as in PATHS, the
#: ``torque_constant`` N m/A with what effects make of it, friction ``power`` W, pads at 2, 4, 6, 8 mm (inner, then outer)
#: and disc in degC.
TRACE = np.dtype(
    [*fields("f8", "force torque leverage torque_constant power"), ("temperature", "f8", (9,)), ("temperature_known", "?")],
    align=True,
)

#: What the force paths take from the rest of the step, at each sample: temperatures (degC) of the pads, ``mean`` and at the
#: ``surface``, and the ``history`` of their rise (K), friction ``power`` (W), ``disc`` (degC), whether temperatures are known,
#: the heat of the motor's winding and housing. Angles (rad) by which the resolver's zero was found to have moved
#: (``zero_moved``), and the contact angle beside it, which is learned anew from then on (``contact_moved``); whether it
#: ``may_come_back``, so that no torque is used, and whether it ``came_back``.
HEAT = np.dtype(
    [
        ("mean", "f8", (2,)),
        ("surface", "f8", (2,)),
        *fields("f8", "history power disc winding housing zero_moved contact_moved"),
        *fields("?", "temperature_known may_come_back came_back"),
    ],
    align=True,
)

_COLD = np.ones(1)
_UNASKED = np.zeros(0, HEAT)


@njit
def _run_paths(samples, factor, parameters, states, force, out):
    p, s = parameters[0], states[0]
    s.gear_zero = samples[0].angle
    s.contact_angle = s.gear_zero + p.clearance
    settle_paths(s, p, samples[0], factor[0])
    for row in range(len(samples)):
        m = samples[row]
        stiffness_path(s, p, m, factor[row] if len(factor) > 1 else factor[0])
        force[row] = s.force
        if len(out) > 0:
            o = out[row]
            o.torque, o.leverage, _ = torque_path(s, p, m)
            o.friction_mean, o.friction_variance = s.friction_mean, s.friction_variance
            s.angle, s.speed = m.angle, m.speed


def run_paths(samples: np.ndarray, parameters: np.ndarray | np.void) -> np.ndarray:
    """Both force paths of cold pads, the contact angle held; returns PATHS rows. ``samples``: SAMPLE rows, or
    any rows with their fields; ``parameters``: one PARAMETERS record, or an array of shape (1,)."""
    force, out = np.empty(len(samples)), np.zeros(len(samples), PATHS)
    _run_paths(samples, _COLD, np.atleast_1d(parameters), np.zeros(1, STATE), force, out)
    out["force"] = force
    return out


def stiffness_force(samples: np.ndarray, parameters: np.ndarray | np.void, factor: np.ndarray = _COLD) -> np.ndarray:
    """Clamp force in N by the stiffness path alone, at half the cost of `run_paths`.

    Arguments as there; ``factor`` of the stiffness has shape (1,) for all rows or (n,)."""
    force = np.empty(len(samples))
    _run_paths(samples, factor, np.atleast_1d(parameters), np.zeros(1, STATE), force, np.zeros(0, PATHS))
    return force


@njit
def _run_step(samples, parameters, states, estimate, out, heat):
    p, s, e = parameters[0], states[0], estimate[0]
    for row in range(len(samples)):
        m, o = samples[row], out[row]
        winding, housing = s.winding, s.housing
        zero, contact = (s.gear_zero, s.contact_angle) if row > 0 else (m.angle, m.angle + p.clearance)
        step(s, p, m, e)
        if len(heat) > 0:
            h = heat[row]
            h.winding, h.housing = winding, housing
            h.mean[0], h.mean[1] = s.mean[0], s.mean[1]
            h.surface[0], h.surface[1] = s.pads[0, 0], s.pads[1, 0]
            h.history, h.zero_moved = s.history, s.gear_zero - zero
            h.contact_moved = s.contact_angle - contact - h.zero_moved
            h.may_come_back, h.came_back = may_come_back(s), h.zero_moved != 0.0 and came_back(s)
            h.power, h.disc, h.temperature_known = s.power, s.disc, s.temperature_known
        factor = effects.torque_constant(p.effects, s.effects, m, s.disc, s.temperature_known, 0.0)
        o.torque_constant = p.torque_constant * factor
        o.force, o.torque, o.leverage, o.power = e.stiffness_force, s.balance, s.leverage, s.power
        for side in range(2):
            for depth in range(4):
                o.temperature[4 * side + depth] = e.depth[side, depth]
        o.temperature[8] = e.disc
        o.temperature_known = s.temperature_known


def held(parameters: np.ndarray | np.void) -> np.ndarray:
    """PARAMETERS, shape (1,), with which the step does not learn the contact angle.

    Learning would spread an error of one path over both, and hide a slow effect in a changing contact angle."""
    fixed = np.atleast_1d(parameters).copy()
    fixed["clearance_sigma"] = 0.0
    fixed["contact_walk"] = 0.0
    return fixed


def run_step(samples: np.ndarray, parameters: np.ndarray | np.void, heat: np.ndarray = _UNASKED) -> np.ndarray:
    """The whole step from power-on; returns TRACE rows, what `estimate` does not tell. Residuals want `held` parameters.

    Fills ``heat``, as many HEAT rows as samples, if it is given."""
    out = np.zeros(len(samples), TRACE)
    _run_step(samples, np.atleast_1d(parameters), new_state(), np.zeros(1, ESTIMATE), out, heat)
    return out


def estimate(
    samples: np.ndarray,
    parameters: np.ndarray | np.void,
    state: np.ndarray | None = None,
    adaptation: Adaptation | None = None,
) -> np.ndarray:
    """The whole step as the daemon runs it; returns ESTIMATE rows. ``parameters``: one PARAMETERS record, or an array of one
    record for each corner or one in all; ``state``: STATE, one or four, carried on if given; ``adaptation``:
    `adapt.adaptation.Adaptation` that learns meanwhile."""
    estimates = np.zeros(len(samples), ESTIMATE)
    answer_all = adaptation.answer if adaptation else answer
    answer_all(samples, len(samples), new_state() if state is None else state, np.atleast_1d(parameters), estimates)
    return estimates
