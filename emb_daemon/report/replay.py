"""The page of a replay: estimates, errors and events of a drive on one time axis."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from emb_daemon import __version__
from emb_daemon.calibration.parameters import in_words, moved, parameter
from emb_daemon.calibration.types import Calibration, to_parameters
from emb_daemon.estimator.status import TABLE
from emb_daemon.models.stiffness import characteristic_curve, travel_at
from emb_daemon.offline.score import PATHS, figures, share_inside
from emb_daemon.offline.stretches import stretches_of
from emb_daemon.replay import Result
from emb_daemon.report.figures import BAND, INK, MODEL, PALE, REFERENCE, Panel, Style, Trace, time_figure, xy_figure
from emb_daemon.report.page import FAIL, PASS, Cell, Page
from emb_daemon.wire.contract import CYCLE_S, MODES, REASONS, SOURCES

if TYPE_CHECKING:
    from emb_daemon.adapt.memory import Entry, Store

#: Shortest interval that is visible on the complete time axis, as a share of it; intervals closer together are drawn as one.
_VISIBLE = 1.0 / 1000.0
_BINS = 120
_LABELS = {"fused": "estimate", "stiffness": "stiffness path", "torque": "torque path"}
_STIFFNESS, _TORQUE = Style("#7fa7d1", 1.0), Style("#c2662d", 1.2, "dot")
_INNER, _OUTER, _DISC = Style("#c2662d", 1.4), Style("#1b7f4b", 1.4), Style(INK, 1.2, "dot")
_INNER_MEAN, _OUTER_MEAN = Style("#e3a982", 1.2), Style("#86bfa0", 1.2)
_STRETCH = Style(MODEL.colour, 7.0)
_REASON = Style("#b3261e", 7.0)


def stretches(time_s: np.ndarray, active: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Begin and end of each stretch in which ``active`` holds; those too close or short to be seen are joined and widened."""
    first, after = stretches_of(active).T
    begin, end = time_s[first], time_s[after - 1]
    if not len(begin):
        return begin, end
    least = max(CYCLE_S, _VISIBLE * float(time_s[-1] - time_s[0]))
    apart = np.concatenate([[True], begin[1:] - end[:-1] > least])
    first = np.flatnonzero(apart)
    last = np.concatenate([first[1:] - 1, [len(begin) - 1]])
    begin, end = begin[first], end[last]
    return begin, np.maximum(end, begin + least)


def _row(time_s: np.ndarray, active: np.ndarray, height: float, style: Style) -> Trace:
    begin, end = stretches(time_s, active)
    x = np.column_stack([begin, end, end]).ravel()
    return Trace("", x, np.tile([height, height, np.nan], len(begin)), style)


def _events(time_s: np.ndarray, estimates: np.ndarray) -> tuple[Panel, list[str]]:
    """A row for each mode, source, reason and fact that occurs; lowest row first."""
    rows = [(f"mode: {name}", estimates["mode"] == code, _STRETCH) for code, name in enumerate(MODES)]
    rows += [(f"source: {name}", estimates["source"] == code, Style(PALE.colour, 7.0)) for code, name in SOURCES.items()]
    rows += [(word, (estimates["reasons"] >> bit & 1).astype(bool), _REASON) for bit, word in enumerate(REASONS)]
    # Their sentences would take half of the page from the plots.
    rows += [(in_words(name), (estimates["facts"] >> bit & 1).astype(bool), _REASON) for bit, name in enumerate(TABLE)]
    rows = [row for row in reversed(rows) if row[1].any()]
    traces = [_row(time_s, active, float(height), style) for height, (_, active, style) in enumerate(rows)]
    return Panel("Mode, source, reasons and facts", "", traces, height=max(90, 24 * len(rows))), [row[0] for row in rows]


def _panels(time_s: np.ndarray, estimates: np.ndarray, force_N: np.ndarray) -> list[Panel]:
    force, sigma_kN = 1e-3 * estimates["force"], 1e-3 * estimates["sigma"]
    traces = [
        Trace("", time_s, force - 2.0 * sigma_kN, BAND),
        Trace("± 2 sigma", time_s, force + 2.0 * sigma_kN, BAND),
        Trace("stiffness path", time_s, 1e-3 * estimates["stiffness_force"], _STIFFNESS),
        Trace("torque path", time_s, 1e-3 * estimates["torque_force"], _TORQUE),
        Trace("estimate", time_s, force, MODEL),
    ]
    panels = [Panel("Clamp force", "kN", traces, height=320)]
    known = np.isfinite(force_N)
    if known.any():
        traces.append(Trace("reference", time_s[known], 1e-3 * force_N[known], REFERENCE))
        at, error, sigma = time_s[known], (estimates["force"] - force_N)[known], estimates["sigma"][known]
        panels.append(
            Panel(
                "Estimate minus reference, and two sigma about zero",
                "N",
                [Trace("", at, -2.0 * sigma, BAND), Trace("", at, 2.0 * sigma, BAND), Trace("", at, error, MODEL)],
                height=200,
            )
        )
    surface, mean = estimates["surface"], estimates["mean"]
    panels += [
        Panel(
            "Temperatures", "°C",
            [
                Trace("inner surface", time_s, surface[:, 0], _INNER), Trace("inner mean", time_s, mean[:, 0], _INNER_MEAN),
                Trace("outer surface", time_s, surface[:, 1], _OUTER), Trace("outer mean", time_s, mean[:, 1], _OUTER_MEAN),
                Trace("disc", time_s, estimates["disc"], _DISC),
            ],
            height=220,
        ),
        Panel("Contact angle", "rad", [Trace("", time_s, estimates["contact_angle"])], height=150),
        Panel("Stiffness factor", "", [Trace("", time_s, estimates["stiffness_factor"])], height=130),
    ]  # fmt: skip
    return panels


def _errors(page: Page, estimates: np.ndarray, force_N: np.ndarray, by_log: list[dict]) -> None:
    section = page.section("Errors", "Estimate minus reference. Conditions overlap; conditions without a sample are left out.")
    for log in by_log:
        rows, name = [], Path(log["log"]).name
        for path, label in _LABELS.items():
            part = log["force_N"].get(path, {"samples": 0})
            if part["samples"]:
                rows.append([label, *_cells(part)])
                if path == "fused":
                    rows += [[f"– {when}", *_cells(some)] for when, some in part["conditions"].items() if some["samples"]]
        if rows:
            section.table(["", "RMSE / N", "bias / N", "95 % / N", "max / N", "samples"], rows, name)
        if log["temperature_K"]:
            table = [
                [place.replace("_", " "), *_cells(part)] for place, part in log["temperature_K"].items() if part["samples"]
            ]
            section.table(["temperature", "RMSE / K", "bias / K", "95 % / K", "max / K", "samples"], table, name)
    known = np.isfinite(force_N)
    errors = {label: (estimates[PATHS[path]] - force_N)[known] for path, label in _LABELS.items()}
    errors = {label: error[np.isfinite(error)] for label, error in errors.items()}
    reach = max(1.0, float(np.percentile(np.abs(errors["estimate"]), 99.5)) * 1.5)
    edges = np.linspace(-reach, reach, _BINS + 1)
    centre = 0.5 * (edges[1:] + edges[:-1])
    styles = {"estimate": MODEL, "stiffness path": _STIFFNESS, "torque path": _TORQUE}
    traces = [
        Trace(label, centre, 100.0 * np.histogram(error, edges)[0] / len(error), styles[label])
        for label, error in errors.items()
        if len(error)
    ]
    section.figure(
        xy_figure([Panel("Distribution of the error", "% of samples", traces)], "error / N"),
        "Beyond the axis: "
        + ", ".join(
            f"{100.0 * np.mean(np.abs(error) > reach):.1f} % of the {label}" for label, error in errors.items() if len(error)
        )
        + ".",
    )


def _cells(part: dict) -> list[str]:
    return [*(f"{part[name]:.1f}" for name in ("rmse", "bias", "p95", "max")), f"{part['samples']}"]


def _adaptation(page: Page, learned, calibration: Calibration) -> None:
    """Results of park brake adaptation in the drive."""
    section = page.section(
        "Adaptation",
        "Learned from motor current and angle in training motions, the newest last; only accepted trainings are used. "
        "Trainings before this drive are those stored in the state directory.",
    )
    headings = ["training", "outcome", "samples", "residual / noise", "up to / kN", "sigma / N", "air / °C", "pads / K"]
    section.table(headings, [_training(entry) for entry in learned.history])
    if learned.current is None:
        return
    values, sigmas = learned.current.values, learned.current.sigmas
    section.table(
        ["", "calibration", "learned", "sigma", "unit"],
        [
            [key, f"{now.value:.4g}", f"{value:.4g}", f"{sigmas[key]:.2g}" if key in sigmas else "", now.unit]
            for key, value in values.items()
            for now in [parameter(calibration, key)]
        ],
    )
    top_N = learned.current.evidence["top_force_N"]
    traces = [
        _curve("calibration", to_parameters(calibration)["curve"], top_N, PALE),
        _curve("learned", to_parameters(moved(calibration, values))["curve"], top_N, MODEL),
    ]
    section.figure(
        xy_figure([Panel("Characteristic curve of the cold pads", "kN", traces)], "motor angle past contact / rad"),
        "Shown up to the largest force of the training.",
    )


def _training(entry: "Entry") -> list:
    figures = (("samples", 1.0, 0), ("residual_ratio", 1.0, 2), ("top_force_N", 1e-3, 1), ("force_sigma_N", 1.0, 0))
    numbers = [(entry.evidence.get(name), factor, digits) for name, factor, digits in figures]
    numbers += [(entry.ambient_C, 1.0, 0), (entry.pad_rise_K, 1.0, 0)]
    return [
        entry.date.replace("T", " "),
        Cell(f"{entry.outcome} {entry.note}".strip(), PASS if entry.values else FAIL),
        *("–" if value is None else f"{factor * value:.{digits}f}" for value, factor, digits in numbers),
    ]


def _curve(name: str, coefficients: np.ndarray, top_N: float, style: Style) -> Trace:
    """A characteristic curve up to ``top_N``, in kN over rad past contact."""
    angle = np.linspace(0.0, travel_at(top_N, coefficients), 200)
    return Trace(name, angle, np.array([1e-3 * characteristic_curve(x, coefficients)[0] for x in angle]), style)


def replay_page(
    results: Sequence[Result], corner: str, calibration: Calibration, described: str, learned: "Store | None" = None
) -> Page:
    """The page of one or more `replay.Result`, in sequence as one drive. ``calibration`` of the file, ``described`` in words;
    ``learned``: `adapt.memory.Store` of the corner after the drive, if it adapts."""
    estimates = np.concatenate([result.estimates for result in results])
    force_N = np.concatenate([result.force_N for result in results])
    time_s = 1e-9 * (estimates["time_ns"] - estimates["time_ns"][0])
    by_log = [result.figures for result in results]
    page = Page(f"Replay, corner {corner}", f"{', '.join(result.path.name for result in results)} · emb-daemon {__version__}")
    flagged = float(np.mean(estimates["reasons"] != 0))
    details = [
        f"{len(estimates)} samples, {time_s[-1]:.1f} s; {100.0 * flagged:.1f} % of them have a reason not to trust them.",
        f"Calibration: {described}.",
    ]
    known = np.isfinite(force_N)
    if known.any():
        error = estimates["force"] - force_N
        of = figures(error)
        inside = 100.0 * share_inside(error, estimates["sigma"])
        headline = f"Clamp force: RMSE {of['rmse']:.0f} N, 95 % within {of['p95']:.0f} N, largest {of['max']:.0f} N"
        details.insert(0, f"{inside:.1f} % of the errors are inside two sigma; a normal distribution has 95.4 %.")
    else:
        headline = f"Clamp force up to {1e-3 * np.nanmax(estimates['force']):.1f} kN; no reference force to judge by"
    page.verdict(None, headline, details)
    panels = _panels(time_s, estimates, force_N)
    events, labels = _events(time_s, estimates)
    figure = time_figure([*panels, events])
    figure.update_yaxes(
        tickvals=list(range(len(labels))), ticktext=labels, range=[-0.6, len(labels) - 0.4], automargin=True,
        row=len(panels) + 1, col=1,
    )  # fmt: skip
    # The legend takes two rows; the tool bar is above them.
    figure.update_layout(margin={"t": 108}, height=figure.layout.height + 40)
    page.section("The drive", "Drag across any plot to zoom all of them; double-click to zoom out.").figure(
        figure, "Curves are reduced for the screen; the smallest and the largest value of every interval are kept."
    )
    if known.any():
        _errors(page, estimates, force_N, by_log)
    if learned is not None and learned.history:
        _adaptation(page, learned, calibration)
    return page
