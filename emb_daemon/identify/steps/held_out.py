"""Each pad thickness from the others: what the models are worth on logs that fitted nothing."""

from dataclasses import dataclass, field

import numpy as np

from emb_daemon.identify.campaign import Campaign
from emb_daemon.identify.dynamics import Pads, fit_dynamics, in_service, is_slow, simulate
from emb_daemon.identify.steps import Step
from emb_daemon.identify.steps import stiffness as stiffness_step
from emb_daemon.identify.steps import torque as torque_step
from emb_daemon.identify.steps.stiffness import StiffnessStep
from emb_daemon.identify.steps.torque import Unexplained, fit_torque, unexplained_current
from emb_daemon.offline import Log

#: (error of the stiffness path, reference force) in N on one log, where there is a reference.
Errors = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True, kw_only=True)
class Fold(Step):
    """What is known of one thickness without its random logs: dynamics and torque path of the other thicknesses, curve and
    contact of its own slow log. ``values`` holds those sections of a calibration.

    Attributes:
        judged: its random logs.
        errors: of the stiffness path on each of them.
        unexplained: of the torque path on each of them.
    """

    pads: Pads
    clearance_rad: float
    judged: tuple[Log, ...]
    errors: list[Errors] = field(repr=False)
    unexplained: list[Unexplained] = field(repr=False)


def identify(campaign: Campaign, stiffness: StiffnessStep) -> list[Fold]:
    """A fold for each thickness with a slow and a random log; none with fewer than two thicknesses."""
    if len(stiffness.pads) < 2:
        return []
    return [_fold(campaign, stiffness, index) for index, pads in enumerate(stiffness.pads) if pads.slow and pads.random]


def _fold(campaign: Campaign, stiffness: StiffnessStep, index: int) -> Fold:
    pads, chosen, joint = stiffness.pads[index], stiffness.chosen.effects, stiffness.fit
    others = [other for i, other in enumerate(stiffness.pads) if i != index]
    curves = [curve for i, curve in enumerate(joint.curves) if i != index]
    fit = fit_dynamics(others, chosen, start=joint.values, curves=curves)
    slow = Pads(pads.thickness_mm, pads.slow)
    own = fit_dynamics([slow], chosen, start=fit.values, curves=[joint.curves[index]], fixed=True)
    clearance = float(np.mean(own.curves[0].clearances_rad))
    torque = fit_torque([log for other in others for log in other.logs], campaign.datasheet)
    gear_gain = campaign.datasheet.actuator.gear_gain_m_per_rad
    force = stiffness.values["stiffness"].maximum_force_N
    errors = []
    for log in pads.random:
        known = np.isfinite(log.force_N)
        found = simulate(log, in_service(fit.values), own.curves[0].coefficients, clearance)
        errors.append(((found - log.force_N)[known], log.force_N[known]))
    return Fold(
        values=stiffness_step.sections(own, force) | torque_step.sections(torque, campaign.datasheet),
        pads=pads,
        clearance_rad=clearance,
        judged=pads.random,
        errors=errors,
        unexplained=[unexplained_current(log, torque, gear_gain) for log in pads.random],
    )


def second_halves(stiffness: StiffnessStep) -> list[Errors]:
    """Errors where no thickness can be left out: of the fit on first halves, on the second halves, slow logs whole."""
    fit = stiffness.chosen.fit
    errors = []
    for pads, curve in zip(stiffness.pads, fit.curves, strict=True):
        for log, clearance in zip(pads.logs, curve.clearances_rad, strict=True):
            rows = slice(0 if is_slow(log) else len(log.samples) // 2, None)
            error = (simulate(log, in_service(fit.values), curve.coefficients, clearance) - log.force_N)[rows]
            known = np.isfinite(error)
            errors.append((error[known], log.force_N[rows][known]))
    return errors
