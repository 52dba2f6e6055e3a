"""The whole of a diagnosis: logs and a calibration in; findings, an augmented calibration and figures out."""

import hashlib
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import msgspec
import numpy as np

from emb_daemon import __version__
from emb_daemon.calibration.curves import curve_at
from emb_daemon.calibration.files import date_of_today
from emb_daemon.calibration.parameters import moved, parameter, value_of
from emb_daemon.calibration.terms import REMEMBERING, Term
from emb_daemon.calibration.types import Calibration, Provenance, Source, to_parameters
from emb_daemon.diagnose.comparison import by_log, comparison, errors, whole
from emb_daemon.diagnose.confirmation import (
    HARM,
    NAMED_LESS,
    confirm,
    harm_of_logs,
    left_out_residuals,
    quarters,
    validation_gains,
)
from emb_daemon.diagnose.coordinates import Coordinate, about_middle, by_key, tolerated
from emb_daemon.diagnose.forms import equation
from emb_daemon.diagnose.late_reference import may_be_late, reference_late_s
from emb_daemon.diagnose.model import LASTING, Model, rms_known
from emb_daemon.diagnose.plain import plain_left, plain_rms
from emb_daemon.diagnose.residuals import CHANNEL_OF_HEAT, FORCE_CHANNELS, UNITS, Bench
from emb_daemon.diagnose.screening import NO_RIVALS, Candidate
from emb_daemon.diagnose.search import select
from emb_daemon.diagnose.selection import Progress, Selection
from emb_daemon.diagnose.signals import Outside, outside_range, remembered
from emb_daemon.diagnose.unexplained import Dependence, Left, dependences, is_beyond, least_dependence
from emb_daemon.diagnose.warmth import HeatSearch, heat_bench
from emb_daemon.effects.base import Effect
from emb_daemon.effects.paths import known_delay
from emb_daemon.errors import InputError
from emb_daemon.models.stiffness import characteristic_curve, travel_at
from emb_daemon.offline.levels import force_error_levels, integral_time, lasting_share
from emb_daemon.offline.log import Log
from emb_daemon.offline.score import EpisodeErrors, rmse
from emb_daemon.offline.stretches import without_gaps

#: Least number of episodes that tell effect from chance.
EPISODES = 6
#: A stated noise this many times what is left is none.
_OVERSTATED = 3.0
#: Correlation from which two parameters are known only together.
_TRADE = 0.9
#: Standard deviations from which a base parameter counts as moved.
_MOVED = 2.0
#: Time from which a reference that is later than was told at first is worth a second search, s: a quarter of a cycle; and the
#: parameter of an effect that is an angle's age.
_LATER_S, _DELAY = 0.001, "delay_s"


@dataclass(frozen=True)
class Recalibrated:
    """A base parameter that was estimated anew; ``gain`` is the RMS that it takes away on left-out episodes.

    ``tolerated``: the factor by which units, wear and temperature change it at most, if that is known."""

    before: float
    value: float
    sigma: float
    unit: str
    gain: float
    channel: str
    tolerated: float = np.inf

    @property
    def is_tolerance(self) -> bool:
        """Whether it may have changed by so much, or by what its standard deviation leaves possible."""
        if not np.isfinite(self.tolerated):
            return True
        low, high = sorted((self.before / self.tolerated, self.before * self.tolerated))
        return low - _MOVED * self.sigma <= self.value <= high + _MOVED * self.sigma


@dataclass(frozen=True)
class Diagnosis:
    """Everything that the report shows."""

    calibration: Calibration  #: the augmented one
    bench: Bench
    judges: Bench
    judged_on: str
    selection: Selection  #: what the search chose
    findings: tuple[Candidate, ...]  #: one for each effect of the catalogue, accepted ones first
    recalibrated: Mapping[str, Recalibrated]  #: base parameters, by key
    #: ``before`` and ``after``: errors of the running estimator on what ``judged_on`` says.
    before: EpisodeErrors
    after: EpisodeErrors
    validated: Mapping[str, float]  #: RMS by which each finding lowers its channel's residual on the validation logs
    #: (before, after) RMS of each channel's residual on the validation logs.
    judged_residual: Mapping[str, tuple[float, float]]
    left: Mapping[str, Left]  #: what is left, by channel
    withdrawn: tuple[str, ...]  #: names of what the fit logs prove and confirmation took out again
    outside: Sequence[Outside]  #: where the validation logs leave the range in which a term was found
    seconds: float
    #: RMS (N) that a plain fit to the same logs (`plain`) leaves of the torque path where it is judged, and that this
    #: calibration leaves there; None of a brake, and where no current was recorded.
    plain: tuple[float, float] | None = None
    #: Time by which the reference force came after angle and current, before it was judged at its own.
    reference_late_s: float = 0.0

    @property
    def accepted(self) -> list[Candidate]:
        """Effects that were found, by share explained."""
        return [finding for finding in self.findings if finding.accepted]

    @property
    def unexplained(self) -> Left | None:
        """Where most is left, over what the calibration achieved, if anything is."""
        present = [left for left in self.left.values() if left.present]
        return max(present, key=lambda left: (left.beyond, np.nan_to_num(left.rms / left.achieved)), default=None)

    @property
    def worse(self) -> list[tuple[str, float, float]]:
        """Logs on which the error was judged and has risen, with the error (N) before and after."""
        pairs = (by_log(self.judges, judged, self.whole).tolist() for judged in (self.before, self.after))
        every = zip(self.judges.sources, *pairs, strict=True)
        return [(name, first, last) for name, first, last in every if last > HARM * first]

    @property
    def plainly_better(self) -> tuple[float, float] | None:
        """What a plain fit leaves (N), and this calibration, if the plain fit is clearly better."""
        return self.plain if self.plain and self.plain[1] > HARM * self.plain[0] else None

    @property
    def full_torque(self) -> dict[str, str]:
        """By log what a brake torque does whose number was full, of which nothing was taken."""
        logs = [trial.log for bench in dict.fromkeys((self.bench, self.judges)) for trial in bench.trials]
        return {log.path.name: log.full_torque for log in logs if log.full_torque}

    @property
    def refused(self) -> dict[str, tuple[float, str]]:
        """Channels whose recalibration these logs prove and which is not applied, with what it gains there and why."""
        return {c: told for c, told in self.selection.refused.items() if c in self.selection.not_recalibrated}

    @property
    def whole(self) -> str:
        return whole(self.judges)

    @property
    def stiffness_scale(self) -> float:
        """Force of the mounted pads' curve over that of the calibration, where that is half of the largest."""
        before, after = (curve_at(c.stiffness.curves, c.pad_thickness_mm) for c in (self.bench.calibration, self.calibration))
        travel = travel_at(0.5 * self.bench.calibration.stiffness.maximum_force_N, before)
        return float(characteristic_curve(travel, after)[0] / characteristic_curve(travel, before)[0])

    def figures(self) -> dict[str, dict[str, dict[str, Any]]]:
        """RMSE before and after with intervals, by path and condition."""
        return comparison(self.before, self.after)


def diagnose(
    fit_logs: Sequence[Log],
    calibration: Calibration,
    validate: Sequence[Log] = (),
    progress: Progress = lambda text, share: None,
) -> Diagnosis:
    """Find what the calibration's models lack on ``fit_logs``, add it, and judge on ``validate``.

    Validation logs fit nothing, but have a veto, and a say where left-out episodes are asked whether the force got worse.
    Without them the fit logs judge: each quarter of their episodes by parameters from the other three. Raises InputError: the
    logs cannot tell anything (too short, no motion, no signal to judge by), or judge themselves."""
    begin = time.monotonic()
    _refuse_same(fit_logs, validate)
    progress("cutting the logs into episodes", 0.02)
    bench = Bench(fit_logs, calibration)
    if bench.episodes < EPISODES:
        count = "one episode" if bench.episodes == 1 else f"{bench.episodes} episodes"
        told = (
            f"only {count} (stops, strokes or holds, between which the motor turns), expected at least {EPISODES} to tell "
            "effect from chance"
        )
        raise InputError(f"{fit_logs[0].path}: {told}")
    judges = _judges(validate, bench)
    for judging in filter(None, (bench, judges)):
        _refuse_silent(judging)
    late_s = reference_late_s(bench)
    for again in (True, False):
        if late_s:
            earlier, others = ([log.with_reference_earlier(late_s) for log in logs] for logs in (fit_logs, validate))
            bench = Bench(earlier, calibration)
            judges = _judges(others, bench)
        result = diagnose_bench(bench, judges, progress)
        # What was found may have hidden that the reference is later still.
        later_s = _later_s(result) if again else 0.0
        if not later_s:
            break
        late_s += later_s
    return replace(result, seconds=time.monotonic() - begin, reference_late_s=late_s)


def _later_s(result: Diagnosis) -> float:
    """Time (s) by which the reference force is later still, by what was found, if that is worth a second search; asked where
    something is left, or an angle was found to be of a time that is still to come: that is the reference's, however short the
    time is, unless the current says otherwise."""
    found = result.calibration
    before_s, after_s = (known_delay(to_parameters(c)["effects"]) for c in (result.bench.calibration, found))
    known_s = min(before_s, 0.0)
    early_s = max(known_s - after_s, 0.0)
    if result.unexplained is None and not early_s:
        return 0.0
    delays = {f"effects.{name}.{_DELAY}": known_s for name, values in found.effects.items() if _DELAY in values}
    bench = result.bench.under(moved(found, delays) if early_s else found)
    later_s = reference_late_s(bench)
    if later_s >= _LATER_S:
        return later_s
    return early_s if early_s and may_be_late(bench) else 0.0


def diagnose_bench(bench: Bench, judges: Bench | None, progress: Progress) -> Diagnosis:
    """The same of logs that are cut into episodes already; ``judges``: the validation logs."""
    begin, calibration = time.monotonic(), bench.calibration
    judged_on = "validate" if judges else "left_out_episodes"
    chosen = select(bench, progress)
    progress("confirming with the running estimator", 0.8)
    selection, left_out = confirm(chosen, judges)
    applied = selection.applied()
    found = with_terms(selection.model.bench.calibrated(applied), selection) if applied else calibration
    augmented = _with_lasting(_with_noise(found, selection) if applied else found, selection)
    progress("judging", 0.9)
    judging = judges or bench
    before = errors(judging, calibration)
    after = errors(judging, augmented) if judges else left_out
    if judges and harm_of_logs(judges, before, after)[0]:
        # What was found the validation logs have not refused; then it is how the noise, stated anew, weighs the paths.
        augmented, after = found, errors(judges, found)
    final = judging.under(augmented).residuals({}) if judges else selection.model.residual
    judged_before = judging.residuals({})
    made = [term for term in augmented.terms if term.name in selection.accepted]
    result = Diagnosis(
        calibration=_with_provenance(augmented, selection, after, judged_on),
        bench=bench,
        judges=judging,
        judged_on=judged_on,
        selection=selection,
        findings=findings(selection, chosen),
        recalibrated=_list_recalibrated(selection),
        before=before,
        after=after,
        validated=validation_gains(selection, judges) if judges else {},
        judged_residual={c: (rms_known(judged_before[c]), rms_known(final[c])) for c in judging.channels} if judges else {},
        left=_left(selection, chosen, judged_before, final, judging, augmented),
        withdrawn=_names_withdrawn(selection, chosen),
        outside=outside_range(judges.under(augmented), made) if judges else (),
        plain=_plain(selection, judges, final),
        seconds=time.monotonic() - begin,
    )
    progress("done", 1.0)
    return result


def _judges(validate: Sequence[Log], bench: Bench) -> Bench | None:
    """The validation logs, if there are any, judged by the same as those of ``bench`` are fitted by."""
    return Bench(validate, bench.calibration, load_follows=bench.load_follows) if validate else None


def _plain(selection: Selection, judges: Bench | None, final: Mapping[str, np.ndarray]) -> tuple[float, float] | None:
    """`Diagnosis.plain`: on the validation logs, of which ``final`` are the residuals, or on each quarter of the episodes by a
    fit to the others."""
    bench = selection.model.bench
    if bench.clamps or "torque" not in bench.channels:
        return None
    told = bench.residuals({})["torque"] != 0.0
    if judges:
        ours = final["torque"]
        return plain_rms(plain_left(bench, told, judges, ours != 0.0)), rms_known(ours)
    ours = left_out_residuals(selection)["torque"]
    left = np.zeros_like(ours)
    for own in quarters(bench):
        rows = own[bench.sample_episode]
        left += plain_left(bench, told & ~rows, bench, told & rows & (ours != 0.0))
    return plain_rms(left), rms_known(ours)


def _refuse_same(fit_logs: Sequence[Log], validate: Sequence[Log]) -> None:
    for judge in validate:
        for log in fit_logs:
            if len(judge.samples) == len(log.samples) and judge.samples.tobytes() == log.samples.tobytes():
                raise InputError(f"{judge.path}: is {log.path}, which chooses; expected another log to judge")


def _refuse_silent(bench: Bench) -> None:
    if any(np.any(residual) for residual in bench.residuals({}).values()):
        return
    log = bench.trials[0].log
    if bench.turns_free and all(trial.stands.all() for trial in bench.trials):
        raise InputError(f"{log.path}: the motor stands throughout without a load, and friction holds it whatever its current")
    apart = 1e3 * float(np.median(log.samples["dt"]))
    raise InputError(
        f"{log.path}: no sample of it can be judged; expected motor, current and reference at 100 Hz or more, or slower "
        f"motion: its samples are {apart:.3g} ms apart"
    )


def findings(selection: Selection, chosen: Selection) -> tuple[Candidate, ...]:
    """What became of every effect and term, with values as they are applied; of what confirmation took out again as the search
    fitted it (``chosen``). Accepted ones first, each group by share explained."""
    described = {name: _describe(selection, candidate) for name, candidate in selection.candidates.items()}
    for name in _names_withdrawn(selection, chosen):
        found = _describe(chosen, chosen.candidates[name])
        described[name] = replace(found, accepted=False, reason=selection.candidates[name].reason)
    return tuple(sorted(described.values(), key=lambda f: (not f.accepted, f.in_calibration, -f.share_explained)))


def _names_withdrawn(selection: Selection, chosen: Selection) -> tuple[str, ...]:
    """Names of what was proven on its own path, but is not in use; not of what effects of the catalogue explain in its
    place."""
    found = selection.candidates
    gone = [name for name in chosen.accepted if name in found and not found[name].accepted]
    return tuple(name for name in gone if found[name].reason != NAMED_LESS)


def _describe(selection: Selection, candidate: Candidate) -> Candidate:
    model, effect = selection.model, candidate.effect
    own = model.of_effect(effect.name)
    if not own or not (candidate.accepted or candidate.in_calibration):
        return candidate
    on = model.bench.calibration.effects.get(effect.name, {})
    applied = by_key({c: model.values[c] for c in own}, model.bench.middle)
    values = {p.name: on.get(p.name, 0.0) for p in effect.parameters} | {c.parameter: applied[c.name] for c in own}
    if not candidate.accepted and own[0].channel not in selection.touched:
        values = dict(on)
    sigmas = dict.fromkeys(values, 0.0) | _sigmas(model, effect, own)
    described = replace(candidate, values=values, sigmas=sigmas, before=dict(on))
    if not candidate.accepted:
        return described
    start = about_middle({c: c.start for c in own}, model.bench.middle)
    without = model.entered(start) if candidate.in_calibration else model.without(own)
    first, last, bare = (
        float(r[candidate.channel] @ r[candidate.channel])
        for r in (selection.screening.initial, model.residual, without.residual)
    )
    share = float(np.clip((bare - last) / first, 0.0, 1.0)) if first > 0.0 else 0.0
    does = without.residual[candidate.channel] - model.residual[candidate.channel]
    described = replace(described, share_explained=share, contribution=does)
    if candidate.made:
        [term] = (term for term in model.bench.calibrated(model.values).terms if term.name == effect.name)
        return replace(described, effect=replace(effect, equation=equation(term)))
    return replace(described, reason=_why(candidate) + _tradeoffs(model, effect, own))


def _why(candidate: Candidate) -> str:
    over = "the whole grammar" if candidate.names else "turns of the disc" if candidate.effect.by_turns else "episodes"
    gain = f"{candidate.gain:.3g} {UNITS[candidate.channel]}"
    text = f"q = {candidate.q_value:.1g} over {over}, gains {gain} on left-out episodes"
    if candidate.in_calibration:
        text = f"not as calibrated: {text}"
    for disturbed, share in candidate.placebos.items():
        text += f"; {disturbed}: {100 * share:.0f} % of it"
    if candidate.confounded_with:
        text += f"; confounded with {candidate.confounded_with} on these logs; to separate them: {candidate.manoeuvre}"
    if candidate.channel == "innovation":
        text += "; from the difference of both paths: no reference was recorded"
    return text


def _sigmas(model: Model, effect: Effect, own: Sequence[Coordinate]) -> dict[str, float]:
    """Standard deviations by parameter. A harmonic's cosine and sine are as sure as its amplitude; a shift of its order only
    turns them."""
    found = {c.parameter: float(model.fits[c.channel].sigmas.get(c, 0.0)) for c in own}
    if effect.harmonic:
        pair = [name for name in (effect.harmonic.cosine, effect.harmonic.sine) if name in found]
        found |= dict.fromkeys(pair, rmse(np.array([found[name] for name in pair])))
    return found


def _tradeoffs(model: Model, effect: Effect, own: Sequence[Coordinate]) -> str:
    """Which parameters of an effect these logs know only together."""
    text, fitted = "", model.fits[own[0].channel]
    known = [c for c in own if c in fitted.keys and not effect.parameter(c.parameter).group]
    for one, other in combinations(known, 2):
        covariance = fitted.block([one, other])
        if abs(covariance[0, 1]) > _TRADE * np.sqrt(covariance[0, 0] * covariance[1, 1]):
            names = f"{one.parameter} and {other.parameter}"
            text += f"; {names} trade off on these logs: what they do together is known better than either"
    return text


def _list_recalibrated(selection: Selection) -> dict[str, Recalibrated]:
    """Base parameters that moved, as applied. Parameters that move together (the curve's coefficients) have one gain: what
    left-out episodes lose without them, everything else free. That is found by running the estimator without them, because
    regressors at the end of a long fit do not predict the residual at its beginning."""
    model, calibration = selection.model, selection.model.bench.calibration
    base = [c for c, value in selection.applied().items() if not c.effect and value != c.start]
    groups: dict[str, list[Coordinate]] = {}
    for c in base:
        groups.setdefault(c.name.partition("[")[0].removesuffix(".over_force").removesuffix(".over_speed"), []).append(c)
    result = {}
    for group in groups.values():
        channel, gain = group[0].channel, 0.0
        # Coordinates that stand as chosen were fitted elsewhere, so that no gain is computed here.
        if not model.chosen.issuperset(group):
            rest = [c for c in model.movable(channel) if c not in group]
            without = model.bench.residual_held({**model.values, **{c: c.start for c in group}}, channel, model.heat)
            gain = model.rms(model.left_out(channel, rest, without).sum() - model.left_out(channel).sum(), channel)
        for c in group:
            size = next((move.weight for move in c.moves if move.key == c.name), 1.0)
            sigma = c.sigma_of(model.values[c], model.fits[c.channel].sigmas.get(c, 0.0)) * abs(size)
            value = model.values[c] * size
            known = any(move.key == c.name for move in c.moves)
            before = value_of(calibration, c.name) if known else c.start
            unit = parameter(calibration, c.name).unit if known else "1"
            if abs(value - before) < _MOVED * sigma and gain < selection.screening.floor(model, c.channel):
                continue
            key = c.name if c.log is None or len(model.bench.trials) == 1 else f"{c.name} (log {c.log + 1})"
            result[key] = Recalibrated(
                before, float(value), float(sigma), unit, gain, c.channel, tolerated(calibration, c.name)
            )
    return result


def _left(
    selection: Selection,
    chosen: Selection,
    before: Mapping[str, np.ndarray],
    after: Mapping[str, np.ndarray],
    judging: Bench,
    augmented: Calibration,
) -> dict[str, Left]:
    """What is left in each channel: its size where the error is judged, and its dependences where effects were looked for.

    ``chosen``: the selection before confirmation, which may have taken out what these logs prove."""
    model, screening, result = selection.model, selection.screening, {}
    force = _force_of(judging) if judging.has_reference else screening.signals["clamp_force"]
    rise = np.concatenate([(t.temperature_C - t.temperature_C[:1]).ravel() for t in judging.trials])
    for channel in model.bench.channels:
        if channel not in after:
            continue
        found: list[Dependence] = []
        # What a calibration's own data left is in its noise already, sample by sample.
        samples = 1 if model.bench.own_data else LASTING[channel]
        if channel in FORCE_CHANNELS:
            gains = screening.dependence(model, channel, samples)
            gains = {name: pair for name, pair in gains.items() if name not in NO_RIVALS.get(channel, ())}
            least = screening.floor(model, channel)
            if not model.bench.own_data:
                least = max(least, least_dependence(model.residual[channel], samples))
            found = dependences(channel, gains, model.counted(channel), least)
        means = None if model.bench.own_data else judging.means(channel, samples)
        first, last = (rms_known(residual[channel], means) for residual in (before, after))
        known, log, time_s = screening.achieved(model, channel, force, rise, samples), "", None
        if channel in FORCE_CHANNELS and not is_beyond(last, known):
            each = _by_log(selection, channel, judging, before[channel], after[channel])
            if channel in selection.not_recalibrated:
                each += _by_log(selection, channel, model.bench, *2 * [screening.initial[channel]])
            if beyond := [one for one in each if is_beyond(*one[1:3])]:
                first, last, known, log = max(beyond, key=lambda one: one[1] / one[2])
            elif channel == "stiffness" and (alone := _in_one_episode(selection, judging, before[channel], after[channel])):
                first, last, known, log, time_s = alone
        if channel == CHANNEL_OF_HEAT and (heat := heat_bench((t.log for t in judging.trials), judging.calibration)):
            # Where the brake torque is measured the pads' friction has no share in it.
            first, last = (rms_known(heat.residual_of(to_parameters(c))) for c in (judging.calibration, augmented))
            known = screening.achieved(model, channel, force, np.zeros(0), samples)
            found = _heat_dependences(selection, augmented) if is_beyond(last, known) else []
        withdrawn = _withdrawn(selection, chosen, channel)
        found = [*withdrawn, *(d for d in found if d.signal not in {w.signal for w in withdrawn})]
        found.sort(key=lambda dependence: -dependence.share)
        share = (last / first) ** 2 if first > 0.0 else 0.0
        fitted = float("nan") if log or judging is model.bench else _left_of_fitted(selection, channel, last, known)
        result[channel] = Left(channel, last, known, share, tuple(found), log, time_s, fitted)
    return result


def _left_of_fitted(selection: Selection, channel: str, rms: float, known: float) -> float:
    """What lasts of a channel on the fitted logs (RMS) by the forces of the judging ones, of which the calibration achieves
    ``known``, where ``rms`` is left of these; NaN where no term was made, or the difference does not matter.

    A term's shape is a guess beyond what was fitted. What no term was made for differs from log to log as the calibration's
    own figures do, and is held against these alone."""
    model, screening = selection.model, selection.screening
    made = [name for name in selection.accepted if selection.candidates[name].made and selection.channel_of(name) == channel]
    if not made or channel not in FORCE_CHANNELS or not model.bench.has_reference:
        return float("nan")
    samples = LASTING[channel]
    own = screening.achieved(model, channel, _force_of(model.bench), np.zeros(0), samples)
    left = rms_known(model.residual[channel], model.bench.means(channel, samples)) * known / own
    return left if rms**2 - left**2 >= screening.floor(model, channel) ** 2 else float("nan")


def _by_log(
    selection: Selection, channel: str, bench: Bench, before: np.ndarray, after: np.ndarray
) -> list[tuple[float, float, float, str]]:
    """What lasts of a channel before and after, RMS, what the calibration achieved, and the log: of each with episodes enough
    to tell it from chance. An error of one log would be averaged away by logs without it."""
    if not bench.has_reference or bench.own_data:
        return []
    samples, force, result = LASTING[channel], _force_of(bench), []
    means, index = bench.means(channel, samples), _index_of_log(bench)
    for number, trial in enumerate(bench.trials):
        if trial.episode[-1] + 1 >= EPISODES:
            own = index == number
            known = selection.screening.achieved(selection.model, channel, force[own], np.zeros(0), samples)
            pair = (rms_known(np.where(own, residual, 0.0), means) for residual in (before, after))
            result.append((*pair, known, bench.sources[number]))
    return result


def _in_one_episode(
    selection: Selection, bench: Bench, before: np.ndarray, after: np.ndarray
) -> tuple[float, float, float, str, float] | None:
    """The same of the stiffness path in the worst of the episodes, with the time (s) of its middle; None where that is no more
    than chance, or does not matter in all logs.

    What holds on the fitted logs may not hold on a stop that is hotter or harder than those, and hundreds of newtons in one
    are little in the mean of many. Not of the torque path: friction is not the same in all stops, which is stated
    (`_with_lasting`)."""
    channel, samples = "stiffness", LASTING["stiffness"]
    if not bench.has_reference or bench.own_data:
        return None
    means, episode = bench.means(channel, samples), bench.episode[channel]
    squared = np.bincount(means.episode, means.of(after[:, None])[:, 0] ** 2, bench.episodes)
    least = selection.screening.floor(selection.model, channel) ** 2 * np.count_nonzero(after * means.told)
    force, index, result = _force_of(bench), _index_of_log(bench), []
    time_s = np.concatenate([trial.log.time_s for trial in bench.trials])
    for number in np.flatnonzero(squared > least).tolist():
        own = episode == number
        known = selection.screening.achieved(selection.model, channel, force[own], np.zeros(0), samples)
        first, last = (rms_known(np.where(own, residual, 0.0), means) for residual in (before, after))
        if is_beyond(last, known, alone=True):
            result.append((first, last, known, bench.sources[index[own][0]], float(time_s[own].mean())))
    return max(result, key=lambda one: one[1] / one[2], default=None)


def _index_of_log(bench: Bench) -> np.ndarray:
    """Number of the log that each sample is of, shape (N,)."""
    return np.repeat(range(len(bench.trials)), [len(trial.episode) for trial in bench.trials])


def _force_of(bench: Bench) -> np.ndarray:
    """Reference force (N) at every sample, nothing where it is not known."""
    return np.concatenate([np.nan_to_num(trial.force_N) for trial in bench.trials])


def _withdrawn(selection: Selection, chosen: Selection, channel: str) -> list[Dependence]:
    """Dependences of a channel's lasting residual on the signals of effects or terms that confirmation took out again, where
    they matter and nothing else explains them now.

    Something is there: these logs prove it. But what does not hold on other logs, or harms the estimator, is not that
    effect."""
    gone = [chosen.candidates[name] for name in chosen.accepted if name not in selection.accepted]
    signals = list(dict.fromkeys(c.effect.signal for c in gone if c.channel == channel))
    if not signals:
        return []
    without, with_ = (s.model.left_out(channel, samples=LASTING[channel]) for s in (selection, chosen))
    floor = selection.screening.floor(selection.model, channel, made=True)
    found = dependences(channel, dict.fromkeys(signals, (without, with_)), selection.model.counted(channel), floor)
    return [replace(d, matters=True) for d in found if d.rms >= floor]


def _heat_dependences(selection: Selection, augmented: Calibration) -> list[Dependence]:
    """What the rest of the heat balance follows, by the best form of each signal at any of its ports."""
    bench = heat_bench((trial.log for trial in selection.model.bench.trials), augmented)
    if bench is None:
        return []
    model, floor = bench.model(), selection.screening.floor(selection.model, CHANNEL_OF_HEAT, made=True)
    return dependences(CHANNEL_OF_HEAT, HeatSearch(model).dependence(), model.counted(CHANNEL_OF_HEAT), floor)


def undecided(selection: Selection) -> dict[str, float]:
    """RMS difference between accepted terms and those that are as likely, as a share of the clamp force, by the key of the
    noise that has to cover it; empty for a motor that turns free, whose force is zero."""
    size, result = selection.screening.force_N, {}
    if size <= 0.0:
        return result
    for candidate in map(selection.candidates.__getitem__, selection.accepted):
        key = f"noise.{candidate.channel}_relative"
        if candidate.channel in ("stiffness", "torque") and candidate.undecided_N > 0.0:
            result[key] = float(np.hypot(result.get(key, 0.0), candidate.undecided_N / size))
    return result


def _with_noise(calibration: Calibration, selection: Selection) -> Calibration:
    """The calibration with new noise of its paths: less of the stiffness path where its residual was explained, and more by
    what terms as likely as the accepted ones would change (`undecided`)."""
    calibration = _with_less_noise(_with_softening_shown(calibration, selection), selection)
    more = undecided(selection)
    return moved(calibration, {key: float(np.hypot(value_of(calibration, key), share)) for key, share in more.items()})


def _with_softening_shown(calibration: Calibration, selection: Selection) -> Calibration:
    """The calibration with what its own logs leave open of a softening that none had shown before."""
    left_open = calibration.thermal.softening.sigma_per_K
    for c in selection.applied():
        if c.name == "thermal.softening.per_K":
            left_open = min(left_open, selection.model.fits[c.channel].sigmas.get(c, np.inf))
    return moved(calibration, {"thermal.softening.sigma_per_K": float(left_open)})


def _with_less_noise(calibration: Calibration, selection: Selection) -> Calibration:
    """The calibration with the stiffness path's noise as it now is, if what it states contains what has been explained.

    Otherwise the filter would trust the stiffness path too little. The noise is never raised: an unexplained residual is no
    noise."""
    noise, model = calibration.noise, selection.model
    if "stiffness" not in selection.touched:
        return calibration
    residual, force = model.residual["stiffness"], selection.screening.signals["clamp_force"]
    known = residual != 0.0
    stated = rmse(np.hypot(noise.stiffness_N, noise.stiffness_relative * force[known]))
    if stated < _OVERSTATED * rmse(residual[known]):
        return calibration
    floor, relative = force_error_levels(residual[known], force[known])
    levels = msgspec.structs.replace(
        noise,
        stiffness_N=floor,
        stiffness_relative=relative,
        stiffness_correlation_s=integral_time(model.bench.by_log(residual)),
    )
    return msgspec.structs.replace(calibration, noise=levels)


def _with_lasting(calibration: Calibration, selection: Selection) -> Calibration:
    """The calibration with the relative error of the torque that nothing explains and that lasts for a manoeuvre, if that is
    more than it states: the filter would take it for other pads. What is the same in all of them it learns, and what the
    calibration grants a gear that wears."""
    bench = selection.model.bench
    residual = bench.residuals(selection.applied()).get("torque")
    if residual is None or not (bench.has_reference and bench.clamps):
        return calibration
    loads = np.where(residual != 0.0, selection.screening.signals["clamp_force"], 0.0)
    apart = residual - (residual @ loads) / max(loads @ loads, 1.0) * loads
    worst, noise = 0.0, calibration.noise
    for error, force in zip(bench.by_log(apart), bench.by_log(loads), strict=True):
        rows = np.flatnonzero(error)
        pairs = zip(without_gaps(rows, error[rows]), without_gaps(rows, force[rows]), strict=True)
        worst = max(worst, lasting_share(pairs, calibration.stiffness.maximum_force_N))
    beyond = float(np.sqrt(max(worst**2 - noise.torque_relative**2, 0.0)))
    return moved(calibration, {"noise.torque_lasting": max(beyond, noise.torque_lasting)})


def with_terms(calibration: Calibration, selection: Selection) -> Calibration:
    """The calibration with the terms that are in use, each with its standard deviation and where it comes from."""
    model, kept = selection.model, []
    for term in calibration.terms:
        if term.name not in selection.candidates:
            kept.append(term)
        elif selection.candidates[term.name].accepted:
            own = [c for c in model.of_effect(term.name) if c.parameter in ("coefficient", "sine")]
            sigma = float(np.max([model.fits[c.channel].sigmas.get(c, 0.0) for c in own]))
            logs = ", ".join(model.bench.sources)
            found = f"{date_of_today()} in {logs}"
            term = msgspec.structs.replace(term, sigma=sigma if np.isfinite(sigma) else 0.0, provenance=found)
            kept.append(_with_memory(term, model.bench, calibration))
    return msgspec.structs.replace(calibration, terms=tuple(kept))


def _with_memory(term: Term, bench: Bench, calibration: Calibration) -> Term:
    """The term with the range of what it remembered in the bench's logs, estimated with this calibration."""
    if term.memory not in REMEMBERING:
        return term
    held = remembered(bench.under(calibration), term)
    low, high = float(held.min()), float(held.max())
    return msgspec.structs.replace(term, memory_low=low, memory_high=high) if low < high else term


def _with_provenance(calibration: Calibration, selection: Selection, after: EpisodeErrors, judged_on: str) -> Calibration:
    old = calibration.provenance
    sigmas, figures = (dict(old.sigmas), dict(old.figures)) if old else ({}, {})
    for c in selection.applied():
        sigma = selection.model.fits[c.channel].sigmas.get(c, np.inf)
        weight = next((abs(move.weight) for move in c.moves if move.key == c.name), 0.0)
        if weight and np.isfinite(sigma) and not c.name.startswith("terms["):
            sigmas[c.name] = float(sigma * weight)
    figures |= {f"diagnose.{judged_on}.{path}_rmse_N": after.rmse(path) for path in after.paths}
    paths = [trial.log.path for trial in selection.model.bench.trials if trial.log.path.is_file()]
    sources = tuple(Source(log=path.name, sha256=hashlib.sha256(path.read_bytes()).hexdigest()) for path in paths)
    provenance = Provenance(
        date=date_of_today(),
        tool=f"emb-daemon diagnose {__version__}",
        campaign=old.campaign if old else "",
        logs=(old.logs if old else ()) + sources,
        figures={name: value for name, value in figures.items() if np.isfinite(value)},
        achieved=old.achieved if old else {},
        sigmas=sigmas,
    )
    return msgspec.structs.replace(calibration, provenance=provenance)
