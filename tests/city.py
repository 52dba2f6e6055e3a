"""The beginning of the simulated city drive, and the estimator over it with something changed."""

import functools

import numpy as np

from emb_daemon.calibration.files import shipped_calibration
from emb_daemon.calibration.types import to_parameters
from emb_daemon.offline import estimate, log_of
from emb_daemon.plant.derive import plant_from_calibration
from emb_daemon.plant.scenarios import city_drive, simulate_log

#: Rows: standing released, clamping, holding 7 kN, holding until it is released at `OPENED`; the second clearance.
RELEASED, CLAMPING, HOLDING, BEFORE_RELEASE, OPENED, SECOND_CLEARANCE = 400, 1300, 1500, 2000, 2150, 2600


@functools.cache
def drive(seed: int = 0, seconds: float = 15.0) -> tuple[np.ndarray, np.ndarray]:
    """Samples of a simulated unit, and the true clamp force."""
    calibration = shipped_calibration()
    frames, _ = simulate_log(plant_from_calibration(calibration, seed), city_drive(), seconds, seed=seed)
    log = log_of(frames)
    return log.samples, log.force_N


def estimated(samples: np.ndarray) -> np.ndarray:
    """ESTIMATE rows with the shipped calibration."""
    return estimate(samples, to_parameters(shipped_calibration()))


def changed(change=lambda samples: None, seed: int = 0, seconds: float = 15.0) -> tuple[np.ndarray, np.ndarray]:
    """Estimates and true force of the drive whose samples went through ``change``."""
    samples, force = drive(seed, seconds)
    samples = samples.copy()
    change(samples)
    return estimated(samples), force


def assert_undone(estimates: np.ndarray, force: np.ndarray, seed: int) -> None:
    """From the second clearance of 40 s on: hardly more error than where nothing was changed, and none beyond sigma."""
    unmoved, _ = changed(seed=seed, seconds=40.0)
    second = slice(SECOND_CLEARANCE, None)
    error = (estimates["force"] - force)[second]
    assert np.sqrt(np.mean(error**2)) < np.sqrt(np.mean((unmoved["force"] - force)[second] ** 2)) + 25.0
    assert np.mean(np.abs(error) > 3.0 * np.hypot(estimates["sigma"][second], 25.0)) < 0.01
