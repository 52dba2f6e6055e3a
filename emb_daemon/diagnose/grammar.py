"""Terms for what the catalogue does not explain: the last step of a search.

Every form of the grammar (`forms`) is screened on episodes left out of its fit, beside all that the path's own parameters
can do. The best few are run through the estimator and fitted; the one whose gain is worth its length (minimum description
length, Rissanen, Automatica 14, 1978) is asked what every effect is asked, and more: chance over the *whole* grammar, by the
best that all forms together do with their signals moved in time (maxima as Romano, Wolf, Econometrica 73, 2005), its own
signal at another time, and whether resampled episodes would choose the same.
"""

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import msgspec
import numpy as np

from emb_daemon.calibration.types import to_parameters
from emb_daemon.diagnose import warmth
from emb_daemon.diagnose.forms import TEMPERATURES, Form, further_numbers, made_effect, places
from emb_daemon.diagnose.held_heat import follow_signals
from emb_daemon.diagnose.model import LASTING, TOLERANCE, Model, is_shape, noise_left
from emb_daemon.diagnose.prospects import (
    AS_GOOD,
    COARSE,
    NEARLY,
    NOTHING,
    Prospect,
    Screen,
    Search,
    coordinate_of,
    description_length,
    free_place,
    standing_terms,
    with_term,
)
from emb_daemon.diagnose.residuals import CHANNEL_OF_HEAT, HEAT_CHANNELS, UNITS
from emb_daemon.diagnose.screening import OF_MODEL_FREE, OF_PLACEBO, Q_VALUE, SHADOW, Candidate
from emb_daemon.diagnose.selection import SURE, TOO_LARGE, Selection, find_known, one_round, recalibrate_heat
from emb_daemon.diagnose.signals import MANOEUVRES
from emb_daemon.effects import REGISTRY
from emb_daemon.effects.base import HOOKS
from emb_daemon.effects.terms import MOST, PORTS
from emb_daemon.offline.run import held
from emb_daemon.offline.score import rmse

#: Bootstraps over episodes.
_BOOTSTRAPS = 100
#: Share of bootstraps that must choose another port or signal for it to be a rival: what fewer choose is outside of a
#: confidence of 95 %. Four fifths must choose the port of a term that is taken, which is in the upper half of what stability
#: selection uses (Meinshausen and Bühlmann, J. Royal Statistical Society B 72, 2010: 0.6 to 0.9).
_RIVAL, _SAME_PORT = 0.05, 0.8
#: Why a term goes whose gain the fit does not find again.
_NOT_HELD = "fitted with everything else it no longer holds"
#: ... and one that is not worth its length.
_NOT_SHORTER = "these logs are described more shortly without it"
#: Terms of the heat balance in a calibration.
_OF_HEAT = 2
#: Ports and signals that are fitted where a small step does not tell.
_FITTED = 4
#: Further shapes of one place that are fitted beside the first.
_SHAPES = 3
#: Share of what a term does (RMS) that one of another place must gain beside it: a power, or a memory, that is nearly right is
#: wrong by some per cent, which then look like another cause.
_BESIDE = 0.1
#: Why an effect that ends at a bound was refused: it is no name for the terms in its place either.
_AT_LIMIT = "physics allows no more of it, and terms leave less"


def make_terms(selection: Selection, progress: Callable[[str], None]) -> Selection:
    """Terms made for what the catalogue leaves, one after the other until none is proven."""
    if CHANNEL_OF_HEAT in selection.model.bench.channels:
        progress("making a term for the heat balance")
        selection = _with_heat_terms(selection)
    for channel in (channel for channel in selection.model.bench.channels if channel in LASTING):
        if channel == CHANNEL_OF_HEAT or not selection.model.own(channel):
            continue
        if _wanted(selection, channel) or _at_limit(selection, channel):
            progress(f"making a term for the {channel} residual")
            found = _without_shadows(_with_terms(selection, channel), selection, channel)
            selection = _with_hidden(found, selection, channel)
            selection = _with_orders_again(_called_by_name(selection, channel), channel)
    return selection


def _with_terms(selection: Selection, channel: str) -> Selection:
    while _has_room(selection, channel) and _wanted(selection, channel):
        before, selection = selection, _one_more(selection, channel)
        if selection.accepted == before.accepted:
            break
        if channel == "stiffness":
            # The force that heats the pads has changed: what is left of their heat must not look like another term.
            selection = replace(selection, model=selection.model.settled({*HEAT_CHANNELS, channel}))
        selection = _restated(selection, before, channel)
    if not _has_room(selection, channel) and _wanted(selection, channel):
        return replace(selection, full=selection.full | {channel})
    return selection


def _has_room(selection: Selection, channel: str) -> bool:
    of_heat = [HOOKS[term.port].channel == CHANNEL_OF_HEAT for term in standing_terms(selection.model).values()]
    if len(of_heat) >= MOST:
        return False
    if channel == CHANNEL_OF_HEAT:
        return sum(of_heat) < _OF_HEAT
    return len(of_heat) - sum(of_heat) < MOST - _OF_HEAT


def _restated(found: Selection, before: Selection, channel: str) -> Selection:
    """The same, or an earlier term in another shape, at a place that was as likely, or of two shapes, if that alone describes
    the residual as shortly as it does with the last one beside it: where a shape or a signal was only nearly right, the rest
    looks like another term."""
    last = found
    # Terms of the heat balance were fitted in all their shapes, and a ripple has but one.
    for name in _made(before, channel) if channel != CHANNEL_OF_HEAT else ():
        candidate = before.candidates[name]
        if "sine" in [c.parameter for c in candidate.amplitudes]:
            continue
        bare = _with_room_of(before, name, "its shape was chosen again")
        found = _shortest([*_in_shapes(bare, candidate, channel), *_at_places(bare, candidate, channel), found], channel)
        if found is last:
            further = _in_shapes(before, candidate, channel, _SHAPES)
            found = _shortest([*further, found], channel)
    return found


def _with_room_of(selection: Selection, name: str, reason: str) -> Selection:
    """The selection without a term, to fit another in its place. Everything else stays as fitted with the term: refitted
    without it, it would make up for the term, and a single fit of the other does not undo that."""
    refused = replace(selection.candidates[name], accepted=False, reason=reason)
    return replace(selection.noted([refused]), model=selection.model.without(selection.model.of_effect(name)))


def _in_shapes(start: Selection, candidate: Candidate, channel: str, most: int | None = None) -> list[Selection]:
    """A selection with a term of the candidate's port and signals in each shape that holds, of at ``most`` so many that gain
    most, and as much as may be the best once fitted."""
    search, result = _search(start.model, channel), []
    prospects = sorted(search.of_means(candidate.effect.hook, candidate.signals), key=lambda p: p.evidence.gain)
    nearly = [p for p in prospects if p.evidence.gain >= NEARLY * prospects[-1].evidence.gain]
    # Of forms with the same structure the one that gains most: a fit finds the size.
    structures = {replace(p.form, **dict.fromkeys(p.form.fitted, 0.0)): p for p in nearly}
    for prospect in sorted(structures.values(), key=lambda p: -p.evidence.gain)[:most]:
        result += _entered_again(start, candidate, prospect)
    return result


def _at_places(start: Selection, candidate: Candidate, channel: str) -> list[Selection]:
    """A selection with a term at each of the places that are as likely as the candidate's, in the shape that gains most there;
    of those that gain most, as many as are fitted where the screen cannot tell."""
    if not candidate.alike:
        return []
    search, result = _search(start.model, channel), []
    best = [max(found, key=lambda p: p.evidence.gain) for place in candidate.alike if (found := search.of_means(*place))]
    for prospect in sorted(best, key=lambda p: -p.evidence.gain)[: _FITTED - 1]:
        places, form = (_place(candidate), *candidate.alike), prospect.form
        alike = tuple(place for place in places if (place[0], {*place[1]}) != (form.port, {*form.signals}))
        unsure, manoeuvre = _unsure(form.signals, alike)
        there = replace(
            candidate, signals=form.signals, over=search.over(form), alike=alike, reason=unsure, manoeuvre=manoeuvre,
            confounded_with=_words(*alike[0]),
        )  # fmt: skip
        result += _entered_again(start, there, prospect)
    return result


def _with_other_temperatures(found: Selection, name: str, channel: str) -> Selection:
    """The same, with each other temperature named as equal that describes the residual nearly as shortly, by odds below 99 to
    1, when it is fitted in place of a term's own. Temperatures move together, and a car estimates them: the screen, linear
    about a fit without the term, errs by more than they differ."""
    candidate = found.candidates[name]
    port, signals = _place(candidate)
    others = [
        (port, tuple(other if signal == own else signal for signal in signals))
        for own in TEMPERATURES if own in signals
        for other in TEMPERATURES if other not in signals
    ]  # fmt: skip
    named = [(where, {*own}) for where, own in candidate.alike]
    asked = tuple(place for place in others if (port, {*place[1]}) not in named)
    if not asked:
        return found
    bare = _with_room_of(found, name, "another temperature is asked")
    fitted = _at_places(bare, replace(candidate, alike=asked), channel)
    lengths = _descriptions([found, *fitted], channel)
    alike, undecided_N = candidate.alike, candidate.undecided_N
    for other, length in zip(fitted, lengths[1:], strict=True):
        if length - lengths[0] < SURE:
            alike += tuple(_place(other.candidates[made]) for made in other.accepted if made not in bare.accepted)
            apart = other.model.residual[channel] - found.model.residual[channel]
            undecided_N = max(undecided_N, found.model.rms(float(apart @ apart), channel))
    if alike == candidate.alike:
        return found
    manoeuvre = _unsure(signals, alike)[1]
    equals = replace(candidate, alike=alike, confounded_with=_words(*alike[0]), manoeuvre=manoeuvre, undecided_N=undecided_N)
    return found.noted([equals])


def _entered_again(start: Selection, candidate: Candidate, prospect: Prospect) -> list[Selection]:
    """The selection with a candidate in another form, if that holds."""
    effect = made_effect(prospect.form, _name(prospect.form, start))
    new = replace(candidate, effect=effect, evidence=prospect.evidence, accepted=False)
    other = _enter(start, new, prospect.form) if prospect.evidence.gain > 0.0 else start
    return [other] if effect.name in other.accepted else []


def search_heat(bench: warmth.HeatBench) -> Selection:
    """Terms of the heat balance that recordings prove."""
    model = bench.model()
    return _with_terms(Selection(model, warmth.HeatScreening(bench, model)), CHANNEL_OF_HEAT)


def _with_heat_terms(selection: Selection) -> Selection:
    """The same with terms of the heat balance that recordings prove, where the whole estimator is better for them than for
    conductances and capacities that are refitted alone.

    They stand as fitted with conductances and capacities to a measured brake torque: in the whole estimator friction and force
    would have a say in them."""
    model = selection.model
    known = {c: value for c, value in model.values.items() if c.channel == CHANNEL_OF_HEAT and c.effect}
    bench = warmth.heat_bench((trial.log for trial in model.bench.trials), model.bench.calibrated(known))
    if bench is None:
        return selection
    found = search_heat(bench)
    if found.full:
        selection = replace(selection, full=selection.full | found.full)
    if not found.accepted:
        return selection.noted(found.candidates.values())
    terms = msgspec.structs.replace(model.bench.calibration, terms=found.model.bench.calibration.terms)
    bare = model.without([c for c in model.values if c.channel == CHANNEL_OF_HEAT and not c.effect])
    there = replace(bare, bench=model.bench.under(terms)).entered(found.model.values, chosen=found.model.values)
    there = replace(there, fits=there.fits | {CHANNEL_OF_HEAT: found.model.fits[CHANNEL_OF_HEAT]})
    with_terms = replace(selection, model=there).noted(found.candidates.values())
    # As they would be applied, each with the pads' friction that then makes the heat; without it terms would be held against
    # conductances that make up for a friction which is a little off.
    alone, beside = (recalibrate_heat(s).model.noise(CHANNEL_OF_HEAT) for s in (selection, with_terms))
    if beside >= alone:
        worse = "with a brake torque that is not measured, what is recalibrated without it explains the temperatures as well"
        return selection.noted(replace(c, accepted=False, reason=worse) for c in found.candidates.values() if c.accepted)
    return with_terms


def _without_shadows(found: Selection, catalogue: Selection, channel: str) -> Selection:
    """The same, or terms alone if these describe it more shortly, and leave less by what matters or are fewer causes without
    any further term.

    An effect of the ``catalogue`` beside which a term had to be made may be the shadow of what no catalogue holds. It is then
    asked again beside the terms. One that has all that physics allows it, and would explain more with more, is not the cause
    even where it leaves nothing to be found beside it: it gives way to as many terms that leave less."""
    at_limit = found.accepted == catalogue.accepted
    suspects = _at_limit(catalogue, channel) if at_limit else _of_channel(catalogue, channel)
    known = any(catalogue.candidates[name].in_calibration for name in _of_channel(catalogue, channel))
    if not suspects or known:
        return found
    bare = catalogue
    for name in suspects:
        bare = bare.without(name, _AT_LIMIT if at_limit else "explains less than terms without it, and nothing beside them")
    terms = _with_terms(bare, channel)
    if terms.accepted == bare.accepted:
        return found
    both = terms if at_limit else one_round(replace(terms, dropped=catalogue.dropped))
    gain = found.model.noise(channel) - both.model.noise(channel)
    more = len(_causes(both, channel)) - len(_causes(found, channel))
    if at_limit:
        return both if gain > 0.0 and more <= 0 else found
    matters = gain > found.screening.floor(found.model, channel, made=True) ** 2
    fewer = more < 0 and len(_made(both, channel)) <= len(_made(found, channel))
    return both if (matters or fewer) and _is_shorter(both, found, channel) else found


def _of_channel(selection: Selection, channel: str) -> list[str]:
    return [name for name in selection.accepted if selection.channel_of(name) == channel]


def _at_limit(selection: Selection, channel: str) -> list[str]:
    """Names of accepted effects of a channel of which a fit has left an amplitude at a bound that is not nothing."""
    values = selection.model.values

    def is_at_limit(name: str) -> bool:
        own = [c for c in selection.model.of_effect(name) if not is_shape(c)]
        return any(abs(values[c]) >= c.step and c.is_held(values[c]) for c in own)

    return [name for name in _of_channel(selection, channel) if is_at_limit(name)]


def _with_hidden(found: Selection, catalogue: Selection, channel: str) -> Selection:
    """The same with effects of the ``catalogue`` beside terms that were made, where they describe it more shortly: what was
    refused as a shadow of something else may be there as well, now that the rest is explained."""
    refused = {name for name, c in catalogue.candidates.items() if c.channel == channel and c.reason.endswith(SHADOW)}
    hidden = {effect.name for effect in REGISTRY} & refused
    others = frozenset(effect.name for effect in REGISTRY) - hidden
    while hidden and found.accepted != catalogue.accepted:
        asked = replace(one_round(replace(found, dropped=found.dropped | others)), dropped=found.dropped)
        if asked.accepted == found.accepted:
            return asked
        if not _is_shorter(asked, found, channel):
            break
        found = asked
    return found


def _called_by_name(selection: Selection, channel: str) -> Selection:
    """The same, with each term replaced by an effect of the catalogue that describes the residual as shortly: an effect has a
    name.

    The term has proven that something is there, against more forms than the catalogue has. So the effect need not pass the
    catalogue's own test, which may lack degrees of freedom where few episodes count."""
    for term in _made(selection, channel):
        bare = selection.without(term, "an effect of the catalogue says the same")
        proven = selection.candidates[term]
        # What acts in the same place and follows the same signal first: most others make up for what the fits do not reach.
        possible = [c for c in find_known(bare, channel) if selection.candidates[c.effect.name].reason != _AT_LIMIT]
        for known in sorted(possible, key=lambda c: (c.effect.hook, (c.effect.signal,)) != _place(proven)):
            known = replace(known, names=term, p_value=proven.p_value, q_value=proven.q_value)
            named = bare.entered([known])
            named = replace(named, model=named.model.arrived(channel))
            if known.effect.name in named.accepted and not _is_shorter(selection, named, channel):
                selection = named
                break
    return selection


def _place(made: Candidate) -> tuple[str, tuple[str, ...]]:
    return made.effect.hook, made.signals


def _descriptions(selections: Sequence[Selection], channel: str) -> list[float]:
    """Description length of what lasts of a channel's residual, with all numbers of its effects and terms, and what each is:
    the name of an effect is one of as many as places of a term, and further shapes of one place have said theirs. Lengths can
    be compared with those of the same call."""
    samples, models = LASTING[channel], [selection.model for selection in selections]
    squared = np.array([float(np.square(Screen(model, channel, samples).residual).sum()) for model in models])
    noise = min(float(noise_left(model, channel, samples).sum()) for model in models)
    screening = selections[0].screening
    matters = min(model.counted(channel) * screening.floor(model, channel, made=True) ** 2 for model in models)
    left = _beyond(squared, np.array(noise), matters)
    ports = [port for port in PORTS if models[0].bench.channel_of(HOOKS[port].channel) == channel]
    lengths = []
    for selection, rest in zip(selections, left, strict=True):
        model, made = selection.model, _made(selection, channel)
        numbers = sum(bool(coordinate.effect) for coordinate in model.own(channel))
        numbers += sum(further_numbers(term) for term in model.bench.calibration.terms if term.name in made)
        named = len(_causes(selection, channel)) * np.log(places(ports))
        lengths.append(float(description_length(rest, numbers, model.bench.episodes) + named))
    return lengths


def _shortest(selections: Sequence[Selection], channel: str) -> Selection:
    return selections[int(np.argmin(_descriptions(selections, channel)))]


def _is_shorter(one: Selection, other: Selection, channel: str) -> bool:
    """Whether ``one`` describes a channel more shortly than the ``other``."""
    lengths = _descriptions((one, other), channel)
    return lengths[0] < lengths[1]


def _causes(selection: Selection, channel: str) -> set[tuple[str, ...]]:
    """What the effects and terms of a channel are: names, or ports with signals."""
    own = [c for c in selection.candidates.values() if c.accepted and c.channel == channel]
    return {(c.effect.hook, *sorted(c.signals)) if c.made else (c.effect.name,) for c in own}


def _wanted(selection: Selection, channel: str) -> bool:
    """Whether the lasting residual is large enough for a term to be looked for."""
    model, floor = selection.model, selection.screening.floor(selection.model, channel, made=True)
    if channel == CHANNEL_OF_HEAT:
        left = float(np.square(Screen(model, channel, 1).residual).sum()) - float(noise_left(model, channel, 1).sum())
        return bool(left >= model.counted(channel) * floor**2)
    screen = Screen(model, channel, COARSE)
    return rmse(screen.residual[:, 0] * screen.means.per_mean) >= floor


def _one_more(selection: Selection, channel: str) -> Selection:
    """With the best term for one channel, accepted if it is proven, else with what speaks against it.

    The screen is linear about the present fit. Another place that could do the same as a small term may not do the same as a
    large one, and heat is not linear at all. So forms that are as good on the screen are fitted with everything else, and the
    one that then describes the residual most shortly is taken."""
    model, screening = selection.model, selection.screening
    search = _search(model, channel)
    floor = screening.floor(model, channel, made=True)
    prospects = search.prospects(floor)
    straight = model.bench.straight or channel != CHANNEL_OF_HEAT
    if not prospects or (straight and model.rms(prospects[0].evidence.gain, channel) < floor):
        return selection
    shares = _shares(search.screen, prospects)
    fitted: list[tuple[Prospect, Selection]] = []
    refused = selection
    for prospect in _most_chosen(prospects, shares) if straight else _first_means(prospects):
        if straight and (prospect.means in [other.means for other, _ in fitted] or len(fitted) == _FITTED):
            continue
        if straight and not fitted and prospect.evidence.gain < AS_GOOD * prospects[0].evidence.gain:
            break
        found = _with(selection, search, prospect, prospects, shares)
        candidate = found.candidates[_name(prospect.form, selection)]
        if candidate.accepted:
            fitted.append((prospect, found))
            continue
        refused = refused.noted([candidate])
        # Where these logs cannot tell forms apart, one that exceeds its port's limit, or whose gain the fit does not reach, is
        # dropped.
        if straight and not fitted and candidate.reason not in (TOO_LARGE, _NOT_HELD):
            break
    if not fitted:
        return refused
    if straight:
        # Chosen by left-out episodes, as the bootstraps choose: they could never support another's port.
        first = int(np.argmin(_lengths_fitted(selection, channel, fitted, np.ones((1, model.bench.episodes)))))
    else:
        first = int(np.argmin([one.model.noise(channel) for _, one in fitted]))
    prospect, found = fitted[first]
    if len(fitted) > 1:
        shares = _shares_fitted(selection, channel, fitted)
    at_port = sum(share for (port, _), share in shares.items() if port == prospect.form.port)
    sure = f"same port in {100 * at_port:.0f} % of bootstraps, and signal in {100 * shares[prospect.means]:.0f} %"
    candidate = found.candidates[_name(prospect.form, selection)]
    longer, unsure = straight and _is_longer(found, selection, channel), at_port < _SAME_PORT
    found = found.noted([replace(candidate, reason=f"{candidate.reason}; {sure}")])
    if longer or unsure:
        refused = selection.noted([replace(candidate, accepted=False, reason=_NOT_SHORTER if longer else sure)])
        return refused if unsure else replace(refused, longer=found)
    return found if channel == CHANNEL_OF_HEAT else _with_other_temperatures(found, candidate.effect.name, channel)


def _is_longer(found: Selection, selection: Selection, channel: str) -> bool:
    """Whether a brake's logs are described more shortly without what was ``found``. The best of all forms always follows a
    little of what is left, most of all where the cause is small and has none of the forms.

    Not asked of machines that clamp nothing: by this rule five of 36 recordings lost a term that holds on other logs."""
    return selection.model.bench.clamps and _is_shorter(selection, found, channel)


def _most_chosen(prospects: Sequence[Prospect], shares: Mapping[tuple[str, str], float]) -> list[Prospect]:
    """Prospects that gain as much as the first (`AS_GOOD`), ordered by how many bootstraps choose them, because small
    differences in gain are chance; then those that gain less but are chosen by enough bootstraps (`_RIVAL`)."""
    least = AS_GOOD * prospects[0].evidence.gain
    equal = sorted((p for p in prospects if p.evidence.gain >= least), key=lambda p: -shares[p.means])
    return [*equal, *(p for p in prospects if p.evidence.gain < least and shares[p.means] >= _RIVAL)]


def _first_means(prospects: Sequence[Prospect]) -> list[Prospect]:
    """All shapes of the first ports and signals."""
    means = list(dict.fromkeys(prospect.means for prospect in prospects))[:_FITTED]
    return [prospect for prospect in prospects if prospect.means in means]


def _with(
    selection: Selection,
    search: Search,
    best: Prospect,
    prospects: Sequence[Prospect],
    shares: Mapping[tuple[str, str], float],
) -> Selection:
    """With one of the ``prospects``, accepted if it is proven, else with what speaks against it; ``shares`` of bootstraps."""
    model, screening, channel = selection.model, selection.screening, search.channel
    rivals = _as_good(best, [p for p in prospects if p is not best], shares)
    chance, moved = search.chance(best), search.at_another_time(best.form) / best.evidence.gain
    alike = tuple((p.form.port, p.form.signals) for p in rivals)
    unsure, manoeuvre = _unsure(best.form.signals, alike)
    ceiling, rival = screening.rival(model, channel, {}, LASTING[channel])
    largest = _largest_beside(selection, best, channel)
    small = model.rms(best.evidence.gain, channel) < _BESIDE * largest
    objections = {
        f"not significant over the whole grammar (q = {chance:.2g})": chance > Q_VALUE,
        f"a smooth function of {rival} explains much more: {SHADOW}": best.evidence.gain < OF_MODEL_FREE * ceiling,
        f"its placebo (its signal at another time) explains {100 * moved:.0f} % of the same": moved > OF_PLACEBO,
        f"less than a tenth of the {largest:.3g} {UNITS[channel]} that another term does, whose shape is a guess": small,
    }
    against = next((text for text, holds in objections.items() if holds), "")
    candidate = Candidate(
        made_effect(best.form, _name(best.form, selection)), channel, evidence=best.evidence, p_value=best.evidence.p_value,
        q_value=chance, gain=model.rms(best.evidence.gain, channel), reason=against or unsure,
        placebos={} if best.form.shape == "harmonic" else {"its signal at another time": max(moved, 0.0)},
        confounded_with=_words(*alike[0]) if alike else None, manoeuvre=manoeuvre, alike=alike,
        undecided_N=search.undecided(best, rivals), over=search.over(best.form), signals=best.form.signals,
    )  # fmt: skip
    if against:
        return selection.noted([candidate])
    if best.form.shape == "harmonic":
        lobes = [p for p in prospects if p.form.shape == "harmonic" and p.means == best.means]
        return _enter_lobe(selection, candidate, lobes)
    return _enter(selection, candidate, best.form)


def _largest_beside(selection: Selection, best: Prospect, channel: str) -> float:
    """RMS of what the largest term of a path does that says something else; none of the heat balance, whose terms were fitted
    in all their shapes."""
    model, largest = selection.model, 0.0
    for name in _made(selection, channel) if channel != CHANNEL_OF_HEAT else ():
        made = selection.candidates[name]
        if (made.effect.hook, {*made.signals}) != (best.form.port, {*best.form.signals}):
            off = {**model.values, **dict.fromkeys(made.amplitudes, 0.0)}
            does = model.bench.residual_held(off, channel, model.heat) - model.residual[channel]
            largest = max(largest, model.rms(float(does @ does), channel))
    return largest


def _enter_lobe(selection: Selection, candidate: Candidate, lobes: Sequence[Prospect]) -> Selection:
    """With a ripple: side lobes that do as well as the best on the screen are told from it by a fit with everything else."""
    most = max(lobe.evidence.gain for lobe in lobes)
    close = [lobe for lobe in lobes if lobe.evidence.gain >= AS_GOOD * most]
    fitted = [_enter(selection, replace(candidate, evidence=lobe.evidence), lobe.form) for lobe in close]
    return min(fitted, key=lambda s: s.model.noise(candidate.channel))


def _with_orders_again(selection: Selection, channel: str) -> Selection:
    """The same with each ripple's order chosen once more: before everything else was in place, a side lobe may have done
    better."""
    for name in _made(selection, channel):
        candidate = selection.candidates[name]
        if "sine" not in [c.parameter for c in candidate.amplitudes]:
            continue
        bare = selection.without(name, "its order was chosen again")
        ripples = Search(bare.model, channel, _signals(bare.model)).ripples()
        lobes = [p for p in ripples if p.form.port == candidate.effect.hook and p.evidence.gain > 0.0]
        if not lobes:
            continue
        again = replace(candidate, effect=made_effect(lobes[0].form, _name(lobes[0].form, bare)))
        other = _enter_lobe(bare, again, lobes)
        if other.model.noise(channel) < (1.0 - TOLERANCE) * selection.model.noise(channel):
            selection = other
    return selection


def _made(selection: Selection, channel: str) -> list[str]:
    return [name for name, c in selection.candidates.items() if c.accepted and c.made and c.channel == channel]


def _search(model: Model, channel: str) -> Search:
    if channel == CHANNEL_OF_HEAT:
        return warmth.HeatSearch(model)
    return Search(model, channel, _signals(model))


def _signals(model: Model) -> list[np.ndarray]:
    """What terms see, by log."""
    result = []
    for trial, heat in zip(model.bench.trials, model.heat, strict=True):
        parameters = held(to_parameters(model.bench.calibrated(model.values, trial.index)))[0]
        result.append(follow_signals(trial.log.samples, parameters, heat))
    return result


def _as_good(best: Prospect, others: Sequence[Prospect], shares: Mapping[tuple[str, str], float]) -> list[Prospect]:
    """The best forms of other ports and signals that gain nearly as much, or that resampled episodes choose often enough.

    How episodes scatter is not all that is unsure: shapes are guesses, and temperatures and torque in a car are models' own,
    wrong alike in every resampled set."""
    found: dict[tuple[str, str], Prospect] = {}
    for other in sorted(others, key=lambda p: -p.evidence.gain):
        close = other.evidence.gain >= AS_GOOD * best.evidence.gain or shares[other.means] >= _RIVAL
        if other.means != best.means and close:
            found.setdefault(other.means, other)
    return list(found.values())


def _words(port: str, signals: tuple[str, ...]) -> str:
    return f"{port} over {' times '.join(signals)}".replace("_", " ")


def _unsure(signals: tuple[str, ...], alike: Sequence[tuple[str, tuple[str, ...]]]) -> tuple[str, str | None]:
    """What is said of a term over some ``signals`` that these logs cannot tell from others (ports and signals), and what would
    tell it from the first of them: of the same signals only the port, which shows over the force."""
    if not alike:
        return "", None
    manoeuvre = MANOEUVRES[next((signal for signal in signals if signal not in alike[0][1]), "clamp_force")]
    others = ", ".join(_words(*place) for place in alike)
    return f"these logs cannot tell it from {others}; to separate them: {manoeuvre}", manoeuvre


def _shares(screen: Screen, prospects: Sequence[Prospect]) -> dict[tuple[str, str], float]:
    """Share of resampled episodes in which each port and signal would be chosen by the screen, by the shortest description as
    well."""
    scores = [screen.scores(np.column_stack(prospect.columns)) for prospect in prospects]
    weights = _resampled(scores[0].u.shape[1])
    gains = np.array([np.sum((weights @ s.u.T) ** 2 / np.maximum(weights @ s.a.T, 1e-300), axis=1) for s in scores])
    alone = np.bincount(screen.means.episode, screen.residual[:, 0] ** 2, weights.shape[1])
    noise = weights @ noise_left(screen.model, screen.channel, LASTING[screen.channel])
    # The noise is an estimate, which may be more than the best prospect leaves: all would leave nothing.
    alone = np.maximum(weights @ alone - noise, gains.max(axis=0) + np.maximum(noise * screen.noise_scatter, NOTHING))
    return _chosen(prospects, _lengths(prospects, 1.0 - gains / alone, weights.shape[1]))


def _shares_fitted(
    selection: Selection, channel: str, fitted: Sequence[tuple[Prospect, Selection]]
) -> dict[tuple[str, str], float]:
    """The same by what is left of left-out episodes once each is fitted; ``selection``: without any of them."""
    lengths = _lengths_fitted(selection, channel, fitted, _resampled(selection.model.bench.episodes))
    return _chosen([prospect for prospect, _ in fitted], lengths)


def _lengths_fitted(
    selection: Selection, channel: str, fitted: Sequence[tuple[Prospect, Selection]], weights: np.ndarray
) -> np.ndarray:
    """Description length of what is left of left-out episodes, ``weights`` (k, episodes), once each is fitted, (fitted, k);
    ``selection``: without any. What is too little to matter is nothing; not of heat, where what leaves least is taken."""
    model, samples = selection.model, LASTING[channel]
    noise, matters = weights @ noise_left(model, channel, samples), NOTHING
    if channel != CHANNEL_OF_HEAT:
        matters = model.counted(channel) * selection.screening.floor(model, channel, made=True) ** 2
    models = model, *(found.model for _, found in fitted)
    alone, *left = _beyond(np.array([m.left_out(channel, samples=samples) for m in models]) @ weights.T, noise, matters)
    return _lengths([prospect for prospect, _ in fitted], np.array(left) / alone, model.bench.episodes)


def _beyond(squared: np.ndarray, noise: np.ndarray, matters: float) -> np.ndarray:
    """Squared errors of several fits, one row each, beyond their ``noise``. This is an estimate: where a fit leaves less, the
    noise is no more than that, or all that leave as little would be as good as each other. What does not matter is nothing."""
    return np.maximum(squared - np.minimum(noise, squared.min(axis=0)), matters)


def _resampled(episodes: int) -> np.ndarray:
    """How often each episode is in each bootstrap, shape (bootstraps, episodes)."""
    return np.random.default_rng(0).multinomial(episodes, np.full(episodes, 1.0 / episodes), _BOOTSTRAPS)


def _lengths(prospects: Sequence[Prospect], left: np.ndarray, episodes: int) -> np.ndarray:
    """Description length with each prospect; ``left``: share of the squared error, of each in each bootstrap."""
    numbers = np.array([prospect.form.numbers for prospect in prospects])
    return description_length(np.maximum(left, 1e-3), numbers[:, None], episodes)


def _chosen(prospects: Sequence[Prospect], lengths: np.ndarray) -> dict[tuple[str, str], float]:
    """Share of bootstraps in which each port and signal has the shortest description."""
    chosen = np.argmin(lengths, axis=0)
    shares = dict.fromkeys((prospect.means for prospect in prospects), 0.0)
    for index, count in zip(*np.unique(chosen, return_counts=True), strict=True):
        shares[prospects[index].means] += count / _BOOTSTRAPS
    return shares


def _name(form: Form, selection: Selection) -> str:
    name = ":".join(["term", form.port, *form.signals])
    # Also those of terms that were taken out again: what became of them is told by name.
    taken = {term.name for term in selection.model.bench.calibration.terms}
    taken |= {known for known, c in selection.candidates.items() if c.made and c.amplitudes}
    return name if name not in taken else next(f"{name}:{n}" for n in itertools.count(2) if f"{name}:{n}" not in taken)


def _enter(selection: Selection, candidate: Candidate, form: Form) -> Selection:
    """With a term, fitted with everything else; without it again if it then proves nothing."""
    before, channel, name = selection.model, candidate.channel, candidate.effect.name
    index = free_place(before)
    if index is None:
        return selection.noted([replace(candidate, reason=f"a calibration holds {MOST} terms")])
    bench = with_term(before.bench, form.term(name), index)
    fields = ["coefficient", *(["sine"] if form.shape == "harmonic" else [])]
    amplitudes = [coordinate_of(index, channel, form, field, name) for field in fields]
    sizes = {coordinate_of(index, channel, form, field, name): getattr(form, field) for field in form.fitted}
    values = dict(zip(amplitudes, map(float, candidate.evidence.values), strict=True)) | sizes
    model = replace(before, bench=bench).entered(values, centre=sizes).refined({channel})
    evidence = model.evidence_against(dict.fromkeys(amplitudes, 0.0), LASTING[channel])
    gain = model.rms(evidence.gain, channel)
    model = model.arrived(channel)
    if not bench.straight:
        gain = float(np.sqrt(max(before.noise(channel) - model.noise(channel), 0.0)))
    worse = model.noise(channel) >= before.noise(channel)
    if worse or evidence.gain <= 0.0 or gain < selection.screening.floor(model, channel, made=True):
        return selection.noted([replace(candidate, reason=_NOT_HELD)])
    fitted = next(term for term in bench.calibrated(model.values).terms if term.name == name)
    if not fitted.is_bounded or (fitted.is_held and not _search(model, channel).is_within(fitted)):
        return selection.noted([replace(candidate, reason=TOO_LARGE)])
    candidate = replace(candidate, amplitudes=tuple(amplitudes), evidence=evidence, gain=gain, accepted=True)
    where = " on left-out episodes" if bench.straight else ""
    explained = f"q = {candidate.q_value:.1g} over the whole grammar, gains {gain:.3g} {UNITS[channel]}{where}"
    reason = "; ".join(filter(None, (explained, candidate.reason)))
    return replace(selection, model=model).noted([replace(candidate, reason=reason)])
