"""The verdict in words, for terminal and page."""

from emb_daemon.diagnose.attribution import Finding
from emb_daemon.diagnose.diagnosis import Diagnosis, amplitudes

#: Units at the end of parameters' keys, longest first.
_UNIT_ENDINGS = (
    "_um_per_MJ", "_um_per_K", "_Nms_per_rad", "_rad_per_s", "_per_turn", "_per_K", "_rad", "_um", "_Nm", "_m2", "_A", "_C",
    "_s",
)  # fmt: skip
_NAMES = {"stiffness": "stiffness path", "torque": "torque path", "fused": "fused", "maximum_likelihood": "maximum likelihood"}


def number(value: float, sigma: float = 0.0) -> str:
    """A value to the digits that its sigma supports."""
    return f"{value:.3g} ± {sigma:.2g}" if sigma > 0.0 else f"{value:.3g}"


def title(finding: Finding) -> str:
    return finding.effect.name.replace("_", " ")


def size(finding: Finding) -> str:
    """The parameters that say how large an effect is, with units."""
    found = amplitudes(finding)
    parts = [f"{_spoken(name)} {number(v['value'], v['sigma'])} {_unit(v['unit'])}" for name, v in found.items()]
    for parameter in finding.effect.parameters:
        name = parameter.name
        if "cosine" in name or "sine" in name or name not in finding.values:
            continue
        value = number(finding.values[name], finding.sigmas.get(name, 0.0))
        parts.append(f"{_spoken(name)} {value} {_unit(parameter.unit)}")
    return ", ".join(part.strip() for part in parts)


def _unit(unit: str) -> str:
    return "" if unit == "1" else unit


def _spoken(name: str) -> str:
    """A parameter's key without the unit at its end."""
    for ending in _UNIT_ENDINGS:
        if name.endswith(ending):
            return name.removesuffix(ending).replace("_", " ")
    return name.replace("_", " ")


def verdict(diagnosis: Diagnosis) -> str:
    """What was found and what it changed, in one or two sentences."""
    accepted = diagnosis.accepted
    path = "fused" if diagnosis.bench.has_reference else "innovation"
    before, after = diagnosis.before.rmse(path), diagnosis.after.rmse(path)
    where = "on the validation logs" if diagnosis.judged_on == "validate" else "on left-out episodes"
    if not diagnosis.bench.has_reference:
        where += ", judged by the difference of both paths because no reference force was recorded"
    change = f"error {before:.1f} N → {after:.1f} N {where}"
    if accepted:
        names = " and ".join(f"{title(f)} ({size(f)})" for f in accepted)
        text = f"Found: {names}; {change}."
    elif diagnosis.attribution.recalibrated:
        text = f"No effect beyond the calibration's models is proven; the calibration itself was off: {change}."
    else:
        text = f"No effect beyond the calibration's models is proven: {change}."
    rest = diagnosis.unexplained
    if rest:
        text += (
            f" Not explained by any known effect: {rest.rms:.0f} N RMS of the {_NAMES.get(rest.channel, rest.channel)},"
            f" which depend most on {rest.signal.replace('_', ' ')}."
        )
    return text


def table(diagnosis: Diagnosis) -> str:
    """RMSE before and after, one line for each path."""
    figures = diagnosis.figures()
    lines = [f"{'RMSE / N':<22}{'before':>10}{'after':>10}   95 % interval of after/before"]
    for path, part in figures.items():
        total = part["total"]
        low, high = total["ratio_interval"]
        name = _NAMES.get(path, path)
        lines.append(f"{name:<22}{total['rmse_before_N']:>10.1f}{total['rmse_after_N']:>10.1f}   {low:.2f} to {high:.2f}")
    return "\n".join(lines)
