"""The verdict in words, for terminal and page."""

import numpy as np

from emb_daemon.calibration.parameters import INERTIA, OFFSET_FRICTION, TORQUE_CONSTANT, in_words
from emb_daemon.diagnose.diagnosis import Diagnosis
from emb_daemon.diagnose.report import amplitudes
from emb_daemon.diagnose.residuals import UNITS
from emb_daemon.diagnose.screening import Candidate
from emb_daemon.diagnose.signals import MANOEUVRES
from emb_daemon.diagnose.unexplained import Left, is_beyond
from emb_daemon.effects.terms import MOST, SIGNALS

#: Where a term acts, for people.
_PORTS = {
    "thickness": "the contact", "motor_angle": "the motor angle", "stiffness": "the stiffness", "force": "the clamp force",
    "torque_constant": "the torque constant", "torque": "the motor torque", "gear_gain": "the gear's transmission",
    "gear_friction": "the gear's friction", "pad_friction": "the pads' friction", "current": "the motor current",
    "relaxation_time": "the relaxation time", "heat_share": "the pads' share of the friction heat",
    "contact_conductance": "the heat transfer of pressed pads", "gap_conductance": "the heat transfer of released pads",
    "pad_conductivity": "the pads' conductivity",
    "disc_cooling": "the disc's cooling", "pad_heat": "the heat into the pads", "disc_heat": "the heat into the disc",
}  # fmt: skip
#: Base parameters that the verdict names.
_TOLD = 3
#: Change of the curve's force from which other pads are a better guess than wear of these: units scatter by less.
_OTHER_PADS = 0.1
#: Share of the friction as calibrated from which what is left of it is none; the same of the inertia, whose search ends at a
#: thousandth, or so many of its standard deviations, if that is not a tenth of it either.
_NO_FRICTION, _NO_INERTIA, _SURE, _OF_STATED = 1e-6, 2e-3, 2.0, 0.1
#: Factor by which a supplier's torque constant may be off: a gear's loss of a fifth, and amperes by peak or RMS.
_OF_A_SUPPLIER = 2.0**0.5 / 0.8
#: Age of a reference that is said, s: half a cycle.
_SAID_S = 0.002
NAMES = {
    "stiffness": "stiffness path",
    "torque": "torque path",
    "maximum_likelihood": "maximum likelihood",
    "fused": "fused force",
    "innovation": "difference of both paths",
    "temperature": "temperatures",
    "brake_torque": "brake torque",
}


def number(value: float, sigma: float) -> str:
    """A value to the digits that its sigma supports."""
    return f"{value:.3g} ± {sigma:.2g}" if sigma > 0.0 else f"{value:.3g}"


def _entry(key: str, value: float, sigma: float, unit: str, before: float | None = None) -> str:
    """A number with its name and unit, and with what it was before."""
    was = "" if before is None else f"{before:.3g} → "
    return f"{in_words(key)} {was}{number(value, sigma)} {'' if unit == '1' else unit}".strip()


def title(finding: Candidate) -> str:
    if finding.made:
        return f"a term of {_place(finding.effect.hook, finding.signals)}"
    return finding.effect.name.replace("_", " ")


def _place(port: str, signals: tuple[str, ...]) -> str:
    """What a term follows, and where it acts."""
    return f"{' times '.join(signals).replace('_', ' ')} at {_PORTS.get(port, port)}"


def _told(diagnosis: Diagnosis, finding: Candidate) -> str:
    """A finding with its numbers, and with all that these logs cannot tell from it, which is as much a finding as it is."""
    numbers = finding.effect.equation if finding.made else size(finding)
    return f"{title(finding)} ({numbers}{_equals(diagnosis, finding)})"


def _equals(diagnosis: Diagnosis, finding: Candidate) -> str:
    """What is as likely as a finding, and what would tell."""
    if not finding.made:
        [*others] = (f for f in diagnosis.findings if f.effect.name == finding.confounded_with)
        return "".join(f"; or instead {title(f)}, {size(f)}; what would tell: {finding.manoeuvre}" for f in others)
    others = " or ".join(_place(*place) for place in finding.alike)
    return f"; as likely it is of {others}; what would tell: {finding.manoeuvre}" if others else ""


def size(finding: Candidate) -> str:
    """The parameters that say how large an effect is, with units."""
    parts = [_entry(name, **found) for name, found in amplitudes(finding).items()]
    for parameter in finding.effect.parameters:
        name = parameter.name
        if "sine" not in name and name in finding.values:
            sigma = finding.sigmas.get(name, 0.0)
            parts.append(_entry(name, finding.values[name], sigma, parameter.unit, finding.before.get(name)))
    return ", ".join(parts)


def verdict(diagnosis: Diagnosis) -> str:
    """What was found and what it changed, in a few sentences."""
    before, after = diagnosis.before.rmse(diagnosis.whole), diagnosis.after.rmse(diagnosis.whole)
    where = "on the validation logs" if diagnosis.judged_on == "validate" else "on left-out episodes"
    if not diagnosis.bench.has_reference:
        where += ", judged by the difference of both paths because no reference force was recorded"
    change = f"error {before:.1f} N → {after:.1f} N {where}"
    if not diagnosis.bench.has_current:
        change += "; no motor current was recorded, so the stiffness path alone was diagnosed"
    found = [_told(diagnosis, f) for f in diagnosis.accepted if not f.in_calibration and not f.made]
    made = [_told(diagnosis, f) for f in diagnosis.accepted if f.made]
    changed = [_told(diagnosis, f) for f in diagnosis.accepted if f.in_calibration]
    sentences = [f"Found: {' and '.join(found)}"] if found else []
    if made:
        sentences.append(f"{'for' if found else 'Found for'} what no known effect explains: {' and '.join(made)}")
    if changed:
        sentences.append(f"{'n' if sentences else 'N'}ot as calibrated: {' and '.join(changed)}")
    if not sentences:
        off = "; the calibration itself was off" if diagnosis.recalibrated else ""
        sentences = [f"No effect beyond the calibration's models is proven{off}"]
    text = f"{'; '.join(sentences)}{': ' if not diagnosis.accepted else '; '}{change}."
    parts = (
        _worse, _plain, _late, _apart, _dead, _full_torque, _outside, _recalibration, _refused, _withdrawn, _no_tolerance,
        _unexplained, _full, _stated,
    )  # fmt: skip
    return " ".join([text, *(sentence for part in parts for sentence in part(diagnosis))])


def _worse(diagnosis: Diagnosis) -> list[str]:
    """Logs that have lost by what was found, whatever the others gain."""
    logs = [f"{log} ({before:.1f} N → {after:.1f} N)" for log, before, after in diagnosis.worse]
    return [f"Worse on {', '.join(logs)}."] if logs else []


def _plain(diagnosis: Diagnosis) -> list[str]:
    """A plain fit is better than what was found: the calibration is not as good as the logs allow."""
    if not diagnosis.plainly_better:
        return []
    plain_N, ours_N = diagnosis.plainly_better
    return [
        "Plain least squares with constant, offset, Coulomb and viscous friction, fitted to the same logs, leave "
        f"{plain_N:.4g} N of the torque path, and this calibration {ours_N:.4g} N: it is not as good as these logs allow."
    ]


def _late(diagnosis: Diagnosis) -> list[str]:
    """The reference force is late, which is no error of the brake."""
    late_s = diagnosis.reference_late_s
    told = f"The reference force comes {1e3 * late_s:.1f} ms after angle and current, and is judged at its own time."
    return [told] if late_s >= _SAID_S else []


def _apart(diagnosis: Diagnosis) -> list[str]:
    """Current and motion differ in time, where the cause would come after its effect."""
    late_ms = 1e3 * diagnosis.bench.current_late_s
    if not late_ms:
        return []
    what, on = f"The current comes {late_ms:.0f} ms after the motion that it causes", "the torque path"
    if late_ms < 0.0:
        what = f"Angle and speed come {-late_ms:.0f} ms after the current that moves them"
        on = on if diagnosis.bench.channel_of("stiffness") else "either path"
    return [f"{what}: nothing is looked for on {on} until they are of one time."]


def _dead(diagnosis: Diagnosis) -> list[str]:
    dead_A = diagnosis.bench.current_dead_A
    told = f"The current is either 0 or above {dead_A:.3g} A, a dead band: the torque path is judged where it is above."
    return [told] if dead_A else []


def _full_torque(diagnosis: Diagnosis) -> list[str]:
    """Logs whose brake torque, and the heat that it makes, nothing was judged by."""
    told = [f"{name}: {what}" for name, what in diagnosis.full_torque.items()]
    return [f"No brake torque was taken of {'; '.join(told)}."] if told else []


def _outside(diagnosis: Diagnosis) -> list[str]:
    """Where a term holds the value of its range's edge, which is no more than a guess there."""
    told = []
    for name, signal, share, (low, high), reached, memory in diagnosis.outside:
        unit, least = "1" if memory == "response" else SIGNALS[signal], "" if low is None else f"{low:.3g} to "
        of = in_words(signal) if memory == "none" else f"what it remembers of {in_words(signal)} ({memory})"
        told.append(
            f"In {100.0 * share:.0f} % of the validation logs' samples {of} is outside the range in which "
            f"{name} was found (there {reached[0]:.3g} to {reached[1]:.3g} {unit}, the range {least}{high:.3g} {unit}): "
            "there the term is a guess."
        )
    return told


def _refused(diagnosis: Diagnosis) -> list[str]:
    """Recalibrations that these logs prove and that are not applied."""
    return [
        f"Not recalibrated: the {NAMES[channel]}, which would gain {gain:.3g} {UNITS[channel]} on these logs ({reason})."
        for channel, (gain, reason) in diagnosis.refused.items()
    ]


def _withdrawn(diagnosis: Diagnosis) -> list[str]:
    """What these logs prove on its own path, and why it is not applied."""
    told = []
    for f in (f for f in diagnosis.findings if f.effect.name in diagnosis.withdrawn and f.channel):
        gains = f"{f.gain:.3g} {UNITS[f.channel]} of the {NAMES[f.channel]}"
        numbers = f.effect.equation if f.made else size(f)
        told.append(
            f"Proven on these logs but not applied: {title(f)} ({f.reason}), which gains {gains}: "
            f"{numbers}{_equals(diagnosis, f)}."
        )
    return told


def _recalibration(diagnosis: Diagnosis) -> list[str]:
    """Base parameters that were off, before → after, the most telling first; the curve as a whole."""
    curve = [r for key, r in diagnosis.recalibrated.items() if key.startswith("stiffness.curves")]
    parts = []
    if curve:
        change = diagnosis.stiffness_scale - 1.0
        guess = ": other pads?" if abs(change) > _OTHER_PADS else ""
        parts.append((max(r.gain for r in curve), f"stiffness scale {100.0 * change:+.1f} %{guess}"))
    for key, r in diagnosis.recalibrated.items():
        if UNITS[r.channel] == "N" and not key.startswith("stiffness.curves"):
            parts.append((r.gain, _entry(key, r.value, r.sigma, r.unit, r.before)))
    if not parts:
        return []
    told = [f"{text} (gains {gain:.3g} N)" for gain, text in sorted(parts, key=lambda part: -part[0])[:_TOLD]]
    offset = diagnosis.recalibrated.get(OFFSET_FRICTION)
    # The fit went down to zero, which no machine has.
    none = offset is not None and offset.value < _NO_FRICTION * offset.before
    turned = [
        "No friction is left, as if it drove the motor: is `scale: -1` of MotorAngle and MotorSpeed missing, or is the "
        "current another than the motor's?"
    ]
    asked = [*(turned if none else []), *_without_inertia(diagnosis), *_other_constant(diagnosis)]
    return [f"Recalibrated: {', '.join(told)}.", *asked]


def _without_inertia(diagnosis: Diagnosis) -> list[str]:
    """The fit went down to the least inertia that is searched, or to what cannot be told from none, which no rotor has: the
    current bears another torque."""
    found = diagnosis.recalibrated.get(INERTIA)
    if found is None:
        return []
    within = _SURE * found.sigma
    is_none = found.value < within and found.value + within < _OF_STATED * found.before
    if not is_none and found.value > _NO_INERTIA * found.before:
        return []
    return [
        "No inertia is left, as if this current did not accelerate the motor: was its torque measured behind the gear, or "
        "computed without inertia, or is the stated one far too large?"
    ]


def _other_constant(diagnosis: Diagnosis) -> list[str]:
    """A torque constant that was stated, and moved by more than what is stated may be off; one that was identified has a
    tolerance."""
    found = diagnosis.recalibrated.get(TORQUE_CONSTANT)
    if found is None or np.isfinite(found.tolerated) or not found.before:
        return []
    ratio = found.value / found.before
    if 1.0 / _OF_A_SUPPLIER < ratio < _OF_A_SUPPLIER:
        return []
    told = (
        f"No supplier's torque constant is off by {ratio:.3g}: is it that of the motor without its gear, or are current, "
        "force or gear gain in another unit?"
    )
    if diagnosis.bench.load_follows:
        return [told]
    return [f"{told} The stated one still holds it back: begin again with {found.value:.3g} N·m/A."]


def _no_tolerance(diagnosis: Diagnosis) -> list[str]:
    """Base parameters that moved by more than such parameters change."""
    found = []
    for key, r in diagnosis.recalibrated.items():
        if not r.is_tolerance:
            change = _entry(key, r.value, r.sigma, r.unit, r.before)
            found.append(f"{change}, where units, wear and temperature make a factor of {r.tolerated:.3g} at most")
    like = "another part, a signal in a wrong scale, or an effect that these logs cannot tell from it looks like that"
    return [f"No tolerance: {'; '.join(found)}: {like}."] if found else []


def _unexplained(diagnosis: Diagnosis) -> list[str]:
    """What is left of each path on which something is, most of what the calibration achieved first."""
    most = diagnosis.unexplained
    if most is None:
        return []
    others = [left for left in diagnosis.left.values() if left.present and left is not most]
    return [told for left in (most, *others) for told in _left(diagnosis, left, "Not" if left is most else "Nor")]


def _left(diagnosis: Diagnosis, left: Left, begin: str) -> list[str]:
    unit, strongest, on = UNITS[left.channel], left.strongest, f" on {left.place}" if left.log else ""
    text = f"{begin} explained by any known effect: {left.rms:.3g} {unit} RMS of the {NAMES[left.channel]}{on}"
    if left.beyond and not is_beyond(left.rms, left.achieved):
        text += f", where {left.fitted:.3g} {unit} are left of the logs in which a term was made for it"
    elif np.isfinite(left.achieved):
        text += f", where {left.achieved:.3g} {unit} are {least_left(diagnosis)}"
    if strongest is None and left.elsewhere:
        return [f"{text}. What would tell: more such manoeuvres in the logs that are fitted."]
    if strongest is None:
        return [f"{text}, which depend on no signal that was recorded."]
    told = f"{text}, which depend most on {strongest.signal.replace('_', ' ')}"
    if not left.beyond:
        told += f" (by {strongest.rms:.3g} {unit})"
    return [f"{told}. What would tell: {MANOEUVRES[strongest.signal]}."]


def _full(diagnosis: Diagnosis) -> list[str]:
    """Where something is left that a term was not looked for."""
    paths = [NAMES[channel] for channel in sorted(diagnosis.selection.full)]
    told = (
        f"No further term was looked for on the {' and the '.join(paths)}: a calibration holds {MOST} terms, two of the heat."
    )
    return [told] if paths else []


def least_left(diagnosis: Diagnosis) -> str:
    """What a residual is held against, in words: errors of a calibration without provenance are stated, not measured."""
    if diagnosis.bench.own_data:
        return "what is noise"
    measured = diagnosis.bench.calibration.provenance is not None
    return "what the calibration achieved on its own data" if measured else "what the calibration states as noise"


def _stated(diagnosis: Diagnosis) -> list[str]:
    before, now = (c.noise.torque_lasting for c in (diagnosis.bench.calibration, diagnosis.calibration))
    told = f"Some stops leave the torque off by another {100.0 * now:.2g} %, which the calibration states from now on."
    return [told] if now > before else []


def table(diagnosis: Diagnosis) -> str:
    """RMSE before and after, one line for each path."""
    lines = [f"{'RMSE / N':<26}{'before':>10}{'after':>10}   95 % interval of after/before"]
    for path, part in diagnosis.figures().items():
        total = part["total"]
        low, high = total["ratio_interval"]
        lines.append(
            f"{NAMES[path]:<26}{total['rmse_before_N']:>10.1f}{total['rmse_after_N']:>10.1f}   {low:.2f} to {high:.2f}"
        )
    return "\n".join(lines)
