"""Logs by pad thickness, how curves vary with it, and what predicting one from others costs."""

from dataclasses import dataclass

import numpy as np

from emb_daemon.calibration.curves import Curve, curve_at
from emb_daemon.errors import InputError
from emb_daemon.identify.campaign import NEED_RANDOM, RANDOM, SLOW, Campaign
from emb_daemon.identify.dynamics import TERMS, CurveFit, Pads, powers
from emb_daemon.identify.steps import Step
from emb_daemon.offline.score import rmse
from emb_daemon.report.figures import Panel, Style, Trace, shades, xy_figure
from emb_daemon.report.page import Page

#: Share of a brake's compliance that is its pads': RMS of a uniform distribution from 0 to 1.
_PADS_PART = 1.0 / np.sqrt(3.0)
_NEED_CURVE = "slow clamp and release from the released position to a tenth of the rated force or more"


@dataclass(frozen=True, kw_only=True)
class ThicknessStep(Step):
    """Curves, one per pad thickness, and `left_out_errors`; nothing of the calibration."""

    curves: list[CurveFit]
    left_out: np.ndarray

    def interpolation_error(self, thickness_mm: float) -> float:
        """Relative force error that interpolation adds at a thickness.

        A straight line between neighbours errs by (t - a)(b - t) times half the curvature, which is found by leaving out each
        inner thickness. A single curve is used for all thicknesses; its error is the change of the pads' part of the
        compliance."""
        thicknesses = np.array([curve.thickness_mm for curve in self.curves])
        if len(thicknesses) == 1:
            return _PADS_PART * abs(float(thickness_mm / thicknesses[0]) - 1.0)
        if len(thicknesses) < 3 or np.any(np.abs(thicknesses - thickness_mm) < 1e-6):
            return 0.0
        spans = (thicknesses[1:-1] - thicknesses[:-2]) * (thicknesses[2:] - thicknesses[1:-1])
        curvature = rmse(self.left_out / spans)
        upper = int(np.clip(np.searchsorted(thicknesses, thickness_mm), 1, len(thicknesses) - 1))
        return curvature * abs((thickness_mm - thicknesses[upper - 1]) * (thicknesses[upper] - thickness_mm))


def load_pads(campaign: Campaign) -> list[Pads]:
    """Slow and random logs by pad thickness, thinnest first. Raises InputError: none can serve, or the campaign's pads are too
    far from every measured thickness."""
    logs: dict[float, list] = {}
    for entries, part, need, reversals in (
        (campaign.file.curves, "curves", _NEED_CURVE, SLOW),
        (campaign.file.random, "random", NEED_RANDOM, RANDOM),
    ):
        for entry in entries:
            log = campaign.load_motion(entry.log, part, need, reversals=reversals)
            if log is not None:
                logs.setdefault(campaign.thickness(entry), []).append(log)
    pads = [Pads(thickness_mm, tuple(logs[thickness_mm])) for thickness_mm in sorted(logs)]
    try:
        if not pads:
            raise InputError(f"curves, random: no usable log; needed: {_NEED_CURVE}")
        _check_thickness(pads, campaign.pad_thickness_mm)
    except InputError as error:
        raise InputError("\n".join([*campaign.faults, f"{campaign.path}: {error}"])) from None
    if len(pads) == 1 and pads[0].thickness_mm != campaign.pad_thickness_mm:
        campaign.fault(
            f"curves: pads of {campaign.pad_thickness_mm:g} mm are taken to be as stiff as the only ones measured, of "
            f"{pads[0].thickness_mm:g} mm, and sigma holds what thickness may change; needed: a slow clamp with the former"
        )
    if not any(own.random for own in pads):
        campaign.fault(
            "random: no usable log, so that the fast relaxation keeps what is usual of brakes, and sigma holds what that may "
            f"do in a hard clamp; needed: {NEED_RANDOM}"
        )
    return pads


def _check_thickness(pads: list[Pads], thickness_mm: float) -> None:
    """Raises InputError if pads of a thickness are too far from every measured one for a calibration."""
    table = tuple(Curve(pad_thickness_mm=own.thickness_mm, coefficients=(1.0,)) for own in pads)
    try:
        curve_at(table, thickness_mm)
    except InputError as error:
        raise InputError(f"{error}; needed: curves of pads nearer to that thickness") from None


def identify(curves: list[CurveFit]) -> ThicknessStep:
    """``curves`` in ascending order of thickness."""
    return ThicknessStep(curves=curves, left_out=left_out_errors(curves))


def left_out_errors(curves: list[CurveFit]) -> np.ndarray:
    """Relative force error of each inner curve predicted from the others, weighted by force; shape (curves - 2,)."""
    errors = []
    for target in curves[1:-1]:
        predicted = curve_at(tuple(c.curve() for c in curves if c is not target), target.thickness_mm)[:TERMS]
        x = np.linspace(0.05, 1.0, 50) * target.travel_rad
        truth = target.force(x)
        errors.append(rmse(powers(x) @ predicted - truth) / rmse(truth))
    return np.array(errors)


def section(page: Page, step: ThicknessStep, thickness_mm: float) -> None:
    """Pad thickness in the report; nothing with fewer than three curves."""
    curves = step.curves
    if len(curves) < 3:
        return
    part = page.section(
        "Pad thickness",
        "Each inner thickness predicted from the others, the compliance of every coefficient running straight: relative error "
        "of the force, weighted by force. The gaps are then twice those that prediction has to bridge.",
    )
    inner = [f"{curve.thickness_mm:g} mm / %" for curve in curves[1:-1]]
    part.table([*inner, "RMS / %"], [[f"{100 * error:.2f}" for error in (*step.left_out, rmse(step.left_out))]])
    part.text(
        f"At {thickness_mm:g} mm interpolation is expected to add {100 * step.interpolation_error(thickness_mm):.2f} % of the "
        "force, which the noise level of the stiffness path contains."
    )
    thicknesses = np.array([curve.thickness_mm for curve in curves])
    traces = []
    for n, colour in enumerate(shades(TERMS)):
        found = np.array([curve.coefficients[n] for curve in curves])
        sigma = np.array([np.sqrt(curve.covariance[n, n]) for curve in curves])
        spread = np.abs(found[0] * sigma / found**2)
        traces.append(Trace(f"1/A{n}", thicknesses, found[0] / found, Style(colour, 1.4, mode="lines+markers"), spread))
    part.figure(
        xy_figure([Panel("Compliance over that of the thinnest pad", "1", traces, 280)], "pad thickness / mm"),
        "Compliance adds up with thickness, so that the reciprocals run nearly straight.",
    )
