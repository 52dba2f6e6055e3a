"""The whole of a diagnosis: logs and a calibration in; findings, an augmented calibration and figures out."""

import hashlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import msgspec
import numpy as np

from emb_daemon import __version__
from emb_daemon.calibration.types import Calibration, Provenance, Source, to_parameters
from emb_daemon.diagnose.attribution import Attribution, Finding, searched
from emb_daemon.diagnose.channels import FORCE_CHANNELS, UNITS, Bench
from emb_daemon.diagnose.confirmation import confirm
from emb_daemon.diagnose.judged import Errors, comparison, judged
from emb_daemon.diagnose.knobs import Knob, calibrated
from emb_daemon.diagnose.unexplained import Rest, rests
from emb_daemon.errors import InputError
from emb_daemon.offline import Log

#: A stated noise this many times what is left is none.
_OVERSTATED = 3.0

Progress = Callable[[str, float], None]


@dataclass
class Diagnosis:
    """Everything that the report shows.

    Attributes:
        calibration: the augmented one.
        before, after: squared errors of the running estimator on ``judged_on``.
        rests: dependence of what is left, by channel, strongest first.
    """

    original: Calibration
    calibration: Calibration
    bench: Bench
    attribution: Attribution
    judged_on: str
    judged_bench: Bench
    before: Errors
    after: Errors
    rests: dict[str, list[Rest]]
    rests_before: dict[str, list[Rest]]
    seconds: float

    @property
    def accepted(self) -> list[Finding]:
        """Effects that were found, by share explained."""
        return sorted((f for f in self.attribution.findings if f.accepted), key=lambda f: -f.share_explained)

    @property
    def unexplained(self) -> Rest | None:
        """The strongest rest that matters."""
        matter = [channel[0] for channel in self.rests.values() if channel and channel[0].matters]
        return max(matter, key=lambda rest: rest.rms, default=None)

    def figures(self) -> dict:
        """RMSE before and after with intervals, by path and condition."""
        return comparison(self.before, self.after)

    def validated(self) -> dict[str, float]:
        """By effect accepted, RMS by which it lowers its path's residual on the validation logs (in quadrature; negative if
        it does harm there). Empty without validation logs. It judges and chooses nothing."""
        if self.judged_on != "validate":
            return {}
        logs = [trial.log for trial in self.judged_bench.trials]
        with_all = Bench(logs, to_parameters(self.calibration)).residuals({})
        result = {}
        for finding in self.accepted:
            if finding.channel not in with_all:
                continue
            bare = to_parameters(self.calibration).copy()
            bare["effects"][finding.effect.name] = np.zeros((), bare["effects"][finding.effect.name].dtype)
            without = Bench(logs, bare).residuals({})[finding.channel]
            gain = float(np.mean(without**2) - np.mean(with_all[finding.channel] ** 2))
            result[finding.effect.name] = float(np.sign(gain) * np.sqrt(abs(gain)))
        return result

    def judged_residual(self) -> dict:
        """RMS of each path's residual on the judging logs, before and after: of the torque path without the limit at zero
        force that its estimate has. Empty where the fit logs judge themselves."""
        if self.judged_on != "validate":
            return {}
        before = self.judged_bench.residuals({})
        after = Bench(
            [trial.log for trial in self.judged_bench.trials], to_parameters(self.calibration)
        ).residuals({})  # fmt: skip
        return {
            channel: {"unit": UNITS[channel], "rms_before": _rms(before[channel]), "rms_after": _rms(after[channel])}
            for channel in self.judged_bench.channels
        }

    def report(self) -> dict:
        """Contents of report.json."""
        figures = self.figures()
        rest = self.unexplained
        validated = self.validated()
        first = max((channel[0] for channel in self.rests.values() if channel), key=lambda r: r.share, default=None)
        return {
            "paths": {
                path: {
                    "rmse_before_N": part["total"]["rmse_before_N"],
                    "rmse_after_N": part["total"]["rmse_after_N"],
                    "interval_before_N": part["total"]["interval_before_N"],
                    "interval_after_N": part["total"]["interval_after_N"],
                    "conditions": {name: value for name, value in part.items() if name != "total"},
                }
                for path, part in figures.items()
            },
            "judged_on": self.judged_on,
            "reference": "clamp_force" if self.bench.has_reference else "innovation",
            "effects": [
                finding_json(finding)
                | ({"gain_on_validation": validated[finding.effect.name]} if finding.effect.name in validated else {})
                for finding in ranked(self.attribution.findings)
            ],
            "recalibrated": {
                knob.name: {"change": value, "sigma": self.attribution.sigmas.get(knob, 0.0), "unit": knob.unit}
                for knob, value in self.attribution.values.items()
                if value != 0.0 and not _of_effect(knob)
            },
            "noise": {
                name: {"before": getattr(self.original.noise, name), "after": getattr(self.calibration.noise, name)}
                for name in ("stiffness_N", "stiffness_relative", "stiffness_correlation_s")
                if getattr(self.original.noise, name) != getattr(self.calibration.noise, name)
            },
            "unexplained": {
                "present": rest is not None,
                "share": rest.share if rest else (first.share if first else 0.0),
                "strongest_dependence": rest.signal if rest else None,
                "path": rest.channel if rest else None,
                "rms_N": rest.rms if rest else 0.0,
            },
            "residual": {
                channel: {
                    "unit": UNITS[channel],
                    "rms_before": _rms(self.attribution.initial[channel]),
                    "rms_after": _rms(self.attribution.residual[channel]),
                    "dependences": [
                        {"signal": r.signal, "share": r.share, "certainty": r.certainty}
                        for r in self.rests.get(channel, [])[:6]
                    ],
                }
                for channel in self.bench.channels
            },
            "judged_residual": self.judged_residual(),
            "episodes": self.bench.episodes,
            "seconds": self.seconds,
        }


def ranked(findings: list[Finding]) -> list[Finding]:
    """Accepted ones first, each group by share explained."""
    return sorted(findings, key=lambda f: (not f.accepted, f.in_calibration, -f.share_explained))


def finding_json(finding: Finding) -> dict:
    """One entry of report.json's ``effects``."""
    effect = finding.effect
    parameters = {
        parameter.name: {
            "value": finding.values.get(parameter.name, 0.0),
            "sigma": finding.sigmas.get(parameter.name, 0.0),
            "unit": parameter.unit,
        }
        for parameter in effect.parameters
        if parameter.name in finding.values
    }
    parameters |= amplitudes(finding)
    entry = {
        "name": effect.name,
        "path": effect.path,
        "accepted": finding.accepted,
        "share_explained": finding.share_explained,
        "gain_N": finding.gain if UNITS.get(finding.channel or "") == "N" else 0.0,
        "q_value": finding.q_value,
        "parameters": parameters,
        "equation": effect.equation,
        "reason": finding.reason,
        "in_calibration": finding.in_calibration,
    }
    if finding.channel and UNITS[finding.channel] != "N":
        entry["gain"] = {"value": finding.gain, "unit": UNITS[finding.channel]}
    if finding.placebo is not None:
        entry["placebo_share"] = finding.placebo
    if finding.confounded_with:
        entry["confounded_with"] = finding.confounded_with
        entry["manoeuvre"] = finding.manoeuvre
    return entry


def amplitudes(finding: Finding) -> dict:
    """Amplitude of each order out of its cosine and sine."""
    result = {}
    for name, cosine in finding.values.items():
        if "cosine" not in name:
            continue
        other = name.replace("cosine", "sine")
        sine = finding.values.get(other, 0.0)
        size = float(np.hypot(cosine, sine))
        if size == 0.0:
            continue
        spread = np.hypot(cosine * finding.sigmas.get(name, 0.0), sine * finding.sigmas.get(other, 0.0)) / size
        parameter = next(p for p in finding.effect.parameters if p.name == name)
        result[name.replace("cosine", "amplitude")] = {"value": size, "sigma": float(spread), "unit": parameter.unit}
    return result


def _of_effect(knob: Knob) -> bool:
    return knob.name.partition(".")[0] not in ("contact", "stiffness", "thermal", "motor", "friction")


def _rms(residual: np.ndarray) -> float:
    counted = residual[residual != 0.0]
    return float(np.sqrt(np.mean(counted**2))) if len(counted) else 0.0


def diagnose(
    fit_logs: Sequence[Log],
    calibration: Calibration,
    validate: Sequence[Log] = (),
    progress: Progress = lambda text, share: None,
) -> Diagnosis:
    """Find what the calibration's models lack on ``fit_logs``, add it, and judge on ``validate``.

    Without validation logs the fit logs judge: each quarter of their episodes by parameters from the other three.

    Raises:
        InputError: the logs cannot tell anything (too short, no motion).
    """
    begin = time.monotonic()
    progress("cutting the logs into episodes", 0.02)
    bench = Bench(fit_logs, to_parameters(calibration))
    if bench.episodes < 6:
        raise InputError(f"{fit_logs[0].path}: only {bench.episodes} episodes, expected at least 6 to tell effect from chance")
    search = searched(bench, progress)
    progress("confirming with the running estimator", 0.8)
    attribution, left_out_errors = confirm(search, calibration)
    progress("what is left", 0.87)
    after_rests = {
        channel: rests(channel, search.dependence(channel), search.counted(channel), search.floor(channel))
        for channel in bench.channels
        if channel in FORCE_CHANNELS
    }
    before_rests = {channel: rests(channel, gains, search.counted(channel), 0.0) for channel, gains in search.first.items()}
    used = {knob: value for knob, value in attribution.values.items() if value != 0.0}
    augmented = _with_noise(calibrated(calibration, used), bench, attribution) if used else calibration
    progress("judging", 0.9)
    if validate:
        judges = Bench(validate, to_parameters(calibration))
        before = judged(judges, to_parameters(calibration))
        after = judged(judges, to_parameters(augmented))
    else:
        judges = bench
        before = judged(bench, to_parameters(calibration))
        after = left_out_errors
    result = Diagnosis(
        calibration, augmented, bench, attribution, "validate" if validate else "left_out_episodes",
        judges, before, after, after_rests, before_rests, time.monotonic() - begin,
    )  # fmt: skip
    sources = tuple(
        Source(log=log.path.name, sha256=hashlib.sha256(log.path.read_bytes()).hexdigest())
        for log in fit_logs
        if log.path.is_file()
    )
    result.calibration = _with_provenance(result, sources)
    progress("done", 1.0)
    return result


def _with_noise(calibration: Calibration, bench: Bench, attribution: Attribution) -> Calibration:
    """The calibration with the stiffness path's noise as it now is, if what it states contains what has been explained.

    The filter would go on trusting the worse path. It is only ever lowered: a rest that nothing explains is no noise."""
    from emb_daemon.identify.steps.noise import force_error_levels, integral_time

    noise = calibration.noise
    if not any(v != 0.0 and knob.channel == "stiffness" for knob, v in attribution.values.items()):
        return calibration
    residual, force = attribution.residual["stiffness"], attribution.signals["clamp_force"]
    known = residual != 0.0
    stated = np.sqrt(np.mean(noise.stiffness_N**2 + (noise.stiffness_relative * force[known]) ** 2))
    if stated < _OVERSTATED * np.sqrt(np.mean(residual[known] ** 2)):
        return calibration
    floor, relative = force_error_levels(residual[known], force[known])
    lengths = np.cumsum([len(trial.log.samples) for trial in bench.trials])[:-1]
    levels = msgspec.structs.replace(
        noise,
        stiffness_N=floor,
        stiffness_relative=relative,
        stiffness_correlation_s=integral_time(np.split(residual, lengths)),
    )
    return msgspec.structs.replace(calibration, noise=levels)


def _with_provenance(diagnosis: Diagnosis, sources: tuple[Source, ...]) -> Calibration:
    old = diagnosis.calibration.provenance
    sigmas = dict(old.sigmas) if old else {}
    for knob, sigma in diagnosis.attribution.sigmas.items():
        if diagnosis.attribution.values.get(knob, 0.0) != 0.0 and np.isfinite(sigma):
            sigmas[f"effects.{knob.name}" if _of_effect(knob) else knob.name] = float(sigma)
    figures = dict(old.figures) if old else {}
    for path in diagnosis.after.names:
        figures[f"diagnose.{diagnosis.judged_on}.{path}_rmse_N"] = diagnosis.after.rmse(path)
    provenance = Provenance(
        date=datetime.now(UTC).date().isoformat(),
        tool=f"emb-daemon diagnose {__version__}",
        campaign=old.campaign if old else "",
        logs=(old.logs if old else ()) + sources,
        figures={name: value for name, value in figures.items() if np.isfinite(value)},
        sigmas=sigmas,
    )
    return msgspec.structs.replace(diagnosis.calibration, provenance=provenance)


def log_paths(paths: Sequence[Path]) -> list[Path]:
    """Check that logs exist before hours are spent on the first.

    Raises:
        InputError: one does not.
    """
    for path in paths:
        if not path.exists():
            raise InputError(f"{path}: no such file")
    return list(paths)
