"""Torque path: torque constant, lumped inertia and friction from current, motion and the reference force.

Thesis 2.4 and 4.2, T_m = gamma F + J dw/dt + (mu F + eta) s, turned round so that the noisy current is what is explained:

    iq = (gamma / K_m) F + (J / K_m) dw/dt + (eta / K_m) s + (mu / K_m) s F

gamma is geometry, so that the first coefficient gives the torque constant. The speed's noise would pull the inertia down
(attenuation); the second difference of the angle, whose noise is independent of it, serves as instrument.
"""

from dataclasses import dataclass, field

import numpy as np

from emb_daemon.estimator.paths import FLICKER_RAD
from emb_daemon.identify.fitting import CLUSTER, clustered_covariance
from emb_daemon.jit import njit
from emb_daemon.models.torque import friction_state, slid_angle
from emb_daemon.offline import Log
from emb_daemon.wire.contract import CYCLE_S

#: Presliding angle that stands for the thesis's sign function, rad.
SIGN = 1e-6
#: Variance of the friction state up to which it counts as known.
_KNOWN = 0.01


@njit
def _friction_means(angle, presliding_angle, flicker, mean, variance):
    state, spread, slid = 0.0, 1.0, angle[0]
    for row in range(1, len(angle)):
        before, slid = slid, slid_angle(slid, angle[row], flicker)
        state, mean[row], spread = friction_state(state, spread, slid - before, presliding_angle, 0.0, CYCLE_S)
        variance[row] = spread


def friction_means(angle: np.ndarray, presliding_angle: float, flicker: float = FLICKER_RAD) -> tuple[np.ndarray, np.ndarray]:
    """Mean friction state over each cycle and its variance, by the estimator's own model."""
    mean, variance = np.zeros(len(angle)), np.ones(len(angle))
    _friction_means(angle, presliding_angle, flicker, mean, variance)
    return mean, variance


@dataclass(frozen=True)
class TorqueFit:
    """Parameters of the torque path.

    Attributes:
        covariance: of (torque constant, inertia, offset friction, load friction, presliding angle), shape (5, 5).
        rms_A: of the current that stays unexplained.
        residuals: unexplained current by log path: (row of the log, A).
    """

    torque_constant: float
    inertia: float
    offset_friction: float
    load_friction: float
    presliding_angle: float
    covariance: np.ndarray
    rms_A: float
    residuals: dict[str, tuple[np.ndarray, np.ndarray]] = field(repr=False)

    NAMES = ("torque_constant_Nm_per_A", "inertia_kg_m2", "offset_Nm", "load_m_per_rad", "presliding_angle_rad")

    def values(self) -> dict[str, float]:
        return dict(
            zip(
                self.NAMES,
                (self.torque_constant, self.inertia, self.offset_friction, self.load_friction, self.presliding_angle),
                strict=True,
            )
        )

    def sigmas(self) -> dict[str, float]:
        return dict(zip(self.NAMES, np.sqrt(np.diag(self.covariance)), strict=True))


class _Regression:
    """One log's part of the regression."""

    def __init__(self, log: Log, sign_model: bool):
        samples = log.samples
        angle, speed = samples["angle"], samples["speed"]
        rows = np.arange(2, len(samples) - 1)
        full_rate = np.all([np.abs(samples["dt"][rows + k] - CYCLE_S) < 1e-6 for k in (-1, 0, 1)], axis=0)
        known = np.isfinite(log.force_N[rows]) & np.isfinite(log.force_N[rows - 1]) & samples["has_current"][rows]
        self.rows = rows[full_rate & known]
        self.angle = angle
        self.path = str(log.path)
        # The thesis takes the sign of every angle difference.
        self.flicker = 0.0 if sign_model else FLICKER_RAD
        r = self.rows
        self.force = 0.5 * (log.force_N[r] + log.force_N[r - 1])
        self.current = samples["current_q"][r]
        of_angle = (angle[r + 1] - angle[r] - angle[r - 1] + angle[r - 2]) / (2.0 * CYCLE_S**2)
        if sign_model:
            self.acceleration = self.instrument = (angle[r] - 2.0 * angle[r - 1] + angle[r - 2]) / CYCLE_S**2
        else:
            self.acceleration, self.instrument = (speed[r] - speed[r - 1]) / CYCLE_S, of_angle

    def matrices(self, presliding_angle: float):
        """Regressors (n, 4), instruments (n, 4), rows where the friction state is known."""
        mean, variance = friction_means(self.angle, presliding_angle, self.flicker)
        s = mean[self.rows]
        regressors = np.column_stack([self.force, self.acceleration, s, s * self.force])
        instruments = regressors.copy()
        instruments[:, 1] = self.instrument
        return regressors, instruments, variance[self.rows] < _KNOWN


def fit_torque(logs: list[Log], gear_gain: float, resolver_count: float, *, sign_model: bool = False) -> TorqueFit:
    """Instrumental-variable regression with the presliding angle sought in one dimension.

    Args:
        gear_gain: clamp travel per motor angle, m/rad.
        resolver_count: smallest step of the motor angle, rad; no turning over is known better than that.
        sign_model: the thesis's form: sign of the angle difference for friction, acceleration by second difference,
            ordinary least squares.
    """
    from scipy.optimize import minimize_scalar

    parts = [_Regression(log, sign_model) for log in logs]

    def solve(presliding_angle):
        matrices = [part.matrices(presliding_angle) for part in parts]
        left, right = np.zeros((4, 4)), np.zeros(4)
        for part, (regressors, instruments, use) in zip(parts, matrices, strict=True):
            left += instruments[use].T @ regressors[use]
            right += instruments[use].T @ part.current[use]
        solution = np.linalg.solve(left, right)
        residuals = [
            part.current[use] - regressors[use] @ solution for part, (regressors, _, use) in zip(parts, matrices, strict=True)
        ]
        return solution, residuals, matrices

    def cost(logarithm):
        return float(np.mean(np.concatenate(solve(np.exp(logarithm))[1]) ** 2))

    if sign_model:
        presliding = SIGN
    else:
        # The grid finds the valley; below a resolver count the angle says nothing.
        grid = np.log(np.geomspace(1e-3, 1.0, 13))
        best = int(np.argmin([cost(g) for g in grid]))
        bounds = (grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)])
        presliding = float(np.exp(minimize_scalar(cost, bounds=bounds, method="bounded", options={"xatol": 1e-3}).x))
    solution, residuals, matrices = solve(presliding)

    step = 1e-2
    normal, scores = np.zeros((5, 5)), []
    for part, (regressors, instruments, use), residual in zip(parts, matrices, residuals, strict=True):
        if sign_model:
            sensitivity = np.zeros((len(residual), 1))
        else:
            moved = part.matrices(presliding * np.exp(step))[0]
            sensitivity = (((moved - regressors) @ solution) / step)[use, None]
        x, z = np.hstack([regressors[use], sensitivity]), np.hstack([instruments[use], sensitivity])
        normal += z.T @ x
        scores.append(np.add.reduceat(z * residual[:, None], np.arange(0, len(residual), CLUSTER), axis=0))
    free = np.array([True, True, True, True, not sign_model])
    covariance = clustered_covariance(normal, np.concatenate(scores), free)
    constant = gear_gain / solution[0]
    # From the coefficients b and log presliding angle to K_m = gamma / b0, J = b1 K_m, eta = b2 K_m, mu = b3 K_m.
    change = np.zeros((5, 5))
    change[0, 0] = -constant / solution[0]
    for index in (1, 2, 3):
        change[index, 0] = -solution[index] * constant / solution[0]
        change[index, index] = constant
    change[4, 4] = presliding
    covariance = change @ covariance @ change.T
    # The play against flicker and the reading's own step shift each reversal by about a count.
    covariance[4, 4] += 0.0 if sign_model else (2.0 * resolver_count) ** 2
    return TorqueFit(
        float(constant),
        float(solution[1] * constant),
        float(solution[2] * constant),
        float(solution[3] * constant),
        presliding,
        covariance,
        float(np.sqrt(np.mean(np.concatenate(residuals) ** 2))),
        {
            part.path: (part.rows[use], residual)
            for part, (_, _, use), residual in zip(parts, matrices, residuals, strict=True)
        },
    )


def unexplained_current(log: Log, fit: TorqueFit, gear_gain: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """What a fit leaves on a log that it need not have seen.

    Returns:
        (rows of the log, current in A left unexplained, mean friction state, mean force in N), one entry per cycle.
    """
    part = _Regression(log, fit.presliding_angle <= SIGN)
    regressors, _, use = part.matrices(fit.presliding_angle)
    coefficients = np.array([gear_gain, fit.inertia, fit.offset_friction, fit.load_friction]) / fit.torque_constant
    residual = part.current - regressors @ coefficients
    return part.rows[use], residual[use], regressors[use, 2], part.force[use]
