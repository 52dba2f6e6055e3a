"""How wrong is the force that the daemon predicts while no sample comes?

    python -m studies.predicted LOG --calibration FILE

RMSE (N) beside the reference force by the age of the prediction, over all samples in which the force changes: of the last
force, of the daemon's own prediction, and of a force that goes on to change as it did for so many milliseconds, by which the
daemon's time was chosen.
"""

import argparse
from pathlib import Path

import numpy as np

from emb_daemon.calibration.files import load_calibration
from emb_daemon.calibration.types import to_parameters
from emb_daemon.offline import estimate, load_log
from emb_daemon.offline.score import rmse
from emb_daemon.wire.contract import CYCLE_S

#: Ages of a prediction, and times for which the motor goes on, cycles; change of the force in one from which it counts, N.
_AGES, _GOES_ON, _CHANGES_N = (3, 5, 8, 12, 18, 25), (3, 5, 8, 12, 18), 20.0


def predict_after_each(samples: np.ndarray, parameters: np.void) -> tuple[np.ndarray, np.ndarray]:
    """Force (N) of every SAMPLE, shape (n,), and what would be predicted if no more came at each of `_AGES`, (n, ages)."""
    rows = np.repeat(samples, 1 + len(_AGES))
    ages = np.tile((0, *_AGES), len(samples))
    rows["is_prediction"], rows["age_cycles"] = ages > 0, ages
    force_N = estimate(rows, parameters)["force"].reshape(len(samples), -1)
    return force_N[:, 0], force_N[:, 1:]


def tabulate(force_N: np.ndarray, predicted_N: np.ndarray, reference_N: np.ndarray) -> np.ndarray:
    """RMSE (N) by age (rows): of the last force, of the prediction, and by time for which the force goes on to change."""
    gained = np.diff(force_N, prepend=force_N[0])
    moving = np.flatnonzero(np.abs(gained) > _CHANGES_N)
    moving = moving[moving < len(force_N) - max(_AGES)]

    def errors(age: int, predicted: np.ndarray) -> list[float]:
        going_on = (force_N[moving] + min(age, cycles) * gained[moving] for cycles in _GOES_ON)
        each = (force_N[moving], predicted[moving], *going_on)
        return [rmse(np.maximum(one, 0.0) - reference_N[moving + age]) for one in each]

    return np.array([errors(age, predicted) for age, predicted in zip(_AGES, predicted_N.T, strict=True)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("log", type=Path)
    parser.add_argument("--calibration", type=Path, required=True)
    arguments = parser.parse_args()
    log = load_log(arguments.log)
    force_N, predicted_N = predict_after_each(log.samples, to_parameters(load_calibration(arguments.calibration)))
    print("age, ms", "last", "predicted", *(f"{1e3 * CYCLE_S * cycles:.0f} ms" for cycles in _GOES_ON), sep="\t")
    for age, row in zip(_AGES, tabulate(force_N, predicted_N, log.force_N), strict=True):
        print(f"{1e3 * CYCLE_S * age:.0f}", *(f"{error:.0f}" for error in row), sep="\t")


if __name__ == "__main__":
    main()
