"""Heat: pads, disc, friction and softening out of a rig's thermal logs, judged beside the thesis's form (its chapter 8)."""

from collections.abc import Callable
from dataclasses import dataclass, field

import msgspec
import numpy as np

from emb_daemon.calibration.types import Disc, Pad, Softening, Thermal, fill_thermal
from emb_daemon.errors import InputError
from emb_daemon.estimator.records import DEPTHS_M
from emb_daemon.identify.friction_map import FrictionFit, constant_friction, fit_friction
from emb_daemon.identify.heat import (
    HeatFit,
    Nominal,
    Recording,
    check_excitation,
    fit_heat,
    recording,
    simulate,
)
from emb_daemon.identify.softening import SofteningFit, fit_softening
from emb_daemon.models.thermal import disc_loss
from emb_daemon.models.thesis_pad import thesis_profiles
from emb_daemon.offline import Log, estimate

__all__ = ["Nominal", "Row", "ThermalLogs", "ThermalResult", "identify_thermal"]

#: Density of grey cast iron (EN-GJL-250), kg/m^3, for the disc's volume.
_CAST_IRON = 7200.0
#: Disc temperatures over ambient that a cooling rate rests on, K.
_LEAST_OVER_AMBIENT_K = 15.0
#: Targets of the judged figures.
_PADS_TARGET_K, _PADS_WITHOUT_TORQUE_TARGET_K, _SOFTENING_TARGET_N = 2.0, 6.0, 300.0
#: Pads are not known better than their thermocouples, K.
_LEAST_SIGMA_K = 0.3
#: Largest rise of conductivity that the thesis's form may take, 1/K: without a bound it takes absurd ones.
_THESIS_RISE = 2e-3


@dataclass(frozen=True)
class ThermalLogs:
    """Logs of one corner by the part they play. ``validate`` and second elements of ``integrated`` fit nothing.

    Any may be missing; ``tune`` alone is enough for a pad model.
    """

    tune: Log | None = None
    validate: Log | None = None
    heat_flux_map: Log | None = None
    pad_cooling: Log | None = None
    disc_cooling: tuple[Log, ...] = ()
    #: (fit, judge) pairs.
    integrated: tuple[tuple[Log | None, Log | None], ...] = ()


@dataclass(frozen=True)
class Row:
    """One line of the report's table: what is judged, RMSE of the thesis's form and of ours, what to reach; NaN: none."""

    name: str
    unit: str
    thesis: float
    ours: float
    target: float
    #: What the thesis reports of its own rig.
    reported: float = float("nan")


@dataclass(frozen=True)
class ThermalResult:
    """What the thermal logs say.

    Attributes:
        thermal: that part of a calibration. What no log could tell holds the datasheet's value and is named in ``notes``.
        sigmas: standard deviations by calibration key, ``thermal.pad.conductivity_W_per_mK`` and so on.
        figures: RMSE on logs that fitted nothing, by name with unit.
        residuals: the same for what was fitted.
        table: lines for the report's table.
        plots: arrays for the report by name, each a dict of arrays of equal last axis:

            - ``tune``, ``validate``, ``integrated 1``, ...: ``time_s`` (n,); ``measured``, ``known``, ``unknown`` (9, n) degC:
              inner pad at 2, 4, 6, 8 mm, outer pad at the same, disc; ``known`` with the brake torque measured, ``unknown``
              without it; ``thesis`` (8, n), where the thesis's form was run;
            - ``disc_cooling``: ``speed_rad_per_s``, ``rate_per_s``, ``rate_sigma_per_s``, ``line_per_s``, ``biot``;
            - ``friction``: ``force_N``, ``speed_rad_per_s``, ``temperature_C``, ``measured``, ``model`` coefficients;
            - ``softening``, per burst: ``time_s``, ``rise_K``, ``factor``, ``factor_sigma``, ``exponential``, ``window``,
              ``fitted`` (1 where the burst fitted, 0 where it judged), ``rmse_N``;
            - ``window``: ``width_s``, ``residual``.
        notes: sentences for the report, such as values kept from the datasheet.
        faults: one line per log that is missing or says too little: which, and what was needed.
    """

    thermal: Thermal
    sigmas: dict[str, float]
    figures: dict[str, float]
    residuals: dict[str, float]
    table: tuple[Row, ...]
    plots: dict[str, dict[str, np.ndarray]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    faults: tuple[str, ...] = ()


@dataclass(frozen=True)
class _DiscLaw:
    """Thesis 8.2: b_d = ``rest`` + ``per_speed`` omega, 1/s."""

    rest: float
    per_speed: float
    speed: np.ndarray
    rate: np.ndarray
    sigma: np.ndarray

    def __call__(self, speed):
        return self.rest + self.per_speed * speed


class _Faults(list):
    """Collects what went wrong with one log, so that the others go on."""

    def attempt(self, action: Callable, *arguments):
        try:
            return action(*arguments)
        except InputError as error:
            self.append(str(error))
            return None


def identify_thermal(
    logs: ThermalLogs,
    nominal: Nominal,
    stiffness: np.void | None = None,
    progress: Callable[[float, str], None] = lambda share, text: None,
) -> ThermalResult:
    """Thermal calibration from logs.

    Args:
        stiffness: PARAMETERS record with the cold stiffness path (curve of this pad thickness, relaxation, effects,
            clearance); softening is identified only with it. If its noise is given as well, the pads' temperatures are also
            judged as in a car: by the whole estimator, its own clamp force heating them.
        progress: called with the share done, 0 to 1, and what comes next.

    Raises:
        InputError: not one log that heats the pads with their thermocouples recorded.
    """
    faults, notes = _Faults(), []
    progress(0.0, "reading thermal logs")
    fitting = _recordings(logs, faults)
    if not fitting:
        raise InputError(
            "thermal: no log heats the pads with their thermocouples recorded; thermal.tune is needed\n" + "\n".join(faults)
        )

    heat = fit_heat(list(fitting.values()), nominal, lambda share: progress(0.05 + 0.65 * share, "pads and disc"))
    for key in heat.unexcited:
        notes.append(f"thermal.{key}: these logs hardly tell it; the usual value, or the datasheet's, was mostly kept")

    progress(0.72, "disc cooling")
    law = _disc_law([fitting[name] for name in fitting if name.startswith("disc_cooling")], heat.parameters)

    progress(0.75, "friction")
    dense = [r for r in fitting.values() if r.dense]
    friction = faults.attempt(fit_friction, dense, heat.parameters) if dense else None
    if friction is None:
        notes.append("thermal.friction: no log tells it; the datasheet's coefficient was kept")

    progress(0.8, "softening")
    softening = None
    if stiffness is None:
        notes.append("thermal.softening: not identified, because there is no stiffness path to identify it with")
    elif logs.pad_cooling is not None and "pad_cooling" in fitting:
        softening = faults.attempt(
            fit_softening, logs.pad_cooling, fitting["pad_cooling"], heat.parameters, np.array([stiffness])
        )

    thermal = _calibration(nominal, heat, friction, softening)
    parameters = heat.parameters.copy()
    fill_thermal(parameters[0], thermal, nominal.pad_thickness_m)
    if dense:
        spread = _rms([simulate(parameters, r, False)[:, :8] - r.measured[:8].T for r in dense])
        thermal = msgspec.structs.replace(thermal, sigma_K=float(f"{max(spread, _LEAST_SIGMA_K):.3g}"))
        fill_thermal(parameters[0], thermal, nominal.pad_thickness_m)

    progress(0.85, "judging temperatures")
    result = _Judgement()
    thesis = _thesis_form(fitting["tune"], parameters, law) if "tune" in fitting else None
    if "tune" in fitting:
        result.temperatures("tune", fitting["tune"], parameters, thesis, result.residuals)
    judged = {"validate": logs.validate}
    for number, (_, judge) in enumerate(logs.integrated, 1):
        judged["integrated" if len(logs.integrated) == 1 else f"integrated {number}"] = judge
    for name, log in judged.items():
        r = faults.attempt(recording, log) if log is not None else None
        if log is None and name == "validate":
            faults.append("thermal.validate: missing; pad temperatures are not judged without it")
        if r is None:
            continue
        result.temperatures(name, r, parameters, thesis, result.figures)
        if stiffness is not None and float(stiffness["stiffness_sigma"]) > 0.0:
            full = np.array([stiffness])
            full["thermal"] = parameters[0]
            result.as_in_a_car(name, log, full)
    if "validate" in result.plots:
        _temperature_rows(result)
    for name, r in fitting.items():
        error = simulate(parameters, r)[:, :9] - r.measured.T
        result.residuals[f"{name}: pads, torque known, K"] = _rms([error[:, :8]])
        result.residuals[f"{name}: disc, torque known, K"] = _rms([error[:, 8]])

    sigmas = {f"thermal.{key}": value for key, value in heat.sigmas.items()}
    if law.speed.size:
        result.disc(law, nominal)
        notes.append(_disc_note(result))
    if friction is not None:
        result.friction(friction)
        sigmas["thermal.friction.coefficient"] = friction.sigma
        notes.append(f"friction on the disc: {friction.equation}, residual {friction.rms:.4f}")
    if softening is not None:
        result.softening(softening)
        sigmas |= {f"thermal.softening.{key}": value for key, value in softening.sigmas.items()}
        notes.append(_softening_note(softening))
    progress(1.0, "thermal part done")
    return ThermalResult(
        thermal=thermal,
        sigmas=sigmas,
        figures=result.figures,
        residuals=result.residuals,
        table=tuple(result.rows),
        plots=result.plots,
        notes=tuple(notes),
        faults=tuple(faults),
    )


def _recordings(logs: ThermalLogs, faults: _Faults) -> dict[str, Recording]:
    """Logs that may fit, by name; those that say too little become faults."""
    wanted: dict[str, Log | None] = {
        "tune": logs.tune,
        "heat_flux_map": logs.heat_flux_map,
        "pad_cooling": logs.pad_cooling,
    }
    needed_for = {
        "tune": "pad conductivity, specific heat and heat shares",
        "heat_flux_map": "friction over force, speed and temperature",
        "pad_cooling": "softening",
    }
    for number, log in enumerate(logs.disc_cooling, 1):
        wanted[f"disc_cooling {number}"] = log
    if not logs.disc_cooling:
        faults.append("thermal.disc_cooling: missing; needed for the disc's cooling over speed")
    for number, (fit, _) in enumerate(logs.integrated, 1):
        if fit is not None:
            wanted["integrated fit" if len(logs.integrated) == 1 else f"integrated fit {number}"] = fit
    found = {}
    for name, log in wanted.items():
        if log is None:
            faults.append(f"thermal.{name}: missing; needed for {needed_for[name]}")
            continue
        r = faults.attempt(recording, log)
        if r is None or faults.attempt(lambda r=r: check_excitation(r) or True) is None:
            continue
        found[name] = r
    return found


def _calibration(nominal: Nominal, heat: HeatFit, friction: FrictionFit | None, softening: SofteningFit | None) -> Thermal:
    p = heat.parameters[0]

    def value(field_name, index=None):
        return float(f"{float(p[field_name] if index is None else p[field_name][index]):.6g}")

    return Thermal(
        pad=Pad(
            area_m2=nominal.pad_area_m2,
            density_kg_per_m3=nominal.pad_density_kg_per_m3,
            conductivity_W_per_mK=value("conductivity"),
            conductivity_rise_per_K=value("conductivity_rise"),
            specific_heat_J_per_kgK=value("specific_heat"),
            inner_heat_share=value("heat_share", 0),
            outer_heat_share=value("heat_share", 1),
            contact_conductance_W_per_m2K=value("contact_conductance"),
            gap_conductance_W_per_m2K=value("gap_conductance"),
            surface_cooling_per_speed_J_per_rad_m2K=value("surface_cooling_per_speed"),
            backplate_conductance_W_per_m2K=value("backplate_conductance"),
        ),
        disc=Disc(
            heat_capacity_J_per_K=value("disc_heat_capacity"),
            effective_radius_m=nominal.disc_effective_radius_m,
            cooling_W_per_K=value("disc_cooling"),
            cooling_per_speed_J_per_rad_K=value("disc_cooling_per_speed"),
            radiating_area_m2=value("disc_radiating_area"),
        ),
        friction=friction.table if friction is not None else constant_friction(nominal.friction_coefficient),
        softening=softening.softening if softening is not None else Softening(),
    )


def _disc_law(cooling: list[Recording], parameters: np.ndarray) -> _DiscLaw:
    """Cooling rate of the disc over its speed from the released parts of logs; ours at 100 K, where there are not two."""
    found = []
    for r in cooling:
        braked = np.flatnonzero(r.touching)
        if not len(braked):
            continue
        over = r.measured[8] - r.ambient
        rows = np.arange(braked[-1] + 1 + int(3.0 / r.step_s), len(over))
        rows = rows[over[rows] > _LEAST_OVER_AMBIENT_K]
        if len(rows) < 30:
            continue
        halves = [-np.polyfit(r.time_s[part], np.log(over[part]), 1)[0] for part in np.array_split(rows, 2)]
        rate = -np.polyfit(r.time_s[rows], np.log(over[rows]), 1)[0]
        found.append((float(r.speed[rows].mean()), rate, 0.5 * abs(halves[1] - halves[0])))
    speed, rate, sigma = np.array(found).T if found else np.empty((3, 0))
    if len(found) > 1 and np.ptp(speed) > 1.0:
        per_speed, rest = np.polyfit(speed, rate, 1)
    else:
        p = parameters[0]
        rest = disc_loss(p, 122.0, 22.0, 0.0) / float(p["disc_heat_capacity"])
        per_speed = float(p["disc_cooling_per_speed"]) / float(p["disc_heat_capacity"])
    return _DiscLaw(float(rest), float(per_speed), speed, rate, sigma)


def _thesis_form(tune: Recording, parameters: np.ndarray, law: _DiscLaw) -> Callable[[Recording], np.ndarray]:
    """The thesis's pad model, fitted on one log as the thesis did: conductivity, its rise and a heat share per pad."""
    from scipy.optimize import least_squares

    p = parameters.copy()
    area, thickness = float(p["area"][0]), float(p["thickness"][0])

    def run(r: Recording, share: np.ndarray) -> np.ndarray:
        columns = []
        for plate, part in ((r.inner, share[0]), (r.outer, share[1])):
            profiles = thesis_profiles(p, plate, r.ambient, part * r.power / area, r.touching, law(r.speed), r.step_s)
            at = np.linspace(0.0, thickness, profiles.shape[1])
            for depth in DEPTHS_M:
                upper = int(np.clip(np.searchsorted(at, depth), 1, len(at) - 1))
                weight = (depth - at[upper - 1]) / (at[upper] - at[upper - 1])
                inside = (1.0 - weight) * profiles[:, upper - 1] + weight * profiles[:, upper]
                columns.append(inside if depth <= thickness + 1e-9 else np.full(len(inside), np.nan))
        return np.array(columns).T

    every = max(round(2.0 / tune.step_s), 1)

    def residual(x):
        p["conductivity"], p["conductivity_rise"] = x[0], x[1]
        error = (run(tune, x[2:]) - tune.measured[:8].T)[::every]
        return error[np.isfinite(error)]

    start = np.array([float(p["conductivity"][0]), 0.25 * _THESIS_RISE, *p["heat_share"][0]])
    bounds = ([0.2 * start[0], 0.0, 1e-3, 1e-3], [5.0 * start[0], _THESIS_RISE, 0.5, 0.5])
    x = least_squares(residual, np.clip(start, *bounds), bounds=bounds, x_scale=[1.0, 1e-3, 0.05, 0.05], max_nfev=40).x
    p["conductivity"], p["conductivity_rise"] = x[0], x[1]
    return lambda r: run(r, x[2:])


def _rms(errors: list[np.ndarray]) -> float:
    flat = np.concatenate([np.ravel(error) for error in errors])
    flat = flat[np.isfinite(flat)]
    return float(np.sqrt(np.mean(flat**2))) if len(flat) else float("nan")


class _Judgement:
    """Figures, table rows and plots as they come."""

    def __init__(self):
        self.figures: dict[str, float] = {}
        self.residuals: dict[str, float] = {}
        self.rows: list[Row] = []
        self.plots: dict[str, dict[str, np.ndarray]] = {}

    def temperatures(self, name: str, r: Recording, parameters: np.ndarray, thesis, into: dict[str, float]) -> None:
        every = max(round(0.5 / r.step_s), 1)
        plot = {"time_s": r.time_s[::every], "measured": r.measured[:, ::every]}
        for key, torque_known, words in (("known", True, "torque known"), ("unknown", False, "no torque")):
            found = simulate(parameters, r, torque_known)[:, :9].T
            plot[key] = found[:, ::every]
            into[f"{name}: pads, {words}, K"] = _rms([found[:8] - r.measured[:8]])
            into[f"{name}: disc, {words}, K"] = _rms([found[8] - r.measured[8]])
        if thesis is not None:
            found = thesis(r).T
            plot["thesis"] = found[:, ::every]
            into[f"{name}: pads, thesis form, K"] = _rms([found - r.measured[:8]])
        self.plots[name] = plot

    def as_in_a_car(self, name: str, log: Log, parameters: np.ndarray) -> None:
        found = estimate(log.samples, parameters)
        errors = []
        for side, pad in enumerate(("inner", "outer")):
            times, depths = log.reference.pads[pad]
            for row in range(len(DEPTHS_M)):
                errors.append(np.interp(times, log.time_ns, found["depth"][:, side, row]) - depths[row])
        self.figures[f"{name}: pads, no torque, estimated force, K"] = _rms(errors)

    def disc(self, law: _DiscLaw, nominal: Nominal) -> None:
        film = law.rate * nominal.disc_mass_kg * nominal.disc_specific_heat_J_per_kgK / nominal.disc_cooling_area_m2
        length = nominal.disc_mass_kg / (_CAST_IRON * nominal.disc_cooling_area_m2)
        line = law(law.speed)
        self.plots["disc_cooling"] = {
            "speed_rad_per_s": law.speed,
            "rate_per_s": law.rate,
            "rate_sigma_per_s": law.sigma,
            "line_per_s": line,
            "biot": film * length / nominal.disc_conductivity_W_per_mK,
        }
        self.residuals["disc cooling rate, line over speed, 1/s"] = _rms([line - law.rate])

    def friction(self, fit: FrictionFit) -> None:
        self.plots["friction"] = {
            "force_N": fit.force_N,
            "speed_rad_per_s": fit.speed_rad_per_s,
            "temperature_C": fit.temperature_C,
            "measured": fit.measured,
            "model": fit.model,
        }
        self.residuals["friction coefficient, weighted by force"] = fit.rms

    def softening(self, fit: SofteningFit) -> None:
        names = ("time_s", "rise_K", "factor", "factor_sigma", "exponential", "window", "fitted", "rmse_N")
        self.plots["softening"] = {name: getattr(fit, name) for name in names}
        self.plots["window"] = {"width_s": fit.widths_s, "residual": fit.width_residuals}
        self.figures["pad_cooling: force, bursts left out, kN"] = 1e-3 * fit.ours_N
        self.figures["pad_cooling: force, bursts left out, thesis form, kN"] = 1e-3 * fit.thesis_N
        self.figures["pad_cooling: force, bursts left out, cold stiffness, kN"] = 1e-3 * fit.uncorrected_N
        name = "curves through the cooling of the pads (bursts that fitted nothing)"
        self.rows.append(Row(name, "kN", 1e-3 * fit.thesis_N, 1e-3 * fit.ours_N, 1e-3 * _SOFTENING_TARGET_N, 1.0))


def _temperature_rows(result: _Judgement) -> None:
    figures, none = result.figures, float("nan")
    thesis, known = figures.get("validate: pads, thesis form, K", none), figures["validate: pads, torque known, K"]
    without = figures.get("validate: pads, no torque, estimated force, K", figures["validate: pads, no torque, K"])
    name = "pad temperatures at 2, 4, 6, 8 mm, both pads, validate, brake torque known"
    result.rows.append(Row(name, "°C", thesis, known, _PADS_TARGET_K, 3.7))
    result.rows.append(Row("the same without brake torque (as in a car)", "°C", none, without, _PADS_WITHOUT_TORQUE_TARGET_K))


def _disc_note(result: _Judgement) -> str:
    biot = result.plots["disc_cooling"]["biot"]
    verdict = "the disc may be taken as lumped" if biot.max() <= 0.1 else "above 0.1: a lumped disc is doubtful"
    return f"Biot number of the disc {biot.min():.4f} to {biot.max():.4f}: {verdict}"


def _softening_note(fit: SofteningFit) -> str:
    hot = np.abs(fit.shift_rad).max()
    kept = "first-order history" if fit.softening.history_per_K else "no history: it does not help on bursts left out"
    return (
        f"softening: {kept}; the thesis's moving window is best at {fit.width_s:.0f} s; fitted on bursts 1, 3, 5, ...,"
        f" judged on the others; contact, if left free, would shift by at most {1e3 * hot:.0f} mrad"
    )
