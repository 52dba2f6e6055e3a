"""Plain least squares beside a diagnosis: what a line through the same logs leaves, without models, priors or tests.

Only of machines that clamp nothing, whose torque path is judged alone: the load over current, offset, Coulomb and viscous
friction; where the current at a given load is judged, the current over load, offset, both frictions and acceleration.
"""

import numpy as np

from emb_daemon.diagnose.residuals import Bench, Trial
from emb_daemon.offline.score import rmse


def plain_left(fitted: Bench, kept: np.ndarray, judged: Bench, asked: np.ndarray) -> np.ndarray:
    """Errors (N) of a plain fit at those samples of ``judged`` that are ``asked`` for, mask (m,); 0 at others.

    It is fitted to those samples of ``fitted`` that are ``kept``, mask (n,). Both are in the unit of their torque residual,
    and may be the same."""
    columns, wanted = _table(fitted)
    scale = np.linalg.norm(columns[kept], axis=0)
    scale[scale == 0.0] = 1.0
    found = np.linalg.lstsq(columns[kept] / scale, wanted[kept])[0] / scale
    there, measured = _table(judged)
    return np.where(asked, measured - there @ found, 0.0)


def plain_rms(left_N: np.ndarray) -> float:
    """RMS (N) of errors where there are some."""
    return rmse(left_N[left_N != 0.0])


def _table(bench: Bench) -> tuple[np.ndarray, np.ndarray]:
    """Regressors and what they are to explain, N, over the samples of all logs: shapes (n, k) and (n,)."""
    parts = [_of_log(bench, trial) for trial in bench.trials]
    return np.concatenate([part[0] for part in parts]), np.concatenate([part[1] for part in parts])


def _of_log(bench: Bench, trial: Trial) -> tuple[np.ndarray, np.ndarray]:
    samples, load_N = trial.log.samples, np.nan_to_num(trial.force_N)
    # As the torque path is judged: by the mean over the cycle before the sample.
    load_N[1:] = 0.5 * (load_N[1:] + load_N[:-1])
    speed, current_N = samples["speed"].astype(float), samples["current_q"] * bench.newton_per_ampere
    way = np.where(trial.stands, 0.0, np.sign(speed))
    rest = [np.ones(len(speed)), way, speed]
    if bench.load_follows:
        return np.column_stack([current_N, *rest]), load_N
    return np.column_stack([load_N, *rest, np.gradient(speed, trial.log.time_s)]), current_N
