"""How wrong is a force that is predicted while no sample comes, if the motor is taken to go on as it went for a while?

    python -m studies.predicted LOG --calibration FILE

RMSE (N) beside the reference force, over all samples in which the force changes, by the age of the prediction and by the time
for which the motor is taken to go on; `emb_daemon.estimator.step` takes one of them.
"""

import argparse
from pathlib import Path

import numpy as np

from emb_daemon.calibration.files import load_calibration
from emb_daemon.offline.score import rmse
from emb_daemon.wire.contract import CYCLE_S
from studies.silent import run_log

#: Ages of a prediction, and times for which the motor goes on, cycles; change of the force in one from which it counts, N.
_AGES, _GOES_ON, _CHANGES_N = (3, 5, 8, 12, 18, 25), (0, 3, 5, 8, 12, 18), 20.0


def tabulate(force_N: np.ndarray, reference_N: np.ndarray) -> np.ndarray:
    """RMSE (N) by age (rows) and time for which the motor goes on (columns), of estimates that come cycle by cycle."""
    gained = np.diff(force_N, prepend=force_N[0])
    moving = np.flatnonzero(np.abs(gained) > _CHANGES_N)
    moving = moving[moving < len(force_N) - max(_AGES)]

    def error(age: int, cycles: int) -> float:
        predicted = np.maximum(force_N[moving] + min(age, cycles) * gained[moving], 0.0)
        return rmse(predicted - reference_N[moving + age])

    return np.array([[error(age, cycles) for cycles in _GOES_ON] for age in _AGES])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("log", type=Path)
    parser.add_argument("--calibration", type=Path, required=True)
    arguments = parser.parse_args()
    _, estimates, reference_N = run_log(arguments.log, load_calibration(arguments.calibration))
    print("age, ms", *(f"{1e3 * CYCLE_S * cycles:.0f} ms" for cycles in _GOES_ON), sep="\t")
    for age, row in zip(_AGES, tabulate(estimates["force"], reference_N), strict=True):
        print(f"{1e3 * CYCLE_S * age:.0f}", *(f"{error:.0f}" for error in row), sep="\t")


if __name__ == "__main__":
    main()
