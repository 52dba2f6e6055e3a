"""What no effect of the catalogue explains: how much of it there is, and on which signal it depends."""

from dataclasses import dataclass

import numpy as np

#: Evidence needed to say that something is left: mean gain over its standard error, over episodes.
_SURE = 3.5
#: Share of the residual's mean square from which a rest is worth a word.
_LEAST_SHARE = 0.03


@dataclass(frozen=True)
class Rest:
    """Dependence of one channel's residual on one signal.

    Attributes:
        share: of the residual's mean square that smooth functions of the signal explain on left-out episodes.
        rms: the same as RMS in N.
        certainty: mean gain over its standard error over episodes.
    """

    channel: str
    signal: str
    share: float
    rms: float
    certainty: float
    matters: bool


def rests(channel: str, gains: dict[str, np.ndarray], residual: np.ndarray, floor: float) -> list[Rest]:
    """One `Rest` for each signal, strongest first."""
    counted = max(int(np.count_nonzero(residual)), 1)
    total = max(float(residual @ residual), 1e-300)
    result = []
    for signal, gain in gains.items():
        spread = gain.std(ddof=1) / np.sqrt(len(gain)) if len(gain) > 2 else np.inf
        certainty = float(gain.mean() / spread) if spread > 0.0 else 0.0
        share = max(float(gain.sum()) / total, 0.0)
        rms = float(np.sqrt(max(gain.sum(), 0.0) / counted))
        result.append(Rest(channel, signal, share, rms, certainty, False))
    result.sort(key=lambda rest: -rest.share)
    return [
        Rest(
            r.channel,
            r.signal,
            r.share,
            r.rms,
            r.certainty,
            r.share >= _LEAST_SHARE and r.rms >= floor and r.certainty >= _SURE,
        )
        for r in result
    ]
