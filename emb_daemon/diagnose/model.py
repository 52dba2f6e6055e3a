"""The state of a search, immutable: what is free, where it stands, and what that leaves."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np

from emb_daemon.diagnose.coordinates import Coordinate, Values, about_middle, base_coordinates, effect_coordinates
from emb_daemon.diagnose.evidence import Averaging, Evidence, Moments, judge, judge_by_turns, leave_out, leave_out_within
from emb_daemon.diagnose.residuals import CHANNEL_OF_HEAT, FORCE_CHANNELS, HEAT_CHANNELS, SIDE_BY_SIDE, Bench, Probe
from emb_daemon.diagnose.unexplained import noise_of_means
from emb_daemon.effects import REGISTRY
from emb_daemon.offline.fit import Block, Fit, Free, fit

#: Least number of samples that are worth one, when priors are weighed against data: twenty milliseconds, the shortest time
#: over which a residual of either path stays the same.
_INFLATION = 5.0
#: A fit ends when the cost falls by less than this share, or after so many evaluations: screening and the next round follow.
TOLERANCE, _EVALUATIONS = 2e-3, 8
#: Fits one after the other until one gains next to nothing.
_FITS = 8
#: Share of the variance by which priors were weighed that a fit must leave, or they counted too much.
_AS_WEIGHED = 0.9
#: Heat and force that rest on each other are fitted in turn so often at most, until a turn leaves this share of the force's
#: mean square, and of the temperatures' or these are right within the standard deviation of a thermocouple (IEC 60584, class
#: 1), K.
_TURNS, _RIGHT_K, LITTLE = 5, 0.75, 0.98

#: Samples over which residuals are averaged before a term is held against them, by channel. What a term of the torque path
#: does lasts longer than an eighth of a second. What is shorter there is how friction turns over, which the calibration's
#: noise states (`noise.presliding`); on simulated brakes with nothing hidden it alone brought false terms of 70 to 120 N.
LASTING = {"stiffness": 4, "torque": 32, "innovation": 32, "brake_torque": 32, "temperature": 1}


def rms_known(residual: np.ndarray, means: Averaging | None = None) -> float:
    """RMS of a channel's residual where there is one: it is zero where nothing was measured; of its ``means`` if they are
    given, which are what lasts."""
    told = residual if means is None else residual * means.told
    averaged = told if means is None else means.of(residual[:, None])
    return float(np.sqrt(np.square(averaged).sum() / max(np.count_nonzero(told), 1)))


@dataclass(frozen=True)
class Model:
    """Coordinates with their values, and the residual there."""

    bench: Bench
    values: dict[Coordinate, float]  #: of every coordinate that has been entered; effects' shapes included
    residual: dict[str, np.ndarray] = field(repr=False)  #: by channel
    #: Of each log (`held_heat.run_with_heat`); coordinates that stand at nothing do not change it.
    heat: Sequence[np.ndarray | None] = field(repr=False)
    #: Where a coordinate's prior is centred, if not at the calibration: a shape is touched up about the start at which it was
    #: chosen.
    centre: Values = field(default_factory=dict)
    chosen: frozenset[Coordinate] = frozenset()  #: coordinates that stand as chosen and are not fitted: whole numbers
    #: Regressors, minus the derivative of the channel's residual, at the last fit.
    columns: Mapping[Coordinate, np.ndarray] = field(default_factory=dict, repr=False)
    #: By channel, bench, values and heat of that: where nothing has moved since, a fit begins with them.
    stood: Mapping[str, tuple[Bench, Values, Sequence[np.ndarray | None]]] = field(default_factory=dict, repr=False)
    fits: Mapping[str, Fit] = field(default_factory=dict, repr=False)  #: by channel

    @classmethod
    def of(cls, bench: Bench) -> "Model":
        """The calibration as it is: its base parameters and its effects free, nothing moved."""
        coordinates = []
        clearances = [bench.on(trial).contact.clearance_rad for trial in bench.trials]
        stated = bench.load_follows and bench.calibration.provenance is None
        for coordinate in base_coordinates(bench.calibration, clearances, stated):
            if channel := bench.channel_of(coordinate.channel):
                coordinates.append(replace(coordinate, channel=channel))
        for effect in REGISTRY:
            on, channel = bench.calibration.effects.get(effect.name, {}), bench.channel_of(effect.channel)
            if channel and any(on.get(p.name, 0.0) for p in effect.amplitudes):
                coordinates += effect_coordinates(bench.calibration, effect, channel, bench.reach).values()
        start = about_middle({c: c.start for c in coordinates}, bench.middle)
        return cls(bench, start, *bench.run(start), centre=start)

    def own(self, channel: str) -> list[Coordinate]:
        """What is fitted in a channel."""
        return [c for c in self.values if c.channel == channel and c not in self.chosen]

    def movable(self, channel: str) -> list[Coordinate]:
        """Of these the coordinates that do not stand at a bound. A linear test would otherwise let a parameter move beyond its
        bound and explain what others do: a friction below zero where a motor turns one way, for example."""
        return [c for c in self.own(channel) if not c.is_held(self.values[c])]

    def of_effect(self, name: str) -> list[Coordinate]:
        return [c for c in self.values if c.effect == name]

    def entered(self, values: Values, chosen: Iterable[Coordinate] = (), centre: Values | None = None) -> "Model":
        """With more coordinates, or some elsewhere."""
        every = self.values | dict(values)
        residual, heat = self.bench.run(every)
        return replace(
            self,
            values=every,
            residual=residual,
            heat=heat,
            centre={**self.centre, **(centre or {})},
            chosen=self.chosen | frozenset(chosen),
        )

    def says_nothing(self, amplitudes: Iterable[Coordinate]) -> bool:
        """Whether a fit has left amplitudes at zero, held by their bounds. A linear test does not know bounds, and may see a
        gain there."""
        return all(abs(self.values[c]) < c.step for c in amplitudes)

    def without(self, gone: Iterable[Coordinate]) -> "Model":
        """With some coordinates taken out again, not refitted."""
        gone = set(gone)
        left = {c: value for c, value in self.values.items() if c not in gone}
        residual, heat = self.bench.run(left)
        return replace(self, values=left, residual=residual, heat=heat, chosen=self.chosen - gone)

    def noise(self, channel: str) -> float:
        """Mean square of the residual where there is one."""
        return rms_known(self.residual[channel]) ** 2

    def lasting(self, channel: str, samples: int) -> float:
        """Mean square of what lasts over so many samples of the residual."""
        return rms_known(self.residual[channel], self.bench.means(channel, samples)) ** 2

    def inflation(self, channel: str) -> float:
        """How many samples of the residual are worth one: the design effect of its episodes (Kish 1965)."""
        residual, episode = self.residual[channel], self.bench.episode[channel]
        sums = np.bincount(episode, residual, minlength=self.bench.episodes)
        squares = np.bincount(episode, residual**2, minlength=self.bench.episodes)
        return max(_INFLATION, float((sums**2).sum() / max(squares.sum(), 1e-300)))

    def refined(self, channels: Iterable[str]) -> "Model":
        """Everything free in some channels fitted through the estimator: heat first, on which stiffness rests."""
        model, channels = self, set(channels)
        for channel in (*HEAT_CHANNELS, *FORCE_CHANNELS):
            if channel in channels and model.own(channel):
                model = model._weighed(channel)
        return model

    def _weighed(self, channel: str) -> "Model":
        """A channel fitted; where nobody has measured what the calibration states, until its priors are weighed by what the
        fit leaves: by what was left before it, numbers that are far off would hold themselves back."""
        model = self._fitted(channel)
        if any(c.unmeasured for c in self.own(channel)):
            before = self
            for _ in range(_FITS):
                if model._variance(channel) > _AS_WEIGHED * before._variance(channel):
                    break
                before, model = model, model._fitted(channel)
        return model

    def _variance(self, channel: str) -> float:
        """Of the sum that one independent observation makes, in the square of the channel's unit."""
        return self.inflation(channel) * max(self.noise(channel), 1e-12)

    def arrived(self, channel: str) -> "Model":
        """A channel fitted until nothing is gained: from far away one fit does not arrive."""
        model = self
        for _ in range(_FITS):
            before, model = model.noise(channel), model.refined({channel})
            if model.noise(channel) > LITTLE * before:
                break
        return model

    def settled(self, channels: Iterable[str]) -> "Model":
        """The same, heat and force in turn until both have arrived: the force heats the pads, and follows their heat.
        One turn from a force that is off by 600 N leaves temperatures wrong by 15 K."""
        model, channels = self, set(channels)
        # Neither rests on the torque path.
        in_turn = channels.intersection(self.bench.channels) & {*HEAT_CHANNELS, "stiffness"}
        if not in_turn.issuperset((CHANNEL_OF_HEAT, "stiffness")):
            return self.refined(channels)
        for _ in range(_TURNS):
            before, model = model, model.refined(in_turn)
            left, was = (m.noise(CHANNEL_OF_HEAT) for m in (model, before))
            right = left < _RIGHT_K**2 or LITTLE * was < left <= was
            if right and model.noise("stiffness") > LITTLE * before.noise("stiffness"):
                break
        return model.refined(channels - in_turn)

    def _fitted(self, channel: str) -> "Model":
        own, episode = tuple(self.own(channel)), self.bench.episode[channel]
        # In units in which an independent observation has variance one, as priors have.
        scale = float(np.sqrt(self._variance(channel)))
        start = tuple(self.values[c] for c in own)
        bench, values, heat = self.stood.get(channel, (None, None, None))
        as_left = bench is self.bench and values == self.values and heat is self.heat
        known = {start: np.column_stack([self.columns[c] for c in own])} if as_left else {}

        # Derivatives, and the model in the end, are asked for where the residual was asked for last.
        @lru_cache(maxsize=2)
        def run(*tried: float) -> tuple[dict[str, np.ndarray], Sequence[np.ndarray | None]]:
            if tried == start:
                return self.residual, self.heat
            return self.bench.run(self.values | dict(zip(own, tried, strict=True)))

        @lru_cache(maxsize=2)
        def own_residual(*tried: float) -> tuple[np.ndarray, Sequence[np.ndarray | None]]:
            if channel == "torque" and tried != start:
                # Pads are heated by a force that hardly follows the torque path: two per cent of all its parameters move what
                # is left of it by 0.03 N RMS.
                values = self.values | dict(zip(own, tried, strict=True))
                return self.bench.residual_held(values, channel, self.heat), self.heat
            found, heat = run(*tried)
            return found[channel], heat

        def residual(tried: Values) -> np.ndarray:
            return own_residual(*(tried[c] for c in own))[0] / scale

        def columns(tried: Values) -> np.ndarray:
            key = () if self.bench.straight and channel not in FORCE_CHANNELS else tuple(tried[c] for c in own)
            if key not in known:
                at, heat = own_residual(*(tried[c] for c in own))
                found = self.bench.regressors(self.values | dict(tried), [Probe(c) for c in own], {channel: at}, heat)
                known[key] = np.column_stack(found)
            return known[key]

        def derivative(tried: Values) -> np.ndarray:
            return columns(tried) / -scale

        prior = {c: (self.centre.get(c, c.start), self._known_to(c)) if np.isfinite(c.prior) else None for c in own}
        free = {c: Free(self.values[c], c.step, c.low, c.high, prior[c]) for c in own}
        found = fit([Block(residual, own, episode, derivative)], free, tolerance=TOLERANCE, evaluations=_EVALUATIONS)
        ended = tuple(found.values[c] for c in own)
        left, heat = run(*ended)
        values, asked = self.values | found.values, own_residual(*ended)[1]
        return replace(
            self,
            values=values,
            residual=left,
            heat=heat,
            columns={**self.columns, **dict(zip(own, columns(found.values).T, strict=True))},
            stood={**self.stood, channel: (self.bench, values, asked)},
            fits={**self.fits, channel: found},
        )

    def _known_to(self, coordinate: Coordinate) -> float:
        centre = self.centre.get(coordinate, coordinate.start)
        return coordinate.known_to(self.values.get(coordinate, centre), centre)

    def penalty(self, coordinates: Sequence[Coordinate], channel: str) -> np.ndarray:
        """What priors add to the normal equations."""
        prior = np.array([self._known_to(c) for c in coordinates])
        return self._variance(channel) / prior**2

    def moments(
        self,
        channel: str,
        columns: Sequence[np.ndarray],
        residual: np.ndarray | None = None,
        samples: int = 1,
        turns: bool = False,
    ) -> Moments:
        """Of regressors, (N,) or (N, k) each, and the channel's residual or another, as means over so many ``samples``.
        ``turns``: episodes are cut by turns of the disc."""
        residual = self.residual[channel] if residual is None else residual
        table = np.column_stack([*columns, residual])
        if turns:
            episode = self.bench.turns
            return Moments.of(table[:, :-1], table[:, -1], episode, int(episode[-1]) + 1)
        episode = self.bench.episode[channel]
        if samples > 1:
            means = self.bench.means(channel, samples)
            table, episode = means.of(table), means.episode
        return Moments.of(table[:, :-1], table[:, -1], episode, self.bench.episodes)

    def residual_at(self, channel: str, elsewhere: Values) -> np.ndarray:
        """A channel's residual with some of its coordinates elsewhere, by their regressors."""
        return self.residual[channel] + sum(self.columns[c] * (self.values[c] - value) for c, value in elsewhere.items())

    def left_out(
        self, channel: str, free: Sequence[Coordinate] | None = None, residual: np.ndarray | None = None, samples: int = 1
    ) -> np.ndarray:
        """Squared error of the channel's residual, or another, over each episode by a fit to the others, shape (episodes,).

        ``free``: coordinates that are fitted, all that can move if none are given; ``samples``: in a mean."""
        free = self.movable(channel) if free is None else free
        moments = self.moments(channel, [self.columns[c] for c in free], residual, samples)
        return leave_out(moments, self.penalty(free, channel)).left_out

    def evidence(
        self, channel: str, own: Sequence[np.ndarray], given: Sequence[np.ndarray] = (), samples: int = 1, turns: bool = False
    ) -> Evidence:
        """Of regressors that are not in the model, everything in it and ``given`` ones free; of means over ``samples``.

        ``turns``: how probable they are by chance is judged by turns of the disc, which a rig that turns it for minutes during
        a few brake applications has seen often; their gain by whole episodes all the same."""
        free = self.movable(channel)
        columns = [*(self.columns[c] for c in free), *given, *own]
        penalty = np.concatenate([self.penalty(free, channel), np.zeros(len(given) + len(own))])
        first = len(free) + len(given)
        parts = list(range(first)), list(range(first, first + len(own)))

        def judged(by: bool) -> Evidence:
            return judge(self.moments(channel, columns, None, samples, by), *parts, penalty)

        return judge_by_turns(judged) if turns else judged(False)

    def evidence_against(self, values: Values, samples: int = 1) -> Evidence:
        """That some fitted coordinates of one channel stand elsewhere than at ``values``, everything else free; of means over
        ``samples``.

        An effect's shape stands as fitted while its amplitudes are tested: it would explain away what they do. Where the rest
        would have to pass a bound without them it stands there: no friction drives a motor that turns one way."""
        tested = list(values)
        channel, effects = tested[0].channel, {c.effect for c in tested if c.effect}
        rest = [c for c in self.movable(channel) if c not in values and (c.effect not in effects or not is_shape(c))]
        start = {c: self.centre.get(c, c.start) for c in rest}
        restored = self.residual_at(channel, start | dict(values))
        first, penalty = len(rest), self.penalty([*rest, *tested], channel)
        nuisances = list(range(first))
        low, high = np.array([(c.low - start[c], c.high - start[c]) for c in rest]).reshape(-1, 2).T

        def judged(turns: bool) -> Evidence:
            moments = self.moments(channel, [self.columns[c] for c in (*rest, *tested)], restored, samples, turns)
            plain = leave_out_within(moments.select(nuisances), penalty[:first], low, high) if rest else None
            return judge(moments, nuisances, list(range(first, len(penalty))), penalty, plain)

        return judge_by_turns(judged) if effects and effects <= _OF_TURNS else judged(False)

    def log_posterior(self, channel: str, samples: int, scale: float) -> float:
        """Of a channel's free coordinates where means over ``samples`` make them most probable, in nats but for a constant;
        ``scale``: variance of an independent observation. What is new to the calibration has no prior and costs nothing."""
        free, own = self.movable(channel), self.own(channel)
        start = {c: self.centre.get(c, c.start) for c in free}
        moments = self.moments(channel, [self.columns[c] for c in free], self.residual_at(channel, start), samples)
        total = moments.products.sum(axis=0)
        normal, right = total[:-1, :-1] + np.diag(scale / np.array([c.prior for c in free]) ** 2), total[:-1, -1]
        size = np.sqrt(np.maximum(np.diag(normal), 1e-300))
        moved = np.linalg.lstsq(normal / np.outer(size, size), right / size, rcond=1e-12)[0] / size
        held = sum(((self.values[c] - self.centre.get(c, c.start)) / c.prior) ** 2 for c in own if c not in free)
        return -0.5 * float((total[-1, -1] - moved @ right) / scale + held)

    def counted(self, channel: str) -> int:
        """Residuals of a channel that say something."""
        return max(int(np.count_nonzero(self.residual[channel])), 1)

    def rms(self, gain: float, channel: str) -> float:
        """A fall of the summed squared error as RMS in the channel's unit."""
        return float(np.sqrt(max(gain, 0.0) / self.counted(channel)))


_OF_TURNS = {effect.name for effect in REGISTRY if effect.by_turns}
_SHAPES = {f"effects.{effect.name}.{parameter.name}" for effect in REGISTRY for parameter in effect.shapes}


def is_shape(coordinate: Coordinate) -> bool:
    """Whether a coordinate shapes an effect, or a term, without switching it on."""
    if coordinate.name.startswith("terms["):
        return coordinate.parameter not in ("coefficient", "sine")
    return coordinate.name in _SHAPES


def noise_left(model: Model, channel: str, samples: int) -> np.ndarray:
    """Squared error of each episode that no term explains, of means over ``samples``, shape (episodes,)."""
    means = model.bench.means(channel, samples)
    told = model.residual[channel] * means.told
    # Each mean has the same variance, of however few samples it is, because it is weighted by their number.
    counted = np.bincount(means.episode, means.of(told[:, None])[:, 0] != 0.0, model.bench.episodes)
    return counted * noise_of_means(told, samples, SIDE_BY_SIDE.get(channel, 1))
