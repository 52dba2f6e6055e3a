"""What the other steps' models lack: the search of ``diagnose`` on the campaign's residuals.

Effects of the catalogue first, then terms of the grammar. What is accepted goes into the calibration; what remains is
reported, and enlarges sigma.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from msgspec.structs import replace

from emb_daemon.calibration.parameters import CLEARANCE, moved, value_of
from emb_daemon.calibration.types import Calibration
from emb_daemon.diagnose.confirmation import refit
from emb_daemon.diagnose.coordinates import by_key
from emb_daemon.diagnose.diagnosis import EPISODES, Diagnosis, diagnose_bench, undecided, with_terms
from emb_daemon.diagnose.page import sections
from emb_daemon.diagnose.residuals import Bench
from emb_daemon.diagnose.selection import Progress
from emb_daemon.diagnose.text import verdict
from emb_daemon.estimator.heat import TOUCHING_N
from emb_daemon.identify.dynamics import Errors, where_known
from emb_daemon.identify.steps import Step
from emb_daemon.identify.steps.held_out import Fold
from emb_daemon.identify.steps.stiffness import StiffnessStep
from emb_daemon.identify.steps.torque import KEYS, TorqueFit, Unexplained, unexplained_current
from emb_daemon.offline import Log
from emb_daemon.report.page import Page

#: Share of the motor's largest speed from which a clamp shows lag and inertia as well as random motion.
_FAST = 0.5


@dataclass(frozen=True, kw_only=True)
class AttributionStep(Step):
    """What was found."""

    calibration: Calibration  #: with what was accepted
    diagnosis: Diagnosis | None = None  #: the search; None where nothing clamps fast or the logs are too short for one
    hot: tuple[Errors, ...] = ()  #: errors of the stiffness path on the logs that heat the pads
    hot_current: tuple[Unexplained, ...] = ()  #: current that is unexplained there
    fastest_rad_per_s: float = 0.0  #: speed of the motor in the hardest clamp of those logs
    #: Relative force by which alternatives to what was found differ from it, by the key of ``noise`` that must cover it.
    undecided: Mapping[str, float] = field(default_factory=dict)

    def without(self, fold: Fold) -> Calibration:
        """What is known of a fold's pads without their random logs: found effects and torque path, from other pads' logs.

        A found effect of the stiffness path is used with the curves and dynamics that were fitted with it."""
        if self.diagnosis is None:
            return moved(self.calibration, fold.values)
        selection, values = self.diagnosis.selection, dict(fold.values)
        bench, applied = selection.model.bench, selection.applied()
        same = [trial.mounted.get("pad_thickness_mm") == fold.pads.thickness_mm for trial in bench.trials]
        if "torque" in selection.touched:
            applied |= refit(selection, "torque", _others(bench, same))
            values = {key: value for key, value in values.items() if key not in KEYS}
        if "stiffness" in map(selection.channel_of, selection.accepted):
            own = [any(trial.log is log for log in fold.held_out) for trial in bench.trials]
            applied |= refit(selection, "stiffness", _others(bench, own))
            slow = [value for c, value in applied.items() if c.name == CLEARANCE and same[c.log] and not own[c.log]]
            fitted = set(by_key(applied, bench.middle))
            values = {key: value for key, value in values.items() if key not in fitted} | {CLEARANCE: float(np.mean(slow))}
        there = with_terms(bench.calibrated(applied), selection)
        return moved(replace(there, noise=self.calibration.noise), values)


def _others(bench: Bench, gone: Sequence[bool]) -> np.ndarray:
    """Which episodes are of other logs than those that are ``gone``, shape (episodes,)."""
    kept = np.ones(bench.episodes, bool)
    kept[np.unique(bench.sample_episode[np.repeat(gone, [len(trial.log.samples) for trial in bench.trials])])] = False
    return kept


def identify(stiffness: StiffnessStep, hot: Sequence[Log], known: Calibration, progress: Progress) -> AttributionStep:
    """Effects and terms that curves, random logs and ``hot`` logs, which heat the pads, prove in addition to ``known``.

    Nothing if no log clamps fast: slow motion does not show inertia and relaxation, so that a search would attribute their
    errors to something else."""
    fast = _fastest(hot) > _FAST * known.motor.maximum_speed_rad_per_s
    if not fast and not any(pads.random for pads in stiffness.pads):
        return _unsearched(hot, known)
    logs, mounted = [], []
    for pads, curve in zip(stiffness.pads, stiffness.fit.curves, strict=True):
        logs += pads.logs
        mounted += [{"pad_thickness_mm": pads.thickness_mm, CLEARANCE: max(float(c), 0.0)} for c in curve.clearances_rad]
    bench = Bench([*logs, *hot], known, [*mounted, *({} for _ in hot)], own_data=True)
    if bench.episodes < EPISODES:
        return _unsearched(hot, known)
    found = diagnose_bench(bench, None, progress)
    residual = found.selection.model.residual["stiffness"]
    calibration = replace(found.calibration, noise=known.noise, provenance=None)
    return AttributionStep(
        sigmas=found.calibration.provenance.sigmas,
        calibration=calibration,
        diagnosis=found,
        hot=_hot_errors(bench, residual, len(logs)),
        hot_current=_unexplained(hot, calibration),
        fastest_rad_per_s=_fastest(hot),
        undecided=undecided(found.selection),
    )


def _unsearched(hot: Sequence[Log], known: Calibration) -> AttributionStep:
    """The step without a search: nothing is added to ``known``."""
    if not hot:
        return AttributionStep(calibration=known)
    bench = Bench(hot, known, own_data=True)
    return AttributionStep(
        calibration=known,
        hot=_hot_errors(bench, bench.residuals({})["stiffness"], 0),
        hot_current=_unexplained(hot, known),
        fastest_rad_per_s=_fastest(hot),
    )


def _unexplained(logs: Sequence[Log], calibration: Calibration) -> tuple[Unexplained, ...]:
    """Current that a calibration leaves on each of the logs."""
    exact = TorqueFit({key: value_of(calibration, key) for key in KEYS}, np.zeros((len(KEYS), len(KEYS))), {})
    return tuple(unexplained_current(log, exact, calibration, hot=True) for log in logs)


def _fastest(logs: Sequence[Log]) -> float:
    """Speed of the motor in the hardest clamp of logs, rad/s."""
    return max((float(np.max(log.samples["speed"], initial=0.0, where=log.force_N > TOUCHING_N)) for log in logs), default=0.0)


def words(step: AttributionStep) -> str:
    """Sentences: what was found in addition to the thesis's models and the stiffness step's effects, and what remains."""
    if step.diagnosis is None:
        return "The campaign has no fast motion, or is too short, to tell what its models lack."
    return verdict(step.diagnosis)


def section(page: Page, step: AttributionStep) -> None:
    """The search in the report, its evidence as a diagnosis shows it."""
    part = page.section(
        "What the models lacked",
        "The residual of curves, random logs and what heats the pads went through the search of a diagnosis: effects of "
        "the catalogue, then terms. Before: the steps above; after: with what was accepted, each quarter of the episodes by "
        "parameters from the other three.",
    )
    part.text(words(step))
    if step.diagnosis is not None:
        sections(page, step.diagnosis)


def _hot_errors(bench: Bench, residual: np.ndarray, first: int) -> tuple[Errors, ...]:
    """Errors of the stiffness path on the logs from number ``first`` on, from the ``residual`` of all logs."""
    ends = np.cumsum([len(trial.log.samples) for trial in bench.trials])[:-1]
    left = list(zip(np.split(residual, ends), bench.trials, strict=True))[first:]
    return tuple(where_known(error, trial.force_N) for error, trial in left)
