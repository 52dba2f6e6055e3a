"""Heat: pads, disc, friction and softening from a rig's thermal logs, and the accuracy of temperatures."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from msgspec import structs

from emb_daemon.calibration.parameters import keys, moved, value_of
from emb_daemon.calibration.terms import Term
from emb_daemon.calibration.types import Calibration, to_parameters
from emb_daemon.diagnose.coordinates import is_clear_of_zero
from emb_daemon.diagnose.diagnosis import with_terms
from emb_daemon.diagnose.forms import equation
from emb_daemon.diagnose.grammar import search_heat
from emb_daemon.diagnose.residuals import CHANNEL_OF_HEAT
from emb_daemon.diagnose.signals import MANOEUVRES
from emb_daemon.diagnose.unexplained import dependences, is_beyond
from emb_daemon.diagnose.warmth import HeatBench, HeatSearch
from emb_daemon.errors import InputError
from emb_daemon.estimator.records import DEPTHS_M
from emb_daemon.identify.campaign import NEED_INTEGRATED, Campaign
from emb_daemon.identify.steps import Step, cooling, friction, softening
from emb_daemon.identify.steps.cooling import CoolingLaw, cooling_law
from emb_daemon.identify.steps.friction import FrictionFit, fit_friction
from emb_daemon.identify.steps.heat import check_excitation, fit_heat
from emb_daemon.identify.steps.softening import PER_K, SofteningFit, fit_softening
from emb_daemon.identify.text import rounded, with_sigma
from emb_daemon.offline import Log, estimate
from emb_daemon.offline.recording import Recording, recording, simulate
from emb_daemon.offline.score import rmse
from emb_daemon.report.figures import MODEL, PALE, Panel, Style, Trace, shades, time_figure
from emb_daemon.report.page import Page

#: Loss of stiffness per kelvin that pads may have which no log has shown hot, one standard deviation: those of the simulated
#: rigs A and H, which follow the thesis's law (8.4), lose 4.4e-4 at once, and 6e-4 to 7e-4 more in half an hour.
_UNSHOWN_SOFTENING_PER_K = 5e-4
#: Pads are not known better than their thermocouples, K.
_LEAST_SIGMA_K = 0.3
#: Figures, by the log's name and what of the brake: with the rig's brake torque, without it, and as in a car, where the force
#: is estimated, too.
_TORQUE_KNOWN, _NO_TORQUE = "{}: {}, torque known, K", "{}: {}, no torque, K"
_IN_CAR = "{}: pads, no torque, estimated force, K"
_NEEDED = {
    "tune": "braking with thermocouples in the pads, for conductivity, specific heat and heat shares",
    "heat_flux_map": "braking at several forces and disc speeds, for friction over force, speed and temperature",
    "pad_cooling": "bursts of clamps while the pads cool, for softening",
    "validate": "braking with thermocouples in the pads; pad temperatures are not judged without it",
}


@dataclass(frozen=True)
class Temperatures:
    """One log's modelled temperatures and its thermocouples, every half second. ``measured``, ``known``, ``unknown``: shape
    (9, n), degC: inner pad at 2, 4, 6, 8 mm, outer pad at the same, disc; ``known`` with the brake torque measured,
    ``unknown`` without it."""

    time_s: np.ndarray
    measured: np.ndarray
    known: np.ndarray
    unknown: np.ndarray


@dataclass(frozen=True, kw_only=True)
class ThermalStep(Step):
    """Thermal section."""

    #: ``fitted`` and ``unseen``: recordings that fitted, and logs that validate, by name.
    fitted: dict[str, Recording]
    unseen: dict[str, Log] = field(default_factory=dict, repr=False)
    #: Logs that fitted in which the brake works as in service: force over heat.
    hot: tuple[Log, ...] = field(default=(), repr=False)
    terms: tuple[Term, ...] = ()  #: of the heat balance, that these logs prove beside it
    #: ``left_K`` and ``follows``: RMS that is clearly left of the temperatures nevertheless, and the signal that it follows
    #: most.
    left_K: float = 0.0
    follows: str = ""
    heat: Step | None = None  #: pads and disc; None without a log that heats the pads, and everything below is then empty
    law: CoolingLaw | None = None
    friction: FrictionFit | None = None
    softening: SofteningFit | None = None
    temperatures: dict[str, Temperatures] = field(default_factory=dict)
    #: RMSE on logs that were not fitted, by name with unit, once `validate`d.
    figures: dict[str, float] = field(default_factory=dict)
    achieved_K: float | None = None  #: the worst of these temperatures; None without one
    in_car_K: float = 0.0  #: the worst of pads as in a car; zero without one
    residuals: dict[str, float] = field(default_factory=dict)  #: the same for what was fitted


def _attempt(campaign: Campaign, action, *arguments):
    """The result; None if a log is faulty, which is reported, so that the others are still used."""
    try:
        return action(*arguments)
    except InputError as error:
        campaign.fault(str(error))
        return None


def identify(campaign: Campaign, cold: Calibration) -> ThermalStep:
    """Thermal section of the calibration. ``cold``: what is known without it: softening is identified with its stiffness path,
    and pads are judged as in a car by the whole estimator, its own clamp force heating them."""
    logs, unseen = _logs(campaign)
    recordings = {name: found for name, log in logs.items() if (found := _attempt(campaign, _fitting, log)) is not None}
    if not recordings:
        campaign.fault(
            "thermal: no log heats the pads with their thermocouples recorded; needed: thermal.tune, braking with "
            "thermocouples in the pads, or in the disc for the disc alone; heat keeps the datasheet's nominal values, the "
            "force does not follow temperature, and sigma holds what hot pads may lose"
        )
        return ThermalStep(fitted={})
    heat = fit_heat(list(recordings.values()), cold)
    padded = {name: r for name, r in recordings.items() if r.has_pads}
    if not padded:
        campaign.fault(
            "thermal: the disc's temperature tells of the disc alone; needed for the pads: braking with thermocouples in "
            "them; they keep the datasheet's nominal values, the force does not follow temperature, and sigma holds what hot "
            "pads may lose"
        )
    terms, left_K, follows = find_terms(list(padded.values()), moved(cold, heat.values)) if padded else ((), 0.0, "")
    if terms:
        cold = structs.replace(cold, terms=terms)
        heat = fit_heat(list(recordings.values()), cold)
    values, heated = dict(heat.values), moved(cold, heat.values)
    dense = [r for r in padded.values() if r.dense]
    rubbed = _attempt(campaign, fit_friction, dense, to_parameters(heated)) if dense else None
    softened = None
    if "pad_cooling" in padded:
        softened = _attempt(campaign, fit_softening, logs["pad_cooling"], padded["pad_cooling"], heated)
    sigmas = heat.sigmas | ({"thermal.friction.coefficient": rubbed.sigma} if rubbed else {})
    sigmas |= softened.sigmas if softened else {}
    for found in (rubbed, softened):
        values |= found.values if found else {}
    if dense:
        parameters = to_parameters(moved(cold, values))
        spread = rmse(np.concatenate([_errors(parameters, r, False)[:8].ravel() for r in dense]))
        values["thermal.sigma_K"] = rounded(max(spread, _LEAST_SIGMA_K), 3)
    law = cooling_law([r for name, r in recordings.items() if name.startswith("disc_cooling")], campaign.datasheet.disc)
    return ThermalStep(
        values=values,
        sigmas=sigmas,
        notes=_notes(heat, law, rubbed, softened),
        fitted=recordings,
        unseen=unseen,
        terms=terms,
        left_K=left_K,
        follows=follows,
        hot=tuple(logs[name] for name in padded if name == "tune" or name.startswith("integrated")),
        heat=heat,
        law=law,
        friction=rubbed,
        softening=softened,
    )


def find_terms(recordings: list[Recording], heated: Calibration) -> tuple[tuple[Term, ...], float, str]:
    """What pads and disc do that the heat balance lacks, as terms of a calibration; what is clearly left of the temperatures
    (K RMS) nevertheless, and the signal that it follows most."""
    bench = HeatBench(recordings, heated)
    found = search_heat(bench)
    model, floor = found.model, found.screening.floor(found.model, CHANNEL_OF_HEAT, made=True)
    terms = with_terms(model.bench.calibrated(model.values), found).terms if found.accepted else ()
    left_K = float(np.sqrt(model.noise(CHANNEL_OF_HEAT)))
    if not is_beyond(left_K, found.screening.achieved(model, CHANNEL_OF_HEAT, np.zeros(0), np.zeros(0))):
        return terms, 0.0, ""
    gains = HeatSearch(model).dependence()
    return terms, left_K, dependences(CHANNEL_OF_HEAT, gains, model.counted(CHANNEL_OF_HEAT), floor)[0].signal


def words(step: ThermalStep) -> str:
    """What was found beside the thesis's heat balance, and what is left of the temperatures; empty if neither."""
    told = [f"Found in the heat of pads and disc: {' and '.join(map(equation, step.terms))}."] if step.terms else []
    if step.follows:
        signal = step.follows.replace("_", " ")
        told.append(f"Not explained: {step.left_K:.2g} K RMS of the temperatures, which depend most on {signal}.")
        told.append(f"What would tell: {MANOEUVRES[step.follows]}.")
    return " ".join(told)


def validate(campaign: Campaign, step: ThermalStep, calibration: Calibration) -> ThermalStep:
    """The step with the accuracy of a calibration; says where that is clearly less than on the logs that fitted."""
    if step.heat is None:
        return step
    temperatures, figures, residuals = _validate(campaign, step.fitted, step.unseen, calibration)
    achieved_K = max(figures.values(), default=None)
    in_car_K = max((figures[key] for name in step.unseen if (key := _IN_CAR.format(name)) in figures), default=0.0)
    for name in step.unseen:
        unseen_K, fitted_K = figures.get(_NO_TORQUE.format(name, "pads"), 0.0), step.values.get("thermal.sigma_K", np.inf)
        if is_beyond(unseen_K, fitted_K):
            campaign.fault(
                f"thermal: {name}: the pads' temperatures are off by {unseen_K:.3g} K RMS without the brake torque, and by "
                f"{figures[_IN_CAR.format(name)]:.3g} K as in a car, which sigma_K holds, where the logs that fitted leave "
                f"{fitted_K:.3g} K: beyond these, pads and disc are not as identified"
            )
    if step.softening:
        figures |= step.softening.figures()
    if step.friction:
        residuals["friction coefficient, weighted by force"] = step.friction.rms
    if law := step.law:
        residuals["disc cooling rate, line over speed, 1/s"] = rmse(law(law.speed_rad_per_s) - law.rate_per_s)
    found = {"achieved_K": achieved_K, "in_car_K": in_car_K, "residuals": residuals}
    return replace(step, temperatures=temperatures, figures=figures, **found)


def stated(step: ThermalStep, calibration: Calibration, sigmas: Mapping[str, float]) -> dict[str, float]:
    """Standard deviations of what logs leave open: of the pads' temperatures, where validation as in a car shows more than the
    calibration states, because logs that fitted tell least of what the heat does elsewhere; and of a softening that none
    has shown. ``sigmas`` of what was identified, by key."""
    unsure = {}
    if step.in_car_K > calibration.thermal.sigma_K:
        unsure["thermal.sigma_K"] = rounded(step.in_car_K, 4)
    if not is_clear_of_zero(calibration.thermal.softening.per_K, sigmas.get(PER_K, 0.0)):
        unsure["thermal.softening.sigma_per_K"] = _UNSHOWN_SOFTENING_PER_K
    return unsure


def _logs(campaign: Campaign) -> tuple[dict[str, Log], dict[str, Log]]:
    """Logs to fit and logs to validate, by name; logs that a thermal rig should have and that are not named become faults."""
    part, fit, unseen = campaign.file.thermal, {}, {}
    for name, into in (("tune", fit), ("heat_flux_map", fit), ("pad_cooling", fit), ("validate", unseen)) if part else ():
        if getattr(part, name) is None:
            campaign.fault(f"thermal.{name}: missing; needed: {_NEEDED[name]}")
        into[name] = campaign.load(getattr(part, name), f"thermal.{name}", _NEEDED[name])
    coolings = part.disc_cooling if part else ()
    if part and not coolings:
        campaign.fault("thermal.disc_cooling: missing; needed for the disc's cooling over speed")
    for number, entry in enumerate(coolings, 1):
        fit[f"disc_cooling {number}"] = campaign.load_cooling(entry)
    pairs = campaign.file.integrated
    for number, pair in enumerate(pairs, 1):
        suffix = f" {number}" if len(pairs) > 1 else ""
        fit[f"integrated fit{suffix}"] = campaign.load(pair.fit, "integrated.fit", NEED_INTEGRATED)
        unseen[f"integrated{suffix}"] = campaign.load(pair.judge, "integrated.judge", NEED_INTEGRATED)
    return tuple({name: log for name, log in logs.items() if log is not None} for logs in (fit, unseen))


def _fitting(log: Log) -> Recording:
    found = recording(log)
    check_excitation(found)
    return found


def _errors(parameters: np.void, r: Recording, torque_known: bool = True) -> np.ndarray:
    """Of the modelled temperatures, shape (9, n), K."""
    return simulate(parameters, r, torque_known)[:, :9].T - r.measured


def _validate(campaign, recordings, unseen: dict[str, Log], calibration: Calibration):
    """(temperatures to draw, figures on logs that fitted nothing, residuals of those that did)."""
    temperatures, figures, residuals, parameters = {}, {}, {}, to_parameters(calibration)
    if "tune" in recordings:
        temperatures["tune"] = _compare("tune", recordings["tune"], parameters, residuals)
    for name, log in unseen.items():
        r = _attempt(campaign, recording, log)
        if r is not None:
            temperatures[name] = _compare(name, r, parameters, figures)
            if r.has_pads:
                figures[_IN_CAR.format(name)] = _as_in_a_car(log, calibration)
    for name, r in recordings.items():
        _note_errors(_TORQUE_KNOWN, name, _errors(parameters, r), residuals)
    return temperatures, figures, residuals


def _note_errors(figure: str, name: str, error: np.ndarray, into: dict[str, float]) -> None:
    for part, rows in (("pads", error[:8]), ("disc", error[8])):
        if np.isfinite(rows).any():
            into[figure.format(name, part)] = rmse(rows)


def _compare(name: str, r: Recording, parameters: np.ndarray, into: dict[str, float]) -> Temperatures:
    every, found = max(round(0.5 / r.step_s), 1), []
    for torque_known, figure in ((True, _TORQUE_KNOWN), (False, _NO_TORQUE)):
        error = _errors(parameters, r, torque_known)
        _note_errors(figure, name, error, into)
        found.append((error + r.measured)[:, ::every])
    return Temperatures(r.time_s[::every], r.measured[:, ::every], *found)


def _as_in_a_car(log: Log, calibration: Calibration) -> float:
    """RMSE of the pads' temperatures (K) by the whole estimator."""
    found = estimate(log.samples, to_parameters(calibration))
    errors = []
    for side, pad in enumerate(("inner", "outer")):
        times, depths = log.reference.pads[pad]
        for row in range(len(DEPTHS_M)):
            errors.append(np.interp(times, log.time_ns, found["depth"][:, side, row]) - depths[row])
    return rmse(np.concatenate(errors))


def _notes(heat, law, rubbed, softened) -> tuple[str, ...]:
    told = "thermal.friction: no log tells it; the datasheet's coefficient was kept"
    if rubbed:
        told = f"friction on the disc: {rubbed.equation}, residual {rubbed.rms:.4f}"
    return (*heat.notes, told, *(found.note() for found in (law, softened) if found))


def section(page: Page, step: ThermalStep, calibration: Calibration) -> None:
    part = page.section("Pads and disc: heat")
    if step.heat is None:
        part.text(
            "No log heats pads or disc: all are the datasheet's nominal values, and the force does not follow temperature. "
            "Needed: braking with thermocouples in the pads."
        )
        return
    part.text(
        "Backing plate, pad, disc, pad, backing plate as one implicit chain (thesis 7.4 to 8.2). Known torque uses the rig's "
        "brake torque sensor; without it the heat comes from the estimated force and the friction map, as in a car."
    )
    numbers = [key for key in keys(calibration) if key.startswith("thermal.") and not key.startswith("thermal.friction.")]
    rows = [[key, with_sigma(value_of(calibration, key), step.sigmas.get(key))] for key in numbers]
    part.table(["parameter", "value"], rows)
    part.items([*step.notes, *filter(None, [words(step)])])
    for name, found in step.temperatures.items():
        part.heading(f"Temperatures: {name}")
        part.figure(time_figure(_panels(found)))
    for module, found in ((cooling, step.law), (friction, step.friction), (softening, step.softening)):
        if found is not None:
            module.figure(part, found)
    part.table(["figure on logs that fitted nothing", "value"], [[k, f"{v:.3g}"] for k, v in step.figures.items()])
    part.table(["residual of what was fitted", "value"], [[k, f"{v:.3g}"] for k, v in step.residuals.items()])


def _panels(found: Temperatures) -> list[Panel]:
    time, colours, grey = found.time_s, shades(4)[::-1], Style("#b3bcc7", 2.2)
    panels = []
    for name, rows in (("Inner pad", range(4)), ("Outer pad", range(4, 8))):
        traces = [Trace("measured", time, found.measured[row], grey) for row in rows]
        for row, colour, depth in zip(rows, colours, DEPTHS_M, strict=True):
            traces.append(Trace(f"{1e3 * depth:g} mm", time, found.known[row], Style(colour, 1.2)))
        panels.append(Panel(f"{name}, torque known", "°C", traces, 230))
    disc = [Trace("measured", time, found.measured[8], grey), Trace("model", time, found.known[8], MODEL)]
    errors = [
        Trace(name, time, np.array([rmse(error) for error in (modelled[:8] - found.measured[:8]).T]), style)
        for name, modelled, style in (("no torque sensor", found.unknown, PALE), ("torque known", found.known, MODEL))
    ]
    error = Panel("Error, RMS over the eight thermocouples", "K", errors, 180)
    return [*panels, Panel("Disc", "°C", disc, 180), error]
