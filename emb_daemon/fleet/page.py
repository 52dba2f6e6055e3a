"""The fleet on one page: what to do next, batches, the map of units, the worst ten, trends, the population."""

import json
from collections import Counter
from pathlib import Path

import numpy as np

from emb_daemon import __version__
from emb_daemon.fleet.dataset import read_results
from emb_daemon.fleet.findings import PER_DAYS, PER_K, Finding, Findings, Placed, load
from emb_daemon.report.figures import ACCENT, GRID, INK, Panel, Style, Trace, xy_figure
from emb_daemon.report.page import Page, Section

#: Rows of the page's tables: what is read in five minutes; findings.json has all.
_WORST, _SPREAD_ROWS, _FAULT_ROWS = 10, 12, 10
#: Standard deviations at which the map's colour is full.
_FULL = 6.0
_NAMED = "#b3261e"
_COLUMNS = ["where", "units", "cause", "force / N", "amount", "chance", "not told apart from"]


def fleet_page(root: Path) -> Page:
    """The report of a data set. Raises InputError: it has not been diagnosed."""
    found = load(root)
    page = Page(
        f"Fleet of {len(found.units)} units",
        f"{found.drives} drives from {found.first_day} to {found.last_day}, calibration {found.calibration}, without force "
        f"sensors: judged by how the two force paths of each unit disagree. emb_daemon {__version__}",
    )
    outlying = [*found.outliers, *found.ageing]
    page.verdict(not (found.groups or outlying), _headline(found))
    listed = [*found.groups, *outlying[:_WORST], *found.drifts, *found.seasons]
    actions = [f"{one.where}: {_words(one.cause)}, {one.size_N:+.0f} N. {one.action}" for one in listed]
    page.section("What to do next").items(actions or ["Nothing: the units differ no more than healthy units do."])
    caption = (
        "Difference between a group and all other units: RMS of the force in contact ± one standard deviation, "
        "from the differences between units; "
        "chance that any row here is false (Holm)."
    )
    _table(
        page, "Batches", found.groups, caption, f"No group of units differs from the others in any of {found.causes} causes."
    )
    page.section("Map of units").figure(
        _map(found.units),
        "One mark for each unit: its largest difference from its group, in standard deviations of ordinary units. "
        f"Ringed ones are named below. The colour is full at {_FULL:g}.",
    )
    more = f" {len(outlying) - _WORST} more in findings.json." if len(outlying) > _WORST else ""
    caption = (
        "Difference from the unit's own group, worst first; chance that a row is false (Benjamini and Hochberg): these "
        f"units are only inspected in a workshop.{more}"
    )
    _table(page, "Units that differ from the others", outlying[:_WORST], caption, "No unit is proven to differ.")
    _trends(page, found)
    _population(page, found)
    _data(page, root, found)
    return page


def _headline(found: Findings) -> str:
    def count_words(count: int, one: str, more: str) -> str:
        return f"{count or 'no'} {one if count == 1 else more}"

    groups = count_words(len({one.where for one in found.groups}), "batch shares", "batches share")
    units = count_words(len({one.where for one in (*found.outliers, *found.ageing)}), "unit is", "units are")
    drifts = count_words(len(found.drifts), "drift", "drifts")
    return f"{groups} a cause, {units} different from the others, {drifts}".capitalize()


def _words(name: str) -> str:
    return name.replace("_", " ")


def _quantity(value: float, unit: str) -> str:
    return f"{value:+.3g}" if unit == "1" else f"{value:+.3g} {unit}"


def _table(page: Page, title: str, findings: list[Finding], caption: str, otherwise: str) -> Section:
    rows = [
        [
            one.where, str(one.units), _words(one.cause), f"{one.size_N:+.0f} ± {one.sigma_N:.0f}",
            _quantity(one.amount, one.unit), f"{one.chance:.1g}", ", ".join(map(_words, one.rivals)),
        ]
        for one in findings
    ]  # fmt: skip
    section = page.section(title)
    return section.table(_COLUMNS, rows, caption) if rows else section.text(otherwise)


def _map(units: list[Placed]):
    from plotly.graph_objects import Figure, Scatter

    def group(unit: Placed) -> str:
        return ", ".join(f"{name} {level}" for name, level in unit.levels.items()) or "all"

    ranked = sorted(units, key=lambda unit: -abs(unit.deviation))
    names = sorted({group(unit) for unit in units})
    places: Counter[str] = Counter()
    across = []
    for unit in ranked:
        across.append(places[group(unit)])
        places[group(unit)] += 1
    marks = Scatter(
        x=across,
        y=[names.index(group(unit)) for unit in ranked],
        mode="markers",
        marker={
            "symbol": "square",
            "size": 15,
            "color": [min(abs(unit.deviation), _FULL) for unit in ranked],
            "colorscale": [[0.0, "#eef2f6"], [0.5, "#93bee8"], [1.0, ACCENT]],
            "cmin": 0.0,
            "cmax": _FULL,
            "line": {"color": _NAMED, "width": [2.5 if unit.outlying else 0.0 for unit in ranked]},
            "colorbar": {"title": {"text": "σ"}, "thickness": 10, "outlinewidth": 0},
        },
        text=[f"{u.unit} {u.corner}: {u.cause}, {u.size_N:+.0f} N, {u.deviation:+.1f} σ" for u in ranked],
        hoverinfo="text",
    )
    figure = Figure(marks)
    figure.update_layout(
        height=90 + 42 * max(len(names), 2),
        margin={"l": 96, "r": 16, "t": 30, "b": 40},
        plot_bgcolor="white",
        font={"family": "system-ui, sans-serif", "size": 12.5, "color": INK},
        xaxis={"title": {"text": "units of the group, largest difference first"}, "gridcolor": GRID, "zeroline": False},
    )
    figure.update_yaxes(
        tickvals=list(range(len(names))), ticktext=names, autorange="reversed", zeroline=False, gridcolor="white"
    )
    return figure


def _trends(page: Page, found: Findings) -> None:
    caption = f"Drift per {PER_DAYS:g} days, season per {PER_K:g} K of ambient temperature; chance as for batches."
    otherwise = "No drift is proven, and no season."
    section = _table(page, "Trend", [*found.drifts, *found.seasons], caption, otherwise)
    style = Style(ACCENT, mode="lines+markers")
    panels = [
        Panel(
            f"{trend.where}: {_words(trend.cause)}",
            "N",
            [Trace("", np.array(trend.days), np.array(trend.size_N), style, np.array(trend.sigma_N))],
            190,
        )
        for trend in found.trends
        if len(trend.days) > 1
    ]
    if panels:
        section.figure(
            xy_figure(panels, "days since the first drive"),
            "All drives of a group together, window by window, ± one standard deviation.",
        )


def _population(page: Page, found: Findings) -> None:
    ranked = sorted(found.population, key=lambda one: -one.spread_N)[:_SPREAD_ROWS]
    about = "Differences between ordinary units, without each unit's own noise (random effects)."
    page.section("What units differ in", about).table(
        ["cause", "spread / N", "a unit's noise / N", "mean / N", "mean", "spread"],
        [
            [
                _words(one.cause), f"{one.spread_N:.0f}", f"{one.noise_N:.0f}", f"{one.mean_N:+.0f}",
                _quantity(one.mean, one.unit), _quantity(one.spread, one.unit),
            ]
            for one in ranked
        ],
        f"{found.causes} causes were tested; the drives distinguish {found.directions} directions among them.",
    )  # fmt: skip


def _data(page: Page, root: Path, found: Findings) -> None:
    files = read_results(root)
    damaged = [known for known in files if known["fault"]]
    figures = [json.loads(path.read_bytes()) for path in sorted(Path(root, "figures").rglob("*.json"))]
    seconds = sum(one["seconds"] for one in figures)
    refused: Counter[str] = Counter()
    reasons: Counter[str] = Counter()
    for one in figures:
        refused.update(one["refused"])
        reasons.update({word: share * one["seconds"] / seconds for word, share in one["reasons"].items()})
    silent = ", ".join(f"{count} × {why}" for why, count in Counter(found.silent.values()).most_common(3))
    raised = ", ".join(f"{word} {100.0 * share:.2g} %" for word, share in reasons.most_common(4))
    section = page.section("Data").items(
        [
            f"{len(files)} log files, {len(damaged)} of them damaged",
            f"{len(found.silent)} drives cannot be used{': ' + silent if silent else ''}",
            f"{len(found.left_out)} units with too few drives",
            f"{len(figures)} drives replayed, {seconds / 3600.0:.1f} h{'; time with a reason: ' + raised if raised else ''}",
            f"frames refused: {', '.join(f'{count} {verdict}' for verdict, count in refused.most_common()) or 'none'}",
        ]
    )
    if damaged:
        section.table(["damaged", "why"], [[Path(one["source"]).name, one["fault"]] for one in damaged[:_FAULT_ROWS]])
