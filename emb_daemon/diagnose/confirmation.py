"""The last hurdle: the running estimator itself must get better on episodes that took no part in the fit.

The search judges residuals of one path with the contact angle held. What an engineer gets is the estimator with everything
at work, so whatever was accepted has to lower the error of its own path there, and must not raise the error of the fused
force. What does is taken out again, one by one.
"""

import numpy as np

from emb_daemon.calibration.types import Calibration, to_parameters
from emb_daemon.diagnose.attribution import Attribution, Search, is_shape
from emb_daemon.diagnose.channels import Bench
from emb_daemon.diagnose.evidence import Moments, fit
from emb_daemon.diagnose.judged import Errors, errors_of, innovation_errors, joined, judged
from emb_daemon.diagnose.knobs import Knob, calibrated
from emb_daemon.offline import estimate

#: Parts into which the episodes are dealt.
_FOLDS = 4
#: Rise of the fused error that is harm. Below it is what the contact angle's learning and the reference's noise do by chance,
#: where an effect is real but the other path carries the fused force.
_HARM = 1.05


def left_out(bench: Bench, attribution: Attribution, calibration: Calibration, without: str = "") -> Errors:
    """Errors of each quarter of the episodes with parameters that the other quarters gave.

    ``without``: effect (or channel with its base parameters) that is taken out, the others refitted.
    """
    fold = np.arange(bench.episodes) % _FOLDS
    parts: list[Errors] = []
    of = errors_of if bench.has_reference else innovation_errors
    for number in range(_FOLDS):
        values: dict[Knob, float] = {}
        for channel in bench.channels:
            own = [knob for knob in attribution.knobs if knob.channel == channel]
            if channel == without or not any(attribution.values[knob] for knob in own):
                continue
            linear = [knob for knob in own if not is_shape(knob)]
            table = np.column_stack([attribution.regressors[knob] for knob in linear])
            restored = attribution.residual[channel] + table @ np.array([attribution.values[knob] for knob in linear])
            free = np.array([knob.name.partition(".")[0] != without for knob in linear])
            moments = Moments.of(table[:, free], restored, bench.episode[channel], bench.episodes)
            kept = Moments(moments.products[fold != number], moments.counts[fold != number])
            penalty = attribution.penalties[channel][[own.index(knob) for knob in linear]][free]
            found = fit(kept, penalty).values
            for knob, value in zip([k for k, use in zip(linear, free, strict=True) if use], found, strict=True):
                values[knob] = float(np.clip(value, knob.low, knob.high))
        # Shapes are not linear: they stand as fitted.
        shapes = {knob: value for knob, value in attribution.values.items() if is_shape(knob) and knob.channel != without}
        values.update({knob: value for knob, value in shapes.items() if knob.name.partition(".")[0] != without})
        parameters = to_parameters(calibrated(calibration, values)) if values else to_parameters(calibration)
        parts.append(joined([of(trial, estimate(trial.log.samples, parameters)) for trial in bench.trials]))
    result = parts[0]
    for number in range(1, _FOLDS):
        result.sums[:, :, fold == number] = parts[number].sums[:, :, fold == number]
        result.counts[:, :, fold == number] = parts[number].counts[:, :, fold == number]
    return result


def harm(before: Errors, after: Errors, paths: set[str]) -> str:
    """What got worse in words, or nothing. ``paths``: those that were meant to get better."""
    for path in sorted(paths & set(before.names)):
        first, last = before.rmse(path), after.rmse(path)
        if last >= first:
            return f"the estimator's {path} error on left-out episodes goes from {first:.4g} to {last:.4g} N"
    whole = "fused" if "fused" in before.names else before.names[0]
    first, last = before.rmse(whole), after.rmse(whole)
    if last > _HARM * first:
        return f"the {whole} error on left-out episodes goes from {first:.4g} to {last:.4g} N"
    return ""


def confirm(search: Search, calibration: Calibration) -> tuple[Attribution, Errors]:
    """What is left of a search when everything that makes the running estimator worse is taken out again.

    Returns it with the errors on left-out episodes.
    """
    bench = search.bench
    before = judged(bench, to_parameters(calibration))
    whole = "fused" if bench.has_reference else "innovation"
    while True:
        attribution = search.outcome()
        after = left_out(bench, attribution, calibration)
        worse = harm(before, after, {search.history[name].channel for name in search.accepted})
        suspects = [*search.accepted, *search.recalibrated]
        if not worse or not suspects:
            return attribution, after
        errors = {name: left_out(bench, attribution, calibration, name).rmse(whole) for name in suspects}
        search.drop(min(suspects, key=errors.__getitem__), worse)
