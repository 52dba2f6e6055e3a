"""Orders per motor turn over which a residual varies most."""

import numpy as np

from emb_daemon.calibration.types import to_parameters
from emb_daemon.diagnose.model import Model
from emb_daemon.effects.base import Effect
from emb_daemon.effects.paths import known_delay

#: Bins of motor angle in one period of the highest order of an octave.
_BINS = 8


def strongest_orders(
    model: Model, effect: Effect, channel: str, signals: dict[str, np.ndarray], most: int = 1
) -> tuple[list[float], int]:
    """Orders of ``effect``'s harmonic over which the channel's residual varies most, strongest first; and how many independent
    orders were looked at. ``most`` of them are returned, because logs at distant angles have side lobes nearly as strong as
    the peak."""
    samples = np.concatenate([trial.log.samples for trial in model.bench.trials])
    travel = np.abs(samples["speed"]) * samples["dt"]
    # Ripples follow the motor's true angle: a known delay is taken out.
    late = known_delay(to_parameters(model.bench.calibrated(model.values))["effects"])
    angle = samples["angle"] + late * samples["speed"]
    harmonic, limits = effect.harmonic, effect.parameter(effect.harmonic.order).starts
    if harmonic.whole:
        orders = np.arange(limits[0], limits[1] + 0.5)
    else:
        span = max(np.ptp(angle), 1.0)
        orders = np.arange(max(limits[0], 4.0 * np.pi / span), limits[1], 0.5 * np.pi / span)
    residual = _beside_the_model(model, channel)
    weight = signals[harmonic.grows_with] if harmonic.grows_with else np.ones(len(residual))
    peaks: list[tuple[float, float]] = []
    low = orders[0]
    while low < orders[-1]:
        # One octave at a time: samples over more than a sixth of a period are left out, and bins are an eighth of a period
        # wide.
        high = 2.0 * low
        slow = (travel * high < 1.0) & (residual != 0.0)
        if not slow.any():
            break
        width = 2.0 * np.pi / (_BINS * high)
        power, scanned = _spectrum(angle[slow] - angle.min(), residual[slow], weight[slow], width)
        chosen = orders[(orders >= low) & (orders < high)]
        if harmonic.whole and len(chosen):
            power, scanned = np.interp(chosen, scanned, power), chosen
        inside = (scanned >= max(low, orders[0])) & (scanned < min(high, orders[-1] + 1e-9))
        peaks += _peaks(power[inside], scanned[inside])
        low = high
    return [order for _, order in sorted(peaks, reverse=True)[:most]], len(orders)


def _peaks(power: np.ndarray, orders: np.ndarray) -> list[tuple[float, float]]:
    """(power, order) where the power is above that of both neighbours."""
    beside = np.concatenate([[-np.inf], power, [-np.inf]])
    top = np.flatnonzero((power > 0.0) & (power >= beside[:-2]) & (power > beside[2:]))
    return [(float(power[row]), float(orders[row])) for row in top]


def _beside_the_model(model: Model, channel: str) -> np.ndarray:
    """The part of a residual that no coordinate of the model explains."""
    own, residual = model.movable(channel), model.residual[channel]
    if not own:
        return residual
    table = np.column_stack([model.columns[c] for c in own])
    normal = table.T @ table + np.diag(model.penalty(own, channel) + 1e-12)
    return residual - table @ np.linalg.lstsq(normal, table.T @ residual, rcond=1e-12)[0]


def _spectrum(angle: np.ndarray, residual: np.ndarray, weight: np.ndarray, width: float) -> tuple[np.ndarray, np.ndarray]:
    """Power of the weighted residual by order, over angles binned ``width`` rad wide."""
    bins = (angle / width).astype(np.int64)
    sums, squares = np.bincount(bins, weight * residual), np.bincount(bins, weight**2)
    # A long hold at one angle must not outweigh the strokes.
    typical = np.median(squares[squares > 0.0]) if squares.any() else 1.0
    cap = np.minimum(1.0, typical / np.maximum(squares, typical))
    padded = 1 << int(np.ceil(np.log2(4 * len(sums))))
    power = np.abs(np.fft.rfft(cap * sums, padded)) ** 2 / max(float((cap**2 * squares).sum()), 1e-300)
    return power, 2.0 * np.pi * np.arange(len(power)) / (padded * width)
