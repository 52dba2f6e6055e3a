"""Selection: which effects of the catalogue do these logs prove?

The steps of a search (`search`): every candidate is screened against what the model leaves (`screening`), the best one of each
channel is added and everything is refitted through the estimator; in the end each accepted effect is tested once more in the
presence of the others.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from emb_daemon.calibration.parameters import CLEARANCE
from emb_daemon.diagnose.coordinates import Coordinate, Values, about_middle
from emb_daemon.diagnose.evidence import Evidence
from emb_daemon.diagnose.model import LASTING, Model, is_shape
from emb_daemon.diagnose.residuals import CHANNEL_OF_HEAT, FORCE_CHANNELS, HEAT_CHANNELS
from emb_daemon.diagnose.screening import Q_VALUE, SHADOW, SLIDING, Candidate, Screening, groups
from emb_daemon.diagnose.unexplained import Dependence
from emb_daemon.effects import REGISTRY
from emb_daemon.effects.base import Effect

#: Two candidates are confounded if the loser would have gained this share of the winner's gain in its place.
_CONFOUNDED = 0.8
#: ... and are as good as each other from here.
_EQUAL = 0.97
#: Log-odds, 99 to 1, from which one of two explains what the other does not: the priors have a share in such a difference,
#: which the jackknife over episodes does not know.
SURE = float(np.log(1.0 / Q_VALUE))
#: Odds up to which neither of two is more probable, nats: 11 to 10. In a machine without load an offset of the current and an
#: asymmetry of its friction are the same torque.
_EVEN = 0.1
#: A candidate whose chance is below this but not sure, and that explains this share of the mean square of what lasts of the
#: residual, is fitted before it is judged. Not of all of it: what differs from sample to sample no effect explains, and in the
#: current that is most.
_UNSURE, _LARGE = 0.05, 0.25

#: Standard deviations by which amplitudes must be clear of nothing where they gain too little to matter.
_CARRIED = 2.0

#: Port at which nothing is looked for of a motor that turns free: a constant that falls with the current would explain any
#: current, friction's above all.
NOT_OF_A_FREE_MOTOR = "torque_constant"
#: Why a term goes that a calibration may not hold.
TOO_LARGE = "fitted with everything else it is more than its port may bear"

Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Selection:
    """What a search has chosen so far."""

    model: Model
    screening: Screening
    #: What became of each effect that was off, by name; the accepted ones are those in the model.
    candidates: dict[str, Candidate] = field(default_factory=dict)
    #: Channels whose base parameters were off, with the RMS that refitting them gains on left-out episodes.
    recalibrated: dict[str, float] = field(default_factory=dict)
    #: Channels whose recalibration was taken out again, with what it gained and why.
    refused: Mapping[str, tuple[float, str]] = field(default_factory=dict)
    #: Channels whose base parameters stand as calibrated beside what was found in them, because refitting them did harm.
    held: frozenset[str] = frozenset()
    dropped: frozenset[str] = frozenset()  #: effects that were accepted and are not to be tried again
    #: What the residual depended on before any effect was accepted, by channel.
    at_first: Mapping[str, list[Dependence]] = field(default_factory=dict)
    instead: "Selection | None" = None  #: what was chosen out of the catalogue alone, where some of it gave way to terms
    #: What was chosen with a term that went because its path, refitted, is described more shortly without it.
    longer: "Selection | None" = None
    #: Channels of which something is left that a term was not looked for, because the calibration has no room for another.
    full: frozenset[str] = frozenset()

    @property
    def accepted(self) -> list[str]:
        return [name for name, candidate in self.candidates.items() if candidate.accepted]

    @property
    def suspects(self) -> list[str]:
        """What can be taken out again: accepted effects, and channels that were only recalibrated."""
        with_effects = {self.candidates[name].channel for name in self.accepted}
        return [*self.accepted, *(channel for channel in self.recalibrated if channel not in with_effects)]

    def channel_of(self, suspect: str) -> str:
        return suspect if suspect in self.recalibrated else self.candidates[suspect].channel

    @property
    def touched(self) -> set[str]:
        """Channels whose fit is applied."""
        return {self.channel_of(suspect) for suspect in self.suspects}

    @property
    def not_recalibrated(self) -> set[str]:
        """Channels whose recalibration was taken out again, and stays out."""
        return {channel for channel in self.refused if channel not in self.touched - self.held}

    def applied(self, without: str = "") -> dict[Coordinate, float]:
        """What differs from the calibration; ``without`` one suspect, the others where they are."""
        without = CHANNEL_OF_HEAT if self._is_of_heat(without) else without
        return {
            c: value
            for c, value in self.model.values.items()
            if c.channel in self.touched and without not in (c.effect or c.channel, c.channel)
        }

    def _is_of_heat(self, suspect: str) -> bool:
        """Whether a suspect is a term of the heat balance: conductances and capacities were fitted with it, and none of them
        stands without the others."""
        candidate = self.candidates.get(suspect)
        return candidate is not None and candidate.made and candidate.channel == CHANNEL_OF_HEAT

    def noted(self, candidates: Iterable[Candidate]) -> "Selection":
        """With what became of some effects; regressors are not kept."""
        return replace(self, candidates=self.candidates | {c.effect.name: replace(c, columns=()) for c in candidates})

    def without(self, suspect: str, reason: str) -> "Selection":
        """An accepted effect, or the recalibration of a channel, taken out; what remains of its channel refitted."""
        if suspect in self.recalibrated:
            left = {c: gain for c, gain in self.recalibrated.items() if c != suspect}
            refused = {**self.refused, suspect: (self.recalibrated[suspect], reason)}
            return replace(self, recalibrated=left, refused=refused)
        candidate, own = self.candidates[suspect], self.model.of_effect(suspect)
        if self._is_of_heat(suspect):
            together = [name for name in self.accepted if self._is_of_heat(name)]
            refused = [replace(self.candidates[name], accepted=False, reason=reason) for name in together]
            model = self.model.without([c for c in self.model.values if c.channel == candidate.channel])
            return replace(self.noted(refused), model=model, dropped=self.dropped | {*together})
        if candidate.in_calibration:
            as_before = about_middle({c: c.start for c in own}, self.model.bench.middle)
            model = self.model.entered(as_before, chosen=own).refined({candidate.channel})
        else:
            model = self.model.without(own).refined({candidate.channel})
        refused = replace(candidate, accepted=False, reason=reason)
        return replace(self.noted([refused]), model=model, dropped=self.dropped | {suspect})

    def with_base_held(self, channel: str, reason: str) -> "Selection":
        """The base parameters of a channel back at the calibration, and its effects refitted to that. Where a log finds its
        contact is none of the calibration's."""
        if channel in self.suspects:
            return self.without(channel, reason)
        base = [c for c in self.model.own(channel) if not c.effect and c.name != CLEARANCE]
        model = self.model.entered({c: c.start for c in base}, chosen=base).refined({channel})
        gain = model.rms(float(np.sum(model.left_out(channel) - self.model.left_out(channel))), channel)
        left = {c: gained for c, gained in self.recalibrated.items() if c != channel}
        refused = {**self.refused, channel: (gain, reason)}
        return replace(self, model=model, recalibrated=left, refused=refused, held=self.held | {channel})

    def entered(self, winners: list[Candidate]) -> "Selection":
        """Effects accepted, one for each channel, and refitted; one that leaves its channel worse than before goes out."""
        before = self.model
        values, chosen, centre = {}, [], {}
        for winner in winners:
            shape, harmonic = dict(winner.shape), winner.effect.harmonic
            own = self.screening.coordinates[winner.effect.name]
            # An effect enters with all its amplitudes; those that prove nothing go at the end.
            values |= {own[p.name]: 0.0 for p in winner.effect.amplitudes} | shape
            fitted = zip(winner.amplitudes, winner.evidence.values, strict=True)
            values |= {c: float(np.clip(value, c.low, c.high)) for c, value in fitted}
            centre |= shape
            chosen += shape if harmonic and harmonic.whole else []
        channels = {winner.channel for winner in winners}
        model = before.entered(values, chosen, centre).refined(channels)
        if "stiffness" in channels:
            # The force that heats the pads has changed, and with their temperatures what softening and growth mean.
            model = model.settled({*HEAT_CHANNELS, *channels})
        result = replace(self.noted(replace(winner, accepted=True) for winner in winners), model=model)
        for winner in winners:
            own = [c for c in result.model.of_effect(winner.effect.name) if not is_shape(c)]
            if result.model.noise(winner.channel) >= before.noise(winner.channel) or result.model.says_nothing(own):
                reason = "no fit of it with the calibration's own parameters is better than without it"
                result = result.without(winner.effect.name, reason)
        return result


def settle_heat(selection: Selection) -> Selection:
    """Heat that is not applied goes back to the calibration, and what is applied is fitted to that.

    While searching, a friction or a heat capacity that is a little off must not pass for an effect; but growth and softening
    that were fitted to other temperatures than the estimator will have would be wrong."""
    model = selection.model
    idle = [c for c in model.values if c.channel in HEAT_CHANNELS and c.channel not in selection.touched]
    start = about_middle({c: c.start for c in idle}, model.bench.middle)
    return replace(selection, model=model.entered(start, chosen=idle).settled(selection.touched))


def recalibrate_heat(selection: Selection) -> Selection:
    """The same with the heat settled, and recalibrated where that gains what matters beside all that was found: as long as the
    force was off, heat that made up for it may have gained nothing.

    Capacities and conductances are never recalibrated without the pads' friction, the source of the heat: they would make up
    for what is wrong of it."""
    settled, model = settle_heat(selection), selection.model
    heat = [c for c in HEAT_CHANNELS if c in model.bench.channels]
    again = find_recalibrated(selection, settled.model, [c for c in heat if c not in selection.touched])
    if CHANNEL_OF_HEAT in {*again, *selection.touched}:
        again |= {c: recalibration_gain(model, settled.model, c) for c in heat if c not in {*again, *selection.touched}}
    return settle_heat(replace(selection, recalibrated=selection.recalibrated | again)) if again else settled


def find_recalibrated(selection: Selection, start: Model, channels: Iterable[str]) -> dict[str, float]:
    """Those of some channels in which refitting the base parameters gains on left-out episodes what matters."""
    model, floor = selection.model, selection.screening.floor
    # Without a reference it is unknown which path is off: adaptation decides that, not a diagnosis.
    asked = [c for c in channels if model.own(c) and c != "innovation"]
    gains = {c: recalibration_gain(model, start, c) for c in asked}
    return {c: gain for c, gain in gains.items() if gain > 0.0 and gain >= floor(model, c)}


def recalibration_gain(model: Model, start: Model, channel: str) -> float:
    """RMS that refitting a channel's base parameters takes on left-out episodes from what it leaves at the ``start``."""
    # Linear about the end of the fit: regressors at its start do not predict the end where friction turns over abruptly.
    restored = model.residual_at(channel, {c: model.centre.get(c, c.start) for c in model.movable(channel)})
    left_out = model.left_out(channel, residual=restored)
    before = float(start.residual[channel] @ start.residual[channel])
    return model.rms(before - float(left_out.sum()), channel)


def one_round(selection: Selection) -> Selection:
    """One round: screen what is left, and accept the best of each channel, if any."""
    model, screening = selection.model, selection.screening
    gone = {*selection.accepted, *selection.dropped}
    left = [e for e in REGISTRY if e.name not in gone and not model.of_effect(e.name)]
    apart = {e: why for e in left if (why := _why_not_asked(e, model))}
    left = [e for e in left if e not in apart]
    rivals: dict = {}
    found = screening.test(model, left)
    tested = [screening.judge(model, c, rivals, found) for c in found]
    winners, losers = [], []
    for channel in model.bench.channels:
        own = [c for c in tested if c.channel == channel]
        passed = [c for c in own if not c.reason]
        if passed:
            winner, beaten = _settle(model, passed, [c for c in own if c.reason.endswith(SHADOW)])
            winners.append(winner)
            losers += beaten
    if not winners:
        # The report states every placebo as a number, also of what fell for another reason.
        tested = [screening.with_placebos(model, c) for c in tested]
    confounded = {name for name, c in selection.candidates.items() if c.confounded_with}
    selection = selection.noted(c for c in tested if not (c.reason and c.effect.name in confounded)).noted(losers)
    selection = selection.noted(Candidate(effect, None, reason=why) for effect, why in apart.items())
    return selection.entered(winners) if winners else _try_unsure(selection, tested, rivals)


def find_known(selection: Selection, channel: str) -> list[Candidate]:
    """The effects of a channel that are not in the model and that nothing but chance speaks against, those first that gain
    most; also of those that were dropped."""
    model, screening = selection.model, selection.screening
    off = [e for e in REGISTRY if not model.of_effect(e.name) and not _why_not_asked(e, model)]
    found = [c for c in screening.test(model, off) if c.channel == channel and c.columns]
    rivals: dict = {}
    passed = [c for c in (screening.plausible(model, c, rivals, found) for c in found) if not c.reason]
    return sorted(passed, key=lambda c: -c.evidence.gain)


def _why_not_asked(effect: Effect, model: Model) -> str:
    if effect.beside and not model.of_effect(effect.beside):
        return f"one more element beside {effect.beside}, which is not there"
    if effect.bare and model.bench.clamps:
        return "looked for where nothing is clamped: elsewhere friction and curve look the same"
    if effect.hook == NOT_OF_A_FREE_MOTOR and model.bench.turns_free:
        return "a motor that turns free does not tell it: its current is all there is to explain; a load that is measured"
    return ""


def _settle(model: Model, passed: list[Candidate], shadows: list[Candidate]) -> tuple[Candidate, list[Candidate]]:
    """The candidate to accept out of those that passed in one channel, and the others of equal gain with why they are not;
    ``shadows``: those to which nothing was objected but that something explains much more.

    Two that these logs cannot tell apart, because neither says anything beside the other, are confounded: then the one
    that stands first in the catalogue, where simpler causes come first, is taken, and both are reported so. In the torque of
    a brake they are compared where friction slides: how it turns over is modelled roughly, and must not decide between
    them. It may also make one of two a shadow, which is therefore asked as well."""
    best = max(passed, key=lambda c: c.evidence.gain)
    samples = SLIDING if model.bench.shows_turning(best.channel) else 1
    scale = 2.0 * model.inflation(best.channel) * model.noise(best.channel)

    def says(own: Candidate, beside: Candidate) -> bool:
        evidence = model.evidence(own.channel, own.columns, beside.columns, samples)
        return evidence.p_value < Q_VALUE and evidence.gain > SURE * scale

    asked = [*passed, *shadows]
    gains = {c.effect.name: model.evidence(c.channel, c.columns, samples=samples).gain for c in asked}
    most, rivals, beaten = gains[best.effect.name], [], []
    for other in asked:
        if other is best or gains[other.effect.name] < _CONFOUNDED * most or says(other, best):
            continue
        if says(best, other):
            reason = other.reason or f"explained by {best.effect.name}, beside which it says nothing"
            beaten.append(replace(other, reason=reason))
        else:
            rivals.append(other)
    equal = [best, *(rival for rival in rivals if not rival.reason and gains[rival.effect.name] >= _EQUAL * most)]
    winner = min(equal, key=lambda c: REGISTRY.index(c.effect))
    losers = [c for c in (best, *rivals) if c is not winner]
    beaten += [_confounded(winner, loser)[1] for loser in losers]
    return (_confounded(winner, losers[0])[0] if losers else winner), beaten


def _try_unsure(selection: Selection, tested: list[Candidate], rivals: dict) -> Selection:
    """With a candidate that would explain much, is not sure in the linear test, but is once it has been fitted.

    Where the shape of a strong effect is only guessed, what the guess leaves makes the effect unsure. Once fitted it must pass
    with a correction for all candidates that could have been tried in this way (Bonferroni)."""
    model = selection.model
    large = [
        c
        for c in tested
        if c.channel in FORCE_CHANNELS
        and c.p_value < _UNSURE
        and c.q_value > Q_VALUE
        and c.gain**2 > _LARGE * model.lasting(c.channel, LASTING[c.channel])
    ]
    plausible = [(c, selection.screening.plausible(model, c, rivals)) for c in large]
    plausible = [pair for pair in plausible if not pair[1].reason]
    if not plausible:
        return selection
    candidate, winner = max(plausible, key=lambda pair: pair[0].gain ** 2 / model.noise(pair[0].channel))
    name, shapes = candidate.effect.name, candidate.p_value / max(candidate.evidence.p_value, 1e-300)
    entered = selection.entered([winner])
    if name not in entered.accepted:
        return entered
    amplitudes = [c for c in entered.model.of_effect(name) if not is_shape(c)]
    evidence = _against(entered.model, candidate.effect, dict.fromkeys(amplitudes, 0.0))
    chance = min(1.0, evidence.p_value * shapes * len(REGISTRY))
    if chance > Q_VALUE or evidence.gain <= 0.0:
        return entered.without(name, candidate.reason)
    gain = entered.model.rms(evidence.gain, candidate.channel)
    sure = replace(entered.candidates[name], p_value=evidence.p_value * shapes, q_value=chance, gain=gain)
    return entered.noted([sure])


def _against(model: Model, effect: Effect, values: Values) -> Evidence:
    """That fitted numbers of an effect stand elsewhere than at ``values``, all or those of one group: a few episodes that show
    every order of an uneven disc cannot carry a test of all its numbers. The gain is that of all."""
    together, every = model.evidence_against(values), groups(effect, list(values))
    single = [model.evidence_against({c: values[c] for c in group}) for group in every] if len(every) > 1 else []
    chances = [evidence.p_value for evidence in (together, *single)]
    return replace(together, p_value=min(1.0, min(chances) * len(chances)))


def weigh_confounded(selection: Selection) -> Selection:
    """Of each accepted effect and the one with which it is confounded the one that stays which asks for less of what the
    calibration knows, both fitted beside all that was found; the other is as likely unless the odds are 99 to 1.

    Where friction slides, two causes may be the same torque if torque constant, inertia and friction follow. How far these
    have to move from the calibration is all that can tell."""
    for name in selection.accepted:
        candidate = selection.candidates[name]
        other = selection.candidates.get(candidate.confounded_with or "")
        if candidate.made or other is None:
            continue
        if other.accepted:
            # Both were proven, one beside the other.
            selection = selection.noted([replace(candidate, confounded_with=None, manoeuvre=None)])
            continue
        channel = candidate.channel
        instead = selection.without(name, "").entered([other])
        if other.effect.name not in instead.accepted:
            continue
        models = selection.model, instead.model
        samples = SLIDING if models[0].bench.shows_turning(channel) else 1
        scale = min(model.inflation(channel) * model.noise(channel) for model in models)
        own, others = (model.log_posterior(channel, samples, scale) for model in models)
        better = others - own > _EVEN
        winner, loser = (other, candidate) if better else (candidate, other)
        if better:
            selection = instead
        selection = selection.noted(_weighed(selection.candidates[winner.effect.name], loser, abs(own - others) > SURE))
    return selection


def _weighed(winner: Candidate, loser: Candidate, sure: bool) -> list[Candidate]:
    """Two that were confounded, with what is said of them once the odds are known."""
    if sure:
        reason = f"explained by {winner.effect.name}: for this the calibration would have to be off by more than it may be"
        beaten = replace(loser, accepted=False, reason=reason, confounded_with=None, manoeuvre=None)
        return [replace(winner, confounded_with=None, manoeuvre=None), beaten]
    return list(_confounded(winner, loser))


def _confounded(winner: Candidate, loser: Candidate) -> tuple[Candidate, Candidate]:
    """Two that these logs cannot tell apart, each with the other's name."""
    reason = (
        f"confounded with {winner.effect.name} on these logs, which is simpler or explains more; to separate them: "
        f"{loser.effect.manoeuvre}"
    )
    apart = loser.effect.manoeuvre
    return (
        replace(winner, confounded_with=loser.effect.name, manoeuvre=apart),
        replace(loser, accepted=False, reason=reason, confounded_with=winner.effect.name, manoeuvre=apart),
    )


def revise(selection: Selection) -> Selection:
    """Each accepted effect tested once more with all others in place; what, or which order, no longer holds goes, beginning
    with the least gain: of two that stand for one cause the other holds without it."""
    while failing := [found for name in selection.accepted if (found := _failing(selection, name))]:
        _, name, gone = min(failing, key=lambda found: found[0])
        if len(gone) == sum(not is_shape(c) for c in selection.model.of_effect(name)):
            selection = selection.without(name, "no longer holds beside the other effects")
        else:
            channel = selection.candidates[name].channel
            selection = replace(selection, model=selection.model.without(gone).refined({channel}))
    return selection


def _failing(selection: Selection, name: str) -> tuple[float, str, list[Coordinate]] | None:
    """The gain (RMS over the least that matters) of those amplitudes of an effect that no longer hold, its name and these."""
    model, candidate = selection.model, selection.candidates[name]
    amplitudes = [c for c in model.of_effect(name) if not is_shape(c)]
    if model.chosen.issuperset(amplitudes):
        return None
    from scipy.stats import ttest_1samp

    over_grammar = candidate.made or candidate.names
    floor = selection.screening.floor(model, candidate.channel, candidate.made)
    whole = len(groups(candidate.effect, amplitudes)) == 1
    gone, gains = [], []
    for group in groups(candidate.effect, amplitudes):
        samples = LASTING[candidate.channel] if over_grammar else 1
        evidence = model.evidence_against(dict.fromkeys(group, 0.0), samples)
        gain, chance = model.rms(evidence.gain, candidate.channel), evidence.p_value
        unclear = over_grammar and _is_unclear(evidence)
        if whole and (0.0 < gain < floor if over_grammar else min(gain, Q_VALUE - chance) <= 0.0):
            # Regressors at the end of a long fit do not predict the residual without the effect: its gain is found by a fit
            # without it.
            unclear, without = False, model.without(model.of_effect(name)).refined({candidate.channel})
            fall = np.subtract(*(m.left_out(candidate.channel, samples=samples) for m in (without, model)))
            gain = model.rms(fall.sum(), candidate.channel)
            chance = float(ttest_1samp(fall, 0.0, alternative="greater").pvalue)
        little = gain < floor
        # A term that is above chance over the whole grammar may rest on few episodes, but its gain must matter and its
        # amplitude be clear of zero. An effect that gains too little to matter stays only if it is clear of zero with its
        # prior's share included.
        by_chance = unclear if over_grammar else chance > Q_VALUE
        if (
            gain <= 0.0
            or model.says_nothing(group)
            or by_chance
            or (little and (over_grammar or not _is_carried(model, group)))
        ):
            gone += group
            gains.append(gain / floor)
    return (max(gains), name, gone) if gone else None


def _is_unclear(evidence: Evidence) -> bool:
    """Whether amplitudes are within `_CARRIED` standard deviations (jackknife over episodes) of zero: a term that rests on one
    hot episode may be the best of the whole grammar, and zero in all others."""
    return bool(np.square(evidence.values / evidence.sigmas).sum() < _CARRIED**2 * len(evidence.values))


def _is_carried(model: Model, group: Sequence[Coordinate]) -> bool:
    """Whether amplitudes are beyond `_CARRIED` standard deviations from zero, by the fit's covariance: the jackknife over
    episodes lacks the priors' share of it."""
    values = np.array([model.values[c] for c in group])
    covariance = model.fits[group[0].channel].block(group)
    known = bool(np.isfinite(covariance).all())
    return known and float(values @ np.linalg.pinv(covariance) @ values) > _CARRIED**2 * len(group)


def find_changes(selection: Selection) -> Selection:
    """With what became of the effects that the calibration has already: one that is not as calibrated counts as found."""
    model, found = selection.model, []
    for effect in REGISTRY:
        own = model.of_effect(effect.name)
        if not own or effect.name in selection.candidates:
            continue
        channel = own[0].channel
        start = about_middle({c: c.start for c in own}, model.bench.middle)
        fitted = [c for c in own if c not in model.chosen]
        evidence = _against(model, effect, {c: start[c] for c in fitted})
        gain = model.rms(evidence.gain, channel)
        changed = evidence.p_value < Q_VALUE and gain >= selection.screening.floor(model, channel)
        known = Candidate(effect, channel, tuple(fitted), evidence=evidence, in_calibration=True, accepted=changed)
        reason = "" if changed else "already in the calibration, and as it says"
        found.append(replace(known, p_value=evidence.p_value, q_value=evidence.p_value, gain=gain, reason=reason))
    return selection.noted(found)
