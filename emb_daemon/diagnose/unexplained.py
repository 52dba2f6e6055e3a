"""What no effect of the catalogue explains: how much of it there is, and on which signal it depends."""

from dataclasses import dataclass

import numpy as np

#: Evidence needed to say that something is left: mean relative gain over its standard error, over episodes.
_SURE = 2.5
#: Share of the residual's mean square from which a rest is worth a word.
_LEAST_SHARE = 0.05


@dataclass(frozen=True)
class Rest:
    """Dependence of one channel's residual on one signal.

    Attributes:
        share: of the left-out squared error that smooth functions of the signal take away.
        rms: the same as RMS in N.
        certainty: mean relative gain over its standard error; relative, so that one violent stop has one vote.
    """

    channel: str
    signal: str
    share: float
    rms: float
    certainty: float
    matters: bool


def rests(channel: str, gains: dict[str, tuple[np.ndarray, np.ndarray]], samples: int, floor: float) -> list[Rest]:
    """One `Rest` for each signal, strongest first.

    Args:
        gains: by signal, squared error of each left-out episode without and with a smooth function of the signal.
        samples: that the squared errors are summed over.
        floor: RMS (N) from which a rest matters.
    """
    result = []
    for signal, (without, with_) in gains.items():
        gain = without - with_
        relative = gain / (without + without.mean() + 1e-300)
        spread = relative.std(ddof=1) / np.sqrt(len(gain)) if len(gain) > 2 else np.inf
        certainty = float(relative.mean() / spread) if spread > 0.0 else 0.0
        share = max(float(gain.sum() / max(without.sum(), 1e-300)), 0.0)
        rms = float(np.sqrt(max(gain.sum(), 0.0) / max(samples, 1)))
        matters = share >= _LEAST_SHARE and rms >= floor and certainty >= _SURE
        result.append(Rest(channel, signal, share, rms, certainty, matters))
    return sorted(result, key=lambda rest: -rest.share)
