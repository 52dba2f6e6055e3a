"""The thesis's table filled in for a campaign: what he reports, his form here, ours, and what to reach."""

from dataclasses import dataclass

import numpy as np

from emb_daemon.identify.judge import Figures
from emb_daemon.identify.run import Identification, Judged

#: Filter and maximum likelihood may be worse than the better of their inputs by this much.
_WORSE = 1.05
#: Share of errors inside two stated standard deviations.
_HONEST = (0.90, 0.99)


@dataclass(frozen=True)
class Line:
    """One line of the table; ``values`` have one entry per judged log and ``met`` is None without a target."""

    judged_on: str
    unit: str
    thesis_reports: str
    thesis: tuple[float, ...]
    ours: tuple[float, ...]
    target: str
    met: bool | None

    @staticmethod
    def spread(values: tuple[float, ...]) -> str:
        """The values as one, or from the least to the largest."""
        known = [value for value in values if np.isfinite(value)]
        if not known:
            return "–"
        low, high = (_digits(value) for value in (min(known), max(known)))
        return low if low == high else f"{low} – {high}"


def _digits(value: float) -> str:
    return f"{value:.3f}" if abs(value) < 1.0 else f"{value:.2f}" if abs(value) < 100.0 else f"{value:.0f}"


def table(result: Identification) -> list[Line]:
    """Every line that the campaign had logs for. Forces in kN RMSE over every sample of logs that fitted nothing."""
    lines = []
    random = [judged for judged in result.judged if judged.kind == "random"]
    predicted = [judged for judged in result.judged if judged.kind in ("predicted", "gear")]
    integrated = [judged for judged in result.judged if judged.kind == "integrated"]

    def add(name, group, path, reports, target=None, inputs=False):
        if not group:
            return
        thesis, ours = _kilonewton(group, path)
        met = None
        if target is not None:
            met = max(ours) <= target
        text = "" if target is None else f"≤ {target:g}"
        if inputs:
            met = (met is not False) and all(_over_inputs(judged.ours, path) <= _WORSE for judged in group)
            text += (", " if text else "") + "≤ 1.05 × better input"
        lines.append(Line(name, "kN", reports, thesis, ours, text, met))

    thicknesses = f"{len(random)} pad thicknesses" if len(random) != 1 else "one pad thickness"
    add(f"dynamic stiffness, random angle, {thicknesses}", random, "stiffness", "0.29", 0.12)
    add("torque balance, same", random, "torque", "0.61", 0.55)
    add("maximum likelihood, same", random, "maximum_likelihood", "0.32", 0.12, True)
    add("Kalman filter, same", random, "fused", "0.29", 0.12, True)
    add("dynamic stiffness, curve predicted from other thicknesses", predicted, "stiffness", "–")
    add("Kalman filter, same", predicted, "fused", "–", None, True)
    for row in result.thermal.table if result.thermal else ():
        target = f"≤ {row.target:g}" if np.isfinite(row.target) else ""
        met = bool(row.ours <= row.target) if np.isfinite(row.target) else None
        lines.append(
            Line(
                row.name,
                row.unit,
                f"{row.reported:g}" if np.isfinite(row.reported) else "–",
                (row.thesis,),
                (row.ours,),
                target,
                met,
            )
        )
    add("integrated, dynamic stiffness", integrated, "stiffness", "1.09")
    add("integrated, maximum likelihood", integrated, "maximum_likelihood", "0.56")
    add("integrated, Kalman filter", integrated, "fused", "0.50", 0.25, True)
    if result.judged:
        ours = tuple(judged.ours.inside_two_sigma for judged in result.judged)
        thesis = tuple(judged.thesis.inside_two_sigma for judged in result.judged)
        met = all(_HONEST[0] <= share <= _HONEST[1] for share in ours)
        lines.append(
            Line(
                f"share of errors inside two sigma, {len(ours)} judged logs",
                "",
                "–",
                thesis,
                ours,
                f"{_HONEST[0]:g} to {_HONEST[1]:g}",
                met,
            )
        )
    return lines


def _kilonewton(group: list[Judged], path: str) -> tuple[tuple[float, ...], tuple[float, ...]]:
    thesis, ours = (judged.thesis for judged in group), (judged.ours for judged in group)
    return tuple(1e-3 * f.rmse[path] for f in thesis), tuple(1e-3 * f.rmse[path] for f in ours)


def _over_inputs(figures: Figures, path: str) -> float:
    return figures.rmse[path] / min(figures.rmse["stiffness"], figures.rmse["torque"])
