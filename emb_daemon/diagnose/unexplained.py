"""What no effect of the catalogue explains: how much of it there is, and on which signal it depends."""

from dataclasses import dataclass

import numpy as np

from emb_daemon.calibration.types import Calibration
from emb_daemon.offline.score import rmse
from emb_daemon.wire.contract import CYCLE_S

#: Evidence needed to say that something is left: mean relative gain over its standard error, over episodes.
_SURE = 2.5
#: Share of the residual's mean square from which a dependence is reported.
_LEAST_SHARE = 0.05
#: Residual over what the calibration achieved on its own data from which something is left: its figures scatter by a quarter
#: from log to log and pad to pad, units by less. A dependence that adds less to what noise leaves of the means it is seen in
#: is within that scatter.
CLEARLY, _SCATTER = 1.5, 1.25
#: The same of one episode: the largest of forty that scatter by a quarter is 1.6 times their mean, and 2.2 times once in a
#: hundred logs.
_ALONE = 2.25
#: Part of a mean's time after which noise has forgotten itself: current sensors average over some milliseconds, torque is held
#: against terms as means over an eighth of a second.
_FORGOTTEN = 4
#: Heat without a brake torque sensor is as uncertain as pads' friction, which no table knows better from one day to the next.
_FRICTION_SHARE = 0.08


@dataclass(frozen=True)
class Dependence:
    """Dependence of one channel's residual on one signal."""

    channel: str
    signal: str
    share: float  #: of the left-out squared error that smooth functions of the signal take away
    rms: float  #: the same as RMS in N
    certainty: float  #: mean relative gain over its standard error; relative, so that one violent stop has one vote
    matters: bool  #: sure, and large enough for a word


def dependences(channel: str, gains: dict[str, tuple[np.ndarray, np.ndarray]], samples: int, floor: float) -> list[Dependence]:
    """One for each signal, strongest first. ``gains``: by signal, squared error of each left-out episode without and with a
    smooth function of the signal; ``samples``: that the squared errors are summed over; ``floor``: RMS (N) from which a
    dependence matters."""
    result = []
    for signal, (without, with_) in gains.items():
        gain = without - with_
        relative = gain / (without + without.mean() + 1e-300)
        spread = relative.std(ddof=1) / np.sqrt(len(gain)) if len(gain) > 2 else np.inf
        certainty = float(relative.mean() / spread) if spread > 0.0 else 0.0
        share = max(float(gain.sum() / max(without.sum(), 1e-300)), 0.0)
        rms = float(np.sqrt(max(gain.sum(), 0.0) / max(samples, 1)))
        matters = share >= _LEAST_SHARE and rms >= floor and certainty >= _SURE
        result.append(Dependence(channel, signal, share, rms, certainty, matters))
    return sorted(result, key=lambda dependence: -dependence.share)


@dataclass(frozen=True)
class Left:
    """What is left of one channel's residual."""

    channel: str
    rms: float  #: of what lasts of the residual after everything, on the judging logs, in the channel's unit
    #: The same of what the calibration achieved on its own data, by its figures and its noise; NaN where it does not say.
    achieved: float
    share: float  #: of the mean square there was before, that is left
    dependences: tuple[Dependence, ...]  #: on signals, strongest first
    log: str = ""  #: the only one on which so much is left, if it is not all
    #: On that log, at the middle of the only episode in which so much is left, if it is not all of the log.
    time_s: float | None = None
    #: Where a term was made that does not carry over whole, what it leaves of the fitted logs, by the forces of these; else
    #: NaN.
    fitted: float = float("nan")

    @property
    def beyond(self) -> bool:
        """Whether the residual is clearly above what the calibration achieved, or what a term leaves of the fitted logs."""
        return is_beyond(self.rms, self.achieved) or is_beyond(self.rms, self.fitted)

    @property
    def present(self) -> bool:
        return self.beyond or any(d.matters for d in self.dependences)

    @property
    def strongest(self) -> Dependence | None:
        """What the residual depends on most: surely, or else by a share that is worth a word; none where no signal tells, or
        where it is left `elsewhere`."""
        worth = (d for d in self.dependences if d.share >= _LEAST_SHARE and not self.elsewhere)
        return next(iter([*(d for d in self.dependences if d.matters), *worth]), None)

    @property
    def elsewhere(self) -> bool:
        """Whether it is left where the fitted logs, of which the dependences are, do not tell."""
        return self.time_s is not None or (not is_beyond(self.rms, self.achieved) and is_beyond(self.rms, self.fitted))

    @property
    def place(self) -> str:
        """Where so much is left, in words, if it is not everywhere."""
        return self.log if self.time_s is None else f"{self.log} at {self.time_s:.0f} s"


def is_beyond(rms: float, known: float, alone: bool = False) -> bool:
    """Whether a residual is clearly above what the calibration achieved, or that of an episode ``alone``; not where it does
    not say."""
    return rms > (_ALONE if alone else CLEARLY) * known


def least_dependence(residual: np.ndarray, samples: int) -> float:
    """RMS from which a dependence of means over ``samples`` of a residual is more than their usual scatter."""
    return float(np.sqrt((_SCATTER**2 - 1.0) / samples)) * sample_noise(residual)


def sample_noise(residual: np.ndarray, places: int = 1) -> float:
    """RMS of what of a residual differs from sample to sample, each of so many ``places``; zero means none."""
    later, earlier = residual[places:], residual[:-places]
    return float(np.sqrt(0.5)) * rmse((later - earlier)[(later != 0.0) & (earlier != 0.0)])


def noise_of_means(residual: np.ndarray, samples: int, places: int = 1) -> float:
    """Variance of white noise that would leave as much of means over ``samples`` as the noise of a residual does, each sample
    of so many ``places``; zero means none.

    Noise is what a residual has forgotten after a part of that time (`_FORGOTTEN`): a sensor filters, and neighbouring samples
    of its noise are alike. Its autocovariance comes from differences (structure function), without what is slower."""
    longest = max(samples // _FORGOTTEN, 1)
    apart = np.array([0.0, *(sample_noise(residual, places * lag) ** 2 for lag in range(1, longest + 1))])
    covariance = apart[-1] - apart[:-1]
    weights = 2.0 * (1.0 - np.arange(longest) / samples)
    weights[0] = 1.0
    return max(float(weights @ covariance), 0.0)


def achieved(calibration: Calibration, channel: str, force_N: np.ndarray, rise_K: np.ndarray, samples: int = 1) -> float:
    """RMS of a channel's residual that the calibration had on its own data: the worst of its figures on logs that fitted
    nothing, or what its noise makes over these forces, if that is more. NaN where it says neither.

    Forces and ``rise_K`` (of pads and disc since the beginning, measured; NaN where there is none) are of the judging logs.
    The residual is averaged over ``samples``; of the paths' errors that leaves what their correlation times say."""
    figures = calibration.provenance.achieved if calibration.provenance else {}
    noise, motor = calibration.noise, calibration.motor
    # Without a reference the current is held against the stiffness path: its error comes on top.
    paths = {"stiffness": ("stiffness",), "torque": ("torque",), "innovation": ("stiffness", "torque")}.get(channel, ())
    # What a unit's gear has of its own (`noise.torque_relative`) is fitted before anything is called unexplained.
    own = {
        "stiffness": np.hypot(noise.stiffness_N, noise.stiffness_relative * force_N),
        "torque": np.sqrt(
            (motor.torque_constant_Nm_per_A * noise.current_A / motor.gear_gain_m_per_rad) ** 2
            + 2.0 * (motor.inertia_kg_m2 * noise.speed_rad_per_s / CYCLE_S / motor.gear_gain_m_per_rad) ** 2
        ),
    }
    times_s = {"stiffness": noise.stiffness_correlation_s, "torque": noise.current_correlation_s}
    total = 0.0
    for path in paths:
        share = _lasting(times_s[path], samples)
        stated = share * rmse(own[path])
        if path == "torque":
            stated = np.hypot(stated, noise.torque_lasting * rmse(force_N))
        total += max(share * figures.get(f"{path}_N", 0.0), stated) ** 2
    if channel == "temperature":
        heated = _FRICTION_SHARE * rmse(rise_K) if np.isfinite(rise_K).any() else 0.0
        total = max(figures.get("temperature_K", 0.0), calibration.thermal.sigma_K) ** 2 + heated**2
    return float(np.sqrt(total)) if total else float("nan")


def _lasting(time_s: float, samples: int) -> float:
    """Share (RMS) of an error with a correlation time (first order) that its means over so many ``samples`` keep."""
    if samples == 1:
        return 1.0
    own = time_s / (samples * CYCLE_S)
    return float(np.sqrt(2.0 * own * (1.0 - own * (1.0 - np.exp(-1.0 / own)))))
