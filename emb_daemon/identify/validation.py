"""Validation of calibrations with the running estimator, on logs that were not fitted."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from emb_daemon.calibration.parameters import moved
from emb_daemon.calibration.types import Calibration, to_parameters
from emb_daemon.errors import InputError
from emb_daemon.identify.campaign import NEED_INTEGRATED, NEED_RANDOM, RANDOM, Campaign
from emb_daemon.identify.dynamics import Pads
from emb_daemon.identify.steps.thickness import ThicknessStep
from emb_daemon.identify.steps.torque import TorqueStep
from emb_daemon.identify.text import stem
from emb_daemon.offline import Log, estimate
from emb_daemon.offline.score import PATHS, force_figures
from emb_daemon.report.figures import BAND, MODEL, PALE, REFERENCE, Panel, Trace, time_figure
from emb_daemon.report.page import Page

#: Share of the errors inside two sigma, 95 % of normal ones, below which sigma is too small: errors last, so that chance may
#: take several per cent of the samples out, but no more.
_LEAST_INSIDE = 0.9
_NEED_SINE = "motor angle a sinusoid in contact, at full frame rate"


@dataclass(frozen=True)
class Validation:
    """One log, as a rule one that was not fitted."""

    name: str
    kind: str  #: random, predicted, gear, frequency or integrated: what was left out or predicted for it; or fitted
    log: Log = field(repr=False)
    calibration: Calibration = field(repr=False)  #: that was run
    estimates: np.ndarray = field(repr=False)  #: ESTIMATE rows
    figures: dict[str, Any]  #: `offline.score.force_figures`
    innovation_ratio: float  #: mean squared normalised innovation; one if the filter's noise levels fit

    def rmse_N(self, path: str = "fused") -> float:
        return self.figures[path]["rmse"]


def validate(name: str, kind: str, log: Log, calibration: Calibration) -> Validation:
    """Run the estimator over a log, as the daemon would, and compare."""
    found = estimate(log.samples, to_parameters(calibration))
    ratio = (found["innovation"] / found["innovation_sigma"]) ** 2
    mean = float(np.nanmean(ratio)) if np.isfinite(ratio).any() else np.nan
    return Validation(name, kind, log, calibration, found, force_figures(log.samples, found, log.force_N), mean)


def at_thickness(calibration: Calibration, thickness: ThicknessStep, thickness_mm: float) -> Calibration:
    """The calibration for pads of another thickness, with the error of the interpolated curve in its noise."""
    there = thickness.interpolation_error(thickness_mm)
    here = thickness.interpolation_error(calibration.pad_thickness_mm)
    relative = float(np.sqrt(max(calibration.noise.stiffness_relative**2 - here**2, 0.0) + there**2))
    return moved(calibration, {"pad_thickness_mm": thickness_mm, "noise.stiffness_relative": relative})


def validate_others(campaign: Campaign, ours: Calibration, thickness: ThicknessStep, torque: TorqueStep) -> list[Validation]:
    """Validations of the campaign's logs that no step fitted, each with the curve for its pad thickness."""
    found = []

    def add(entry, kind, name, log, calibration=ours):
        if log is None:
            return
        try:
            found.append(validate(name, kind, log, at_thickness(calibration, thickness, campaign.thickness(entry))))
        except InputError as error:
            campaign.fault(f"{kind}: {log.path}: {error}; not validated")

    for entry in campaign.file.adaptation:
        log = campaign.load_motion(entry.judge, "adaptation.judge", NEED_RANDOM, reversals=RANDOM)
        add(entry, "predicted", f"random, {campaign.thickness(entry):g} mm, curve predicted", log)
    gears = dict(torque.gears)
    for entry in campaign.file.gear_wear:
        if entry.judge is not None and entry.training in gears:
            log = campaign.load_motion(entry.judge, "gear_wear.judge", NEED_RANDOM, reversals=RANDOM)
            worn = moved(ours, gears[entry.training].friction())
            add(entry, "gear", f"{stem(entry.judge)}, curve predicted", log, worn)
    for entry in campaign.file.frequency_response:
        bounds = (0.0, 4.0 * entry.frequency_Hz)
        log = campaign.load_motion(entry.log, "frequency_response", _NEED_SINE, reversals=bounds)
        add(entry, "frequency", f"sine, {entry.frequency_Hz:g} Hz", log)
    for pair in campaign.file.integrated:
        log = campaign.load(pair.judge, "integrated.judge", NEED_INTEGRATED)
        if log is not None:
            found.append(validate(f"integrated, {stem(pair.judge)}", "integrated", log, ours))
    return found


def validate_fitted(groups: list[Pads], calibration: Calibration, thickness: ThicknessStep) -> list[Validation]:
    """Validations of fitted logs, where no others are left: their errors must at least be inside their sigma."""
    return [
        validate(f"{log.path.name}, which was fitted", "fitted", log, at_thickness(calibration, thickness, pads.thickness_mm))
        for pads in groups
        for log in pads.logs
    ]


def _below(share: float, least: float) -> str:
    """A share in per cent, with digits enough to be below ``least``; never rounded up to that."""
    text = f"{100 * share:.0f}"
    return text if float(text) < 100 * least else f"{np.floor(1000 * share) / 10:.1f}"


def why_worse(validations: list[Validation]) -> list[str]:
    """A line for each log that shows the calibration to be worse than it says."""
    return [
        f"{one.name}: {_below(share, _LEAST_INSIDE)} % of the errors inside two sigma, expected {100 * _LEAST_INSIDE:.0f} % "
        "or more: the calibration is worse than it says"
        for one in validations
        if (share := one.figures["inside_two_sigma"]) < _LEAST_INSIDE
    ]


#: Columns of `rows`.
COLUMNS = ("log", "stiffness / N", "torque / N", "max. likelihood / N", "fused / N", "fused bias / N", "inside 2 σ / %")


def rows(validations: list[Validation]) -> list[list[str]]:
    """RMSE of each path, bias of the fused force and share inside two sigma, one row per log."""
    return [
        [
            one.name,
            *(f"{one.rmse_N(path):.0f}" for path in PATHS),
            f"{one.figures['fused']['bias']:+.0f}",
            f"{100 * one.figures['inside_two_sigma']:.1f}",
        ]
        for one in validations
    ]


def section(page: Page, validations: list[Validation]) -> None:
    """Figures of every such log, and time plots of some."""
    part = page.section(
        "On logs that fitted nothing",
        "RMSE over every sample. A random log's dynamics and torque path come from the other pads, its curve from its own "
        "slow log; gears have the friction of their own training; everything else is as calibrated. Innovation ratio: mean "
        "squared normalised innovation, one where the noise levels fit.",
    )
    ratios = [f"{one.innovation_ratio:.2f}" for one in validations]
    part.table([*COLUMNS, "innovation ratio"], [[*row, ratio] for row, ratio in zip(rows(validations), ratios, strict=True)])
    random = [one for one in validations if one.kind == "random"]
    shown = random[len(random) // 2 :][:1] + [one for one in validations if one.kind in ("predicted", "integrated")]
    for one in shown:
        part.heading(one.name)
        part.figure(_figure(one))


def _figure(one: Validation):
    log, found = one.log, one.estimates
    time = log.time_s
    forces = [
        Trace("reference", time, 1e-3 * log.force_N, REFERENCE),
        Trace("torque balance", time, 1e-3 * found["torque_force"], PALE),
        Trace("fused", time, 1e-3 * found["force"], MODEL),
    ]
    errors = [
        Trace("", time, -2.0 * found["sigma"], BAND),
        Trace("two sigma", time, 2.0 * found["sigma"], BAND),
        Trace("fused", time, found["force"] - log.force_N, MODEL),
    ]
    stiffness = [Trace("stiffness path", time, found["stiffness_force"] - log.force_N, MODEL)]
    return time_figure(
        [
            Panel("Clamp force", "kN", forces, 300),
            Panel("Error of the fused force, with two sigma", "N", errors, 200),
            Panel("Error of the stiffness path", "N", stiffness, 200),
        ]
    )
