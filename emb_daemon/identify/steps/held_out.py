"""Each pad thickness predicted from the others: errors of the models on logs that were not fitted."""

from dataclasses import dataclass, field, replace

import numpy as np

from emb_daemon.calibration.parameters import CLEARANCE, moved, value_of
from emb_daemon.calibration.types import Calibration, to_parameters
from emb_daemon.identify.campaign import Campaign
from emb_daemon.identify.dynamics import Errors, Pads, fit_dynamics, path_errors, where_known
from emb_daemon.identify.steps import Step
from emb_daemon.identify.steps.stiffness import StiffnessStep
from emb_daemon.identify.steps.torque import KEYS, TorqueFit, Unexplained, fit_torque, unexplained_current
from emb_daemon.offline import Log
from emb_daemon.offline.run import held, run_step


@dataclass(frozen=True, kw_only=True)
class Fold(Step):
    """What is known of one thickness without its random logs: dynamics and torque path of the other thicknesses, curve and
    contact of its own slow log."""

    pads: Pads
    held_out: tuple[Log, ...]  #: its random logs
    torque: TorqueFit = field(repr=False)  #: fit of the torque path to the other thicknesses' logs
    errors: list[Errors] = field(repr=False)  #: of the stiffness path on each of them
    unexplained: list[Unexplained] = field(repr=False)  #: of the torque path on each of them

    def under(self, calibration: Calibration) -> "Fold":
        """The same with the errors of another calibration, which has these pads."""
        found = replace(self.torque, values={key: value_of(calibration, key) for key in KEYS})
        there = held(to_parameters(moved(calibration, {"pad_thickness_mm": self.pads.thickness_mm})))
        return replace(
            self,
            # Of the whole step: effects that follow heat act on cold pads, too, and need their temperature.
            errors=[where_known(run_step(log.samples, there)["force"] - log.force_N, log.force_N) for log in self.held_out],
            unexplained=[unexplained_current(log, found, calibration) for log in self.held_out],
        )


def identify(campaign: Campaign, stiffness: StiffnessStep) -> list[Fold]:
    """A fold for each thickness with a slow and a random log; none with fewer than two thicknesses."""
    if len(stiffness.pads) < 2:
        return []
    return [_fold(campaign, stiffness, index) for index, pads in enumerate(stiffness.pads) if pads.slow and pads.random]


def _fold(campaign: Campaign, stiffness: StiffnessStep, index: int) -> Fold:
    pads, joint = stiffness.pads[index], stiffness.fit
    others = [other for i, other in enumerate(stiffness.pads) if i != index]
    shared = fit_dynamics(others, joint.calibration, joint.delay_s)
    own = fit_dynamics([Pads(pads.thickness_mm, pads.slow)], shared.calibration, shared.delay_s, shared=())
    clearance = float(np.mean(own.curves[0].clearances_rad))
    torque = fit_torque([log for other in others for log in other.logs], joint.calibration, campaign.datasheet)
    return Fold(
        values=own.values() | torque.physical() | {"pad_thickness_mm": pads.thickness_mm, CLEARANCE: max(clearance, 0.0)},
        pads=pads,
        held_out=pads.random,
        torque=torque,
        errors=[path_errors(log, own.calibration, pads.thickness_mm, clearance) for log in pads.random],
        unexplained=[unexplained_current(log, torque, joint.calibration) for log in pads.random],
    )
