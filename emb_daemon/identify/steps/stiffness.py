"""Characteristic curves and dynamics of all pads at once, and the effects that the random logs show."""

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from emb_daemon.calibration.curves import rising_force
from emb_daemon.calibration.parameters import moved, parameter
from emb_daemon.calibration.types import Calibration
from emb_daemon.effects.base import Effect
from emb_daemon.identify.dynamics import (
    DELAY,
    FURTHER,
    OPTIONAL,
    RELAXATION,
    DynamicsFit,
    Errors,
    Pads,
    curve_keys,
    dynamics,
    errors_left_out,
    errors_unseen,
    fit_dynamics,
    is_slow,
    starting_point,
)
from emb_daemon.identify.steps import Step
from emb_daemon.identify.text import with_sigma
from emb_daemon.offline.score import rmse
from emb_daemon.report.figures import Panel, Style, Trace, shades, xy_figure
from emb_daemon.report.page import Page, Section

#: Relaxation time of an ordinary brake, s, and also its standard deviation if no log shows it: between pads whose force
#: follows at once and those that need as long as a hard application takes.
USUAL_RELAXATION_S = 0.03
#: A curve with a maximum below the brake's largest force is used up to this share of that maximum.
_RISING = 0.999
#: Factor on the least held-out error of all combinations up to which a combination with fewer effects is preferred.
_WORTH = 1.02
#: The same where pads have a single slow log, which is judged as it was fitted. Real effects are far beyond it: loop and slow
#: relaxation together lower the error of slow clamps of two independent rigs to a third and an eighth. A lag of 0.015 to
#: 0.08 s instead of the usual 0.03 s also passes for an effect, without a loss in fast motion (studied on the thesis's brake).
_WORTH_SEEN = 1.25
#: Least amplitude of an effect, in its standard deviations.
_CLEAR = 3.0
_DELAY_TITLE = "reference later than resolver (not in the calibration)"
#: Ratio of errors on left-out logs from which a plain fit is reported as better: noise alone makes five per cent.
_PLAINLY = 1.05
#: Style of many measured points behind a line.
_CLOUD = Style("#aab4c0", mode="markers", size=3.0)


@dataclass(frozen=True)
class Candidate:
    """One combination of effects in the choice of structure, fitted on the first halves of the random logs."""

    effects: tuple[Effect, ...]
    fit: DynamicsFit
    #: (error of the stiffness path, reference force) in N on what was not fitted, one pair per log; without a random log, on
    #: each slow log of a fit to the others of its pads, and to all where it is the only one.
    held_out: list[Errors]
    clear: bool  #: every amplitude is significant

    @property
    def held_out_rmse(self) -> float:
        return rmse(np.concatenate([error for error, _ in self.held_out]))


@dataclass(frozen=True, kw_only=True)
class StiffnessStep(Step):
    """Curves, dynamics and effects."""

    pads: list[Pads]  #: the logs
    fit: DynamicsFit  #: over all pads at once
    candidates: list[Candidate]  #: combinations that were compared
    chosen: Candidate
    separate: list[DynamicsFit]  #: fits of each pair of pads alone, where it has random logs
    reached_N: float  #: largest force of the logs
    #: RMS error on each slow log of a cubic of the angle for each way that is fitted to the others of its pads; None where
    #: nothing was left out so.
    plain_N: float | None = None

    @property
    def plainly_better(self) -> str:
        """A line if that cubic predicts a left-out log clearly better than these models do; empty if not."""
        ours_N = self.chosen.held_out_rmse
        if self.plain_N is None or ours_N <= _PLAINLY * self.plain_N:
            return ""
        return (
            f"a cubic of the angle for each way, fitted to the other slow logs, leaves {self.plain_N:.3g} N of the one left "
            f"out, and a clamp's curve {ours_N:.3g} N: the force is no clamp's, or the logs begin at different places; sigma "
            "holds what is left"
        )


def identify(pads: list[Pads], nominal: Calibration) -> StiffnessStep:
    """Curves, dynamics and effects. ``pads``: in ascending order of thickness, for each of which ``nominal`` has a curve."""
    effects = [combination for count in range(len(OPTIONAL) + 1) for combination in combinations(OPTIONAL, count)]
    candidates = [_candidate(pads, nominal, combination) for combination in effects if not _opposed(combination)]
    left_out = all(own.random or len(own.logs) > 1 for own in pads)
    worth = _WORTH if left_out else _WORTH_SEEN
    chosen = _choose(candidates, worth)
    while more := [_candidate(pads, nominal, (*chosen.effects, effect)) for effect in _further(chosen)]:
        candidates += more
        better = _choose([chosen, *more], worth)
        if better is chosen:
            break
        chosen = better
    # Slow logs are fitted whole already.
    fit = fit_dynamics(pads, chosen.fit.calibration, chosen.fit.delay_s) if any(own.random for own in pads) else chosen.fit
    separate = [fit_dynamics([own], fit.calibration, fit.delay_s) for own in pads if own.random]
    reached = max(float(np.nanmax(log.force_N)) for own in pads for log in own.logs)
    rises = min(rising_force(curve.coefficients) for curve in fit.curves)
    sigmas = {RELAXATION: USUAL_RELAXATION_S} | {key: sigma for key, sigma in fit.sigmas.items() if key != DELAY}
    for curve in fit.curves:
        keys = curve_keys(fit.calibration, curve.thickness_mm)
        sigmas |= dict(zip(keys, np.sqrt(np.diag(curve.covariance)).tolist(), strict=True))
    return StiffnessStep(
        values=fit.values()
        | {"stiffness.maximum_force_N": min(max(reached, nominal.stiffness.maximum_force_N), _RISING * rises)},
        sigmas=sigmas,
        pads=pads,
        fit=fit,
        candidates=candidates,
        chosen=chosen,
        separate=separate,
        reached_N=reached,
        plain_N=_plain(pads) if left_out and not any(own.random for own in pads) else None,
    )


def _plain(groups: list[Pads]) -> float:
    """`StiffnessStep.plain_N`."""
    errors = []
    for pads in groups:
        x = np.concatenate([log.samples["angle"] for log in pads.logs])
        middle, half = 0.5 * (np.min(x) + np.max(x)), max(0.5 * np.ptp(x), 1e-9)
        tables = [cubic_of_each_way((log.samples["angle"] - middle) / half) for log in pads.logs]
        known = [np.isfinite(log.force_N) for log in pads.logs]
        parts = [(table[told], log.force_N[told]) for table, told, log in zip(tables, known, pads.logs, strict=True)]
        for number, (table, force) in enumerate(parts):
            others = [part for other, part in enumerate(parts) if other != number]
            fitted = np.linalg.lstsq(np.concatenate([t for t, _ in others]), np.concatenate([f for _, f in others]))[0]
            errors.append(force - table @ fitted)
    return rmse(np.concatenate(errors))


def cubic_of_each_way(x: np.ndarray) -> np.ndarray:
    """Regressors of a force over an angle ``x``: a cubic, and what is added while closing; shape (n, 8)."""
    cubic = np.vander(x, 4)
    return np.column_stack([cubic, np.sign(np.gradient(x))[:, None] * cubic])


def _candidate(groups: list[Pads], nominal: Calibration, effects: tuple[Effect, ...]) -> Candidate:
    start = starting_point(groups, nominal, effects)
    if any(pads.random for pads in groups):
        fit = fit_dynamics(groups, start, fraction=0.5, search=True)
        held_out = errors_unseen(groups, fit, fit.delay_s, slow=False)
    else:
        # What is faster than a slow clamp it does not show: the first time constant keeps its usual value.
        start = moved(start, {RELAXATION: USUAL_RELAXATION_S})
        slower = tuple(key for key in dynamics(start) if key != RELAXATION)
        fit = fit_dynamics(groups, start, search=True, shared=slower)
        held_out = errors_left_out(groups, fit, lambda rest: fit_dynamics(rest, fit.calibration, shared=slower))
    amplitudes = [f"effects.{effect.name}.{amplitude.name}" for effect in effects for amplitude in effect.amplitudes]
    return Candidate(effects, fit, held_out, all(fit.value(a) > _CLEAR * fit.sigmas[a] for a in amplitudes))


def _opposed(effects: tuple[Effect, ...]) -> bool:
    names = [effect.name for effect in effects]
    return any(effect.opposes in names for effect in effects)


def _further(chosen: Candidate) -> list[Effect]:
    """Effects that are one more element beside one that was chosen."""
    names = [effect.name for effect in chosen.effects]
    return [effect for effect in FURTHER if effect.beside in names and effect.name not in names]


def _choose(candidates: list[Candidate], worth: float) -> Candidate:
    """Effects are compared in all combinations, because one may help only together with another."""
    usable = [candidate for candidate in candidates if candidate.clear]
    best = min(candidate.held_out_rmse for candidate in usable)
    return min(
        (candidate for candidate in usable if candidate.held_out_rmse <= worth * best),
        key=lambda candidate: (len(candidate.effects), candidate.held_out_rmse),
    )


def section(page: Page, step: StiffnessStep) -> None:
    curves = page.section(
        "Characteristic curves",
        "Clamp force over motor angle past contact (thesis 2.1, 2.2). Points: slow clamp and release; line: the static curve "
        "of the joint fit, without the lag and the loop that the dynamics explain. Residual: of the full model.",
    )
    curves.figure(_curve_figure(step), "The joint fit leaves the reference's noise.")
    _curve_table(curves, step)
    dynamics = page.section(
        "Dynamic stiffness",
        "Output-error fit of the estimator's own stiffness path over all pads at once. Effects are tried in every combination "
        "without opposites on the first halves of the random logs, then one more element beside what is kept; kept is what "
        "lowers the error of the second halves by more than 2 % and whose amplitude stands clear of zero by three sigma. "
        "Without random logs each slow log is predicted from the others of its pads; of a single one an effect has to "
        "explain a fifth.",
    )
    _dynamics_tables(dynamics, step)


def _curve_figure(step: StiffnessStep):
    force, residual = [], []
    for pads, curve, colour in zip(step.pads, step.fit.curves, shades(len(step.pads)), strict=True):
        name = f"{pads.thickness_mm:g} mm"
        for log, clearance in zip(pads.logs, curve.clearances_rad, strict=True):
            if not is_slow(log):
                continue
            x = log.samples["angle"] - log.samples["angle"][0] - clearance
            thin = slice(None, None, max(len(x) // 700, 1))
            force.append(Trace("measured", x[thin], 1e-3 * log.force_N[thin], _CLOUD))
            known = np.isfinite(log.force_N)
            residual.append(Trace(name, x[known][thin], step.fit.residuals[str(log.path)][thin], Style(colour, 0.9)))
        grid = np.linspace(0.0, curve.travel_rad, 200)
        force.append(Trace(name, grid, 1e-3 * curve.force(grid), Style(colour, 1.8)))
    panels = [Panel("Clamp force", "kN", force, 360), Panel("Residual", "N", residual, 220)]
    return xy_figure(panels, "motor angle past contact / rad")


def _curve_table(section: Section, step: StiffnessStep) -> None:
    rows = []
    for pads, curve in zip(step.pads, step.fit.curves, strict=True):
        sigmas = np.sqrt(np.diag(curve.covariance))
        full = np.array([curve.travel_rad])
        slow = [step.fit.residuals[str(log.path)] for log in pads.slow]
        rows.append(
            [
                f"{curve.thickness_mm:g}",
                *(with_sigma(c, s) for c, s in zip(curve.coefficients, sigmas, strict=True)),
                with_sigma(float(curve.force(full)[0]), float(curve.force_sigma(full)[0]), 1e-3),
                with_sigma(float(np.mean(curve.clearances_rad)), float(np.max(curve.clearance_sigmas_rad))),
                f"{rmse(np.concatenate(slow)):.0f}" if slow else "–",
            ]
        )
    section.table(
        ["pad / mm", "A0 / N/rad", "A1 / N/rad²", "A2 / N/rad³", "force at full travel / kN", "clearance / rad",
         "residual, slow clamp / N"],
        rows,
        "± one standard deviation, jackknife over seconds.",
    )  # fmt: skip


def _dynamics_tables(section: Section, step: StiffnessStep) -> None:
    rows = [
        [
            " + ".join(["one lag", *(effect.name.replace("_", " ") for effect in c.effects)]),
            f"{c.held_out_rmse:.1f}",
            "yes" if c.clear else "no",
            "chosen" if c is step.chosen else "",
        ]
        for c in step.candidates
    ]
    section.table(["structure", "held-out RMSE / N", "amplitudes clear of zero", ""], rows)
    rows = []
    for key, sigma in step.fit.sigmas.items():
        each = [fit.value(key) for fit in step.separate]
        span = f"{min(each):.4g} – {max(each):.4g}" if each else "–"
        title, unit = (key, parameter(step.fit.calibration, key).unit) if key != DELAY else (_DELAY_TITLE, "s")
        rows.append([title, with_sigma(step.fit.value(key), sigma), unit, span])
    section.table(["shared dynamics", "all pads at once", "unit", "each pad alone"], rows)
    if len(step.separate) > 1:
        alone = rmse(np.concatenate([r for fit in step.separate for r in fit.residuals.values()]))
        enough = step.fit.rms < 1.05 * alone
        section.text(
            f"One set of dynamics for all thicknesses {'is enough' if enough else 'is not enough'}: "
            f"{step.fit.rms:.1f} N together against {alone:.1f} N with dynamics of its own for each pad."
        )
