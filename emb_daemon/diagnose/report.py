"""Contents of report.json."""

from typing import Any

import numpy as np

from emb_daemon.diagnose.diagnosis import Diagnosis, Recalibrated
from emb_daemon.diagnose.residuals import UNITS
from emb_daemon.diagnose.screening import Candidate
from emb_daemon.diagnose.signals import MANOEUVRES
from emb_daemon.diagnose.unexplained import Left

#: Dependences listed for each channel.
_LISTED = 6


def report(diagnosis: Diagnosis) -> dict[str, Any]:
    before, after = diagnosis.bench.calibration.noise, diagnosis.calibration.noise
    return {
        "paths": {
            path: {
                **{key: part["total"][key] for key in ("rmse_before_N", "rmse_after_N")},
                **{key: part["total"][key] for key in ("interval_before_N", "interval_after_N")},
                "conditions": {name: value for name, value in part.items() if name != "total"},
            }
            for path, part in diagnosis.figures().items()
        },
        "judged_on": diagnosis.judged_on,
        "reference": "clamp_force" if diagnosis.bench.has_reference else "innovation",
        "reference_late_s": diagnosis.reference_late_s,
        "current_late_s": diagnosis.bench.current_late_s,
        "current_dead_A": diagnosis.bench.current_dead_A,
        "brake_torque_full": [*diagnosis.full_torque],
        "effects": [_finding(diagnosis, finding) for finding in diagnosis.findings],
        "recalibrated": {key: _recalibrated(found) for key, found in diagnosis.recalibrated.items()},
        "stiffness_scale": diagnosis.stiffness_scale,
        "noise": {
            name: {"before": getattr(before, name), "after": getattr(after, name)}
            for name in ("stiffness_N", "stiffness_relative", "stiffness_correlation_s")
            if getattr(before, name) != getattr(after, name)
        },
        "not_recalibrated": {
            channel: _gain(gain, channel) | {"reason": reason} for channel, (gain, reason) in diagnosis.refused.items()
        },
        "worse": [{"log": log, "rmse_before_N": first, "rmse_after_N": last} for log, first, last in diagnosis.worse],
        "plain": dict(zip(("rms_plain_N", "rms_after_N"), diagnosis.plain, strict=True)) if diagnosis.plain else None,
        "no_room_for_a_term": sorted(diagnosis.selection.full),
        "outside_range": [place._asdict() for place in diagnosis.outside],
        "unexplained": _unexplained(diagnosis),
        "judged_residual": {
            channel: {"unit": UNITS[channel], "rms_before": before, "rms_after": after}
            for channel, (before, after) in diagnosis.judged_residual.items()
        },
        "episodes": diagnosis.bench.episodes,
        "seconds": diagnosis.seconds,
    }


def _unexplained(diagnosis: Diagnosis) -> dict:
    left = diagnosis.unexplained
    strongest = left.strongest if left else None
    every = [d.share for part in diagnosis.left.values() for d in part.dependences]
    return {
        "present": left is not None,
        "share": strongest.share if strongest else max(every, default=0.0),
        "strongest_dependence": strongest.signal if strongest else None,
        "manoeuvre": MANOEUVRES[strongest.signal] if strongest else None,
        "path": left.channel if left else None,
        "rms_N": left.rms if left and UNITS[left.channel] == "N" else 0.0,
        "paths": {channel: _left(part) for channel, part in diagnosis.left.items()},
    }


def _left(left: Left) -> dict:
    return {
        "present": left.present,
        "unit": UNITS[left.channel],
        "rms": left.rms,
        "log": left.log or None,
        "time_s": left.time_s,
        "left_of_fitted_logs": left.fitted if np.isfinite(left.fitted) else None,
        "achieved_by_calibration": left.achieved if np.isfinite(left.achieved) else None,
        "share": left.share,
        "dependences": [
            {"signal": d.signal, "share": d.share, "rms": d.rms, "certainty": d.certainty} for d in left.dependences[:_LISTED]
        ],
    }


def _recalibrated(found: Recalibrated) -> dict:
    entry = {"before": found.before, "value": found.value, "sigma": found.sigma, "unit": found.unit}
    return entry | {"tolerance": found.is_tolerance} | _gain(found.gain, found.channel)


def _gain(gain: float, channel: str | None) -> dict:
    unit = UNITS.get(channel or "", "N")
    return {"gain_N": gain} if unit == "N" else {"gain_N": 0.0, "gain": {"value": gain, "unit": unit}}


def _finding(diagnosis: Diagnosis, finding: Candidate) -> dict:
    effect = finding.effect
    parameters = {
        p.name: {"value": finding.values[p.name], "sigma": finding.sigmas.get(p.name, 0.0), "unit": p.unit}
        | ({"before": finding.before[p.name]} if p.name in finding.before else {})
        for p in effect.parameters
        if p.name in finding.values
    }
    entry = {
        "name": effect.name,
        "path": effect.path,
        "accepted": finding.accepted,
        "share_explained": finding.share_explained,
        **_gain(finding.gain, finding.channel),
        "q_value": finding.q_value,
        "parameters": parameters | amplitudes(finding),
        "equation": effect.equation,
        "reason": finding.reason,
        "in_calibration": finding.in_calibration,
    }
    if finding.made:
        entry |= {"made": True, "port": effect.hook, "signals": [*finding.signals]}
        entry |= {"alike": [{"port": port, "signals": [*signals]} for port, signals in finding.alike]}
        terms = {term.name: term for term in diagnosis.calibration.terms}
        if effect.name in terms:
            term = terms[effect.name]
            entry |= {"shape": term.shape, "memory": term.memory, "gate": term.gate, "range": [term.low, term.high]}
            entry |= {"full_at": term.other_high} if term.other else {}
            entry |= {"memory_range": [term.memory_low, term.memory_high]} if term.memory_low is not None else {}
    if effect.name in diagnosis.withdrawn:
        entry["withdrawn"] = True
    if finding.placebos:
        entry |= {"placebo_share": max(finding.placebos.values()), "placebos": dict(finding.placebos)}
    if finding.confounded_with:
        entry |= {"confounded_with": finding.confounded_with, "manoeuvre": finding.manoeuvre}
    if effect.name in diagnosis.validated:
        entry["gain_on_validation"] = diagnosis.validated[effect.name]
    return entry


def amplitudes(finding: Candidate) -> dict[str, dict[str, float | str]]:
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
        unit = finding.effect.parameter(name).unit
        result[name.replace("cosine", "amplitude")] = {"value": size, "sigma": float(spread), "unit": unit}
    return result
