"""Noise levels of both paths as the filter needs them, from data that were not fitted.

The daemon's standard deviation is judged against a reference instrument and must therefore contain that instrument's noise, as
errors on held-out data do.
"""

from collections.abc import Sequence
from functools import reduce

import numpy as np

from emb_daemon.calibration.curves import rising_force
from emb_daemon.calibration.parameters import INERTIA, LOAD_FRICTION, OFFSET_FRICTION, TORQUE_CONSTANT
from emb_daemon.calibration.types import Calibration
from emb_daemon.identify.campaign import Campaign
from emb_daemon.identify.dynamics import EPISODE, Errors, errors_unseen
from emb_daemon.identify.steps import Step
from emb_daemon.identify.steps.attribution import AttributionStep
from emb_daemon.identify.steps.held_out import Fold
from emb_daemon.identify.steps.stiffness import USUAL_RELAXATION_S, StiffnessStep
from emb_daemon.identify.steps.torque import UNKNOWN_CURRENT_A, TorqueStep, Unexplained, unexplained_current
from emb_daemon.identify.text import with_sigma
from emb_daemon.jit import njit
from emb_daemon.models.stiffness import travel_at
from emb_daemon.offline import Log
from emb_daemon.offline.levels import force_error_levels, integral_time, lasting_share
from emb_daemon.offline.score import rmse
from emb_daemon.offline.stretches import without_gaps
from emb_daemon.report.page import Page
from emb_daemon.wire.contract import CYCLE_S

#: One minus the squared friction state below which a gear slides.
_SLID = 0.1
#: Relative error of an extrapolated curve from which a note is written: the usual relative noise of the path.
_NOTED = 0.01
#: The same from which angles are of different places: at one angle pads give or take by their relaxation and hysteresis, some
#: per cent each.
_OF_OTHER_PLACES = 0.1
#: Length of the stretches, in samples, from which noise is identified, if there are any that long.
_LONG = 50
#: Resolver movement that still counts as standing, rad.
_STANDING = 2.5e-3


def identify(
    campaign: Campaign,
    stiffness: StiffnessStep,
    torque: TorqueStep,
    folds: list[Fold],
    interpolation: float,
    found: AttributionStep | None = None,
) -> Step:
    """Noise levels from the folds, or where there are none from the second halves of the random logs, or from slow logs.

    ``interpolation``: relative force error that a curve between two measured pad thicknesses adds; ``found``: the search, once
    it is done, of which what it leaves of hot pads is used where that is larger than what is left of cold pads."""
    known = stiffness.fit.calibration
    found = found or AttributionStep(calibration=known)
    gear_gain, rated_N = known.motor.gear_gain_m_per_rad, campaign.datasheet.actuator.rated_clamp_force_N
    notes = []
    speed = speed_noise([log for pads in stiffness.pads for log in pads.logs])
    if speed is None:
        speed = campaign.datasheet.resolver.count_rad / CYCLE_S
        notes.append("The motor never stands for 0.2 s: speed noise is one resolver count per sample, not measured.")
    if not folds:
        notes.append(
            "Fewer than two pad thicknesses with a slow and a random log: nothing could be held out by thickness, and noise "
            "levels come from the second halves of the random logs; without these from slow logs, each predicted from the "
            "others of its pads, a single one as it was fitted."
        )
    errors, unexplained = _on_others(stiffness, torque, folds)
    floor, relative, correlation_s = _stiffness_levels(errors, found.hot)
    unknown_lag = 0.0
    if not any(pads.random for pads in stiffness.pads):
        unknown_lag = _unknown_lag(stiffness, campaign, found.fastest_rad_per_s)
        notes.append(
            "No random log: the stiffness path's relative noise holds what an unknown relaxation does in a hard clamp."
        )
    beyond = _extrapolation(stiffness, rated_N)
    if beyond > _NOTED:
        campaign.fault(_unsure_at_the_end(stiffness.reached_N, rated_N, beyond))
    levels = {
        "stiffness_N": floor,
        "stiffness_relative": _together(relative, interpolation, unknown_lag, beyond),
        "stiffness_correlation_s": correlation_s,
        **torque_levels(unexplained + _more_current(unexplained, found.hot_current), gear_gain, speed),
        "torque_lasting": _lasting([*unexplained, *found.hot_current], gear_gain, known.stiffness.maximum_force_N),
    }
    # The daemon does not know how worn its gear is.
    levels["torque_relative"] = _together(levels["torque_relative"], torque.gear_wear() / gear_gain)
    values = {f"noise.{name}": value for name, value in levels.items()}
    values |= {key: _together(values[key], share) for key, share in found.undecided.items()}
    return Step(values=values, notes=tuple(notes))


def _together(*sigmas: float) -> float:
    """Standard deviation of the sum of independent errors."""
    return float(reduce(np.hypot, sigmas))


def _on_others(stiffness: StiffnessStep, torque: TorqueStep, folds: list[Fold]) -> tuple[list[Errors], list[Unexplained]]:
    """Errors of the stiffness path and unexplained currents on logs that were not fitted, as far as there are any."""
    if folds:
        return [pair for fold in folds for pair in fold.errors], [left for fold in folds for left in fold.unexplained]
    chosen, random = stiffness.chosen, any(pads.random for pads in stiffness.pads)
    errors = errors_unseen(stiffness.pads, chosen.fit) if random else chosen.held_out
    return errors, [unexplained_current(log, torque.fit, stiffness.fit.calibration) for log in torque.logs]


def _stiffness_levels(errors: list[Errors], hot: Sequence[Errors]) -> tuple[float, float, float]:
    """Floor (N), relative part and correlation time (s) of the stiffness path's ``errors``, and of those on ``hot`` logs that
    are larger than they."""
    error, force = map(np.concatenate, zip(*errors, strict=True))
    floor, relative = force_error_levels(error, force)
    # Where the path shows no force a relative part covers nothing, whatever the reference shows: the floor alone has to.
    none = np.abs(force + error) < floor
    floor = max(floor, rmse(error[none])) if none.any() else floor
    if more := [(error, force) for error, force in hot if rmse(error) > rmse(np.hypot(floor, relative * force))]:
        errors = [*errors, *more]
        floor, relative = force_error_levels(*map(np.concatenate, zip(*errors, strict=True)))
    return floor, relative, integral_time([error for error, _ in errors])


def _unknown_lag(stiffness: StiffnessStep, campaign: Campaign, fastest_rad_per_s: float) -> float:
    """Relative force error of the uncertain lag in the fastest clamp that the motor can make, beyond that in the fastest
    recorded clamp, which the known errors contain."""
    travel = max(curve.travel_rad for curve in stiffness.fit.curves)
    unseen = max(campaign.datasheet.actuator.max_motor_speed_rad_per_s - fastest_rad_per_s, 0.0)
    return USUAL_RELAXATION_S * unseen / travel


def _extrapolation(stiffness: StiffnessStep, rated_N: float) -> float:
    """Relative error that curves which were not measured up to the brake's largest force have there beyond the one at their
    last travel. That one the errors on other logs contain; of pads with a single log there are none."""
    worst = 0.0
    for curve, pads in zip(stiffness.fit.curves, stiffness.pads, strict=True):
        if rising_force(curve.coefficients) < rated_N:
            return 1.0
        travel = travel_at(rated_N, curve.coefficients)
        if travel > curve.travel_rad:
            told_rad = curve.travel_rad if len(pads.logs) > 1 else 0.0
            worst = max(worst, curve.rise_sigma(told_rad, travel) / rated_N)
    return min(worst, 1.0)


def _unsure_at_the_end(reached_N: float, rated_N: float, beyond: float) -> str:
    """A line on curves whose force is unsure by the share ``beyond`` at the largest force, for want of logs or in spite of
    them."""
    reached = f"{1e-3 * reached_N:.3g} of {1e-3 * rated_N:.3g} kN"
    told = f"leaves {100.0 * beyond:.3g} % of the largest force unsure; sigma holds that share of any force; needed:"
    if reached_N < rated_N:
        return (
            f"curves: no log clamps harder than {reached}, and a cubic that goes on {told} a slow clamp to the largest force"
        )
    if beyond > _OF_OTHER_PLACES:
        return (
            f"curves: logs clamp up to {reached}, but at angles so unlike that their cubic {told} logs in which the angle "
            "counts from one place, or one log alone"
        )
    return (
        f"curves: logs clamp up to {reached} in motion, but the curve of all of them, without what pads resist motion with, "
        f"reaches the largest force beyond their angles, and {told} a slow clamp a little beyond the largest force"
    )


def speed_noise(logs: list[Log]) -> float | None:
    """Standard deviation in rad/s of the motor speed while the motor stands; None if it never stands for 0.2 s."""
    squares = count = 0.0
    for log in logs:
        angle, speed = log.samples["angle"], log.samples["speed"]
        window = 50
        for start in range(0, len(angle) - window, window):
            rows = slice(start, start + window)
            if np.ptp(angle[rows]) <= _STANDING:
                squares += float(np.sum((speed[rows] - speed[rows].mean()) ** 2))
                count += window - 1
    return float(np.sqrt(squares / count)) if count else None


@njit
def _innovation_cost(residual, variance, decay, difference):
    """Mean negative log likelihood (without constants) of first-order noise plus the difference of successive values of white
    noise, by its Kalman filter. ``variance`` of the first-order noise, ``difference`` of the white one."""
    white = 0.5 * difference
    state, spread, cost = 0.0, variance, 0.0
    # White noise at the sample before, which this difference has too, and its covariance with the state.
    before, before_spread, shared = 0.0, white, 0.0
    for value in residual:
        total = spread - 2.0 * shared + before_spread + white
        innovation = value - state + before
        cost += np.log(total) + innovation * innovation / total
        gain, white_gain = (spread - shared) / total, white / total
        state = decay * (state + gain * innovation)
        before = white_gain * innovation
        shared = -decay * gain * white
        before_spread = white - white_gain * white
        spread = decay * decay * (spread - gain * gain * total) + (1.0 - decay * decay) * variance
    return cost


def current_noise(residuals: list[np.ndarray], difference_A: float) -> tuple[float, float]:
    """First-order coloured noise of the unexplained current, in gap-free stretches, by maximum likelihood: (standard deviation
    in A, correlation time in s).

    ``difference_A``: standard deviation of the further part that the speed's noise causes through inertia times a difference
    of two speeds; each speed's noise enters twice with opposite signs, so that this part is not white."""
    from scipy.optimize import minimize

    total = float(np.mean(np.concatenate(residuals) ** 2))
    samples = sum(len(r) for r in residuals)

    def cost(p):
        decay = float(np.exp(-CYCLE_S / np.exp(p[1])))
        return sum(_innovation_cost(r, float(np.exp(2.0 * p[0])), decay, difference_A**2) for r in residuals) / samples

    start = [0.5 * np.log(max(total - difference_A**2, 0.1 * total)), np.log(2.0 * CYCLE_S)]
    bounds = [(start[0] - 5.0, start[0] + 2.0), (np.log(0.25 * CYCLE_S), np.log(1.0))]
    found = minimize(cost, start, method="Nelder-Mead", bounds=bounds, options={"xatol": 1e-3, "fatol": 1e-7})
    return float(np.exp(found.x[0])), float(np.exp(found.x[1]))


def _with_what_lasts(residuals: list[np.ndarray], sigma_A: float, time_s: float) -> tuple[float, float]:
    """First-order noise (standard deviation in A, correlation time in s) with the spectral density, at low frequency, of the
    current's noise and of the error that lasts for a manoeuvre together.

    The likelihood is dominated by fast noise. The filter would attribute an error that lasts for a second to the contact
    angle."""
    lasts = CYCLE_S * EPISODE
    means = _means(residuals)
    if not len(means):
        return sigma_A, time_s
    # A mean of first-order noise over much longer than its time has this variance.
    slow = max(rmse(means) ** 2 - sigma_A**2 * 2.0 * time_s / lasts, 0.0)
    total = sigma_A**2 + slow
    return float(np.sqrt(total)), (sigma_A**2 * time_s + slow * lasts) / total


def _more_current(held_out: list[Unexplained], hot: tuple[Unexplained, ...]) -> list[Unexplained]:
    """The ``hot`` logs with more unexplained current over a manoeuvre and longer than any of ``held_out``."""
    most = max(filter(np.isfinite, map(_lasting_A, held_out)), default=np.inf)
    return [left for left in hot if _lasting_A(left) > most]


def _lasting_A(left: Unexplained) -> float:
    """RMS of the means of an unexplained current over manoeuvres, A; NaN without one that long."""
    return rmse(_means(without_gaps(left.rows, left.current_A)))


def _lasting(held_out: list[Unexplained], gear_gain: float, maximum_force_N: float) -> float:
    """Relative error of the torque that lasts for a manoeuvre, the largest of all logs."""
    shares = []
    for left in held_out:
        torque = left.found.values[TORQUE_CONSTANT] * left.current_A
        load = (gear_gain + left.found.values[LOAD_FRICTION] * left.friction_mean) * left.force_N
        pairs = zip(without_gaps(left.rows, torque), without_gaps(left.rows, load), strict=True)
        shares.append(lasting_share(pairs, gear_gain * maximum_force_N))
    return max(shares)


def _means(series: list[np.ndarray]) -> np.ndarray:
    """Means over manoeuvres."""
    return np.array([s[row : row + EPISODE].mean() for s in series for row in range(0, len(s) - EPISODE + 1, EPISODE)])


def torque_levels(held_out: list[Unexplained], gear_gain: float, speed_sigma: float) -> dict[str, float]:
    """Fields of ``noise`` that belong to the torque path, from what fits leave unexplained on logs that were not fitted."""
    series, turning, excess, gains = [], [], [], []
    first = held_out[0].found
    constant = first.values[TORQUE_CONSTANT]
    if not any(len(left.rows) for left in held_out):
        # No current was measured: the fit's prior, and friction that may be as large as its load.
        relative = np.hypot(first.sigmas[TORQUE_CONSTANT] / constant, first.sigmas[LOAD_FRICTION] / gear_gain)
        return {
            "current_A": UNKNOWN_CURRENT_A,
            "current_correlation_s": CYCLE_S,
            "speed_rad_per_s": speed_sigma,
            "presliding": 1.0,
            "torque_relative": float(relative),
        }
    held_out = [left for left in held_out if len(left.rows)]
    difference = np.sqrt(2.0) * first.values[INERTIA] * speed_sigma / CYCLE_S / constant
    for left in held_out:
        values = left.found.values
        current, mean, force = left.current_A, left.friction_mean, left.force_N
        torque = values[TORQUE_CONSTANT] * current
        series += without_gaps(left.rows, left.current_A)
        sliding = 1.0 - mean**2
        turning.append((sliding * (values[OFFSET_FRICTION] + values[LOAD_FRICTION] * np.maximum(force, 0.0))) ** 2)
        excess.append(torque**2 - np.mean(torque[sliding < _SLID] ** 2))
        load = (gear_gain + values[LOAD_FRICTION] * mean) * force
        # Slope of torque error over explained torque: the error of torque constant and friction, constant over the log.
        gains.append(float(load @ torque / (load @ load)))
    turning, excess = np.concatenate(turning), np.concatenate(excess)
    share = float(turning @ excess / (turning @ turning)) if np.any(turning > 0.0) else 0.0
    # Short stretches show little, but where friction turns over for most of a log there are no longer ones.
    series = [s for s in series if len(s) > _LONG] or series
    sigma, time = _with_what_lasts(series, *current_noise(series, difference))
    return {
        "current_A": sigma,
        "current_correlation_s": time,
        "speed_rad_per_s": speed_sigma,
        "presliding": float(np.sqrt(np.clip(share, 0.0, 1.0))),
        "torque_relative": float(np.hypot(rmse(gains), first.sigmas[TORQUE_CONSTANT] / constant)),
    }


def section(page: Page, calibration: Calibration) -> None:
    noise, contact = calibration.noise, calibration.contact
    part = page.section(
        "Noise levels",
        "Noise levels come from residuals of data that did not fit the models; they contain the reference instrument's own "
        "noise, because the stated sigma is compared with that instrument.",
    )
    part.table(
        ["noise level", "value"],
        [
            ["stiffness path, floor / N", f"{noise.stiffness_N:.1f}"],
            ["stiffness path, relative / %", f"{100 * noise.stiffness_relative:.2f}"],
            ["stiffness path, correlation / ms", f"{1e3 * noise.stiffness_correlation_s:.0f}"],
            ["current / A", f"{noise.current_A:.3f}"],
            ["current, correlation / ms", f"{1e3 * noise.current_correlation_s:.1f}"],
            ["motor speed / rad/s", f"{noise.speed_rad_per_s:.3f}"],
            ["friction while it turns over / %", f"{100 * noise.presliding:.0f}"],
            ["torque path, relative / %", f"{100 * noise.torque_relative:.2f}"],
            ["torque path, relative, other in other stops / %", f"{100 * noise.torque_lasting:.2f}"],
            ["clearance / rad", with_sigma(contact.clearance_rad, contact.clearance_sigma_rad)],
        ],
    )
