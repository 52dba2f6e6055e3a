"""All steps of an identification, in order: logs in, calibration and evidence out."""

import datetime
import os
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import msgspec
import numpy as np

from emb_daemon import __version__
from emb_daemon.calibration.types import (
    Calibration,
    Contact,
    Curve,
    Disc,
    Friction,
    FrictionTable,
    Motor,
    Noise,
    Pad,
    Provenance,
    Softening,
    Source,
    Stiffness,
    Thermal,
    curve_at,
    to_parameters,
)
from emb_daemon.errors import InputError
from emb_daemon.identify import thermal as heat
from emb_daemon.identify.campaign import Campaign
from emb_daemon.identify.frequency import Response, response
from emb_daemon.identify.judge import Figures, judge
from emb_daemon.identify.noise import noise_levels, speed_noise
from emb_daemon.identify.stiffness import (
    OPTIONAL,
    TERMS,
    CurveFit,
    Dynamics,
    DynamicsFit,
    Pads,
    fit_dynamics,
    is_slow,
    regress_damping,
    regress_free,
    simulate,
    thesis_curve,
    with_dynamics,
)
from emb_daemon.identify.torque import SIGN, TorqueFit, fit_torque
from emb_daemon.offline import Log
from emb_daemon.wire.contract import CYCLE_S

#: Held-out error may be this much above the best of all combinations before an effect that lowers it is taken in.
_WORTH = 1.02
#: Standard deviations by which an effect's amplitude must stand clear of zero.
_CLEAR = 3.0
#: Reversals per second of motion that tell a slow clamp from random motion.
_SLOW, _RANDOM = (0.0, 1.0), (1.0, 100.0)
_NEED_CURVE = "slow clamp and release from the released position to a tenth of the rated force or more"
_NEED_RANDOM = "random motor angle from the released position to a tenth of the rated force or more"
_NEED_SINE = "motor angle a sinusoid in contact, at full frame rate"
_NEED_TRAINING = "clamp and release with the reference force, at full frame rate"


@dataclass(frozen=True)
class Candidate:
    """One combination of effects in the choice of structure."""

    effects: tuple[str, ...]
    fit: DynamicsFit = field(repr=False)
    held_out_rms: float
    clear: bool


@dataclass(frozen=True)
class ThesisForm:
    """The thesis's models of one pad thickness: curve through the loop, one damping, friction by sign.

    Attributes:
        contact: clearance from the slow log's first angle to contact, rad.
        free: (coefficients, time constant in s, free-run rms in N) of form 3-5, fitted on the random log itself.
        damping: (time constant in s, sigma) of form 3-8 on this thickness's random log.
        output_error_s: time constant by output error on the same.
    """

    thickness_mm: float
    clearance: float
    coefficients: np.ndarray
    curve_rms: float
    curve_residual: np.ndarray = field(repr=False)
    free: tuple[np.ndarray, float, float] | None
    damping: tuple[float, float] | None
    output_error_s: float | None


@dataclass(frozen=True)
class Judged:
    """One log that fitted nothing."""

    name: str
    kind: str
    log: Log = field(repr=False)
    thesis: Figures | None
    ours: Figures
    note: str = ""


@dataclass
class Identification:
    """Everything that the report tells; steps that found no logs are None or empty."""

    campaign: Campaign
    pads: list[Pads] = field(default_factory=list)
    candidates: list[Candidate] = field(default_factory=list)
    chosen: tuple[str, ...] = ()
    fit: DynamicsFit | None = None
    separate: list[DynamicsFit] = field(default_factory=list)
    thesis: list[ThesisForm] = field(default_factory=list)
    thesis_damping_s: float = 0.0
    laws: dict[str, np.ndarray] = field(default_factory=dict)
    interpolation_relative: float = 0.0
    torque: TorqueFit | None = None
    thesis_torque: TorqueFit | None = None
    #: Training log, our fit, the thesis's.
    gears: list[tuple[str, TorqueFit, TorqueFit]] = field(default_factory=list)
    response: Response | None = None
    noise: Noise | None = None
    contact: Contact | None = None
    thesis_noise: Noise | None = None
    thermal: heat.ThermalResult | None = None
    nominal_thermal: Thermal | None = None
    judged: list[Judged] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    calibration: Calibration | None = None
    seconds: float = 0.0


Progress = Callable[[float, str], None]


def _quiet(share: float, text: str) -> None:
    pass


def identify(campaign: Campaign, progress: Progress = _quiet) -> Identification:
    """Run every step that the campaign has logs for.

    Args:
        progress: called with the share done, 0 to 1, and what comes next.

    Raises:
        InputError: no log from which a characteristic curve or the torque path could be identified.
    """
    begin = time.monotonic()
    result = Identification(campaign)
    progress(0.0, "reading logs")
    result.pads = _pads(campaign)
    if not result.pads:
        raise InputError(
            "\n".join([*campaign.faults, f"{campaign.path}: curves, random: no usable log; needed: {_NEED_CURVE}"])
        )
    _check_thickness(result)
    progress(0.02, "structure of the dynamics")
    _choose_structure(result)
    progress(0.1, "torque path")
    _torque(result)
    result.contact = _contact(result)
    progress(0.15, "thesis forms")
    _thesis_forms(result)
    progress(0.2, "each thickness from the others")
    folds = _folds(result)
    progress(0.35, "noise levels, frequency response, gears")
    _gears(result)
    _noise(result, folds)
    _frequency(result)
    _heat(result, lambda share, text: progress(0.4 + 0.5 * share, text))
    progress(0.9, "judging")
    result.calibration = _calibration(result)
    _judge(result, folds)
    result.calibration = msgspec.structs.replace(result.calibration, provenance=_provenance(result))
    result.seconds = time.monotonic() - begin
    progress(1.0, "done")
    return result


def _pads(campaign: Campaign) -> list[Pads]:
    logs: dict[float, list[Log]] = {}
    for entries, part, need, reversals in (
        (campaign.file.curves, "curves", _NEED_CURVE, _SLOW),
        (campaign.file.random, "random", _NEED_RANDOM, _RANDOM),
    ):
        for entry in entries:
            log = campaign.load_motion(entry.log, part, need, reversals=reversals)
            if log is not None:
                logs.setdefault(campaign.thickness(entry), []).append(log)
    return [Pads(thickness, tuple(logs[thickness])) for thickness in sorted(logs)]


def _check_thickness(result: Identification) -> None:
    """A calibration for pads too far from every measured thickness could not be loaded."""
    campaign = result.campaign
    table = tuple(Curve(pad_thickness_mm=pads.thickness_mm, coefficients=(1.0,)) for pads in result.pads)
    try:
        curve_at(table, campaign.file.pad_thickness_mm)
    except InputError as error:
        raise InputError(
            "\n".join([*campaign.faults, f"{campaign.path}: {error}; needed: curves of pads nearer to that thickness"])
        ) from None
    if not any(_random_logs(pads) for pads in result.pads):
        campaign.fault(
            f"random: no usable log, so that relaxation rests on slow clamps, which hardly show it; needed: {_NEED_RANDOM}"
        )


def _slow_logs(pads: Pads) -> list[Log]:
    return [log for log in pads.logs if is_slow(log)]


def _random_logs(pads: Pads) -> list[Log]:
    return [log for log in pads.logs if not is_slow(log)]


def _choose_structure(result: Identification) -> None:
    """Effects in all combinations: one alone can gain nothing that pays with the other beside it."""
    for effects in ((), OPTIONAL[:1], OPTIONAL[1:], OPTIONAL):
        fit = fit_dynamics(result.pads, effects, fraction=0.5)
        errors = []
        for pads, curve in zip(result.pads, fit.curves, strict=True):
            for log, clearance in zip(pads.logs, curve.clearances_rad, strict=True):
                if not is_slow(log):
                    error = _simulated(log, fit.dynamics.values, curve.coefficients, clearance) - log.force_N
                    errors.append(error[len(error) // 2 :])
        # Without random logs nothing is held out, and the fit's own rms has to do.
        rms = float(np.sqrt(np.nanmean(np.concatenate(errors) ** 2))) if errors else fit.rms
        shares = [f"{effect}.share" for effect in effects]
        clear = all(fit.dynamics.values[s] > _CLEAR * fit.dynamics.sigmas[s] for s in shares)
        result.candidates.append(Candidate(effects, fit, rms, clear))
    usable = [candidate for candidate in result.candidates if candidate.clear]
    best = min(candidate.held_out_rms for candidate in usable)
    chosen = min(
        (candidate for candidate in usable if candidate.held_out_rms <= _WORTH * best),
        key=lambda candidate: (len(candidate.effects), candidate.held_out_rms),
    )
    result.chosen = chosen.effects
    result.fit = fit_dynamics(result.pads, chosen.effects, start=chosen.fit.dynamics.values, curves=chosen.fit.curves)
    for pads, curve in zip(result.pads, result.fit.curves, strict=True):
        if _random_logs(pads):
            result.separate.append(fit_dynamics([pads], chosen.effects, start=result.fit.dynamics.values, curves=[curve]))


def _simulated(log: Log, values: dict[str, float], coefficients: np.ndarray, clearance: float) -> np.ndarray:
    parameters = with_dynamics(values)
    parameters["curve"][0, : len(coefficients)] = coefficients
    return simulate(log.samples, log.samples["angle"][0] + clearance, parameters)


def _in_service(values: dict[str, float]) -> dict[str, float]:
    """Dynamics as the daemon has them: the delay of the rig's reference is none of the brake's."""
    return {**values, "signal_delay.delay_s": 0.0}


def _geometry(campaign: Campaign) -> tuple[float, float]:
    """Gear gain in m/rad and the resolver's smallest step in rad."""
    sheet = campaign.datasheet
    return sheet.actuator.gear_gain_m_per_rad, 2.0 * np.pi / sheet.resolver.counts_per_revolution


def _torque(result: Identification) -> None:
    logs = [log for pads in result.pads for log in pads.logs if log.samples["has_current"].any()]
    if not logs:
        raise InputError(f"{result.campaign.path}: curves, random: no log holds motor current; needed: EMB_*_Current frames")
    gear_gain, count = _geometry(result.campaign)
    result.torque = fit_torque(logs, gear_gain, count)
    result.thesis_torque = fit_torque(logs, gear_gain, count, sign_model=True)


def _thesis_forms(result: Identification) -> None:
    for pads in result.pads:
        slow = _slow_logs(pads)
        log = slow[0] if slow else pads.logs[0]
        contact, coefficients, residual = thesis_curve(log)
        clearance = contact - float(log.samples["angle"][0])
        free = damping = output_error = None
        random = _random_logs(pads)
        if random:
            judged = random[0]
            at = float(judged.samples["angle"][0]) + clearance
            own, time_constant, _ = regress_free(judged, at)
            error = _simulated(judged, {"relaxation_time_s": time_constant}, own, clearance) - judged.force_N
            free = (own, time_constant, float(np.sqrt(np.nanmean(error**2))))
            damping = regress_damping(judged, at, coefficients)
            output_error = _output_error(judged, coefficients, clearance, damping[0])
        result.thesis.append(
            ThesisForm(
                pads.thickness_mm,
                clearance,
                coefficients,
                float(np.sqrt(np.mean(residual**2))),
                residual,
                free,
                damping,
                output_error,
            )
        )
    dampings = [form.damping[0] for form in result.thesis if form.damping]
    result.thesis_damping_s = float(np.mean(dampings)) if dampings else 0.0
    if not dampings:
        result.notes.append("No random log: the thesis's damping could not be identified and stays zero in its column.")


def _output_error(log: Log, coefficients: np.ndarray, clearance: float, guess: float) -> float:
    from scipy.optimize import minimize_scalar

    def cost(logarithm):
        values = {"relaxation_time_s": float(np.exp(logarithm))}
        return float(np.nanmean((_simulated(log, values, coefficients, clearance) - log.force_N) ** 2))

    center = np.log(max(guess, 1e-3))
    bounds = (center - 1.5, center + 1.5)
    return float(np.exp(minimize_scalar(cost, bounds=bounds, method="bounded", options={"xatol": 1e-3}).x))


@dataclass(frozen=True)
class Fold:
    """What is known of one thickness without its random logs: dynamics and torque path of the other thicknesses, curve and
    contact of its own slow log."""

    pads: Pads
    values: dict[str, float]
    curve: CurveFit
    clearance: float
    torque: TorqueFit
    thesis_torque: TorqueFit
    judged: tuple[Log, ...]
    #: Error of the stiffness path and reference force on each judged log.
    errors: list[tuple[np.ndarray, np.ndarray]] = field(repr=False)
    thesis_errors: list[tuple[np.ndarray, np.ndarray]] = field(repr=False)
    thesis_damping_s: float = 0.0


def _folds(result: Identification) -> list[Fold]:
    gear_gain, count = _geometry(result.campaign)
    folds = []
    indices = [i for i, pads in enumerate(result.pads) if _slow_logs(pads) and _random_logs(pads)]
    if len(result.pads) < 2 or not indices:
        result.notes.append(
            "Fewer than two pad thicknesses with a slow and a random log: nothing could be held out by thickness, and noise "
            "levels come from the second halves of the random logs."
        )
        return []
    for index in indices:
        pads = result.pads[index]
        others = [other for i, other in enumerate(result.pads) if i != index]
        curves = [curve for i, curve in enumerate(result.fit.curves) if i != index]
        fit = fit_dynamics(others, result.chosen, start=result.fit.dynamics.values, curves=curves)
        slow = Pads(pads.thickness_mm, tuple(_slow_logs(pads)))
        own = fit_dynamics(
            [slow], result.chosen, start=fit.dynamics.values, curves=[result.fit.curves[index]], fixed=True
        ).curves[0]
        clearance = float(np.mean(own.clearances_rad))
        logs = [log for other in others for log in other.logs]
        judged = tuple(_random_logs(pads))
        form = result.thesis[index]
        damping = float(np.mean([f.damping[0] for i, f in enumerate(result.thesis) if i != index and f.damping] or [0.0]))
        errors, thesis_errors = [], []
        for log in judged:
            known = np.isfinite(log.force_N)
            force = _simulated(log, _in_service(fit.dynamics.values), own.coefficients, clearance)
            errors.append(((force - log.force_N)[known], log.force_N[known]))
            force = _simulated(log, {"relaxation_time_s": damping}, form.coefficients, form.clearance)
            thesis_errors.append(((force - log.force_N)[known], log.force_N[known]))
        folds.append(
            Fold(
                pads,
                fit.dynamics.values,
                own,
                clearance,
                fit_torque(logs, gear_gain, count),
                fit_torque(logs, gear_gain, count, sign_model=True),
                judged,
                errors,
                thesis_errors,
                damping,
            )
        )
    return folds


LAWS = {
    "1/a straight between neighbours (used)": None,
    "1/a straight through all": (1, lambda a: 1.0 / a, lambda y: 1.0 / y),
    "ln a quadratic through all": (2, np.log, np.exp),
    "a straight through all": (1, lambda a: a, lambda y: y),
}


def thickness_laws(curves: list[CurveFit]) -> dict[str, np.ndarray]:
    """Relative force error of each inner curve predicted from the others, weighted by force, by law.

    Shape (curves - 2,); empty with fewer than three curves."""
    found = {}
    for name, law in LAWS.items():
        errors = []
        for index in range(1, len(curves) - 1):
            others = [curve for i, curve in enumerate(curves) if i != index]
            target = curves[index]
            predicted = predict_curve(others, target.thickness_mm, law)
            x = np.linspace(0.05, 1.0, 50) * target.travel_rad
            truth = target.force(x)
            guess = sum(c * x ** (n + 1) for n, c in enumerate(predicted))
            errors.append(float(np.sqrt(np.sum((guess - truth) ** 2) / np.sum(truth**2))))
        found[name] = np.array(errors)
    return found


def predict_curve(curves: list[CurveFit], thickness_mm: float, law=None) -> np.ndarray:
    """Coefficients at a thickness from the curves of others, by one of `LAWS`; None is the calibration's own."""
    coefficients = np.array([curve.coefficients for curve in curves])
    if law is None or np.any(coefficients <= 0.0):
        table = tuple(curve.curve() for curve in curves)
        return curve_at(table, thickness_mm)[:TERMS]
    degree, forward, back = law
    thicknesses = np.array([curve.thickness_mm for curve in curves])
    degree = min(degree, len(curves) - 1)
    return np.array([back(np.polyval(np.polyfit(thicknesses, forward(a), degree), thickness_mm)) for a in coefficients.T])


def interpolation_error(curves: list[CurveFit], thickness_mm: float) -> float:
    """Relative force error that interpolation adds at a thickness.

    A straight line between neighbours errs by (t - a)(b - t) times half the curvature, which leaving out each inner thickness
    shows.
    """
    thicknesses = np.array([curve.thickness_mm for curve in curves])
    if len(curves) < 3 or np.any(np.abs(thicknesses - thickness_mm) < 1e-6):
        return 0.0
    left_out = thickness_laws(curves)[next(iter(LAWS))]
    spans = (thicknesses[1:-1] - thicknesses[:-2]) * (thicknesses[2:] - thicknesses[1:-1])
    curvature = float(np.sqrt(np.mean((left_out / spans) ** 2)))
    upper = int(np.clip(np.searchsorted(thicknesses, thickness_mm), 1, len(curves) - 1))
    return curvature * abs((thickness_mm - thicknesses[upper - 1]) * (thicknesses[upper] - thickness_mm))


def _noise(result: Identification, folds: list[Fold]) -> None:
    curves = result.fit.curves
    result.laws = thickness_laws(curves)
    result.interpolation_relative = interpolation_error(curves, result.campaign.file.pad_thickness_mm)
    result.noise = _noise_of(result, folds, result.interpolation_relative)
    result.thesis_noise = _noise_of(result, folds, result.interpolation_relative, thesis=True)


def _noise_of(result: Identification, folds: list[Fold], interpolation: float = 0.0, thesis: bool = False) -> Noise:
    actuator = result.campaign.datasheet.actuator
    logs = [log for pads in result.pads for log in pads.logs]
    speed = speed_noise(logs)
    if speed is None:
        speed = _geometry(result.campaign)[1] / CYCLE_S
        result.notes.append("The motor never stands for 0.2 s: speed noise is one resolver count per sample, not measured.")
    if folds:
        errors = [pair for fold in folds for pair in (fold.thesis_errors if thesis else fold.errors)]
        torque = [(log, fold.thesis_torque if thesis else fold.torque) for fold in folds for log in fold.judged]
    else:
        errors = _second_halves(result)
        torque = [(log, result.thesis_torque if thesis else result.torque) for log in logs]
    levels = noise_levels(errors, torque, actuator.gear_gain_m_per_rad, speed, interpolation)
    worn = np.array([(his if thesis else ours).load_friction for _, ours, his in result.gears])
    if len(worn) < 2:
        return levels
    # The daemon is not told how worn its gear is.
    wear = float(np.std(worn, ddof=1)) / actuator.gear_gain_m_per_rad
    return msgspec.structs.replace(levels, torque_relative=float(np.hypot(levels.torque_relative, wear)))


def _second_halves(result: Identification) -> list[tuple[np.ndarray, np.ndarray]]:
    candidate = next(c for c in result.candidates if c.effects == result.chosen)
    errors = []
    for pads, curve in zip(result.pads, candidate.fit.curves, strict=True):
        for log, clearance in zip(pads.logs, curve.clearances_rad, strict=True):
            rows = slice(len(log.samples) // 2 if not is_slow(log) else 0, None)
            force = _simulated(log, _in_service(candidate.fit.dynamics.values), curve.coefficients, clearance)
            known = np.isfinite(log.force_N[rows])
            errors.append(((force - log.force_N)[rows][known], log.force_N[rows][known]))
    return errors


def _frequency(result: Identification) -> None:
    campaign, trials = result.campaign, []
    values = result.fit.dynamics.values
    clearance = result.contact.clearance_rad
    for entry in campaign.file.frequency_response:
        bounds = (0.0, 4.0 * entry.frequency_Hz)
        log = campaign.load_motion(entry.log, "frequency_response", _NEED_SINE, reversals=bounds)
        if log is None:
            continue
        try:
            coefficients = predict_curve(result.fit.curves, campaign.thickness(entry))
        except InputError as error:
            campaign.fault(f"frequency_response: {log.path}: {error}; left out")
            continue
        x = log.samples["angle"] - log.samples["angle"][0] - clearance
        static = sum(c * np.maximum(x, 0.0) ** (n + 1) for n, c in enumerate(coefficients))
        trials.append((log, entry.frequency_Hz, static, _simulated(log, values, coefficients, clearance)))
    if campaign.file.frequency_response:
        result.response, faults = response(trials)
        for fault in faults:
            campaign.fault(fault)


def _gears(result: Identification) -> None:
    campaign = result.campaign
    for entry in campaign.file.gear_wear:
        log = campaign.load_motion(entry.training, "gear_wear", _NEED_TRAINING, reversals=(0.0, 100.0))
        if log is not None:
            gear_gain, count = _geometry(campaign)
            forms = (fit_torque([log], gear_gain, count), fit_torque([log], gear_gain, count, sign_model=True))
            result.gears.append((entry.training, *forms))


def _contact(result: Identification) -> Contact:
    """Clearance as the mean of all logs, with the standard deviation with which the next power-on will find it."""
    found = np.concatenate([curve.clearances_rad for curve in result.fit.curves])
    errors = np.concatenate([curve.clearance_sigmas_rad for curve in result.fit.curves])
    count = _geometry(result.campaign)[1]
    spread = float(np.std(found, ddof=1)) if len(found) > 1 else 0.0
    return Contact(
        clearance_rad=float(np.mean(found)),
        clearance_sigma_rad=float(np.sqrt(spread**2 + np.mean(errors**2) + count**2 / 12.0)),
        walk_rad_per_sqrt_s=_contact_walk(result),
    )


def _contact_walk(result: Identification) -> float:
    """Root of the contact angle's wandering per second, rad: between tens of seconds of the fitted logs.

    The scatter of each estimate is in it, so that it errs to the safe side.
    """
    squares, seconds = 0.0, 0.0
    step, rows = 1e-3, 2500
    for pads, curve in zip(result.pads, result.fit.curves, strict=True):
        for log, clearance in zip(pads.logs, curve.clearances_rad, strict=True):
            values = result.fit.dynamics.values
            at, moved = (_simulated(log, values, curve.coefficients, clearance + s) for s in (0.0, step))
            slope, error = (moved - at) / step, at - log.force_N
            shifts = []
            for start in range(0, len(error) - rows + 1, rows):
                part = slice(start, start + rows)
                weight = float(slope[part] @ slope[part])
                if weight > 0.0 and np.isfinite(error[part]).all():
                    shifts.append(-float(slope[part] @ error[part]) / weight)
            squares += float(np.sum(np.diff(shifts) ** 2))
            seconds += rows * CYCLE_S * max(len(shifts) - 1, 0)
    return float(np.sqrt(squares / seconds)) if seconds else 0.0


def _assemble(
    result: Identification,
    *,
    thickness_mm: float,
    curves: tuple[Curve, ...],
    values: dict[str, float],
    effects: dict[str, dict[str, float]],
    torque: TorqueFit,
    noise: Noise,
    clearance: float | None = None,
) -> Calibration:
    sheet, file = result.campaign.datasheet, result.campaign.file
    force = max(float(np.nanmax(log.force_N)) for pads in result.pads for log in pads.logs)
    return Calibration(
        format=1,
        actuator=f"rig-{file.rig}",
        pad_thickness_mm=thickness_mm,
        motor=Motor(
            torque_constant_Nm_per_A=torque.torque_constant,
            inertia_kg_m2=torque.inertia,
            gear_gain_m_per_rad=sheet.actuator.gear_gain_m_per_rad,
            maximum_speed_rad_per_s=sheet.actuator.max_motor_speed_rad_per_s,
        ),
        friction=_friction(torque),
        stiffness=Stiffness(
            curves=curves,
            relaxation_time_s=float(values["relaxation_time_s"]),
            maximum_force_N=max(force, sheet.actuator.rated_clamp_force_N),
        ),
        contact=result.contact
        if clearance is None
        else msgspec.structs.replace(result.contact, clearance_rad=max(clearance, 0.0)),
        noise=noise,
        thermal=result.thermal.thermal if result.thermal else result.nominal_thermal,
        effects=effects,
    )


def _calibration(result: Identification) -> Calibration:
    return _tidy(
        _assemble(
            result,
            thickness_mm=result.campaign.file.pad_thickness_mm,
            curves=tuple(curve.curve() for curve in result.fit.curves),
            values=result.fit.dynamics.values,
            effects=result.fit.dynamics.effects(),
            torque=result.torque,
            noise=result.noise,
        )
    )


def _thesis_calibration(result: Identification) -> Calibration:
    """The same estimator with the thesis's models: no effects, friction by sign, curves through the loops."""
    return _assemble(
        result,
        thickness_mm=result.campaign.file.pad_thickness_mm,
        curves=tuple(_thesis_curve(form) for form in result.thesis),
        values={"relaxation_time_s": result.thesis_damping_s},
        effects={},
        torque=result.thesis_torque,
        noise=result.thesis_noise,
        clearance=float(np.mean([form.clearance for form in result.thesis])),
    )


def _thesis_curve(form: ThesisForm) -> Curve:
    coefficients = form.coefficients.copy()
    # The estimator wants a force that rises from contact; a line of best fit may start flat.
    coefficients[0] = max(coefficients[0], 1e-3 * float(np.max(np.abs(coefficients))))
    return Curve(pad_thickness_mm=form.thickness_mm, coefficients=tuple(float(c) for c in coefficients))


def _nominal(campaign: Campaign) -> heat.Nominal:
    pad, disc = campaign.datasheet.pad, campaign.datasheet.disc
    return heat.Nominal(
        pad_thickness_m=1e-3 * campaign.file.pad_thickness_mm,
        pad_area_m2=pad.frontal_area_m2,
        pad_density_kg_per_m3=pad.density_kg_per_m3,
        pad_specific_heat_J_per_kgK=pad.specific_heat_J_per_kgK,
        pad_conductivity_W_per_mK=pad.conductivity_W_per_mK,
        disc_mass_kg=disc.mass_kg,
        disc_specific_heat_J_per_kgK=disc.specific_heat_J_per_kgK,
        disc_effective_radius_m=disc.effective_radius_m,
        disc_cooling_area_m2=disc.cooling_area_m2,
        disc_conductivity_W_per_mK=disc.conductivity_W_per_mK,
        friction_coefficient=campaign.datasheet.friction_coefficient,
    )


def _nominal_thermal(nominal: heat.Nominal) -> Thermal:
    """Thermal part of a calibration when no log heats the pads: datasheet values, and textbook ones where it is silent."""
    forces = (0.0, 1000.0, 2500.0, 5000.0, 10000.0, 20000.0)
    speeds = (0.5, 5.0, 10.0, 20.0, 40.0, 80.0)
    temperatures = (20.0, 100.0, 150.0, 200.0, 250.0, 300.0, 400.0, 500.0)
    flat = ((nominal.friction_coefficient,) * len(temperatures),) * len(speeds)
    area = nominal.disc_cooling_area_m2
    return Thermal(
        pad=Pad(
            area_m2=nominal.pad_area_m2,
            density_kg_per_m3=nominal.pad_density_kg_per_m3,
            conductivity_W_per_mK=nominal.pad_conductivity_W_per_mK,
            specific_heat_J_per_kgK=nominal.pad_specific_heat_J_per_kgK,
            # Organic pads take some five per cent of the heat each; contact and gap as in Incropera, Fundamentals of Heat
            # and Mass Transfer, 7th ed., table 3.1 and natural convection in a narrow gap.
            inner_heat_share=0.05,
            outer_heat_share=0.05,
            contact_conductance_W_per_m2K=2000.0,
            gap_conductance_W_per_m2K=200.0,
            backplate_conductance_W_per_m2K=5000.0,
        ),
        disc=Disc(
            heat_capacity_J_per_K=nominal.disc_mass_kg * nominal.disc_specific_heat_J_per_kgK,
            effective_radius_m=nominal.disc_effective_radius_m,
            cooling_W_per_K=10.0 * area,
            cooling_per_speed_J_per_rad_K=2.0 * area,
            radiating_area_m2=0.5 * area,
        ),
        friction=FrictionTable(
            force_N=forces, disc_speed_rad_per_s=speeds, surface_temperature_C=temperatures, coefficient=(flat,) * len(forces)
        ),
        softening=Softening(),
        sigma_K=50.0,
    )


def _heat(result: Identification, progress: Progress) -> None:
    campaign = result.campaign
    nominal = _nominal(campaign)
    logs = _thermal_logs(campaign)
    try:
        if logs is None:
            raise InputError(f"{campaign.path}: thermal: no logs; needed: braking with thermocouples in the pads")
        result.thermal = heat.identify_thermal(logs, nominal, to_parameters(_cold(result, nominal)), progress)
        for fault in result.thermal.faults:
            campaign.fault(fault)
        result.notes.extend(result.thermal.notes)
    except InputError as error:
        campaign.fault(f"{error}; heat keeps the datasheet's nominal values and the force does not follow temperature")
        result.nominal_thermal = _nominal_thermal(nominal)


def _cold(result: Identification, nominal: heat.Nominal) -> Calibration:
    result.nominal_thermal = _nominal_thermal(nominal)
    cold = _calibration(result)
    result.nominal_thermal = None
    return cold


def _thermal_logs(campaign: Campaign) -> heat.ThermalLogs | None:
    file = campaign.file
    part = file.thermal

    def load(name, key, need):
        return campaign.load(name, key, need) if name is not None else None

    integrated = tuple(
        (
            load(pair.fit, "integrated.fit", "training and braking heat at full frame rate"),
            load(pair.judge, "integrated.judge", "training and braking heat at full frame rate"),
        )
        for pair in file.integrated
    )
    if part is None:
        return heat.ThermalLogs(integrated=integrated) if any(log for pair in integrated for log in pair) else None
    coolings = []
    for entry in part.disc_cooling:
        log = load(entry.log, "thermal.disc_cooling", "a hot disc released at constant speed, with its thermocouple")
        if log is not None:
            coolings.append(log)
    return heat.ThermalLogs(
        tune=load(part.tune, "thermal.tune", "braking with thermocouples in the pads"),
        validate=load(part.validate, "thermal.validate", "braking with thermocouples in the pads"),
        heat_flux_map=load(part.heat_flux_map, "thermal.heat_flux_map", "braking at several forces and disc speeds"),
        pad_cooling=load(part.pad_cooling, "thermal.pad_cooling", "bursts of clamps while the pads cool"),
        disc_cooling=tuple(coolings),
        integrated=integrated,
    )


def _judge(result: Identification, folds: list[Fold]) -> None:
    campaign, ours, thesis = result.campaign, result.calibration, _thesis_calibration(result)
    for fold in folds:
        others = [other for other in folds if other is not fold] or [fold]
        mine = _assemble(
            result,
            thickness_mm=fold.pads.thickness_mm,
            curves=(fold.curve.curve(),),
            values=fold.values,
            effects=_effects_of(fold.values, result),
            torque=fold.torque,
            noise=_noise_of(result, others),
            clearance=fold.clearance,
        )
        form = next(form for form in result.thesis if form.thickness_mm == fold.pads.thickness_mm)
        his = _assemble(
            result,
            thickness_mm=fold.pads.thickness_mm,
            curves=(_thesis_curve(form),),
            values={"relaxation_time_s": fold.thesis_damping_s},
            effects={},
            torque=fold.thesis_torque,
            noise=_noise_of(result, others, thesis=True),
            clearance=form.clearance,
        )
        for log in fold.judged:
            name = f"random, {fold.pads.thickness_mm:g} mm"
            result.judged.append(Judged(name, "random", log, judge(log, his), judge(log, mine)))
    for entry in campaign.file.adaptation:
        thickness = campaign.thickness(entry)
        log = campaign.load_motion(entry.judge, "adaptation.judge", _NEED_RANDOM, reversals=_RANDOM)
        if log is not None:
            name = f"random, {thickness:g} mm, curve predicted"
            _judge_at(result, name, "predicted", log, thickness, thesis, ours)
    states = {training: forms for training, *forms in result.gears}
    for entry in campaign.file.gear_wear:
        if entry.judge is None or entry.training not in states:
            continue
        log = campaign.load_motion(entry.judge, "gear_wear.judge", _NEED_RANDOM, reversals=_RANDOM)
        if log is not None:
            worn, thesis_worn = (
                _with_gear(calibration, fit) for calibration, fit in zip((ours, thesis), states[entry.training], strict=True)
            )
            name = f"{_stem(entry.judge)}, curve predicted"
            _judge_at(result, name, "gear", log, campaign.thickness(entry), thesis_worn, worn)
    for pair in campaign.file.integrated:
        if pair.judge is None:
            continue
        log = campaign.load(pair.judge, "integrated.judge", "training and braking heat at full frame rate")
        if log is not None:
            name = f"integrated, {_stem(pair.judge)}"
            _judge_at(result, name, "integrated", log, campaign.file.pad_thickness_mm, thesis, ours)


def _with_gear(calibration: Calibration, fit: TorqueFit) -> Calibration:
    """Wear changes friction; motor and inertia stay."""
    return msgspec.structs.replace(calibration, friction=_friction(fit))


def _friction(fit: TorqueFit) -> Friction:
    return Friction(
        load_m_per_rad=max(fit.load_friction, 0.0),
        offset_Nm=max(fit.offset_friction, 0.0),
        presliding_angle_rad=max(fit.presliding_angle, SIGN),
    )


def _stem(name: str) -> str:
    return name.rsplit("/", 1)[-1].split(".log")[0]


def _judge_at(result, name, kind, log, thickness, thesis, ours) -> None:
    """Judge both calibrations with pads of another thickness; a thickness too far from the measured ones is a fault."""
    interpolation = interpolation_error(result.fit.curves, thickness)
    base = _without(result.noise.stiffness_relative, result.interpolation_relative)
    noise = msgspec.structs.replace(ours.noise, stiffness_relative=float(np.hypot(base, interpolation)))
    try:
        mine = judge(log, msgspec.structs.replace(ours, pad_thickness_mm=thickness, noise=noise))
        his = judge(log, msgspec.structs.replace(thesis, pad_thickness_mm=thickness))
    except InputError as error:
        result.campaign.fault(f"{kind}: {log.path}: {error}; not judged")
        return
    result.judged.append(Judged(name, kind, log, his, mine))


def _without(total: float, part: float) -> float:
    return float(np.sqrt(max(total**2 - part**2, 0.0)))


def _effects_of(values: dict[str, float], result: Identification) -> dict[str, dict[str, float]]:
    return Dynamics(values, {}).effects() if result.chosen else {}


def _provenance(result: Identification) -> Provenance:
    epoch = os.environ.get("SOURCE_DATE_EPOCH")
    now = datetime.datetime.fromtimestamp(int(epoch), datetime.UTC) if epoch else datetime.datetime.now(datetime.UTC)
    figures = {}
    for judged in result.judged:
        for path, rmse in judged.ours.rmse.items():
            figures[f"{judged.name}: {path} rmse_N"] = rmse
        figures[f"{judged.name}: inside_two_sigma"] = judged.ours.inside_two_sigma
    sigmas = {f"stiffness.{k}" if "." not in k else f"effects.{k}": v for k, v in result.fit.dynamics.sigmas.items()}
    sigmas.pop("effects.signal_delay.delay_s", None)
    keys = {"torque_constant_Nm_per_A": "motor", "inertia_kg_m2": "motor"}
    sigmas |= {f"{keys.get(name, 'friction')}.{name}": value for name, value in result.torque.sigmas().items()}
    for number, curve in enumerate(result.fit.curves):
        for n, value in enumerate(np.sqrt(np.diag(curve.covariance))):
            sigmas[f"stiffness.curves[{number}].coefficients[{n}]"] = float(value)
    if result.thermal:
        figures |= result.thermal.figures
        sigmas |= result.thermal.sigmas
    return Provenance(
        date=now.strftime("%Y-%m-%d"),
        tool=f"emb-daemon {__version__}",
        campaign=result.campaign.path.name,
        logs=tuple(Source(log=name, sha256=digest) for name, digest in sorted(result.campaign.sources.items())),
        figures={name: _rounded(value) for name, value in figures.items() if np.isfinite(value)},
        sigmas={name: _rounded(value) for name, value in sigmas.items() if np.isfinite(value)},
    )


def _rounded(value: float, digits: int = 4) -> float:
    return float(f"{value:.{digits}g}")


def _tidy(calibration: Calibration) -> Calibration:
    """Seven digits: far more than is known, and a file that people can read."""

    def tidy(value):
        if isinstance(value, dict):
            return {key: tidy(entry) for key, entry in value.items()}
        if isinstance(value, list | tuple):
            return [tidy(entry) for entry in value]
        return _rounded(value, 7) if isinstance(value, float) else value

    return msgspec.convert(tidy(msgspec.to_builtins(calibration)), Calibration)
