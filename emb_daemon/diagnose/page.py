"""report.html: verdict, error bars before and after, evidence for each effect, and why the others lost."""

import numpy as np

from emb_daemon import __version__
from emb_daemon.diagnose.attribution import Finding
from emb_daemon.diagnose.channels import UNITS
from emb_daemon.diagnose.diagnosis import Diagnosis, ranked
from emb_daemon.diagnose.text import number, size, title, verdict
from emb_daemon.report import ACCENT, MARKS, MODEL, PALE, Page, Panel, Trace, xy_figure

_BINS = 40
_PATHS = {
    "stiffness": "stiffness path",
    "torque": "torque path",
    "maximum_likelihood": "maximum likelihood",
    "fused": "fused force",
    "innovation": "difference of both paths",
}


def page(diagnosis: Diagnosis) -> str:
    """The whole report as one HTML file."""
    logs = ", ".join(trial.log.path.name for trial in diagnosis.bench.trials)
    judges = ", ".join(trial.log.path.name for trial in diagnosis.judged_bench.trials)
    report = Page(
        "Diagnosis of a clamp force estimate",
        f"{diagnosis.original.actuator} · found in {logs} · judged on "
        + (judges if diagnosis.judged_on == "validate" else "left-out episodes")
        + f" · emb-daemon {__version__}",
    )
    details = [f"{title(f)}: {f.effect.equation}" for f in diagnosis.accepted]
    report.verdict(True if diagnosis.unexplained is None else None, verdict(diagnosis), details)
    _errors(report, diagnosis)
    for finding in diagnosis.accepted:
        _evidence(report, diagnosis, finding)
    _rest(report, diagnosis)
    _candidates(report, diagnosis)
    _recalibration(report, diagnosis)
    return report.render()


def _errors(report: Page, diagnosis: Diagnosis) -> None:
    section = report.section(
        "Error before and after",
        "RMSE of the running estimator against the reference force; intervals (95 %) from resampling episodes. These data "
        "chose neither the effects nor their values.",
    )
    figures = diagnosis.figures()
    rows = []
    for path, part in figures.items():
        for condition, f in part.items():
            low, high = f["ratio_interval"]
            before = f"{f['rmse_before_N']:.1f}"
            after = f"{f['rmse_after_N']:.1f}"
            interval = f"{f['interval_after_N'][0]:.1f} to {f['interval_after_N'][1]:.1f}"
            rows.append([_PATHS.get(path, path), condition, before, after, interval, f"{low:.2f} to {high:.2f}"])
    main = "fused" if "fused" in figures else "innovation"
    names = list(figures[main])
    section.figure(_bars(names, figures[main]), f"{_PATHS[main].capitalize()}, by condition.")
    section.table(["path", "condition", "before / N", "after / N", "after, 95 %", "ratio, 95 %"], rows)


def _bars(names: list[str], figures: dict):
    from plotly.graph_objects import Bar, Figure

    figure = Figure()
    for key, name, colour in (("before", "before", "#9aa4b1"), ("after", "after", ACCENT)):
        values = np.array([figures[n][f"rmse_{key}_N"] for n in names])
        low = np.array([figures[n][f"interval_{key}_N"][0] for n in names])
        high = np.array([figures[n][f"interval_{key}_N"][1] for n in names])
        figure.add_trace(
            Bar(
                x=names,
                y=values,
                name=name,
                marker={"color": colour},
                error_y={"type": "data", "array": np.maximum(high - values, 0.0), "arrayminus": np.maximum(values - low, 0.0)},
            )
        )
    figure.update_layout(
        barmode="group", height=320, yaxis_title="RMSE / N", plot_bgcolor="white", margin={"l": 64, "r": 16, "t": 20, "b": 40}
    )
    return figure


def _binned(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean of ``y`` and its spread in bins of ``x``; bins with too few samples are left out."""
    edges = np.unique(np.quantile(x, np.linspace(0.0, 1.0, _BINS + 1)))
    if len(edges) < 3:
        return np.zeros(0), np.zeros(0), np.zeros(0)
    place = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, len(edges) - 2)
    count = np.bincount(place, minlength=len(edges) - 1)
    kept = count >= 5
    mean = np.bincount(place, y, minlength=len(edges) - 1) / np.maximum(count, 1)
    square = np.bincount(place, y**2, minlength=len(edges) - 1) / np.maximum(count, 1)
    centre = np.bincount(place, x, minlength=len(edges) - 1) / np.maximum(count, 1)
    return centre[kept], mean[kept], np.sqrt(np.maximum(square - mean**2, 0.0))[kept]


def _evidence(report: Page, diagnosis: Diagnosis, finding: Finding) -> None:
    section = report.section(
        title(finding).capitalize(), f"{finding.effect.equation}, with {size(finding)}. {finding.reason}."
    )
    channel = finding.channel
    signal = diagnosis.attribution.signals.get(finding.effect.signal)
    if channel not in ("stiffness", "torque", "innovation") or signal is None:
        return
    applied = diagnosis.attribution.signals["clamp_force"] > 150.0
    if channel != "stiffness" or not applied.any():
        applied = np.ones(len(signal), bool)
    unit = UNITS[channel]
    traces = []
    for residual, name, style in (
        (diagnosis.attribution.initial[channel], "before", PALE),
        (diagnosis.attribution.residual[channel], "after", MODEL),
    ):
        x, mean, _ = _binned(signal[applied], residual[applied])
        traces.append(Trace(name, x, mean, style))
    panels = [Panel(f"mean residual of the {_PATHS[channel]}", unit, traces)]
    section.figure(xy_figure(panels, finding.effect.signal.replace("_", " ")), "Mean residual in bins of equal counts.")
    for text, share in finding.placebos.items():
        section.text(f"Placebo: with {text} the same term reaches {100 * share:.0f} % of this gain.")
    section.table(
        ["parameter", "value", "unit"],
        [[n, number(v, finding.sigmas.get(n, 0.0)), _unit(finding, n)] for n, v in finding.values.items()],
    )


def _unit(finding: Finding, name: str) -> str:
    return next((p.unit for p in finding.effect.parameters if p.name == name), "")


def _rest(report: Page, diagnosis: Diagnosis) -> None:
    rest = diagnosis.unexplained
    section = report.section("What is left")
    if rest is None:
        section.text("No smooth function of any measured or estimated signal explains what is left on left-out episodes.")
    else:
        section.text(
            f"{rest.rms:.0f} N RMS ({100 * rest.share:.0f} % of the mean square) of the {_PATHS[rest.channel]} follow "
            f"{rest.signal.replace('_', ' ')} on left-out episodes. No effect of the catalogue explains it; none was invented."
        )
    for channel, listed in diagnosis.rests.items():
        if not listed:
            continue
        signal = diagnosis.attribution.signals[listed[0].signal]
        keep = diagnosis.attribution.residual[channel] != 0.0
        if keep.sum() < 100:
            continue
        before = _binned(signal[keep], diagnosis.attribution.initial[channel][keep])
        after = _binned(signal[keep], diagnosis.attribution.residual[channel][keep])
        traces = [Trace("before", before[0], before[1], PALE), Trace("after", after[0], after[1], MARKS)]
        section.figure(
            xy_figure([Panel(f"{_PATHS[channel]}, mean residual", "N", traces)], listed[0].signal.replace("_", " ")),
            f"Strongest dependence of the {_PATHS[channel]} residual after the diagnosis.",
        )
        earlier = {r.signal: r for r in diagnosis.rests_before.get(channel, [])}
        section.table(
            ["signal", "share before", "share after", "mean gain / its error"],
            [
                [
                    r.signal.replace("_", " "),
                    f"{earlier[r.signal].share:.3f}" if r.signal in earlier else "–",
                    f"{r.share:.3f}",
                    f"{r.certainty:.1f}",
                ]
                for r in listed[:6]
            ],
            f"{_PATHS[channel]}: share of the residual's mean square that a smooth function explains on left-out episodes.",
        )


def _candidates(report: Page, diagnosis: Diagnosis) -> None:
    section = report.section(
        "All candidates", "Every effect of the catalogue, with what it would have gained and why it was not taken."
    )
    rows = []
    for f in ranked(diagnosis.attribution.findings):
        state = "accepted" if f.accepted else "in calibration" if f.in_calibration else ""
        unit = UNITS.get(f.channel or "", "")
        gain = f"{f.gain:.3g} {unit}" if f.channel and not f.in_calibration else "–"
        rows.append([title(f), f.effect.path, state, gain, f"{f.q_value:.2g}", size(f), f.reason])
    section.table(["effect", "path", "", "gain", "q", "size", "why"], rows)


def _recalibration(report: Page, diagnosis: Diagnosis) -> None:
    attribution = diagnosis.attribution
    rows = [
        [knob.name, number(value, attribution.sigmas.get(knob, 0.0)), "relative" if knob.unit == "1" else knob.unit]
        for knob, value in attribution.values.items()
        if value != 0.0 and knob.name.partition(".")[0] in ("contact", "stiffness", "thermal", "motor", "friction")
    ]
    if rows:
        report.section(
            "Recalibrated",
            "Base parameters that were re-estimated together with the effects: a calibration that is off is no effect.",
        ).table(["parameter", "change", "unit"], rows)
