"""What compiling Python costs: the estimator's step beside the same in C, over a simulated drive.

python -m studies.c_twin.compare
"""

import numpy as np

from emb_daemon.bench.logs import difference, medians_s
from emb_daemon.calibration.files import load_calibration
from emb_daemon.calibration.types import to_parameters
from emb_daemon.offline import estimate, log_of
from emb_daemon.plant.derive import plant_from_calibration
from emb_daemon.plant.scenarios import city_drive, simulate_log
from emb_daemon.resources import resource
from studies.c_twin.twin import Twin


def main(seconds: float = 120.0) -> None:
    calibration = load_calibration(resource("config/calibration.yaml"))
    samples = log_of(simulate_log(plant_from_calibration(calibration, 0), city_drive(), seconds)[0]).samples
    parameters, twin = np.atleast_1d(to_parameters(calibration)), Twin()
    off = difference(twin.estimate(samples, parameters), estimate(samples, parameters))
    python_s, c_s = medians_s(lambda: estimate(samples, parameters), lambda: twin.estimate(samples, parameters))
    print(f"compiled by numba {1e6 * python_s / len(samples):.3f} us a step")
    print(f"{twin.version}, -O2: {1e6 * c_s / len(samples):.3f} us")
    print(f"ratio {python_s / c_s:.2f}, largest relative difference of any estimate {off:g}")


if __name__ == "__main__":
    main()
