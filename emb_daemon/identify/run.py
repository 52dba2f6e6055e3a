"""An identification: logs in, calibration and evidence out, step by step."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from dataclasses import replace as replaced

import numpy as np
from msgspec.structs import replace

from emb_daemon.calibration.parameters import moved
from emb_daemon.calibration.types import Calibration
from emb_daemon.identify.calibration import nominal, provenance, tidy
from emb_daemon.identify.campaign import Campaign
from emb_daemon.identify.dynamics import DELAY, Pads
from emb_daemon.identify.steps import Step, attribution, contact, held_out, noise, stiffness, thermal, thickness, torque
from emb_daemon.identify.steps.held_out import Fold
from emb_daemon.identify.validation import Validation, validate, validate_fitted, validate_others, why_worse

Progress = Callable[[float, str], None]
#: Delay from which the reference force counts as late, s: half a cycle (twelve rigs whose instruments are in time show 0.4 ms
#: at most); and in its standard deviations.
_LATE_S, _SURELY = 0.002, 5.0


@dataclass(frozen=True)
class Identification:
    """What an identification found, step by step."""

    campaign: Campaign
    stiffness: stiffness.StiffnessStep
    torque: torque.TorqueStep
    contact: Step
    folds: list[Fold]
    thickness: thickness.ThicknessStep
    noise: Step
    thermal: thermal.ThermalStep
    attribution: attribution.AttributionStep
    validations: list[Validation]
    calibration: Calibration
    seconds: float

    @property
    def notes(self) -> list[str]:
        """Notes of steps whose section of the report does not show them."""
        return [note for step in (self.stiffness, self.torque, self.contact, self.noise) for note in step.notes]


def identify(campaign: Campaign, progress: Progress = lambda share, text: None) -> Identification:
    """Run every step that the campaign has logs for. ``progress``: called with the share done, 0 to 1, and what comes next.
    Raises InputError: no log from which a characteristic curve or the torque path could be identified."""
    begin = time.monotonic()
    progress(0.0, "reading logs")
    pads = thickness.load_pads(campaign)
    progress(0.05, "characteristic curves and dynamics")
    sheet, measured_mm = campaign.datasheet, [own.thickness_mm for own in pads]
    start = nominal(sheet, f"rig-{campaign.file.rig}", campaign.pad_thickness_mm, measured_mm)
    stiff = _stiffness_in_time(campaign, pads, start)
    if stiff.plainly_better:
        campaign.fault(f"curves: {stiff.plainly_better}")
    progress(0.3, "torque path")
    motor = torque.identify(campaign, stiff.pads, start)
    zero = contact.identify(stiff, sheet.resolver.count_rad, start.contact.clearance_rad)
    for note in zero.notes:
        campaign.fault(f"contact: {note}")
    progress(0.4, "each thickness from the others")
    folds = held_out.identify(campaign, stiff)
    progress(0.6, "noise levels")
    thick = thickness.identify(stiff.fit.curves)
    interpolation = thick.interpolation_error(campaign.pad_thickness_mm)
    levels = noise.identify(campaign, stiff, motor, folds, interpolation)
    progress(0.65, "pads and disc: heat")
    known = moved(start, stiff.values | motor.values | zero.values | levels.values)
    heat = thermal.identify(campaign, known)
    known = replace(moved(known, heat.values), terms=heat.terms)
    found = attribution.identify(stiff, heat.hot, known, lambda text, share: progress(0.7 + 0.2 * share, text))
    progress(0.9, "validating")
    folds = [fold.under(found.without(fold)) for fold in folds]
    levels = noise.identify(campaign, stiff, motor, folds, interpolation, found)
    calibration = tidy(moved(found.calibration, levels.values))
    heat = thermal.validate(campaign, heat, calibration)
    unsure = thermal.stated(heat, calibration, {**heat.sigmas, **found.sigmas})
    calibration = moved(calibration, unsure)
    validations = []
    for fold in folds:
        # Noise levels, too, come from other pads than those that judge them.
        others = [other for other in folds if other is not fold] or [fold]
        mine = noise.identify(campaign, stiff, motor, others, interpolation)
        there, name = moved(found.without(fold), mine.values | unsure), f"random, {fold.pads.thickness_mm:g} mm"
        validations += [validate(name, "random", log, there) for log in fold.held_out]
    validations += validate_others(campaign, calibration, thick, motor)
    for fault in why_worse(validations or validate_fitted(stiff.pads, calibration, thick)):
        campaign.fault(fault)
    steps = (stiff, motor, heat, found)
    calibration = replace(calibration, provenance=provenance(campaign, steps, validations, heat))
    progress(1.0, "done")
    seconds = time.monotonic() - begin
    return Identification(campaign, stiff, motor, zero, folds, thick, levels, heat, found, validations, calibration, seconds)


def _stiffness_in_time(campaign: Campaign, pads: list[Pads], start: Calibration) -> stiffness.StiffnessStep:
    """The stiffness step, after the reference force of all logs has been moved to its own time if it clearly comes late.

    Otherwise every other step would attribute the delay to the brake: to inertia, friction and the sigma of the force."""
    found = stiffness.identify(pads, start)
    # The delay that the time stamps of the logs state is not a part of the fitted one.
    stamped_s = 1e-9 * float(np.median([log.stamped_later_ns for own in pads for log in own.logs]))
    late_s = found.fit.delay_s + stamped_s
    # Slow logs alone do not tell a delay from a relaxation.
    certain = any(own.random for own in pads) and found.fit.delay_s > _SURELY * found.fit.sigmas[DELAY]
    if not (certain and late_s > _LATE_S):
        return found
    campaign.move_reference(late_s)
    note = f"The reference force comes {1e3 * late_s:.1f} ms after the resolver: all logs are judged with it at its own time."
    return replaced(stiffness.identify(thickness.load_pads(campaign), start), notes=(note,))
