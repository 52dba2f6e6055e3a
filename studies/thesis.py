"""The thesis's models and ours, identified and judged on the same logs, and the figures that the thesis reports of its own
rig.

    python -m studies.thesis ../shared/rig/campaign.yaml

The thesis's forms: line of best fit through the loop of a slow clamp (2.1), one damping (3.8), friction by the sign of the
motion (2.4, 4.1), an explicit pad that holds its surface while braking (8.1), a moving window of the mean temperature (8.4),
a first-order frequency response (3.3.1). Targets are those that this project set itself for the simulated rig A: they say
nothing about another brake.
"""

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from msgspec.structs import replace
from scipy.optimize import least_squares, minimize_scalar

from emb_daemon.calibration.curves import curve_at
from emb_daemon.calibration.parameters import CLEARANCE, INERTIA, LOAD_FRICTION, OFFSET_FRICTION, TORQUE_CONSTANT, moved
from emb_daemon.calibration.types import Calibration, to_parameters
from emb_daemon.errors import InputError
from emb_daemon.estimator.records import DEPTHS_M
from emb_daemon.identify.campaign import Campaign, load_campaign
from emb_daemon.identify.campaign_file import Datasheet
from emb_daemon.identify.dynamics import EPISODE, RELAXATION, TERMS, Pads, clearance_guess, curve_keys, powers, simulate
from emb_daemon.identify.run import Identification, identify
from emb_daemon.identify.steps import noise
from emb_daemon.identify.steps.held_out import Errors, Fold
from emb_daemon.identify.steps.softening import cold_bursts
from emb_daemon.identify.steps.torque import KEYS, TorqueFit, TorqueStep, Unexplained
from emb_daemon.identify.validation import Validation, at_thickness, validate
from emb_daemon.offline import Log
from emb_daemon.offline.fit import jackknife
from emb_daemon.offline.recording import Recording, recording
from emb_daemon.offline.score import rmse
from emb_daemon.wire.contract import CYCLE_S
from studies.frequency import response
from studies.thesis_pad import thesis_profiles

#: Presliding angle that approximates the sign function, rad.
SIGN = 1e-6
#: Bound of the rise of conductivity of the thesis's pad, 1/K; without it the fit is unphysical.
_MOST_RISE = 2e-3
#: Relative amount by which a fusion may be worse than the better of its inputs.
_WORSE = 1.05
#: Share of errors inside two stated standard deviations.
_HONEST = (0.90, 0.99)


# -- forms of the stiffness and torque paths ------------------------------------------------------------------------------


@dataclass(frozen=True)
class Form:
    """One pad thickness: clearance (rad) and line of best fit of its slow log, damping (s) of its random log."""

    thickness_mm: float
    clearance: float
    coefficients: np.ndarray
    damping_s: float | None

    def values(self, calibration: Calibration) -> dict[str, float]:
        """The curve by the calibration's keys."""
        coefficients = self.coefficients.copy()
        # The estimator needs a force that rises from contact; a line of best fit may start flat.
        coefficients[0] = max(coefficients[0], 1e-3 * float(np.max(np.abs(coefficients))))
        return dict(zip(curve_keys(calibration, self.thickness_mm), coefficients, strict=True))


def _travel(log: Log) -> np.ndarray:
    return log.samples["angle"] - log.samples["angle"][0]


def best_fit_line(log: Log) -> tuple[float, np.ndarray, np.ndarray]:
    """Thesis 2.1: line of best fit through the loop of a slow clamp and release. Returns (clearance in rad, coefficients,
    residual in N at each sample with a reference)."""
    x, known = _travel(log), np.isfinite(log.force_N)
    force, guess = log.force_N[known], clearance_guess(log, x)
    span = float(x.max() - guess)
    scale = span ** np.arange(1, 4)

    def solve(clearance):
        columns = powers(x[known] - clearance) / scale
        coefficients = np.linalg.lstsq(columns, force, rcond=None)[0]
        return columns @ coefficients - force, coefficients

    clearances = guess - np.linspace(0.0, 0.15, 61) * span
    clearance = clearances[int(np.argmin([np.sum(solve(c)[0] ** 2) for c in clearances]))]
    residual, coefficients = solve(clearance)
    return float(clearance), coefficients / scale, residual


def regress_damping(log: Log, clearance: float, coefficients: np.ndarray) -> float:
    """Thesis 3-8 with the static curve known: F(i) = b1 [F_s(i) + b0 F(i-1)], b1 = 1 / (1 + b0), by least squares.

    Returns:
        Time constant b0 dt in s.
    """
    force = log.force_N
    static = powers(_travel(log) - clearance) @ coefficients
    rows = np.flatnonzero(np.isfinite(force[1:]) & np.isfinite(force[:-1])) + 1
    change, lag = force[rows] - force[rows - 1], static[rows] - force[rows]
    return float(change @ lag / (change @ change)) * float(np.median(log.samples["dt"][1:]))


def form_of(pads: Pads) -> Form:
    """The thesis's form of one pad thickness."""
    clearance, coefficients, _ = best_fit_line((*pads.slow, *pads.logs)[0])
    damping = regress_damping(pads.random[0], clearance, coefficients) if pads.random else None
    return Form(pads.thickness_mm, clearance, coefficients, damping)


def _regressors(log: Log) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(rows, regressors (n, 4), current): friction by the sign of every angle difference, which keeps it while the motor
    stands, and acceleration by the second difference."""
    angle, force, dt = log.samples["angle"], log.force_N, log.samples["dt"]
    rows = np.arange(2, len(angle))
    rows = rows[(np.abs(dt[rows] - CYCLE_S) < 1e-6) & (np.abs(dt[rows - 1] - CYCLE_S) < 1e-6)]
    rows = rows[np.isfinite(force[rows]) & np.isfinite(force[rows - 1]) & log.samples["has_current"][rows]]
    step = np.diff(angle, prepend=angle[0])
    moved = np.maximum.accumulate(np.where(step != 0.0, np.arange(len(angle)), 0))
    sign, rows = np.sign(step[moved]), rows[moved[rows] > 0]
    mean, sign = 0.5 * (force[rows] + force[rows - 1]), sign[rows]
    second = (angle[rows] - 2.0 * angle[rows - 1] + angle[rows - 2]) / CYCLE_S**2
    return rows, np.column_stack([mean, second, sign, sign * mean]), log.samples["current_q"][rows]


def unexplained(log: Log, found: TorqueFit, gear_gain: float) -> Unexplained:
    """Current that the thesis's form leaves unexplained on a log."""
    rows, columns, current = _regressors(log)
    coefficients = np.array([gear_gain, *(found.values[key] for key in (INERTIA, OFFSET_FRICTION, LOAD_FRICTION))])
    residual = current - columns @ coefficients / found.values[TORQUE_CONSTANT]
    return Unexplained(found, rows, residual, columns[:, 2], columns[:, 0])


def regress_torque(logs: list[Log], sheet: Datasheet) -> TorqueFit:
    """Ordinary least squares."""
    normals, scores, parts = [], [], [(log, *_regressors(log)) for log in logs]
    solution = np.linalg.lstsq(np.concatenate([p[2] for p in parts]), np.concatenate([p[3] for p in parts]), rcond=None)[0]
    residuals = {}
    for log, rows, columns, current in parts:
        residual = current - columns @ solution
        residuals[str(log.path)] = (rows, residual)
        for start in range(0, len(rows), EPISODE):
            piece = slice(start, start + EPISODE)
            normals.append(columns[piece].T @ columns[piece])
            scores.append(columns[piece].T @ residual[piece])
    constant = sheet.actuator.gear_gain_m_per_rad / solution[0]
    change = np.zeros((5, 4))
    change[:4] = np.diag([-constant / solution[0], constant, constant, constant])
    change[1:4, 0] = -solution[1:] * constant / solution[0]
    covariance = change @ jackknife(np.array(normals), np.array(scores)) @ change.T
    return TorqueFit(dict(zip(KEYS, [constant, *(solution[1:] * constant), SIGN], strict=True)), covariance, residuals)


class Thesis:
    """The thesis's forms of all models of an identification."""

    def __init__(self, result: Identification):
        self.result = result
        self.sheet = result.campaign.datasheet
        #: Ours without the effects that the thesis does not know.
        self.plain = replace(result.calibration, effects={})
        self.forms = [form_of(pads) for pads in result.stiffness.pads]
        self.damping_s = self._damping([])
        self.torque = regress_torque([log for pads in result.stiffness.pads for log in pads.logs], self.sheet)
        self.folds = [self._fold(fold) for fold in result.folds]
        gears = [
            (entry.training, regress_torque([log], self.sheet))
            for entry in result.campaign.file.gear_wear
            if (log := result.campaign.load(entry.training, "gear_wear", "training")) is not None
        ]
        self.torque_step = TorqueStep(values=self.torque.physical(), fit=self.torque, logs=result.torque.logs, gears=gears)

    def _damping(self, without: list[float]) -> float:
        known = [form.damping_s for form in self.forms if form.damping_s and form.thickness_mm not in without]
        return float(np.mean(known)) if known else 0.0

    def form(self, thickness_mm: float) -> Form:
        return next(form for form in self.forms if form.thickness_mm == thickness_mm)

    def _fold(self, fold: Fold) -> Fold:
        form, damping = self.form(fold.pads.thickness_mm), self._damping([fold.pads.thickness_mm])
        others = [p for p in self.result.stiffness.pads if p is not fold.pads]
        found = regress_torque([log for pads in others for log in pads.logs], self.sheet)
        stiffness = form.values(self.plain) | {RELAXATION: damping}
        errors: list[Errors] = []
        for log in fold.held_out:
            known = np.isfinite(log.force_N)
            force = simulate(log, moved(self.plain, stiffness), form.thickness_mm, form.clearance)
            errors.append(((force - log.force_N)[known], log.force_N[known]))
        here = {"pad_thickness_mm": form.thickness_mm, CLEARANCE: max(form.clearance, 0.0)}
        return Fold(
            values=stiffness | here | found.physical(),
            pads=fold.pads,
            held_out=fold.held_out,
            torque=found,
            errors=errors,
            unexplained=[unexplained(log, found, self.sheet.actuator.gear_gain_m_per_rad) for log in fold.held_out],
        )

    def _noise(self, folds: list[Fold], thickness_mm: float):
        interpolation = self.result.thickness.interpolation_error(thickness_mm)
        return noise.identify(self.result.campaign, self.result.stiffness, self.torque_step, folds, interpolation)

    def calibration(self) -> Calibration:
        """The estimator with the thesis's models: no effects, friction by sign, curves through the loops."""
        values = self.torque_step.values | self._noise(self.folds, self.result.campaign.pad_thickness_mm).values
        for form in self.forms:
            values |= form.values(self.plain)
        clearance = max(float(np.mean([form.clearance for form in self.forms])), 0.0)
        return moved(self.plain, values | {RELAXATION: self.damping_s, CLEARANCE: clearance})

    def of_fold(self, fold: Fold) -> Calibration:
        """The thesis's forms of one thickness, identified without its random logs."""
        others = [other for other in self.folds if other is not fold] or [fold]
        return moved(self.plain, self._noise(others, self.result.campaign.pad_thickness_mm).values | fold.values)

    def validate(self) -> dict[str, Validation]:
        """Errors by name, on the same logs as ours."""
        whole, gears = self.calibration(), dict(self.torque_step.gears)
        ours = {one.name: one for one in self.result.validations}
        found = {}
        for fold in self.folds:
            for log in fold.held_out:
                name = f"random, {fold.pads.thickness_mm:g} mm"
                found[name] = validate(name, "random", log, self.of_fold(fold))
        worn = {Path(entry.judge or "").name: entry.training for entry in self.result.campaign.file.gear_wear}
        for name, one in ours.items():
            if name not in found:
                there = at_thickness(whole, self.result.thickness, one.calibration.pad_thickness_mm)
                if one.kind == "gear":
                    there = moved(there, gears[worn[one.log.path.name]].friction())
                found[name] = validate(name, one.kind, one.log, there)
        return found


# -- heat -----------------------------------------------------------------------------------------------------------------


def fit_pad(tune: Recording, parameters: np.ndarray, cooling_rate):
    """The thesis's pad fitted on one log as the thesis did: conductivity, its rise and a heat share per pad.

    Args:
        parameters: THERMAL, shape (1,), as identified.
        cooling_rate: of the disc in 1/s, of its speed in rad/s.

    Returns:
        From a recording to temperatures at the thermocouples, shape (8, n).
    """
    p = parameters.copy()
    area, thickness = float(p["area"][0]), float(p["thickness"][0])

    def run(r: Recording, shares) -> np.ndarray:
        rows = []
        for plate, share in zip((r.inner, r.outer), shares, strict=True):
            rate = cooling_rate(r.speed)
            profiles = thesis_profiles(p, plate, r.ambient, share * r.power / area, r.touching, rate, r.step_s)
            at = np.linspace(0.0, thickness, profiles.shape[1])
            for depth in DEPTHS_M:
                inside = np.array([np.interp(depth, at, profile) for profile in profiles])
                rows.append(inside if depth <= thickness + 1e-9 else np.full(len(inside), np.nan))
        return np.array(rows)

    every = max(round(2.0 / tune.step_s), 1)

    def residual(x):
        p["conductivity"], p["conductivity_rise"] = x[0], x[1]
        error = (run(tune, x[2:]) - tune.measured[:8])[:, ::every]
        return error[np.isfinite(error)]

    start = np.array([float(p["conductivity"][0]), 0.25 * _MOST_RISE, *p["heat_share"][0]])
    bounds = ([0.2 * start[0], 0.0, 1e-3, 1e-3], [5.0 * start[0], _MOST_RISE, 0.5, 0.5])
    x = least_squares(residual, np.clip(start, *bounds), bounds=bounds, x_scale=[1.0, 1e-3, 0.05, 0.05], max_nfev=40).x
    p["conductivity"], p["conductivity_rise"] = x[0], x[1]
    return lambda r: run(r, x[2:])


def moving_window(rise: np.ndarray, step_s: float, width_s: float) -> np.ndarray:
    """Thesis zeta: integral of ``rise`` over the last ``width_s``, K s."""
    total = np.concatenate([[0.0], np.cumsum(rise) * step_s])
    row = np.arange(1, len(rise) + 1)
    return total[row] - total[np.maximum(row - max(round(width_s / step_s), 1), 0)]


def softening_rmse_N(log: Log, heat: Recording, calibration: Calibration) -> float:
    """RMSE over bursts that were not fitted, of a static line with the moving window; arguments as in `fit_softening`."""
    bursts = cold_bursts(log, heat, calibration)
    force = [bursts.force_N(index) for index in range(len(bursts.rows))]
    x = [log.samples["angle"][rows] - bursts.contact for rows in bursts.rows]
    known = [np.isfinite(f) for f in force]
    line = np.linalg.lstsq(powers(x[0][known[0]]), force[0][known[0]], rcond=None)[0]
    static = [powers(travel) @ line for travel in x]
    factor = np.array([s[k] @ f[k] / (s[k] @ s[k]) for s, f, k in zip(static, force, known, strict=True)])
    own, others = np.arange(0, len(factor), 2), range(1, len(factor), 2)

    def solve(width):
        window = moving_window(bursts.grid_rise_K, heat.step_s, width)
        columns = np.array([bursts.rise_K, np.interp(bursts.time_s, bursts.grid_s, window)]).T
        terms = np.linalg.lstsq(columns[own], 1.0 - factor[own], rcond=None)[0]
        return rmse(columns[own] @ terms - 1.0 + factor[own]), 1.0 - terms[0] * bursts.grid_rise_K - terms[1] * window

    span = float(bursts.grid_s[-1])
    widths = np.geomspace(max(0.005 * span, 2.0 * heat.step_s), span, 60)
    best = int(np.argmin([solve(width)[0] for width in widths]))
    bounds = (widths[max(best - 1, 0)], widths[min(best + 1, len(widths) - 1)])
    modelled = solve(float(minimize_scalar(lambda w: solve(w)[0], bounds=bounds, method="bounded").x))[1]
    errors = [
        (static[i] * np.interp(log.time_s[bursts.rows[i]], bursts.grid_s, modelled) - force[i])[known[i]] for i in others
    ]
    return rmse(np.concatenate(errors))


# -- the table ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Line:
    """One line of the table: what the thesis reports of its own rig, its form here, ours, and what to reach on rig A."""

    judged_on: str
    unit: str
    reported: str
    thesis: list[float]
    ours: list[float]
    target: str = ""
    met: bool | None = None

    def cells(self) -> tuple[str, ...]:
        verdict = {True: "met", False: "MISSED", None: ""}[self.met]
        return (self.judged_on, self.unit, self.reported, _span(self.thesis), _span(self.ours), self.target, verdict)


def _span(values: list[float]) -> str:
    def short(value):
        return f"{value:.3f}" if abs(value) < 1.0 else f"{value:.2f}" if abs(value) < 100.0 else f"{value:.0f}"

    known = [value for value in values if np.isfinite(value)]
    ends = (short(min(known)), short(max(known))) if known else ("–",)
    return ends[0] if len(set(ends)) == 1 else " – ".join(ends)


def force_lines(ours: list[Validation], thesis: dict[str, Validation]) -> list[Line]:
    """Forces, kN RMSE over every sample of logs that were not fitted."""
    lines = []

    def add(name, kinds, path, reported, target=None, fusion=False):
        group = [one for one in ours if one.kind in kinds]
        if not group:
            return
        values = [1e-3 * one.rmse_N(path) for one in group]
        targets = [f"≤ {target:g}"] if target else []
        met = max(values) <= target if target else None
        if fusion:
            better = all(one.rmse_N(path) <= _WORSE * min(one.rmse_N("stiffness"), one.rmse_N("torque")) for one in group)
            targets.append(f"≤ {_WORSE} × better input")
            met = better and met is not False
        his = [1e-3 * thesis[one.name].rmse_N(path) for one in group]
        lines.append(Line(name, "kN", reported, his, values, ", ".join(targets), met))

    add("dynamic stiffness, random angle", ("random",), "stiffness", "0.29", 0.12)
    add("torque balance, same", ("random",), "torque", "0.61", 0.55)
    add("maximum likelihood, same", ("random",), "maximum_likelihood", "0.32", 0.12, True)
    add("Kalman filter, same", ("random",), "fused", "0.29", 0.12, True)
    add("dynamic stiffness, curve predicted from other thicknesses", ("predicted", "gear"), "stiffness", "–")
    add("Kalman filter, same", ("predicted", "gear"), "fused", "–", None, True)
    add("integrated, dynamic stiffness", ("integrated",), "stiffness", "1.09")
    add("integrated, maximum likelihood", ("integrated",), "maximum_likelihood", "0.56")
    add("integrated, Kalman filter", ("integrated",), "fused", "0.50", 0.25, True)
    counted = [one for one in ours if one.kind != "frequency"]
    if counted:
        shares = [one.figures["inside_two_sigma"] for one in counted]
        met = all(_HONEST[0] <= share <= _HONEST[1] for share in shares)
        his = [thesis[one.name].figures["inside_two_sigma"] for one in counted]
        lines.append(Line("share of errors inside two sigma", "", "–", his, shares, "0.9 to 0.99", met))
    return lines


def thermal_lines(result: Identification) -> list[Line]:
    """Temperatures on the validation log, and force through the cooling of the pads."""
    step, campaign, lines = result.thermal, result.campaign, []
    name = "validate: pads, torque known, K"
    if step.law and "tune" in step.fitted and name in step.figures:
        validate = recording(campaign.load(campaign.file.thermal.validate, "thermal.validate", "thermocouples"))
        pad = fit_pad(step.fitted["tune"], np.atleast_1d(to_parameters(result.calibration)["thermal"]), step.law)
        his = rmse(pad(validate) - validate.measured[:8])
        known, car = step.figures[name], step.figures["validate: pads, no torque, estimated force, K"]
        lines.append(Line("pad temperatures, validate, brake torque known", "K", "3.7", [his], [known], "≤ 2", known <= 2.0))
        lines.append(Line("the same without brake torque (as in a car)", "K", "–", [], [car], "≤ 6", car <= 6.0))
    if step.softening:
        log = campaign.load(campaign.file.thermal.pad_cooling, "thermal.pad_cooling", "bursts")
        his = softening_rmse_N(log, step.fitted["pad_cooling"], result.calibration)
        ours = step.softening.ours_N
        name = "curves through the cooling of the pads (bursts that fitted nothing)"
        lines.append(Line(name, "kN", "1", [1e-3 * his], [1e-3 * ours], "≤ 0.3", ours <= 300.0))
    return lines


def frequency_lines(result: Identification) -> list[str]:
    """First-order frequency response, and the identified dynamics on logs that were not fitted."""
    campaign, fit, trials = result.campaign, result.stiffness.fit, []
    clearance = result.calibration.contact.clearance_rad
    for entry in campaign.file.frequency_response:
        log = campaign.load(entry.log, "frequency_response", "a sinusoid in contact")
        try:
            coefficients = curve_at(fit.calibration.stiffness.curves, campaign.thickness(entry))[:TERMS]
        except InputError:
            continue
        if log is not None:
            static = powers(_travel(log) - clearance) @ coefficients
            model = simulate(log, fit.calibration, campaign.thickness(entry), clearance, fit.delay_s)
            trials.append((log, entry.frequency_Hz, static, model))
    found, faults = response(trials) if trials else (None, [])
    if found is None:
        return faults
    rows = [
        f"frequency response, first order: K = {found.gain:.4f} ± {found.gain_sigma:.4f}, "
        f"τ = {1e3 * found.time_constant_s:.2f} ± {1e3 * found.time_constant_sigma_s:.2f} ms"
    ]
    for f, measured, fitted, model in zip(found.frequency_Hz, found.measured, found.fitted, found.model, strict=True):
        errors = (100.0 * (abs(value) / abs(measured) - 1.0) for value in (fitted, model))
        text = "{:>6.2f} Hz  |G| {:.4f}  first order {:+.2f} %  identified dynamics {:+.2f} %"
        rows.append(text.format(f, abs(measured), *errors))
    return [*faults, *rows]


def compare(campaign: Campaign) -> tuple[list[Line], list[str]]:
    """(table, frequency response in lines)."""
    result = identify(campaign)
    thesis = Thesis(result).validate()
    return [*force_lines(result.validations, thesis), *thermal_lines(result)], frequency_lines(result)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m studies.thesis", description=__doc__.splitlines()[0])
    parser.add_argument("campaign", type=Path)
    lines, responses = compare(load_campaign(parser.parse_args().campaign))
    rows = [("simulated rig, RMSE on logs that fitted nothing", "", "thesis reports", "thesis form", "ours", "to reach", "")]
    rows += [line.cells() for line in lines]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        print("  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip())
    print("\n".join(responses))


if __name__ == "__main__":
    main()
