"""Contact angle: where it is found at power-on, and how far it wanders."""

import numpy as np

from emb_daemon.calibration.parameters import CLEARANCE, CLEARANCE_SIGMA
from emb_daemon.identify.dynamics import simulate
from emb_daemon.identify.steps import Step
from emb_daemon.identify.steps.stiffness import StiffnessStep
from emb_daemon.wire.contract import CYCLE_S

#: Samples over which one contact angle is estimated: ten seconds, in which it hardly moves.
_ROWS = 2500
#: Least information on the contact angle, over that of the log's best ten seconds: with less, its standard deviation is over
#: ten times as large, as where pads have just parted and the force only decays.
_TELLS = 0.01
#: Step of the derivative by the clearance, rad.
_STEP = 1e-3


def identify(stiffness: StiffnessStep, count_rad: float, nominal_rad: float) -> Step:
    """Clearance as the mean of all logs, with the standard deviation with which the next power-on will find it.

    A log that begins in contact shows no clearance; if all do, it is the datasheet's, with half of it as standard deviation.
    ``count_rad``: the resolver's smallest step; ``nominal_rad``: the datasheet's clearance."""
    curves = stiffness.fit.curves
    found = np.concatenate([curve.clearances_rad for curve in curves])
    errors = np.concatenate([curve.clearance_sigmas_rad for curve in curves])
    open_ = found > 0.0
    notes = ()
    if not open_.any():
        found, errors, open_ = np.array([nominal_rad]), np.array([0.5 * nominal_rad]), np.array([True])
        notes = ("every log begins in contact, and the clearance is the datasheet's; needed: a log that begins released",)
    found, errors = found[open_], errors[open_]
    spread = float(np.std(found, ddof=1)) if len(found) > 1 else 0.0
    return Step(
        values={
            CLEARANCE: float(np.mean(found)),
            CLEARANCE_SIGMA: float(np.sqrt(spread**2 + np.mean(errors**2) + count_rad**2 / 12.0)),
            "contact.walk_rad_per_sqrt_s": _walk(stiffness),
        },
        notes=notes,
    )


def _walk(stiffness: StiffnessStep) -> float:
    """Random walk of the contact angle, rad per root of a second, from estimates ten seconds apart in the fitted logs.

    It contains the scatter of the estimates, and is therefore rather too large."""
    squares, seconds = 0.0, 0.0
    fit = stiffness.fit
    for pads, curve in zip(stiffness.pads, fit.curves, strict=True):
        for log, clearance in zip(pads.logs, curve.clearances_rad, strict=True):
            at, moved = (
                simulate(log, fit.calibration, pads.thickness_mm, clearance + step, fit.delay_s) for step in (0.0, _STEP)
            )
            slope, error = (moved - at) / _STEP, at - log.force_N
            parts = [slice(start, start + _ROWS) for start in range(0, len(error) - _ROWS + 1, _ROWS)]
            weights = np.array([slope[part] @ slope[part] for part in parts])
            whole = np.array([np.isfinite(error[part]).all() for part in parts], bool)
            told = whole & (weights > _TELLS * np.max(weights, initial=0.0))
            shifts = [-float(slope[parts[n]] @ error[parts[n]]) / weights[n] for n in np.flatnonzero(told)]
            squares += float(np.sum(np.diff(shifts) ** 2))
            seconds += _ROWS * CYCLE_S * max(len(shifts) - 1, 0)
    return float(np.sqrt(squares / seconds)) if seconds else 0.0
