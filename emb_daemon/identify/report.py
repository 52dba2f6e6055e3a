"""The report of an identification: verdict, the thesis's table, then every step with data, fit and residual."""

import numpy as np

from emb_daemon.calibration.files import calibration_hash
from emb_daemon.identify.run import Identification, Judged, is_slow
from emb_daemon.identify.stiffness import DYNAMICS
from emb_daemon.identify.table import Line, table
from emb_daemon.report import (
    BAND,
    FAIL,
    MARKS,
    MODEL,
    PALE,
    PASS,
    REFERENCE,
    THESIS,
    Cell,
    Page,
    Panel,
    Trace,
    shades,
    time_figure,
    xy_figure,
)
from emb_daemon.report.figures import Style

_UNITS = {
    "relaxation_time_s": ("relaxation time τ", 1e3, "ms"),
    "second_relaxation.share": ("second relaxation, share w", 1e2, "%"),
    "second_relaxation.time_constant_s": ("second relaxation, time constant τ₂", 1e3, "ms"),
    "stiffness_hysteresis.share": ("hysteresis, share h", 1e2, "%"),
    "stiffness_hysteresis.slip_angle_rad": ("hysteresis, slip angle", 1.0, "rad"),
    "signal_delay.delay_s": ("reference later than resolver (not in the calibration)", 1e3, "ms"),
}
_TORQUE = (
    ("torque_constant_Nm_per_A", "torque constant K_m", 1e3, "mN m/A"),
    ("inertia_kg_m2", "lumped inertia J", 1e6, "g cm² · 10"),
    ("offset_Nm", "Coulomb friction η", 1e3, "mN m"),
    ("load_m_per_rad", "load friction μ", 1e6, "µm/rad"),
    ("presliding_angle_rad", "presliding angle", 1e3, "mrad"),
)
#: Many measured points behind a line; and few of them.
_CLOUD = Style("#aab4c0", mode="markers", size=3.0)
_POINTS = Style("#1d2430", mode="markers")
_EFFECTS = {
    (): "one lag alone (thesis)",
    ("second_relaxation",): "+ second relaxation",
    ("stiffness_hysteresis",): "+ hysteresis",
    ("second_relaxation", "stiffness_hysteresis"): "+ second relaxation + hysteresis",
}


def _value(value: float, sigma: float | None, factor: float = 1.0) -> str:
    """Value ± sigma, with the digits that sigma leaves."""
    value *= factor
    if sigma is None or not np.isfinite(sigma) or sigma <= 0.0:
        return f"{value:.5g}"
    sigma *= factor
    digits = max(0, 1 - int(np.floor(np.log10(sigma))))
    return f"{value:.{digits}f} ± {sigma:.{digits}f}"


def build(result: Identification) -> Page:
    """The page; nothing is written yet."""
    file = result.campaign.file
    provenance = result.calibration.provenance
    page = Page(
        f"Identification of rig {file.rig}",
        f"{result.campaign.path.name}, corner {file.corner}, pads {file.pad_thickness_mm:g} mm · {provenance.date} · "
        f"{provenance.tool} · calibration {calibration_hash(result.calibration)} · {result.seconds:.0f} s",
    )
    lines = table(result)
    judged = [line for line in lines if line.met is not None]
    missed = [line for line in judged if not line.met]
    faults = result.campaign.faults
    details = [f"Missed: {line.judged_on}: {Line.spread(line.ours)} {line.unit}, {line.target}." for line in missed]
    if faults:
        details.append(f"{len(faults)} log{'s' if len(faults) > 1 else ''} or steps left out; see Logs.")
    details.append("Every figure of this table is judged on logs that fitted nothing.")
    headline = f"All {len(judged)} targets met" if judged and not missed else f"{len(missed)} of {len(judged)} targets missed"
    page.verdict(not missed if judged else None, headline if judged else "Nothing could be judged", details)
    _table(page, lines)
    _curves(page, result)
    _dynamics(page, result)
    _thickness(page, result)
    _frequency(page, result)
    _torque(page, result)
    _fusion(page, result)
    _thermal(page, result)
    _logs(page, result)
    return page


def _table(page: Page, lines: list[Line]) -> None:
    section = page.section(
        "Against the thesis",
        "RMSE over every sample. Thesis form is the same estimator with the thesis's models, identified here by his least "
        "squares; ours adds the effects that the residuals asked for. A range runs over the logs or pads judged.",
    )
    rows = [
        [
            line.judged_on,
            line.unit,
            line.thesis_reports,
            Line.spread(line.thesis),
            Line.spread(line.ours),
            line.target,
            Cell({True: "met", False: "missed", None: ""}[line.met], {True: PASS, False: FAIL, None: ""}[line.met]),
        ]
        for line in lines
    ]
    section.table(["judged on", "unit", "thesis reports", "thesis form", "ours", "to reach", ""], rows)


def _curves(page: Page, result: Identification) -> None:
    section = page.section(
        "Characteristic curves",
        "Clamp force over motor angle past contact (thesis 2.1, 2.2). Points: slow clamp and release; line: the static curve "
        "of the joint fit, without the lag and the loop that the dynamics explain. Residual: of the full model.",
    )
    force, residual = [], []
    colours = shades(len(result.pads))
    for pads, curve, form, colour in zip(result.pads, result.fit.curves, result.thesis, colours, strict=True):
        name = f"{pads.thickness_mm:g} mm"
        for log, clearance in zip(pads.logs, curve.clearances_rad, strict=True):
            if not is_slow(log):
                continue
            x = log.samples["angle"] - log.samples["angle"][0] - clearance
            thin = slice(None, None, max(len(x) // 700, 1))
            force.append(Trace("measured", x[thin], 1e-3 * log.force_N[thin], _CLOUD))
            known = np.isfinite(log.force_N)
            error = result.fit.residuals[str(log.path)]
            residual.append(Trace(name, x[known][thin], error[thin], Style(colour, 0.9)))
            thesis = form.curve_residual
            residual.append(Trace("line of best fit (thesis)", x[known][thin], thesis[thin], Style("#c2662d", 0.6)))
        grid = np.linspace(0.0, curve.travel_rad, 200)
        force.append(Trace(name, grid, 1e-3 * curve.force(grid), Style(colour, 1.8)))
    section.figure(
        xy_figure(
            [Panel("Clamp force", "kN", force, 360), Panel("Residual", "N", _behind(residual), 220)],
            "motor angle past contact / rad",
        ),
        "The line of best fit leaves the loop as residual; the joint fit leaves the reference's noise.",
    )
    rows = []
    for curve, form in zip(result.fit.curves, result.thesis, strict=True):
        sigmas = np.sqrt(np.diag(curve.covariance))
        full = np.array([curve.travel_rad])
        rows.append(
            [
                f"{curve.thickness_mm:g}",
                *(_value(c, s) for c, s in zip(curve.coefficients, sigmas, strict=True)),
                _value(float(curve.force(full)[0]), float(curve.force_sigma(full)[0]), 1e-3),
                _value(float(np.mean(curve.clearances_rad)), float(np.max(curve.clearance_sigmas_rad))),
                f"{form.curve_rms:.0f}",
                f"{_slow_rms(result, curve.thickness_mm):.0f}",
            ]
        )
    section.table(
        ["pad / mm", "A0 / N/rad", "A1 / N/rad²", "A2 / N/rad³", "force at full travel / kN", "clearance / rad",
         "residual, line of best fit / N", "residual, ours / N"],
        rows,
        "± one standard deviation, robust against residuals correlated within a second.",
    )  # fmt: skip


def _behind(traces: list[Trace]) -> list[Trace]:
    """Thesis lines first, so that ours lie on top."""
    return sorted(traces, key=lambda trace: "thesis" not in trace.name)


def _slow_rms(result: Identification, thickness_mm: float) -> float:
    pads = next(p for p in result.pads if p.thickness_mm == thickness_mm)
    parts = [result.fit.residuals[str(log.path)] for log in pads.logs if is_slow(log)]
    return float(np.sqrt(np.mean(np.concatenate(parts) ** 2))) if parts else np.nan


def _dynamics(page: Page, result: Identification) -> None:
    section = page.section(
        "Dynamic stiffness",
        "Thesis 3.3.2 and 3.4 as they stand, then the output-error fit of the estimator's own stiffness path over all pads at "
        "once. Effects are tried in every combination on the first halves of the random logs and kept if the second halves "
        "gain by more than 2 % and the amplitude stands clear of zero by three sigma.",
    )
    rows = [
        [
            _EFFECTS[c.effects],
            f"{c.held_out_rms:.1f}",
            "yes" if c.clear else "no",
            "chosen" if c.effects == result.chosen else "",
        ]
        for c in result.candidates
    ]
    section.table(["structure", "held-out RMSE / N", "amplitudes clear of zero", ""], rows)
    fit = result.fit.dynamics
    rows = []
    for name, _ in DYNAMICS:
        if name in fit.sigmas:
            title, factor, unit = _UNITS[name]
            each = [s.dynamics.values[name] * factor for s in result.separate]
            rows.append(
                [title, _value(fit.values[name], fit.sigmas[name], factor), unit,
                 f"{min(each):.4g} – {max(each):.4g}" if each else "–"]
            )  # fmt: skip
    section.table(["shared dynamics", "all pads at once", "unit", "each pad alone"], rows)
    if len(result.separate) > 1:
        joint = result.fit.rms
        alone = float(np.sqrt(np.mean([s.rms**2 for s in result.separate])))
        enough = joint < 1.05 * alone
        section.text(
            f"One damping for all thicknesses {'is enough' if enough else 'is not enough'}: "
            f"{joint:.1f} N together against {alone:.1f} N with dynamics of its own for each pad."
        )
    rows = [
        [
            f"{form.thickness_mm:g}",
            f"{1e3 * form.free[1]:.1f}",
            f"{form.free[2]:.0f}",
            _value(*form.damping, 1e3),
            f"{1e3 * form.output_error_s:.1f}",
        ]
        for form in result.thesis
        if form.free
    ]
    if rows:
        section.table(
            ["pad / mm", "form 3-5: τ / ms", "form 3-5: free run on its own log / N", "form 3-8, least squares: τ / ms",
             "form 3-8, output error: τ / ms"],
            rows,
            "Thesis forms by thickness. Form 3-5 is fitted on the log on which it stands here, which flatters it.",
        )  # fmt: skip
    shown = [judged for judged in result.judged if judged.kind == "random"]
    if shown:
        middle = shown[len(shown) // 2]
        section.heading(f"Held out: {middle.name}")
        section.figure(_force_figure(middle), "Its dynamics come from the other pads, its curve from its own slow log.")


def _force_figure(judged: Judged):
    log, ours, thesis = judged.log, judged.ours.estimates, judged.thesis.estimates
    time = log.time_s
    error = ours["fused"] - log.force_N
    return time_figure(
        [
            Panel(
                "Clamp force",
                "kN",
                [
                    Trace("reference", time, 1e-3 * log.force_N, REFERENCE),
                    Trace("torque balance", time, 1e-3 * ours["torque"], PALE),
                    Trace("fused", time, 1e-3 * ours["fused"], MODEL),
                ],
                300,
            ),
            Panel(
                "Error of the fused force, with two sigma",
                "N",
                [
                    Trace("", time, -2.0 * ours["sigma"], BAND),
                    Trace("two sigma", time, 2.0 * ours["sigma"], BAND),
                    Trace("fused", time, error, MODEL),
                ],
                200,
            ),
            Panel(
                "Error of the stiffness path",
                "N",
                [
                    Trace("thesis form", time, thesis["stiffness"] - log.force_N, THESIS),
                    Trace("ours", time, ours["stiffness"] - log.force_N, MODEL),
                ],
                200,
            ),
        ]
    )


def _thickness(page: Page, result: Identification) -> None:
    if not result.laws or not len(next(iter(result.laws.values()))):
        return
    section = page.section(
        "Pad thickness",
        "How the curve varies with thickness: each inner thickness predicted from the others, relative error of the force, "
        "weighted by force. The gaps are then twice those that prediction has to bridge.",
    )
    inner = [curve.thickness_mm for curve in result.fit.curves[1:-1]]
    rows = [
        [name, *(f"{100 * e:.2f}" for e in errors), f"{100 * float(np.sqrt(np.mean(errors**2))):.2f}"]
        for name, errors in result.laws.items()
    ]
    section.table(["law for each coefficient a", *(f"{t:g} mm / %" for t in inner), "RMS / %"], rows)
    section.text(
        f"At {result.campaign.file.pad_thickness_mm:g} mm interpolation is expected to add "
        f"{100 * result.interpolation_relative:.2f} % of the force, which the noise level of the stiffness path contains."
    )
    traces = []
    for n, colour in zip(range(len(result.fit.curves[0].coefficients)), shades(3), strict=True):
        first = result.fit.curves[0].coefficients[n]
        thicknesses = np.array([curve.thickness_mm for curve in result.fit.curves])
        inverse = np.array([first / curve.coefficients[n] for curve in result.fit.curves])
        sigma = np.array([first * np.sqrt(curve.covariance[n, n]) / curve.coefficients[n] ** 2 for curve in result.fit.curves])
        traces.append(Trace(f"1/A{n}", thicknesses, inverse, Style(colour, 1.4, mode="lines+markers"), np.abs(sigma)))
    section.figure(
        xy_figure([Panel("Compliance over that of the thinnest pad", "1", traces, 280)], "pad thickness / mm"),
        "Compliance adds up with thickness, so that the reciprocals run nearly straight.",
    )


def _frequency(page: Page, result: Identification) -> None:
    found = result.response
    if found is None:
        return
    section = page.section(
        "Frequency response",
        "Clamp force over the static force of the same angle (thesis 3.3.1). First order: K and τ by least squares on 1/|G|². "
        "The identified dynamics saw none of these logs.",
    )
    section.table(
        ["first-order fit", "value"],
        [
            ["gain K", _value(found.gain, found.gain_sigma)],
            ["time constant τ / ms", _value(found.time_constant_s, found.time_constant_sigma_s, 1e3)],
        ],
    )
    f = found.frequency_Hz
    phase = -np.degrees(np.arctan(2.0 * np.pi * f * found.time_constant_s))
    section.figure(
        xy_figure(
            [
                Panel(
                    "Magnitude",
                    "dB",
                    [
                        Trace("measured", f, 20.0 * np.log10(np.abs(found.measured)), _POINTS),
                        Trace("first order (thesis)", f, 20.0 * np.log10(found.fitted), THESIS),
                        Trace("identified dynamics", f, 20.0 * np.log10(np.abs(found.model)), MODEL),
                    ],
                ),
                Panel(
                    "Phase",
                    "°",
                    [
                        Trace("measured", f, np.degrees(np.angle(found.measured)), _POINTS),
                        Trace("first order (thesis)", f, phase, THESIS),
                        Trace("identified dynamics", f, np.degrees(np.angle(found.model)), MODEL),
                    ],
                    200,
                ),
                Panel(
                    "Residual of the magnitude",
                    "%",
                    [
                        Trace("first order (thesis)", f, 100.0 * (found.fitted / np.abs(found.measured) - 1.0), THESIS),
                        Trace(
                            "identified dynamics",
                            f,
                            100.0 * (np.abs(found.model) / np.abs(found.measured) - 1.0),
                            Style("#0b5cad", 1.4, mode="lines+markers"),
                        ),
                    ],
                    180,
                ),
            ],
            "frequency / Hz",
            x_log=True,
        )
    )


def _torque(page: Page, result: Identification) -> None:
    section = page.section(
        "Torque balance",
        "Current explained by force, acceleration and friction (thesis 2.4, 4.1, 4.2). The current is noisy and is what is "
        "explained; the angle's second difference instruments the noisy speed. Friction turns over within the presliding "
        "angle instead of jumping with the sign.",
    )
    columns = ["parameter", "all pads", "thesis form (sign, ordinary least squares)"]
    rows = []
    for name, title, factor, unit in _TORQUE:
        if name == "inertia_kg_m2":
            factor, unit = 1e4, "10⁻⁴ kg m²"
        row = [f"{title} / {unit}"]
        for fit in (result.torque, result.thesis_torque, *(ours for _, ours, _ in result.gears)):
            row.append(_value(fit.values()[name], fit.sigmas()[name], factor))
        rows.append(row)
    rows.append(
        ["unexplained current / A"]
        + [f"{fit.rms_A:.3f}" for fit in (result.torque, result.thesis_torque, *(ours for _, ours, _ in result.gears))]
    )
    columns += [name.rsplit("/", 1)[-1].split(".log")[0] for name, _, _ in result.gears]
    section.table(columns, rows, "Gears: each state of wear identified from its own training log.")
    pads = result.pads[len(result.pads) // 2]
    log = pads.logs[-1]
    rows_of, residual = result.torque.residuals[str(log.path)]
    rows_thesis, residual_thesis = result.thesis_torque.residuals[str(log.path)]
    time = log.time_s
    section.figure(
        time_figure(
            [
                Panel(
                    "Motor current",
                    "A",
                    [
                        Trace("measured", time, log.samples["current_q"], REFERENCE),
                        Trace("explained", time[rows_of], log.samples["current_q"][rows_of] - residual, MODEL),
                    ],
                ),
                Panel(
                    "Residual",
                    "A",
                    [
                        Trace("thesis form", time[rows_thesis], residual_thesis, THESIS),
                        Trace("ours", time[rows_of], residual, MODEL),
                    ],
                    200,
                ),
            ]
        ),
        f"Random angle, pads {pads.thickness_mm:g} mm.",
    )


def _fusion(page: Page, result: Identification) -> None:
    section = page.section(
        "Noise levels and fusion",
        "Noise levels come from residuals of data that did not fit the models; they contain the reference instrument's own "
        "noise, because the stated sigma is compared with that instrument. Innovation ratio: mean squared normalised "
        "innovation, one where the levels fit.",
    )
    noise = result.noise
    section.table(
        ["noise level", "value"],
        [
            ["stiffness path, floor / N", f"{noise.stiffness_N:.1f}"],
            ["stiffness path, relative / %", f"{100 * noise.stiffness_relative:.2f}"],
            ["stiffness path, correlation / ms", f"{1e3 * noise.stiffness_correlation_s:.0f}"],
            ["current / A", f"{noise.current_A:.3f}"],
            ["current, correlation / ms", f"{1e3 * noise.current_correlation_s:.1f}"],
            ["motor speed / rad/s", f"{noise.speed_rad_per_s:.3f}"],
            ["friction while it turns over / %", f"{100 * noise.presliding:.0f}"],
            ["torque path, relative / %", f"{100 * noise.torque_relative:.2f}"],
            ["clearance / rad", _value(result.contact.clearance_rad, result.contact.clearance_sigma_rad)],
        ],
    )
    rows = []
    for judged in result.judged:
        for form, figures in (("thesis", judged.thesis), ("ours", judged.ours)):
            inside = f"{100 * figures.inside_two_sigma:.1f}"
            state = "" if form != "ours" else PASS if 0.9 <= figures.inside_two_sigma <= 0.99 else FAIL
            rows.append(
                [
                    judged.name if form != "ours" else "",
                    form,
                    *(f"{figures.rmse[p]:.0f}" for p in ("stiffness", "torque", "maximum_likelihood", "fused")),
                    f"{figures.bias['fused']:+.0f}",
                    Cell(inside, state),
                    f"{figures.innovation_ratio:.2f}",
                ]
            )
    section.table(
        ["judged on", "form", "stiffness / N", "torque / N", "max. likelihood / N", "Kalman / N", "Kalman bias / N",
         "inside 2 σ / %", "innovation ratio"],
        rows,
        "RMSE over every sample.",
    )  # fmt: skip
    for judged in result.judged:
        if judged.kind in ("predicted", "integrated"):
            section.heading(judged.name)
            section.figure(_force_figure(judged))


_DEPTHS = ("2 mm", "4 mm", "6 mm", "8 mm")


def _thermal(page: Page, result: Identification) -> None:
    section = page.section("Pads and disc: heat")
    if result.thermal is None:
        section.text(
            "No log heats the pads: conductivity, specific heat and disc are the datasheet's nominal values, and the force "
            "does not follow temperature. Needed: braking with thermocouples in the pads."
        )
        return
    found = result.thermal
    section.text(
        "Backing plate, pad, disc, pad, backing plate as one implicit chain (thesis 7.4 to 8.2). Known torque uses the rig's "
        "brake torque sensor; without it the heat comes from the estimated force and the friction map, as in a car."
    )
    rows = []
    for key, value in _thermal_values(found):
        rows.append([key, _value(value, found.sigmas.get(f"thermal.{key}"))])
    section.table(["parameter", "value"], rows)
    section.items(list(found.notes))
    for name, data in found.plots.items():
        if "measured" in data and "known" in data:
            _temperatures(section, name, data)
    _cooling(section, found.plots.get("disc_cooling"))
    _friction(section, found.plots.get("friction"))
    _softening(section, found.plots.get("softening"), found.plots.get("window"))
    section.table(["figure on logs that fitted nothing", "value"], [[k, f"{v:.3g}"] for k, v in found.figures.items()])
    section.table(["residual of what was fitted", "value"], [[k, f"{v:.3g}"] for k, v in found.residuals.items()])


def _thermal_values(found):
    thermal = found.thermal
    for part in ("pad", "disc", "softening"):
        struct = getattr(thermal, part)
        for name in struct.__struct_fields__:
            yield f"{part}.{name}", getattr(struct, name)
    yield "sigma_K", thermal.sigma_K


def _temperatures(section, name, data) -> None:
    time = data["time_s"]
    panels = []
    colours = shades(4)[::-1]
    for side, offset in (("Inner pad", 0), ("Outer pad", 4)):
        traces = [Trace("measured", time, row, Style("#b3bcc7", 2.2)) for row in data["measured"][offset : offset + 4]]
        for index, depth in enumerate(_DEPTHS):
            if offset + index < len(data["known"]):
                traces.append(Trace(depth, time, data["known"][offset + index], Style(colours[index], 1.2)))
        panels.append(Panel(f"{side}, torque known", "°C", traces, 230))
    if len(data["measured"]) > 8:
        panels.append(
            Panel(
                "Disc",
                "°C",
                [
                    Trace("measured", time, data["measured"][8], Style("#b3bcc7", 2.2)),
                    Trace("model", time, data["known"][8], MODEL),
                ],
                180,
            )
        )
    errors = []
    if "thesis" in data:
        errors.append(Trace("thesis form", time, _rms(data["thesis"] - data["measured"][:8]), THESIS))
    errors.append(Trace("no torque sensor", time, _rms(data["unknown"][:8] - data["measured"][:8]), PALE))
    errors.append(Trace("torque known", time, _rms(data["known"][:8] - data["measured"][:8]), MODEL))
    panels.append(Panel("Error, RMS over the eight thermocouples", "K", errors, 180))
    section.heading(f"Temperatures: {name}")
    section.figure(time_figure(panels))


def _rms(errors: np.ndarray) -> np.ndarray:
    return np.sqrt(np.mean(errors**2, axis=0))


def _cooling(section, data) -> None:
    if data is None:
        return
    order = np.argsort(data["speed_rad_per_s"])
    speed = data["speed_rad_per_s"][order]
    section.heading("Disc cooling")
    section.figure(
        xy_figure(
            [
                Panel(
                    "Cooling rate b_d (thesis 8.2)",
                    "1/s",
                    [
                        Trace(
                            "each log",
                            speed,
                            data["rate_per_s"][order],
                            _POINTS,
                            data["rate_sigma_per_s"][order],
                        ),
                        Trace("line", speed, data["line_per_s"][order], MODEL),
                    ],
                    240,
                ),
                Panel("Biot number (lumped below 0.1)", "1", [Trace("Biot number", speed, data["biot"][order], MARKS)], 150),
            ],
            "disc speed / rad/s",
        )
    )


def _friction(section, data) -> None:
    if data is None:
        return
    section.heading("Friction of pad on disc, for service without a brake torque sensor")
    thin = slice(None, None, max(len(data["measured"]) // 1500, 1))
    measured, model = data["measured"][thin], data["model"][thin]
    dots = Style("rgba(11,92,173,0.35)", mode="markers", size=3.5)
    section.figure(
        xy_figure(
            [
                Panel(
                    "Friction coefficient",
                    "1",
                    [
                        Trace("measured", data["temperature_C"][thin], measured, _CLOUD),
                        Trace("map", data["temperature_C"][thin], model, dots),
                    ],
                    260,
                ),
                Panel("Residual", "1", [Trace("map", data["temperature_C"][thin], model - measured, dots)], 160),
            ],
            "surface temperature / °C",
        ),
        "Over clamp force, disc speed and surface temperature; drawn over the last.",
    )


def _softening(section, data, window) -> None:
    if data is None:
        return
    section.heading("Stiffness over temperature and its history")
    hours = data["time_s"] / 3600.0
    section.figure(
        xy_figure(
            [
                Panel(
                    "Stiffness over that of the cold pads",
                    "1",
                    [
                        Trace("each burst", hours, data["factor"], _POINTS, data["factor_sigma"]),
                        Trace("moving window (thesis)", hours, data["window"], THESIS),
                        Trace("first-order history", hours, data["exponential"], MODEL),
                    ],
                    280,
                ),
                Panel(
                    "Residual",
                    "%",
                    [
                        Trace("moving window (thesis)", hours, 100.0 * (data["window"] - data["factor"]), THESIS),
                        Trace("first-order history", hours, 100.0 * (data["exponential"] - data["factor"]), MODEL),
                    ],
                    170,
                ),
            ],
            "time / h",
        ),
        "Thesis 8.4 has a moving window of the mean temperature; a first-order lag forgets without an edge.",
    )
    if window is not None:
        section.figure(
            xy_figure(
                [
                    Panel(
                        "Search for the window's width",
                        "residual",
                        [Trace("window", window["width_s"], window["residual"], THESIS)],
                        200,
                    )
                ],
                "width / s",
            )
        )


def _logs(page: Page, result: Identification) -> None:
    section = page.section("Logs and provenance")
    if result.campaign.faults:
        section.heading("Left out")
        section.items(result.campaign.faults)
    if result.notes:
        section.heading("Notes")
        section.items(result.notes)
    provenance = result.calibration.provenance
    section.heading("Logs read")
    section.table(["log", "sha256"], [[source.log, source.sha256[:16] + "…"] for source in provenance.logs])
    section.text("Full hashes, figures and standard deviations stand in the calibration's provenance.")
