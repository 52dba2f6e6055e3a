"""An effect of one's own, tried on a log before it becomes a file in emb_daemon/effects.

Suspicion: the caliper warms up and widens, so the pads touch later than the model believes. The term is one line, the
regressor is its derivative, and what it explains is judged on the half of the log that did not fit it.

python examples/own_effect.py LOG
"""

import sys

import numpy as np

import emb_daemon
from emb_daemon.calibration.types import curve_at


def caliper_growth(metres_per_kelvin: float, warming_K: np.ndarray) -> np.ndarray:
    """How much wider the caliper is than when it was cold, m; exactly zero at a zero parameter."""
    return metres_per_kelvin * warming_K


def main(path: str) -> None:
    log = emb_daemon.load_log(path)
    calibration = emb_daemon.shipped_calibration()
    estimates = emb_daemon.run(log, calibration)
    known = np.isfinite(log.force_N) & log.samples["has_thermocouple"] & (log.force_N > 200.0)
    residual = (log.force_N - estimates["stiffness_force"])[known]

    # What a metre of pad travel is worth in newtons, from the slope of the identified curve: a wider caliper takes that away.
    curve = [*reversed(curve_at(calibration.stiffness.curves, calibration.pad_thickness_mm)), 0.0]
    x = np.maximum(log.samples["angle"] - estimates["contact_angle"], 0.0)
    newtons_per_metre = np.polyval(np.polyder(curve), x) / calibration.motor.gear_gain_m_per_rad
    regressor = -(newtons_per_metre * caliper_growth(1.0, log.samples["caliper"] - np.nanmin(log.samples["caliper"])))[known]
    usable = np.isfinite(regressor)
    residual, regressor = residual[usable], regressor[usable]

    half = len(residual) // 2
    parameter = float(regressor[:half] @ residual[:half] / max(regressor[:half] @ regressor[:half], 1e-30))
    before = np.sqrt(np.mean(residual[half:] ** 2))
    after = np.sqrt(np.mean((residual[half:] - parameter * regressor[half:]) ** 2))
    print(f"caliper growth {1e6 * parameter:.3f} µm/K; RMSE on the other half {before:.1f} N -> {after:.1f} N")
    if after < 0.9 * before:
        print("it explains something, or is the shadow of what does: `emb-daemon diagnose` compares it with the catalogue")
    else:
        print("it explains nothing here: not worth a file of its own")


if __name__ == "__main__":
    main(*sys.argv[1:])
