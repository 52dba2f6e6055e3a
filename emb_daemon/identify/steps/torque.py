"""Torque path: torque constant, lumped inertia and friction from current, motion and the reference force.

Thesis 2.4 and 4.2, T_m = gamma F + J dw/dt + (mu F + eta) s, solved for the noisy current:

    iq = (gamma / K_m) F + (J / K_m) dw/dt + (eta / K_m) s + (mu / K_m) s F

gamma is geometry, so that the first coefficient gives the torque constant. The speed's noise would pull the inertia down
(attenuation); the second difference of the angle, whose noise is independent of it, serves as instrument.
"""

from dataclasses import dataclass, field

import numpy as np

from emb_daemon.calibration.parameters import INERTIA, LOAD_FRICTION, OFFSET_FRICTION, PRESLIDING_ANGLE, TORQUE_CONSTANT, moved
from emb_daemon.calibration.types import Calibration, to_parameters
from emb_daemon.identify.campaign import NEED_INTEGRATED, Campaign
from emb_daemon.identify.campaign_file import Datasheet
from emb_daemon.identify.dynamics import EPISODE, Pads
from emb_daemon.identify.steps import Step
from emb_daemon.identify.text import stem, with_sigma
from emb_daemon.models.gear import all_through_gear
from emb_daemon.offline import Log
from emb_daemon.offline.fit import jackknife, valley
from emb_daemon.offline.run import held, run_paths, run_step
from emb_daemon.offline.score import rmse
from emb_daemon.report.figures import MODEL, REFERENCE, Panel, Trace, time_figure
from emb_daemon.report.page import Page
from emb_daemon.wire.contract import CYCLE_S

#: Parameters in the order of every covariance, with their least physical value.
KEYS = {TORQUE_CONSTANT: 0.0, INERTIA: 0.0, OFFSET_FRICTION: 0.0, LOAD_FRICTION: 0.0, PRESLIDING_ANGLE: 1e-6}
#: Variance of the friction state up to which it counts as known.
_KNOWN = 0.01
#: Step of the derivative by the logarithm of the presliding angle.
_STEP = 1e-2
#: Motor angle within which the friction of rolling gears turns over, rad, before a log has shown it: median, and standard
#: deviation of its logarithm (rolling elements slide after micrometres to tens of them: Armstrong-Helouvry et al., Automatica
#: 30(7), 1994, sec. 2.1, over a screw's micrometres per hundredth of a radian).
_USUAL_PRESLIDING, _PRESLIDING_SPREAD = 0.03, 1.0
#: Standard deviation of a current before a log has shown it, A.
UNKNOWN_CURRENT_A = 1.0
_NEED_TRAINING = "clamp and release with the reference force, at full frame rate"


@dataclass(frozen=True)
class TorqueFit:
    """Parameters of the torque path. ``values``: by the calibration's keys (`KEYS`); ``covariance``: in their order;
    ``residuals``: unexplained current by log path: (row of the log, A)."""

    values: dict[str, float]
    covariance: np.ndarray
    residuals: dict[str, tuple[np.ndarray, np.ndarray]] = field(repr=False)

    @property
    def sigmas(self) -> dict[str, float]:
        return dict(zip(KEYS, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))

    @property
    def rms_A(self) -> float:
        """RMS of the unexplained current; NaN if none was measured."""
        left = np.concatenate([residual for _, residual in self.residuals.values()])
        return rmse(left) if len(left) else float("nan")

    def physical(self) -> dict[str, float]:
        """Values for a calibration; those that noise moved below the physical limit are set to it."""
        return {key: max(self.values[key], least) for key, least in KEYS.items()}

    def friction(self) -> dict[str, float]:
        """The values that wear changes."""
        return {
            key: value for key, value in self.physical().items() if key in (OFFSET_FRICTION, LOAD_FRICTION, PRESLIDING_ANGLE)
        }


@dataclass(frozen=True, kw_only=True)
class TorqueStep(Step):
    """Motor and friction, fitted to ``logs``: all random ones of the campaign's pads, or drives if there are none. ``gears``:
    (training log, fit) for each state of wear of the gear."""

    fit: TorqueFit
    logs: list[Log]
    gears: list[tuple[str, TorqueFit]]

    def gear_wear(self) -> float:
        """Spread of the load friction over the states of wear that were measured, m/rad."""
        worn = [fit.values[LOAD_FRICTION] for _, fit in self.gears]
        return float(np.std(worn, ddof=1)) if len(worn) > 1 else 0.0


def identify(campaign: Campaign, pads: list[Pads], nominal: Calibration) -> TorqueStep:
    """Torque path from all logs with motor current, and each gear's from its training log; without any current, the
    datasheet's values, with their wide standard deviations."""
    sheet = campaign.datasheet
    logs = [log for own in pads for log in own.logs]
    if not any(own.random for own in pads):
        # Slow motion alone shows friction at one speed only.
        driven = (campaign.load(pair.fit, "integrated.fit", NEED_INTEGRATED) for pair in campaign.file.integrated)
        logs += [log for log in driven if log is not None]
    logs = [log for log in logs if log.samples["has_current"].any()]
    if not logs:
        campaign.fault(
            "torque: no log holds motor current, so that torque constant and inertia are the datasheet's, friction is unknown "
            f"and a force from a current is off by as much as itself; needed: the motor's current in a log of {_NEED_TRAINING}"
        )
        logs = [pads[len(pads) // 2].logs[-1]]
    found = fit_torque(logs, nominal, sheet)
    for key in (TORQUE_CONSTANT, INERTIA):
        campaign.compare_with_datasheet(key, found.values[key])
    gears = []
    for entry in campaign.file.gear_wear:
        log = campaign.load_motion(entry.training, "gear_wear", _NEED_TRAINING, reversals=(0.0, 100.0))
        if log is not None:
            gears.append((entry.training, fit_torque([log], nominal, sheet)))
    return TorqueStep(values=found.physical(), sigmas=found.sigmas, fit=found, logs=logs, gears=gears)


class _Regression:
    """One log's part of the regression."""

    def __init__(self, log: Log, calibration: Calibration):
        samples = log.samples
        angle, speed = samples["angle"], samples["speed"]
        rows = np.arange(2, len(samples) - 1)
        full_rate = np.all([np.abs(samples["dt"][rows + k] - CYCLE_S) < 1e-6 for k in (-1, 0, 1)], axis=0)
        known = np.isfinite(log.force_N[rows]) & np.isfinite(log.force_N[rows - 1]) & samples["has_current"][rows]
        self.log, self.calibration = log, calibration
        self.rows = r = rows[full_rate & known]
        self.force = 0.5 * (log.force_N[r] + log.force_N[r - 1])
        # Load of the reduction, as force on a constant gear.
        motor = calibration.motor
        turned, slope = all_through_gear(motor.gear(), 0.5 * (angle[r] + angle[r - 1]) - angle[0])
        spring = motor.release_spring_N_per_m * motor.gear_gain_m_per_rad * np.maximum(turned, 0.0)
        self.load = (self.force + spring) * slope
        self.current = samples["current_q"][r]
        self.acceleration = (speed[r] - speed[r - 1]) / CYCLE_S
        self.of_angle = (angle[r + 1] - angle[r] - angle[r - 1] + angle[r - 2]) / (2.0 * CYCLE_S**2)

    def matrices(self, presliding_angle: float):
        """Regressors (n, 4) and instruments (n, 4) by the estimator's own model, and rows where the friction state is known;
        in others it is the state's mean, zero if nothing is known."""
        parameters = to_parameters(moved(self.calibration, {PRESLIDING_ANGLE: presliding_angle}))
        paths = run_paths(self.log.samples, parameters)[self.rows]
        s = paths["friction_mean"]
        regressors = np.column_stack([self.load, self.acceleration, s, s * self.load])
        instruments = regressors.copy()
        instruments[:, 1] = self.of_angle
        return regressors, instruments, paths["friction_variance"] < _KNOWN


def fit_torque(logs: list[Log], calibration: Calibration, sheet: Datasheet) -> TorqueFit:
    """Instrumental-variable regression, and a one-dimensional search for the presliding angle.

    Of the calibration only the gear is used. The datasheet's torque constant and inertia are priors; the presliding angle is
    not known better than its resolver count. What logs do not excite keeps a wide prior, and a large sigma."""
    parts = [_Regression(log, calibration) for log in logs]
    nominal, precision = _wide_prior(sheet)

    def solve(presliding):
        matrices = [part.matrices(presliding) for part in parts]
        left = precision[:4, :4] + sum(z[use].T @ x[use] for x, z, use in matrices)
        right = precision[:4, :4] @ nominal
        right += sum(z[use].T @ part.current[use] for part, (_, z, use) in zip(parts, matrices, strict=True))
        solution = np.linalg.solve(left, right)
        residuals = [part.current - x @ solution for part, (x, _, _) in zip(parts, matrices, strict=True)]
        return solution, matrices, residuals

    def cost(logarithm):
        # Over all rows: large angles leave the friction state of most rows unknown, and must not be rewarded for leaving them
        # out.
        left_over = np.concatenate(solve(np.exp(logarithm))[2])
        return float(left_over @ left_over + precision[4, 4] * (logarithm - np.log(_USUAL_PRESLIDING)) ** 2)

    # Angles below a resolver count cannot be identified.
    presliding = float(np.exp(valley(cost, np.log(np.geomspace(1e-3, 1.0, 13)), xatol=1e-3)))
    solution, matrices, residuals = solve(presliding)
    residuals = [residual[use] for residual, (_, _, use) in zip(residuals, matrices, strict=True)]
    covariance = _covariance(parts, matrices, residuals, solution, presliding, precision)
    physical, covariance = _physical(solution, presliding, covariance, sheet)
    physical, covariance = _with_priors(physical, covariance, sheet)
    # The priors of the others move it along a slope that is valid only nearby.
    physical[4] = np.clip(physical[4], 0.5 * presliding, 2.0 * presliding)
    left_over = {
        str(part.log.path): (part.rows[use], residual)
        for part, (_, _, use), residual in zip(parts, matrices, residuals, strict=True)
    }
    return TorqueFit(dict(zip(KEYS, physical.tolist(), strict=True)), covariance, left_over)


def _wide_prior(sheet: Datasheet) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients (4,) by the datasheet, and inverse covariance (5, 5) of them and the presliding angle's logarithm for a
    current known to `UNKNOWN_CURRENT_A`: torque constant and inertia to a third, friction up to its load."""
    actuator = sheet.actuator
    constant, gear = actuator.motor_torque_constant_Nm_per_A, actuator.gear_gain_m_per_rad
    nominal = np.array([gear, actuator.lumped_inertia_kg_m2, 0.0, 0.0]) / constant
    sigma = np.array(
        [*(nominal[:2] / 3.0), gear * actuator.rated_clamp_force_N / constant, gear / constant, _PRESLIDING_SPREAD]
    )
    return nominal, np.diag((UNKNOWN_CURRENT_A / sigma) ** 2)


def _covariance(parts, matrices, residuals, solution, presliding, precision) -> np.ndarray:
    """Of the four coefficients and the logarithm of the presliding angle, jackknife over seconds."""
    normals, scores = [], []
    for part, (regressors, instruments, use), residual in zip(parts, matrices, residuals, strict=True):
        moved = part.matrices(presliding * np.exp(_STEP))[0]
        sensitivity = (((moved - regressors) @ solution) / _STEP)[use, None]
        x, z = np.hstack([regressors[use], sensitivity]), np.hstack([instruments[use], sensitivity])
        for start in range(0, len(residual), EPISODE):
            rows = slice(start, start + EPISODE)
            normals.append(z[rows].T @ x[rows])
            scores.append(z[rows].T @ residual[rows])
    return jackknife(np.array(normals), np.array(scores), precision) if normals else np.linalg.inv(precision)


def _physical(solution, presliding, covariance, sheet: Datasheet) -> tuple[np.ndarray, np.ndarray]:
    """`KEYS` from coefficients b: K_m = gamma / b0, J = b1 K_m, eta = b2 K_m, mu = b3 K_m."""
    constant = sheet.actuator.gear_gain_m_per_rad / solution[0]
    change = np.diag([-constant / solution[0], constant, constant, constant, presliding])
    change[1:4, 0] = -solution[1:] * constant / solution[0]
    covariance = change @ covariance @ change.T
    # The play that suppresses flicker, and the resolver's step, shift each reversal by about a count.
    covariance[4, 4] += (2.0 * sheet.resolver.count_rad) ** 2
    return np.array([constant, *(solution[1:] * constant), presliding]), covariance


def _with_priors(values, covariance, sheet: Datasheet) -> tuple[np.ndarray, np.ndarray]:
    """Values and covariance combined with the datasheet's torque constant and inertia, by its tolerances."""
    stated = np.array([sheet.stated(key) for key in (TORQUE_CONSTANT, INERTIA)])
    sigma = stated[:, 0] * stated[:, 1] / 2.0
    seen = np.eye(2, len(KEYS))
    gain = covariance @ seen.T @ np.linalg.inv(covariance[:2, :2] + np.diag(sigma**2))
    return values + gain @ (stated[:, 0] - values[:2]), covariance - gain @ seen @ covariance


@dataclass(frozen=True)
class Unexplained:
    """Unexplained current of a fit on any log, one entry per cycle."""

    found: TorqueFit
    rows: np.ndarray  #: of the log
    current_A: np.ndarray  #: unexplained
    friction_mean: np.ndarray  #: friction state, -1 to 1
    force_N: np.ndarray  #: mean load of the reduction: clamp force and release spring, times the gear's slope over its mean


def unexplained_current(log: Log, found: TorqueFit, calibration: Calibration, hot: bool = False) -> Unexplained:
    """Current of a log that the estimator's torque path leaves: a fit's parameters, the calibration's gear and effects; of
    ``hot`` pads, whose heat and brake torque effects may follow, by the whole step."""
    part, parameters = _Regression(log, calibration), to_parameters(moved(calibration, found.physical()))
    paths = run_paths(log.samples, parameters)[part.rows]
    balance = run_step(log.samples, held(parameters))[part.rows] if hot else paths
    residual = (balance["torque"] - balance["leverage"] * part.force) / found.values[TORQUE_CONSTANT]
    use = (paths["friction_variance"] < _KNOWN) & np.isfinite(residual)
    return Unexplained(found, part.rows[use], residual[use], paths["friction_mean"][use], part.load[use])


_ROWS = (
    ("torque constant K_m / mN m/A", 1e3),
    ("lumped inertia J / 10⁻⁴ kg m²", 1e4),
    ("Coulomb friction η / mN m", 1e3),
    ("load friction μ / µm/rad", 1e6),
    ("presliding angle / mrad", 1e3),
)


def section(page: Page, step: TorqueStep) -> None:
    part = page.section(
        "Torque balance",
        "Current explained by force, acceleration and friction (thesis 2.4, 4.1, 4.2). The current is noisy and is what is "
        "explained; the angle's second difference instruments the noisy speed. Friction turns over within the presliding "
        "angle instead of jumping with the sign. The datasheet's torque constant and inertia are priors.",
    )
    fits = [step.fit, *(found for _, found in step.gears)]
    rows = [
        [title, *(with_sigma(found.values[key], found.sigmas[key], factor) for found in fits)]
        for key, (title, factor) in zip(KEYS, _ROWS, strict=True)
    ]
    rows.append(["unexplained current / A", *(f"{found.rms_A:.3f}" for found in fits)])
    gears = [stem(name) for name, _ in step.gears]
    part.table(["parameter", "all pads", *gears], rows, "Gears: each state of wear identified from its own training log.")
    log = step.logs[len(step.logs) // 2]
    current, time = log.samples["current_q"], log.time_s
    rows_of, residual = step.fit.residuals[str(log.path)]
    explained = Trace("explained", time[rows_of], current[rows_of] - residual, MODEL)
    part.figure(
        time_figure(
            [
                Panel("Motor current", "A", [Trace("measured", time, current, REFERENCE), explained]),
                Panel("Residual", "A", [Trace("unexplained", time[rows_of], residual, MODEL)], 200),
            ]
        ),
        f"{log.path.name}",
    )
