"""Frequency response of the clamp force over the static force of the same angle (thesis 3.3.1)."""

from dataclasses import dataclass

import numpy as np

from emb_daemon.offline import Log
from emb_daemon.wire.contract import CYCLE_S

#: Harmonics fitted beside the fundamental: the curve is not straight.
_HARMONICS = 4


@dataclass(frozen=True)
class Response:
    """Frequency response at several frequencies and its first-order fit."""

    frequency_Hz: np.ndarray  #: shape (n,)
    #: ``measured`` and ``model``: complex F / F_s, shape (n,); the model's is that of the identified dynamics, which saw none
    #: of this.
    measured: np.ndarray
    model: np.ndarray
    #: ``gain`` and ``gain_sigma``: K of the first-order fit.
    gain: float
    gain_sigma: float
    #: ``time_constant_s`` and ``time_constant_sigma_s``: tau of the first-order fit.
    time_constant_s: float
    time_constant_sigma_s: float
    fitted: np.ndarray  #: |F / F_s| of the first-order fit, shape (n,)


def phasor(signal: np.ndarray, time_s: np.ndarray, frequency_Hz: float) -> complex:
    """Complex amplitude of ``signal`` at a frequency, harmonics and mean fitted beside it."""
    angle = 2.0 * np.pi * frequency_Hz * time_s
    columns = [np.ones(len(angle))]
    for order in range(1, _HARMONICS + 1):
        columns += [np.cos(order * angle), np.sin(order * angle)]
    solution = np.linalg.lstsq(np.column_stack(columns), signal, rcond=None)[0]
    return complex(solution[1], -solution[2])


def steady_rows(log: Log, frequency_Hz: float) -> np.ndarray | None:
    """Rows of whole periods in which the angle is the stated sinusoid; None if there is not one such period.

    Approach and return around the sinusoid do not follow it and are found by their misfit."""
    angle, time = log.samples["angle"], log.time_s
    period = 1.0 / frequency_Hz
    length = round(period / CYCLE_S)
    if len(angle) < length + 1:
        return None
    good = []
    for start in range(0, len(angle) - length + 1, max(length // 4, 1)):
        rows = np.arange(start, start + length)
        phase = 2.0 * np.pi * frequency_Hz * time[rows]
        columns = np.column_stack([np.ones(length), np.cos(phase), np.sin(phase)])
        misfit = angle[rows] - columns @ np.linalg.lstsq(columns, angle[rows], rcond=None)[0]
        swing = np.ptp(angle[rows])
        if swing > 0.1 * np.ptp(angle) and np.std(misfit) < 0.02 * swing:
            good.append(start)
    if not good:
        return None
    # One period more to settle, where there is one to spare.
    first = good[0] + (length if good[-1] - good[0] >= 2 * length else 0)
    periods = max((good[-1] + length - first) // length, 1)
    return np.arange(first, first + periods * length)


def fit_first_order(frequency_Hz: np.ndarray, magnitude: np.ndarray) -> tuple[float, float, float, float]:
    """1 / |G|^2 = (4 pi^2 tau^2 / K^2) f^2 + 1 / K^2 by least squares. Returns (K, its standard deviation, tau in s, its
    standard deviation)."""
    design = np.column_stack([frequency_Hz**2, np.ones(len(frequency_Hz))])
    inverse = 1.0 / magnitude**2
    solution = np.linalg.lstsq(design, inverse, rcond=None)[0]
    residual = inverse - design @ solution
    covariance = np.linalg.inv(design.T @ design) * float(residual @ residual) / max(len(inverse) - 2, 1)
    a, b = max(solution[0], 1e-12), solution[1]
    gain, time = 1.0 / np.sqrt(b), np.sqrt(a / b) / (2.0 * np.pi)
    by_gain = np.array([0.0, -0.5 * gain / b])
    by_time = 0.5 * time * np.array([1.0 / a, -1.0 / b])
    return gain, float(np.sqrt(by_gain @ covariance @ by_gain)), time, float(np.sqrt(by_time @ covariance @ by_time))


def response(trials: list[tuple[Log, float, np.ndarray, np.ndarray]]) -> tuple[Response | None, list[str]]:
    """Frequency response over logs of (log, frequency in Hz, static force in N, force of the identified model in N).

    Returns:
        The response, None from fewer than three frequencies, and a line for each log in which the angle is not that sinusoid.
    """
    rows, faults = [], []
    for log, frequency, static, model in trials:
        steady = steady_rows(log, frequency)
        if steady is None or not np.isfinite(log.force_N[steady]).all():
            faults.append(
                f"frequency_response: {log.path}: the motor angle is no sinusoid of {frequency:g} Hz; "
                "needed: at least one whole period of it with the reference force; left out"
            )
            continue
        time = log.time_s[steady]
        drive = phasor(static[steady], time, frequency)
        rows.append(
            (frequency, phasor(log.force_N[steady], time, frequency) / drive, phasor(model[steady], time, frequency) / drive)
        )
    if len(rows) < 3:
        faults.append(f"frequency_response: {len(rows)} usable logs; needed: at least three frequencies; step left out")
        return None, faults
    rows.sort(key=lambda row: row[0])
    frequencies = np.array([row[0] for row in rows])
    measured = np.array([row[1] for row in rows])
    gain, gain_sigma, time, time_sigma = fit_first_order(frequencies, np.abs(measured))
    fitted = gain / np.sqrt(1.0 + (2.0 * np.pi * time * frequencies) ** 2)
    return Response(
        frequencies, measured, np.array([row[2] for row in rows]), gain, gain_sigma, time, time_sigma, fitted
    ), faults
