"""Confirmation: the running estimator itself must improve on data that were not fitted.

Every accepted suspect must lower the residual of its own path on episodes left out of the fit, with the contact angle held,
because otherwise that would take over an error of the other path and contradict a true term. The error of the fused force
must not rise either, nor clearly that of a single log, unless all together gain by a larger factor: a fit that gains a little
on a log with large errors may ruin all others, which the mean would not show. Validation logs, if given, have a veto. What
fails is taken out one by one, and the rest is refitted. Where only what was recalibrated beside an effect does harm, that goes
and the effect stays.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace

import numpy as np

from emb_daemon.diagnose.comparison import by_log, episodes_by_log, errors, errors_of, whole
from emb_daemon.diagnose.coordinates import Coordinate
from emb_daemon.diagnose.evidence import Moments, leave_out, solve_within
from emb_daemon.diagnose.model import is_shape
from emb_daemon.diagnose.residuals import FORCE_CHANNELS, UNITS, Bench
from emb_daemon.diagnose.screening import Q_VALUE
from emb_daemon.diagnose.selection import TOO_LARGE, Selection, revise
from emb_daemon.diagnose.unexplained import CLEARLY
from emb_daemon.offline.score import EpisodeErrors, rmse

#: Parts into which the episodes are dealt.
_FOLDS = 4
#: Factor on the fused error from which it has become worse. Learning of the contact angle and the reference's noise cause
#: smaller changes, if an effect is real but the fused force rests on the other path.
HARM = 1.05
#: The same for a single log, whose few episodes scatter more: the factor from which a residual counts as unexplained.
_LOG_HARM = CLEARLY
#: Why a term goes for effects of the catalogue, which explain in its place what it did.
NAMED_LESS = "effects of the catalogue alone leave less of left-out episodes and validation logs"
#: Share of the samples with a force before that must have one after: a delay takes some at the edges.
_KEPT = 0.99


def confirm(selection: Selection, judges: Bench | None) -> tuple[Selection, EpisodeErrors]:
    """The selection without everything that makes the running estimator worse; what effects of the catalogue alone make of it
    if they leave less of a path than terms for which some of them went.

    Returns it with the errors on left-out episodes. ``judges``: the validation logs."""
    confirmed = _confirmed(selection, judges)
    if selection.longer is not None and {*confirmed[0].accepted} <= {*selection.longer.accepted}:
        confirmed = _with_longer(confirmed, selection.longer, judges)
    if selection.instead is None:
        return confirmed
    alone = _confirmed(selection.instead, judges)
    made, named = _left(confirmed[0], judges), _left(alone[0], judges)
    terms = [c for c in selection.candidates.values() if c.made]
    if all(made[c.channel] < named[c.channel] for c in terms if c.accepted and c.channel in made):
        return confirmed
    return alone[0].noted(replace(c, accepted=False, reason=NAMED_LESS if c.accepted else c.reason) for c in terms), alone[1]


def _with_longer(
    confirmed: tuple[Selection, EpisodeErrors], longer: Selection, judges: Bench | None
) -> tuple[Selection, EpisodeErrors]:
    """The same, or with the terms that went because their path is described more shortly without them. It is not if the refit
    that describes it so was taken out again: then they stay, if what is confirmed with them leaves less of the path."""
    terms = [name for name in longer.accepted if name not in confirmed[0].accepted]
    paths = {longer.candidates[name].channel for name in terms}
    if not terms or not paths <= confirmed[0].not_recalibrated:
        return confirmed
    found = _confirmed(longer, judges)
    left, without = _left(found[0], judges), _left(confirmed[0], judges)
    return found if all(left[path] < without[path] for path in paths & left.keys()) else confirmed


def _left(selection: Selection, judges: Bench | None) -> dict[str, float]:
    """Mean square by force path, N², of what is left of left-out episodes and validation logs."""
    parts = [left_out_residuals(selection)]
    if judges:
        parts.append(judges.under(selection.model.bench.calibrated(selection.applied())).residuals({}))
    there = [c for c in FORCE_CHANNELS if all(c in part for part in parts)]
    return {c: float(np.mean(np.concatenate([part[c] for part in parts]) ** 2)) for c in there}


def _confirmed(selection: Selection, judges: Bench | None) -> tuple[Selection, EpisodeErrors]:
    """The selection without everything that makes the running estimator worse.

    Returns it with the errors on left-out episodes."""
    bench, recalibrated = selection.model.bench, selection.recalibrated
    before, main, held = errors(bench, bench.calibration), whole(bench), bench.residuals({})
    withdrawn: list[str] = []

    def judged(tried: Selection) -> tuple[EpisodeErrors, tuple[str, str] | None]:
        after = left_out_errors(tried)
        return after, _against(tried, judges, before, after, held) or (_veto(tried, judges) if judges else None)

    while True:
        for name in _beyond_bounds(selection):
            selection = selection.without(name, TOO_LARGE)
        after, against = judged(selection)
        if against is None:
            break
        if instead := _instead(selection, against, judges, judged):
            selection = instead
            continue
        withdrawn.append(against[0])
        selection = selection.without(*against)
    # A recalibration may have gone for what something else did that went later.
    for channel in withdrawn[:-1]:
        if channel in recalibrated and channel not in selection.touched:
            more = {**selection.recalibrated, channel: recalibrated[channel]}
            again = replace(selection, recalibrated=more, model=selection.model.refined({channel}))
            its, against = judged(again)
            if against is None and not harm(after, its, main):
                selection, after = again, its
    return selection, after


def _instead(
    selection: Selection,
    against: tuple[str, str],
    judges: Bench | None,
    judged: Callable[[Selection], tuple[EpisodeErrors, tuple[str, str] | None]],
) -> Selection | None:
    """Where something speaks ``against`` an effect, the selection with it, but without what was recalibrated beside the
    effects of a path, or, if the effect is not all that does harm, without anything of another path; None if something speaks
    against each, or the effect's path is described better without the effect.

    What a recalibration does to the estimator goes with its path's effects otherwise: of all effects the one goes first
    without which least is left, and that may be a true one of the other path."""
    suspect, reason = against
    own = selection.channel_of(suspect)
    if suspect == own or own not in FORCE_CHANNELS:
        return None
    bare = selection.without(suspect, reason)
    does_all_harm = judged(bare)[1] is None
    paths = sorted(selection.touched & {*FORCE_CHANNELS}, key=lambda channel: channel != own)
    for channel in (c for c in paths if c not in selection.held):
        held = revise(selection.with_base_held(channel, reason))
        if suspect not in held.accepted or judged(held)[1] is not None:
            continue
        left, without = _left(held, judges), _left(bare, judges)
        if not does_all_harm or left.get(own, np.inf) < without.get(own, np.inf):
            return held
    for channel in () if does_all_harm else (c for c in paths if c != own):
        alone = selection
        while gone := [name for name in alone.suspects if alone.channel_of(name) == channel]:
            alone = alone.without(gone[0], reason)
        if judged(alone)[1] is None:
            return alone
    return None


def _against(
    selection: Selection, judges: Bench | None, before: EpisodeErrors, after: EpisodeErrors, held: Mapping[str, np.ndarray]
) -> tuple[str, str] | None:
    """The suspect against which left-out episodes speak most, with the reason in words; ``held``: residuals before by channel,
    N.

    Validation logs, on which the whole estimator runs as well and which fitted nothing either, speak of its error together
    with them: in one log, where its contact angle wanders may hide what it gains."""
    bench = selection.model.bench
    main = whole(bench)
    if rise := _own_harm(selection, held):
        return rise

    beside = judges if judges and whole(judges) == main else None

    def unseen(left_out: EpisodeErrors, without: str = "") -> EpisodeErrors:
        if beside is None:
            return left_out
        return EpisodeErrors.joined([left_out, errors(beside, bench.calibrated(selection.applied(without)))])

    was = EpisodeErrors.joined([before, errors(beside, bench.calibration)]) if beside else before
    if (worse := harm(was, unseen(after), main)) and selection.suspects:
        rest = {suspect: unseen(left_out_errors(selection, suspect), suspect).rmse(main) for suspect in selection.suspects}
        where = "left-out episodes and validation logs" if beside else "left-out episodes"
        return min(rest, key=rest.__getitem__), f"{worse} on {where}"
    if (ruined := _ruined(bench, before, after, main)) and (guilty := _guilty(selection, ruined[1])):
        told, own = ruined
        rest = {suspect: _product(left_out_errors(selection, suspect), main, own) for suspect in guilty}
        worst = min(rest, key=rest.__getitem__)
        if rest[worst] < _product(after, main, own):
            return worst, f"{told} on left-out episodes"
    return None


def _product(judged: EpisodeErrors, main: str, own: np.ndarray) -> float:
    """A log's ``main`` error (its episodes are the ``own`` ones) times that of all logs, N². The product rises where one log
    loses by a larger factor than all gain. By mean squares a small gain on logs with a large error would outweigh any loss."""
    return judged.rmse(main, weights=own) * judged.rmse(main)


def _ruined(bench: Bench, before: EpisodeErrors, after: EpisodeErrors, main: str) -> tuple[str, np.ndarray] | None:
    """What became of the log whose ``main`` error rose most, where that is clear, and which episodes are its own."""
    first, last = by_log(bench, before, main), by_log(bench, after, main)
    ratios = np.nan_to_num(np.divide(last, first, out=np.zeros_like(last), where=first > 0.0))
    worst = int(np.argmax(ratios))
    if ratios[worst] <= _LOG_HARM:
        return None
    change = f"goes from {first[worst]:.4g} to {last[worst]:.4g} N"
    return f"the estimator's {main} error on {bench.sources[worst]} {change}", episodes_by_log(bench)[worst]


def _guilty(selection: Selection, there: np.ndarray) -> list[str]:
    """Suspects that may have ruined episodes, ``there`` as weights, shape (episodes,).

    Logs that the calibration was fitted to will have its noise stated anew, and with it how the paths are weighed. Until then
    what makes its own path better there has not ruined it."""
    if not selection.model.bench.own_data:
        return selection.suspects
    weight = np.sqrt(there)[selection.model.bench.sample_episode]

    def left(without: str) -> dict[str, float]:
        return _sizes({c: r * weight for c, r in left_out_residuals(selection, without).items() if c in FORCE_CHANNELS})

    with_all = left("")
    channel = {suspect: selection.channel_of(suspect) for suspect in selection.suspects}
    return [suspect for suspect, c in channel.items() if c not in with_all or left(suspect)[c] < with_all[c]]


def _beyond_bounds(selection: Selection) -> list[str]:
    """Accepted terms that the last fit has made larger than a calibration may hold."""
    fitted = selection.model.bench.calibrated(selection.applied())
    return [term.name for term in fitted.terms if term.name in selection.accepted and not term.is_bounded]


def _sizes(residual: Mapping[str, np.ndarray]) -> dict[str, float]:
    """RMS of the residual of each force path, in N."""
    return {channel: rmse(residual[channel]) for channel in FORCE_CHANNELS if channel in residual}


def _own_harm(selection: Selection, before: Mapping[str, np.ndarray]) -> tuple[str, str] | None:
    """Of a path whose residual on left-out episodes has not fallen, or has clearly risen on one log: the suspect without which
    least is left, with the reason in words; ``before``: residuals by channel, N."""
    after = left_out_residuals(selection)
    for channel in sorted(selection.touched & set(FORCE_CHANNELS)):
        if worse := _where_worse(selection, channel, before[channel], after[channel]):
            rows, told = worse
            own = [suspect for suspect in selection.suspects if selection.channel_of(suspect) == channel]
            rest = {suspect: rmse(left_out_residuals(selection, suspect)[channel][rows]) for suspect in own}
            return min(rest, key=rest.__getitem__), f"{told} on left-out episodes"
    return None


def _where_worse(selection: Selection, channel: str, before: np.ndarray, after: np.ndarray) -> tuple[slice, str] | None:
    """Rows in which a path's residual is no better than before: all of them, or those of the log where it has risen most, if
    that is clear, by what matters, and by more than it has fallen over all logs; and what became of it. A torque constant that
    is low where the motor is warm may hide in an inertia that is too small, which other logs then show. A large gain may cost
    a log that had hardly any error a little: such a log is no evidence against it."""
    first, last = rmse(before), rmse(after)
    gained = first**2 - last**2
    if gained <= 0.0:
        return slice(None), f"what is left of the {channel} path goes from {first:.4g} to {last:.4g} N"
    bench, floor = selection.model.bench, selection.screening.floor(selection.model, channel)
    pairs = [(rmse(before[rows]), rmse(after[rows])) for rows in bench.rows]
    worst = int(np.argmax([last**2 - first**2 for first, last in pairs]))
    first, last = pairs[worst]
    if last <= _LOG_HARM * first or last**2 - first**2 < max(floor**2, gained):
        return None
    name = bench.trials[worst].log.path.name
    return bench.rows[worst], f"what is left of the {channel} path on {name} goes from {first:.4g} to {last:.4g} N"


def quarters(bench: Bench) -> list[np.ndarray]:
    """Masks of the episodes that are left out together, shape (episodes,) each.

    Episodes are dealt at random: dealt in turn, a manoeuvre that repeats could have one of its phases in one part only."""
    fold = np.random.default_rng(0).permutation(np.arange(bench.episodes) % _FOLDS)
    return [fold == number for number in range(_FOLDS)]


def _fits_without(selection: Selection, without: str) -> Iterator[tuple[np.ndarray, dict[Coordinate, float]]]:
    """Each quarter of the episodes as a mask, shape (episodes,), with the parameters that the other quarters give."""
    bench = selection.model.bench
    for own in quarters(bench):
        values = selection.applied(without)
        for channel in bench.channels:
            values |= refit(selection, channel, ~own, without)
        yield own, values


def left_out_residuals(selection: Selection, without: str = "") -> dict[str, np.ndarray]:
    """Residuals by channel of each quarter of the episodes with parameters that the other quarters gave."""
    bench, result = selection.model.bench, {}
    for own, values in _fits_without(selection, without):
        for channel, residual in bench.residuals(values).items():
            rows = own[bench.episode[channel]]
            result.setdefault(channel, np.zeros_like(residual))[rows] = residual[rows]
    return result


def left_out_errors(selection: Selection, without: str = "") -> EpisodeErrors:
    """Errors of each quarter of the episodes with parameters that the other quarters gave; ``without`` one suspect."""
    bench, result = selection.model.bench, None
    for own, values in _fits_without(selection, without):
        # A log with other pads has its own contact angle, too.
        there = [bench.calibrated(values, trial.index if trial.mounted else None) for trial in bench.trials]
        part = EpisodeErrors.joined([errors_of(bench, *pair) for pair in zip(bench.trials, there, strict=True)])
        result = result or part
        result.sums[:, :, own], result.counts[:, :, own] = part.sums[:, :, own], part.counts[:, :, own]
    return result


def refit(selection: Selection, channel: str, kept: np.ndarray, without: str = "") -> dict[Coordinate, float]:
    """A channel's coordinates from the episodes that are ``kept``, shape (episodes,), ``without`` one suspect; shapes, which
    are not linear, stand as fitted."""
    model = selection.model
    centre = {c: model.centre.get(c, c.start) for c in model.own(channel) if not is_shape(c)}
    free = [c for c in centre if c.effect != without or not without]
    if channel == without or not free or channel not in selection.touched:
        return {}
    moments = model.moments(channel, [model.columns[c] for c in free], model.residual_at(channel, centre))
    low, high = np.array([(c.low - centre[c], c.high - centre[c]) for c in free]).T
    moved = solve_within(Moments(moments.products[kept], moments.counts[kept]), model.penalty(free, channel), low, high)
    return {c: float(centre[c] + by) for c, by in zip(free, moved, strict=True)}


def harm(before: EpisodeErrors, after: EpisodeErrors, main: str, tolerated: float = HARM) -> str:
    """What got worse in words, or nothing: a path that says less than before, or the ``main`` one's error, which may rise by
    the factor ``tolerated``."""
    for path in before.paths:
        if after.samples(path) < _KEPT * before.samples(path):
            return f"the estimator's {path} force is no number where it was one"
    first, last = before.rmse(main), after.rmse(main)
    return f"the estimator's {main} error goes from {first:.4g} to {last:.4g} N" if last > tolerated * first else ""


def harm_of_logs(
    judges: Bench, before: EpisodeErrors, after: EpisodeErrors, tolerated: float = HARM
) -> tuple[str, np.ndarray | None]:
    """The same of validation logs, where no single one may be ruined for the others' sake, and the episodes that say so as
    weights, shape (episodes,); None for all of them."""
    main = whole(judges)
    if worse := harm(before, after, main, tolerated):
        return worse, None
    return _ruined(judges, before, after, main) or ("", None)


def validation_gains(selection: Selection, judges: Bench) -> dict[str, float]:
    """By suspect, RMS by which it lowers its channel's residual on the validation logs, in quadrature and the channel's unit;
    negative where it does harm there."""
    return {suspect: _gain(*pair) for suspect, pair in _with_and_without(selection, judges).items()}


def _with_and_without(selection: Selection, judges: Bench) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """By suspect, its channel's residual on the validation logs with all that was found, and without it."""
    bench, result = selection.model.bench, {}
    with_all = judges.under(bench.calibrated(selection.applied())).residuals({})
    for suspect in selection.suspects:
        if (channel := selection.channel_of(suspect)) in with_all:
            rest = judges.under(bench.calibrated(selection.applied(suspect))).residuals({})
            result[suspect] = with_all[channel], rest[channel]
    return result


def _gain(there: np.ndarray, bare: np.ndarray) -> float:
    """RMS by which a residual is smaller with a suspect ``there``, in quadrature."""
    gain = rmse(bare) ** 2 - rmse(there) ** 2
    return float(np.sign(gain) * np.sqrt(abs(gain)))


def is_refuted(there: np.ndarray, bare: np.ndarray, episode: np.ndarray) -> bool:
    """Whether validation logs refute a suspect as clearly as the fitted logs had to prove it: by the likelihood ratio of its
    full contribution against none, with independent episodes. ``there`` and ``bare``: the channel's residual with and without
    it, shape (N,); ``episode`` (N,) counts from 0.

    Where it contributes next to nothing a log is a little better or worse for it by chance, and refutes nothing. A suspect
    that makes its path worse by more than `HARM` is refuted in any case."""
    if _gain(there, bare) >= 0.0 or rmse(there) > HARM * rmse(bare):
        return _gain(there, bare) < 0.0
    moments = Moments.of((bare - there)[:, None], bare, episode, int(episode[-1]) + 1)
    share = leave_out(moments, np.zeros(1))
    return bool(share.values[0] - 0.5 < np.log(Q_VALUE) * share.covariance[0, 0])


def _veto(selection: Selection, judges: Bench) -> tuple[str, str] | None:
    """The suspect that the validation logs speak against most, and what they say."""
    spoken = _with_and_without(selection, judges)
    channel = {suspect: selection.channel_of(suspect) for suspect in spoken}
    refuted = {s: _gain(*pair) for s, pair in spoken.items() if is_refuted(*pair, judges.episode[channel[s]])}
    if refuted:
        worst = min(refuted, key=refuted.__getitem__)
        adds = f"{-refuted[worst]:.3g} {UNITS[channel[worst]]} RMS"
        return worst, f"withdrawn: on the validation logs it adds {adds} to what it explains"
    bench, main = selection.model.bench, whole(judges)
    before = errors(judges, bench.calibration)
    # If nothing is clamped there is only this path, and no other hides the effect of a recalibration.
    tolerated = HARM if judges.clamps else 1.0
    worse, there = harm_of_logs(judges, before, errors(judges, bench.calibrated(selection.applied())), tolerated)
    if not worse or not spoken:
        return None
    without = {suspect: errors(judges, bench.calibrated(selection.applied(suspect))) for suspect in spoken}
    rest = {suspect: its.rmse(main, weights=there) for suspect, its in without.items()}
    return min(rest, key=rest.__getitem__), f"withdrawn: {worse} on the validation logs"
