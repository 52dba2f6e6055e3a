"""Screening: what speaks for and against each effect of the catalogue, given a model.

A candidate is refused unless it passes all of

1. a cluster-robust test over episodes, with the channel's base parameters and all accepted effects free, corrected for the
   shapes tried; false discovery rate over the whole catalogue at most 1 % (Benjamini and Hochberg),
2. a gain on episodes left out of the fit that matters: a share of the residual and of the force,
3. values inside the physical bounds,
4. comparison with what no model at all can say: if a smooth function of a single signal explains much more, the candidate
   is a shadow of something else,
5. placebos: with what it rests on disturbed it must do much worse.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import TypeAlias

import numpy as np

from emb_daemon.diagnose.coordinates import Coordinate, effect_coordinates
from emb_daemon.diagnose.evidence import NOT_EXCITED, Evidence, leave_out
from emb_daemon.diagnose.model import LASTING, Model
from emb_daemon.diagnose.orders import strongest_orders
from emb_daemon.diagnose.residuals import FORCE_CHANNELS, SIDE_BY_SIDE, UNITS, Bench, Probe
from emb_daemon.diagnose.signals import signals, smooth_basis
from emb_daemon.diagnose.unexplained import achieved, sample_noise
from emb_daemon.effects import REGISTRY
from emb_daemon.effects.base import HOOKS, Effect, Placebo
from emb_daemon.offline.score import rmse

#: How the reason ends for which an effect is refused that explains much less than a smooth function of a signal.
SHADOW = "a shadow of something else"
#: False discovery rate over the catalogue.
Q_VALUE = 0.01
#: A gain matters from this share of the channel's residual, or of what lasts of it where that is less, and from this share of
#: the RMS of what is measured: force sensors of test rigs are good for two parts in a thousand, and thermocouples of what they
#: have risen by (IEC 60584, class 1: 0.4 % are two standard deviations). On simulated brakes with nothing hidden the best of
#: all forms gains 0.05 to 0.12 of what lasts (ten drives), and the best effect of the catalogue that chance does not explain
#: 0.11 (twelve). A term of a brake has to be above chance over the whole grammar as well, and needs less.
_RESIDUAL_SHARE, _LASTING_SHARE, _OF_A_TERM, _SIGNAL_SHARE = 0.06, 0.2, 0.15, 0.002
#: Samples in the shortest means, which leave out where friction turns over. How friction turns over is modelled roughly; where
#: it turns over late it looks like a friction that rises with speed.
SLIDING = 2
#: What matters in a temperature (K), and of a brake torque's RMS: friction tables are not known better.
_FLOOR_K, _TORQUE_SHARE = 1.5, 0.08
#: Standard deviation of a thermocouple (IEC 60584, class 1: 1.5 K are two): what a heat balance need not do better.
_THERMOCOUPLE_K = 0.75
#: Share of the best model-free explanation that a candidate must reach, and of its own gain that placebos must not.
OF_MODEL_FREE, OF_PLACEBO = 0.6, 0.5
#: Draws of a placebo that runs through the estimator, and of one that does not.
_DRAWS, _SHUFFLES = 2, 5
#: By channel, the largest gain of a smooth function of one signal, and that signal.
Rivals: TypeAlias = dict[str, tuple[float, str]]
#: Signals that are no rivals in a channel: what a base parameter answers for (smoothed, the acceleration shows inertia better
#: than the estimator's own difference of noisy speeds can), and the current of which the residual itself is made.
NO_RIVALS: dict[str, tuple[str, ...]] = {"torque": ("motor_acceleration", "current"), "innovation": ("current",)}


@dataclass(frozen=True)
class Candidate:
    """What became of one effect of the catalogue."""

    effect: Effect
    channel: str | None  #: that shows it, or None where these logs have none
    #: ``amplitudes`` and ``shape``: the coordinates tested, and the shape in which they were.
    amplitudes: tuple[Coordinate, ...] = ()
    shape: tuple[tuple[Coordinate, float], ...] = ()
    columns: tuple[np.ndarray, ...] = field(default=(), repr=False)  #: their regressors
    evidence: Evidence = field(default=NOT_EXCITED, repr=False)
    p_value: float = 1.0
    q_value: float = 1.0
    #: RMS that it takes away on left-out episodes, in the channel's unit; ``share_explained`` of the first residual's mean
    #: square.
    gain: float = 0.0
    share_explained: float = 0.0
    #: Share of the gain that it reaches with what it rests on disturbed, by what is disturbed.
    placebos: Mapping[str, float] = field(default_factory=dict)
    accepted: bool = False
    in_calibration: bool = False
    reason: str = ""  #: why it is not accepted, or what it rests on
    #: ``values`` and ``sigmas``: by parameter; ``before``: as calibrated, for an effect that was.
    values: Mapping[str, float] = field(default_factory=dict)
    sigmas: Mapping[str, float] = field(default_factory=dict)
    before: Mapping[str, float] = field(default_factory=dict)
    confounded_with: str | None = None
    manoeuvre: str | None = None
    names: str = ""  #: the term in whose place it stands, by which its chance was judged
    #: Port and signals of the terms that these logs cannot tell from it, as good as it first.
    alike: tuple[tuple[str, tuple[str, ...]], ...] = ()
    undecided_N: float = 0.0  #: RMS by which those do otherwise
    #: What it takes from the channel's residual, at every sample.
    contribution: np.ndarray = field(default_factory=lambda: np.zeros(0), repr=False)
    #: Its signal at every sample, for a term; ``signals``: that and what multiplies.
    over: np.ndarray = field(default_factory=lambda: np.zeros(0), repr=False)
    signals: tuple[str, ...] = ()

    @property
    def made(self) -> bool:
        """Whether it is a term that no catalogue holds."""
        return self.effect.name.startswith("term:")


class Screening:
    """What is the same in all rounds: signals, coordinates of the effects that are off, and the residual at the beginning."""

    def __init__(self, bench: Bench, model: Model):
        self.bench = bench
        self.initial: dict[str, np.ndarray] = model.residual
        self.signals: dict[str, np.ndarray] = signals(bench)
        channels = {effect.name: bench.channel_of(effect.channel) for effect in REGISTRY}
        #: Coordinates by parameter, of each effect that is off.
        self.coordinates: dict[str, dict[str, Coordinate]] = {
            effect.name: effect_coordinates(bench.calibration, effect, channels[effect.name], bench.reach)
            for effect in REGISTRY
            if channels[effect.name] and not model.of_effect(effect.name)
        }
        braking = self.signals["brake_torque"][self.signals["brake_torque"] > 0.0]
        #: RMS of the clamp force, or of the load where nothing is clamped, N.
        self.force_N: float = rmse(self.signals["clamp_force"]) if bench.clamps else rmse(bench.load_N)
        self._size = dict.fromkeys(bench.channels, self.force_N)
        self._size["brake_torque"] = rmse(braking) if len(braking) else 0.0
        self._size["temperature"] = risen_K([trial.temperature_C for trial in bench.trials])

    def floor(self, model: Model, channel: str, made: bool = False) -> float:
        """Least RMS of an effect that matters, or of the heat balance of a term that is ``made``, in the channel's unit.

        A term of the heat balance has a lower limit, because its gain is only what heat capacities and conductances cannot
        make up for in these logs, which may be a fifth of what it does in the next."""
        if channel == "temperature" and not made:
            return _FLOOR_K
        share = _TORQUE_SHARE if channel == "brake_torque" else _SIGNAL_SHARE
        term = made and channel in FORCE_CHANNELS and model.bench.clamps
        of_lasting = _OF_A_TERM if term else _LASTING_SHARE
        lasting = of_lasting * np.sqrt(model.lasting(channel, LASTING[channel]))
        left = min(_RESIDUAL_SHARE * np.sqrt(model.noise(channel)), lasting)
        return float(max(left, share * self._size[channel]))

    def achieved(self, model: Model, channel: str, force_N: np.ndarray, rise_K: np.ndarray, samples: int = 1) -> float:
        """RMS that a channel's residual need not exceed: what the calibration achieved on its own data, by what it states
        (`unexplained.achieved`), or where these are its own data by what of the residual is noise or does not matter."""
        if self.bench.own_data:
            noise = sample_noise(model.residual[channel], SIDE_BY_SIDE.get(channel, 1))
            return max(noise, _THERMOCOUPLE_K if channel == "temperature" else self.floor(model, channel))
        return achieved(self.bench.calibration, channel, force_N, rise_K, samples)

    def test(self, model: Model, effects: Sequence[Effect]) -> list[Candidate]:
        """Each effect in the shape that does best, with its chance corrected for all that were tried."""
        from scipy.stats import false_discovery_control

        shapes = {effect.name: self._shapes(model, effect) for effect in effects}
        probes = [
            Probe(self.coordinates[effect.name][p.name], shape)
            for effect in effects
            for shape in shapes[effect.name][0]
            for p in effect.amplitudes
        ]
        columns = model.bench.regressors(model.values, probes, model.residual, model.heat)
        columns = dict(zip(probes, columns, strict=True))
        found = [self._best(model, effect, *shapes[effect.name], columns) for effect in effects]
        chances = np.array([c.p_value for c in found] + [1.0] * (len(REGISTRY) - len(found)))
        return [replace(c, q_value=float(q)) for c, q in zip(found, false_discovery_control(chances), strict=False)]

    def _shapes(self, model: Model, effect: Effect) -> tuple[list[tuple[tuple[Coordinate, float], ...]], int]:
        """Shapes in which to test an effect, and how many were looked at to choose them."""
        own = self.coordinates.get(effect.name)
        if not own:
            return [], 1
        if not effect.shapes:
            return [()], 1
        parameter = effect.shapes[0]
        if effect.harmonic:
            orders, tried = strongest_orders(model, effect, own[parameter.name].channel, self.signals)
            return [((own[parameter.name], order),) for order in orders], tried
        return [((own[parameter.name], start),) for start in parameter.starts], len(parameter.starts)

    def _best(self, model: Model, effect: Effect, shapes: list, tried: int, columns: dict) -> Candidate:
        own = self.coordinates.get(effect.name)
        if not own:
            return Candidate(effect, None)
        channel = next(iter(own.values())).channel
        low, high = np.quantile(self.signals[effect.signal], (0.05, 0.95))
        if low == high:
            # Where its signal is constant an effect cannot be told from an offset.
            return Candidate(effect, channel)
        parts = _parts(effect, [own[p.name] for p in effect.amplitudes])
        best = Candidate(effect, channel, tuple(parts[-1]))
        for shape in shapes:
            for part in parts:
                regressors = tuple(columns[Probe(c, shape)] for c in part)
                evidence = model.evidence(channel, regressors, turns=effect.by_turns)
                earlier = best.evidence
                if not best.columns or (evidence.p_value, -evidence.gain) < (earlier.p_value, -earlier.gain):
                    best = Candidate(effect, channel, tuple(part), shape, regressors, evidence)
        evidence = best.evidence
        names = [c.parameter for c in best.amplitudes]
        first = float(self.initial[channel] @ self.initial[channel])
        return replace(
            best,
            p_value=min(1.0, evidence.p_value * tried * len(parts)),
            gain=model.rms(evidence.gain, channel),
            share_explained=max(evidence.gain, 0.0) / first if first > 0.0 else 0.0,
            values=dict(zip(names, evidence.values.tolist(), strict=False)),
            sigmas=dict(zip(names, evidence.sigmas.tolist(), strict=False)),
        )

    def judge(self, model: Model, candidate: Candidate, rivals: Rivals, tested: Sequence[Candidate]) -> Candidate:
        """With the reason why it may not be accepted, empty if it may, and its placebos if they were asked. ``tested``: all
        that were tested with it."""
        effect, evidence = candidate.effect, candidate.evidence
        if candidate.channel is None:
            return replace(candidate, reason="these logs hold no reference on which it would show")
        if not candidate.columns or not len(evidence.values):
            return replace(candidate, reason=f"not excited by these logs; {effect.manoeuvre}")
        if candidate.q_value > Q_VALUE:
            seen = "parts of whole turns of the disc" if effect.by_turns else "episodes"
            clusters = f"{evidence.clusters:.0f} effective {seen} (q = {candidate.q_value:.2g})"
            return replace(candidate, reason=f"not significant over {clusters}")
        return self.plausible(model, candidate, rivals, tested)

    def plausible(self, model: Model, candidate: Candidate, rivals: Rivals, tested: Sequence[Candidate] = ()) -> Candidate:
        """The same but for chance."""
        channel, evidence, unit = candidate.channel, candidate.evidence, UNITS[candidate.channel]
        floor = self.floor(model, channel)
        if evidence.gain <= 0.0:
            return replace(candidate, reason="no gain on left-out episodes")
        gain, where = candidate.gain, ""
        if model.bench.shows_turning(channel):
            sliding = model.rms(model.evidence(channel, candidate.columns, samples=SLIDING).gain, channel)
            gain, where = min((gain, where), (sliding, " where friction slides"))
        if gain < floor:
            too_little = f"explains {gain:.3g} {unit} RMS{where}, too little to matter (limit {floor:.3g} {unit})"
            return replace(candidate, reason=too_little)
        for c, value, sigma in zip(candidate.amplitudes, evidence.values, evidence.sigmas, strict=True):
            if not c.low - 2.0 * sigma <= value <= c.high + 2.0 * sigma:
                return replace(candidate, reason=f"{c.parameter} = {value:.3g} {c.unit} is outside what physics allows")
        gain, signal = self.rival(model, channel, rivals)
        if (
            evidence.gain < OF_MODEL_FREE * gain
            and _together(model, candidate, signal, tested) < OF_MODEL_FREE * gain
            and self._gain_beside(model, candidate, signal) < OF_PLACEBO * evidence.gain
        ):
            shadow = (
                f"explains {candidate.gain:.3g} {unit} RMS where a smooth function of {signal} explains "
                f"{model.rms(gain, channel):.3g} {unit}: {SHADOW}"
            )
            return replace(candidate, reason=shadow)
        candidate = self.with_placebos(model, candidate)
        for text, share in candidate.placebos.items():
            if share > OF_PLACEBO:
                return replace(candidate, reason=f"its placebo ({text}) explains {100 * share:.0f} % of the same")
        return replace(candidate, reason="")

    def rival(self, model: Model, channel: str, rivals: Rivals, samples: int = 1) -> tuple[float, str]:
        """Largest gain on left-out episodes of a smooth function of one signal, and that signal; kept in ``rivals``."""
        if channel not in rivals:
            gains = {
                name: float((without - with_).sum())
                for name, (without, with_) in self.dependence(model, channel, samples).items()
                if name not in NO_RIVALS.get(channel, ())
            }
            name = max(gains, key=gains.__getitem__, default="")
            rivals[channel] = (max(gains.get(name, 0.0), 0.0), name)
        return rivals[channel]

    def dependence(self, model: Model, channel: str, samples: int = 1) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Squared error of each left-out episode, without and with a smooth function of each signal; of means over
        ``samples``."""
        if channel not in FORCE_CHANNELS:
            return {}
        plain = model.left_out(channel, samples=samples)
        with_ = {name: self._left_out_with(model, channel, name, samples=samples) for name in self.signals}
        return {name: (plain, own) for name, own in with_.items() if own is not None}

    def _left_out_with(
        self, model: Model, channel: str, name: str, columns: Sequence[np.ndarray] = (), samples: int = 1
    ) -> np.ndarray | None:
        """Squared error of each left-out episode with a smooth function of a signal and other regressors, shape (episodes,);
        None for a signal that does not vary."""
        basis = smooth_basis(name, self.signals[name], self.signals["clamp_force"])
        if not basis.shape[1]:
            return None
        own = model.movable(channel)
        basis = basis * (model.residual[channel] != 0.0)[:, None]
        moments = model.moments(channel, [*(model.columns[c] for c in own), *columns, basis], samples=samples)
        size = np.einsum("gii->i", moments.products)[-1 - basis.shape[1] : -1]
        prior = np.append(model.penalty(own, channel), np.zeros(len(columns)))
        return leave_out(moments, np.append(prior, 1e-3 * np.maximum(size, 1e-300) + 1e-12)).left_out

    def _gain_beside(self, model: Model, candidate: Candidate, signal: str) -> float:
        """Gain of a candidate on left-out episodes beside a smooth function of a signal: a shadow of what that explains has
        none, another cause keeps its own."""
        alone, both = (self._left_out_with(model, candidate.channel, signal, own) for own in ((), candidate.columns))
        return float((alone - both).sum())

    def with_placebos(self, model: Model, candidate: Candidate) -> Candidate:
        """With the share of its gain that it reaches with what it rests on disturbed, if it gains anything."""
        if candidate.evidence.gain <= 0.0:
            return candidate
        random, result = np.random.default_rng(0), {}
        for placebo in candidate.effect.placebos:
            tables = self._disturbed(model, candidate, placebo, random)
            gains = [model.evidence(candidate.channel, own).gain for own in tables]
            if gains:
                result[placebo.text] = max(0.0, *gains) / candidate.evidence.gain
        return replace(candidate, placebos=result)

    def _disturbed(self, model: Model, candidate: Candidate, placebo: Placebo, random) -> list[list[np.ndarray]]:
        """Regressors of a candidate under a placebo, drawn a few times."""
        if placebo.order:
            [(order, found)] = candidate.shape
            return [self._columns(model, model.bench, candidate, ((order, other),)) for other in placebo.order(found)]
        if placebo.samples:
            benches = [model.bench.disturbed(placebo.samples, random) for _ in range(_DRAWS)]
            return [self._columns(model, bench, candidate, candidate.shape) for bench in benches]
        like = [model.columns[c] for c in model.own(candidate.channel) if c.name == HOOKS[candidate.effect.hook].like]
        if not like:
            return []
        signal, episode = self.signals[candidate.effect.signal], model.bench.sample_episode
        shuffled = [placebo.signal(signal - signal[0], episode, random) for _ in range(_SHUFFLES)]
        return [[np.sum(like, axis=0) * follows] for follows in shuffled]

    def _columns(self, model: Model, bench: Bench, candidate: Candidate, shape: tuple) -> list[np.ndarray]:
        at, heat = (model.residual, model.heat) if bench is model.bench else bench.run(model.values)
        return bench.regressors(model.values, [Probe(c, shape) for c in candidate.amplitudes], at, heat)


def risen_K(temperatures: Iterable[np.ndarray]) -> float:
    """RMS by which measured temperatures, of each log (N, places), differ from those it begins with; 0 if there are none."""
    rises = np.concatenate([(own - own[:1]).ravel() for own in temperatures])
    return rmse(rises[np.isfinite(rises)]) if np.isfinite(rises).any() else 0.0


def _together(model: Model, candidate: Candidate, signal: str, tested: Sequence[Candidate]) -> float:
    """Gain on left-out episodes of all proven candidates that follow the same signal: what a smooth function of it explains
    may be two effects, viscous and Stribeck friction, neither of which is a shadow."""
    alike = [c for c in tested if (c.channel, c.effect.signal) == (candidate.channel, signal) and c.q_value <= Q_VALUE]
    if len(alike) < 2 or candidate not in alike:
        return 0.0
    return model.evidence(candidate.channel, [column for c in alike for column in c.columns]).gain


def groups(effect: Effect, coordinates: Sequence[Coordinate]) -> list[list[Coordinate]]:
    """Amplitudes that stand or fall together."""
    found: dict[str, list[Coordinate]] = {}
    for coordinate in coordinates:
        found.setdefault(effect.parameter(coordinate.parameter).group, []).append(coordinate)
    return list(found.values())


def _parts(effect: Effect, coordinates: Sequence[Coordinate]) -> list[list[Coordinate]]:
    """The first group only, the first two, ..., all: few episodes cannot carry a test of many numbers."""
    every = groups(effect, coordinates)
    return [list(chain.from_iterable(every[: count + 1])) for count in range(len(every))] or [[]]
