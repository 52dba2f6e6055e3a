"""The whole search: from a calibration and logs to what these prove.

Stepwise: the base calibration is refitted, then the catalogue is asked round by round until none of it is proven any more
(`selection`), then the grammar makes what it lacks (`grammar`), and everything is revised. Stepwise selection alone would be
greedy where two effects only work together (a slow branch without slip gains nothing), so effects that lost are tried again
each round.
"""

from dataclasses import replace

import numpy as np

from emb_daemon.diagnose.coordinates import Coordinate, effect_coordinates
from emb_daemon.diagnose.grammar import make_terms
from emb_daemon.diagnose.model import Model
from emb_daemon.diagnose.residuals import FORCE_CHANNELS, Bench
from emb_daemon.diagnose.screening import Candidate, Screening
from emb_daemon.diagnose.selection import (
    Progress,
    Selection,
    find_changes,
    find_recalibrated,
    one_round,
    recalibrate_heat,
    revise,
    weigh_confounded,
)
from emb_daemon.diagnose.unexplained import dependences, is_beyond
from emb_daemon.effects import REGISTRY


def select(bench: Bench, progress: Progress) -> Selection:
    """Recalibrate, accept effects until none is proven any more, make terms for what is left, and revise.

    ``progress``: what is being done, share done."""
    progress("recalibrating", 0.1)
    begin = Model.of(bench)
    known = _told(begin)
    start = begin.entered(known, centre=known) if known else begin
    model = start.settled(bench.channels)
    screening = Screening(bench.under(bench.calibrated(start.values)) if known else bench, begin)
    at_first = {
        channel: dependences(
            channel, screening.dependence(model, channel), model.counted(channel), screening.floor(model, channel)
        )
        for channel in bench.channels
        if channel in FORCE_CHANNELS
    }
    selection = Selection(model, screening, at_first=at_first).noted(_found(model, c) for c in known if not c.start)
    selection = replace(selection, recalibrated=find_recalibrated(selection, start, bench.channels))
    if bench.own_data and not _anything_left(selection):
        return find_changes(recalibrate_heat(selection))
    for number in range(len(REGISTRY)):
        progress(f"testing the catalogue, round {number + 1}", 0.2 + 0.5 * (1.0 - 0.6**number))
        before = selection.accepted
        selection = one_round(selection)
        if selection.accepted == before:
            break
    found = make_terms(selection, lambda text: progress(text, 0.72))
    progress("refitting what is applied", 0.75)
    final = _finished(found)
    if found.longer is not None:
        final = replace(final, longer=_finished(found.longer))
    if found.accepted == selection.accepted or {*selection.accepted} <= {*final.accepted}:
        return final
    return replace(final, instead=_finished(selection))


def _finished(selection: Selection) -> Selection:
    return find_changes(revise(weigh_confounded(recalibrate_heat(selection))))


def _told(begin: Model) -> dict[Coordinate, float]:
    """Coordinates of effects that the signals alone show (`Effect.measure`), at the values shown. Refitted without them other
    parameters would make up for them, a relaxation for a late angle."""
    bench, known = begin.bench, {}
    for effect in REGISTRY:
        if effect.measure is None or not (channel := bench.channel_of(effect.channel)):
            continue
        own = begin.of_effect(effect.name) or effect_coordinates(bench.calibration, effect, channel, bench.reach).values()
        known |= {c: bench.told[c.name] for c in own if c.name in bench.told}
    return known


def _found(model: Model, amplitude: Coordinate) -> Candidate:
    """An effect that the calibration lacks and signals alone have told, accepted until the whole is revised."""
    [effect] = (effect for effect in REGISTRY if effect.name == amplitude.effect)
    evidence = model.evidence_against({amplitude: 0.0})
    chance, gain = min(1.0, evidence.p_value * len(REGISTRY)), model.rms(evidence.gain, amplitude.channel)
    found = Candidate(effect, amplitude.channel, (amplitude,), evidence=evidence, accepted=True)
    return replace(found, p_value=evidence.p_value, q_value=chance, gain=gain)


def _anything_left(selection: Selection) -> bool:
    """Whether a channel's residual depends on anything that matters, or is clearly more than it need be."""
    model, screening = selection.model, selection.screening
    force = screening.signals["clamp_force"]
    return any(
        any(d.matters for d in found)
        or is_beyond(np.sqrt(model.noise(channel)), screening.achieved(model, channel, force, np.zeros(0)))
        for channel, found in selection.at_first.items()
    )
