"""report.html: verdict, error bars before and after, evidence for each effect, and why others were rejected."""

import numpy as np

from emb_daemon import __version__
from emb_daemon.diagnose.diagnosis import Diagnosis
from emb_daemon.diagnose.residuals import FORCE_CHANNELS, UNITS
from emb_daemon.diagnose.screening import Candidate
from emb_daemon.diagnose.text import NAMES, least_left, number, size, title, verdict
from emb_daemon.diagnose.unexplained import Left
from emb_daemon.effects.terms import CLAMPED_N, SIGNALS
from emb_daemon.report.figures import ACCENT, MARKS, MODEL, PALE, Panel, Trace, xy_figure
from emb_daemon.report.page import Page

_BINS = 40
#: Least number of residuals for a plot, and number of dependences listed.
_FEWEST, _LISTED = 100, 6


def page(diagnosis: Diagnosis) -> str:
    """The whole report as one HTML file."""
    logs = ", ".join(trial.log.path.name for trial in diagnosis.bench.trials)
    judges = ", ".join(trial.log.path.name for trial in diagnosis.judges.trials)
    report = Page(
        "Diagnosis of a clamp force estimate",
        f"{diagnosis.bench.calibration.actuator} · found in {logs} · judged on "
        + (judges if diagnosis.judged_on == "validate" else "left-out episodes")
        + f" · emb-daemon {__version__}",
    )
    details = [f"{title(f)}: {f.effect.equation}" for f in diagnosis.accepted]
    report.verdict(True if diagnosis.unexplained is None else None, verdict(diagnosis), details)
    sections(report, diagnosis)
    return report.render()


def sections(report: Page, diagnosis: Diagnosis) -> None:
    """Error before and after, evidence for what was found, what is left, and everything that was tried."""
    _errors(report, diagnosis)
    for finding in diagnosis.accepted:
        _evidence(report, diagnosis, finding)
    _left(report, diagnosis)
    _candidates(report, diagnosis)
    _recalibration(report, diagnosis)


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
            rows.append([NAMES[path], condition, before, after, interval, f"{low:.2f} to {high:.2f}"])
    main = diagnosis.whole
    names = list(figures[main])
    section.figure(_bars(names, figures[main]), f"{NAMES[main].capitalize()}, by condition.")
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


def _bin(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centre of bins of ``x`` and mean of ``y`` in them; bins with too few samples are left out."""
    edges = np.unique(np.quantile(x, np.linspace(0.0, 1.0, _BINS + 1)))
    if len(edges) < 3:
        return np.zeros(0), np.zeros(0)
    place = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, len(edges) - 2)
    count = np.bincount(place, minlength=len(edges) - 1)
    kept = count >= 5
    mean = np.bincount(place, y, minlength=len(edges) - 1) / np.maximum(count, 1)
    centre = np.bincount(place, x, minlength=len(edges) - 1) / np.maximum(count, 1)
    return centre[kept], mean[kept]


def _evidence(report: Page, diagnosis: Diagnosis, finding: Candidate) -> None:
    section = report.section(
        title(finding).capitalize(), f"{finding.effect.equation}, with {size(finding)}. {finding.reason}."
    )
    if finding.made:
        section.text(
            "No known effect: where it acts and what it follows is what these logs tell, its shape is the one that describes "
            "them most shortly, and its cause is not known. Outside of what they cover it is a guess."
        )
    channel, signals = finding.channel, diagnosis.selection.screening.signals
    signal = finding.over if finding.made else signals.get(finding.effect.signal)
    if channel not in FORCE_CHANNELS or signal is None:
        return
    applied = (signals["clamp_force"] > CLAMPED_N) & np.isfinite(signal)
    if channel != "stiffness" or not applied.any():
        applied = np.isfinite(signal)
    first, last = diagnosis.selection.screening.initial[channel], diagnosis.selection.model.residual[channel]
    parts = (("before", first, PALE), ("after", last, MODEL), ("what it does", finding.contribution, MARKS))
    traces = [Trace(name, *_bin(signal[applied], shown[applied]), style) for name, shown, style in parts]
    panels = [Panel(f"mean residual of the {NAMES[channel]}", UNITS[channel], traces)]
    section.figure(xy_figure(panels, _axis(finding.effect.signal)), "Mean residual in bins of equal counts.")
    for text, share in finding.placebos.items():
        section.text(f"Placebo: with {text} the same term reaches {100 * share:.0f} % of this gain.")
    section.table(
        ["parameter", "value", "unit"],
        [[n, number(v, finding.sigmas.get(n, 0.0)), finding.effect.parameter(n).unit] for n, v in finding.values.items()],
    )


def _left(report: Page, diagnosis: Diagnosis) -> None:
    section = report.section("What is left")
    least = least_left(diagnosis)
    if diagnosis.unexplained is None:
        section.text(f"Nothing clearly above {least}, and no smooth function of any signal.")
    section.table(
        ["", "left, RMS", least, "unit", "share of before", ""],
        [
            [NAMES[c], f"{p.rms:.3g}", f"{p.achieved:.3g}" if p.achieved > 0.0 else "–", UNITS[c], f"{p.share:.2f}", _where(p)]
            for c, p in diagnosis.left.items()
        ],
        "Residual with the contact angle held. What is marked neither an effect of the catalogue nor a term explains.",
    )
    screening, residual = diagnosis.selection.screening, diagnosis.selection.model.residual
    for channel, left in diagnosis.left.items():
        if not left.dependences:
            continue
        # Temperatures have times of their own, and signals that only the estimator has no column here.
        strongest, keep = left.dependences[0].signal, residual[channel] != 0.0
        signal = screening.signals.get(strongest)
        if channel in FORCE_CHANNELS and signal is not None and keep.sum() >= _FEWEST:
            before = _bin(signal[keep], screening.initial[channel][keep])
            after = _bin(signal[keep], residual[channel][keep])
            traces = [Trace("before", *before, PALE), Trace("after", *after, MARKS)]
            section.figure(
                xy_figure([Panel(f"{NAMES[channel]}, mean residual", "N", traces)], _axis(strongest)),
                f"Strongest dependence of the {NAMES[channel]} residual after the diagnosis.",
            )
        earlier = {d.signal: f"{d.share:.3f}" for d in diagnosis.selection.at_first.get(channel, [])}
        section.table(
            ["signal", "share before", "share after", "mean gain / its error"],
            [
                [d.signal.replace("_", " "), earlier.get(d.signal, "–"), f"{d.share:.3f}", f"{d.certainty:.1f}"]
                for d in left.dependences[:_LISTED]
            ],
            f"{NAMES[channel]}: share of the residual's mean square that a smooth function explains on left-out episodes.",
        )


def _axis(signal: str) -> str:
    """A signal with its unit, where it has one."""
    unit = SIGNALS.get(signal, "1")
    return signal.replace("_", " ") + (f" / {unit}" if unit != "1" else "")


def _where(left: Left) -> str:
    return f"not explained on {left.place}" if left.log else "not explained" if left.present else ""


def _candidates(report: Page, diagnosis: Diagnosis) -> None:
    section = report.section(
        "All candidates", "Every effect of the catalogue, with what it would have gained and why it was not taken."
    )
    rows = []
    for f in diagnosis.findings:
        state = "accepted" if f.accepted else "in calibration" if f.in_calibration else ""
        state = "proven, not applied" if f.effect.name in diagnosis.withdrawn else state
        unit = UNITS.get(f.channel or "", "")
        gain = f"{f.gain:.3g} {unit}" if f.channel and not f.in_calibration else "–"
        rows.append([title(f), f.effect.path, state, gain, f"{f.q_value:.2g}", size(f), f.reason])
    section.table(["effect", "path", "", "gain", "q", "size", "why"], rows)


def _recalibration(report: Page, diagnosis: Diagnosis) -> None:
    rows = [
        [
            key, f"{r.before:.4g}", number(r.value, r.sigma), r.unit, f"{r.gain:.3g} {UNITS[r.channel]}",
            "" if r.is_tolerance else f"no tolerance: more than a factor of {r.tolerated:.3g}",
        ]
        for key, r in diagnosis.recalibrated.items()
    ]  # fmt: skip
    if rows:
        report.section(
            "Recalibrated",
            "Base parameters that were estimated anew together with the effects: a calibration that is off is no effect. The "
            "curve's coefficients stand for those of all pad thicknesses, which follow in proportion, and gain together.",
        ).table(["parameter", "before", "after", "unit", "gain", ""], rows)
