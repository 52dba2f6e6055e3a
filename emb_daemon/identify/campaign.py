"""A rig campaign: which log plays which part, and what the supplier's datasheet says.

Logs are read once, checked for what their part needs, and left out with a word when they cannot serve.
"""

import hashlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
from msgspec import Meta

from emb_daemon.calibration.strict_yaml import load_yaml
from emb_daemon.calibration.types import Positive, Struct
from emb_daemon.errors import InputError, InputErrors
from emb_daemon.jit import njit
from emb_daemon.offline import Log, corner_index, load_log
from emb_daemon.resources import resource
from emb_daemon.wire.layout import load_database


class Trial(Struct, kw_only=True):
    """One log with pads of one thickness."""

    log: str
    pad_thickness_mm: Positive | None = None


class Sine(Struct, kw_only=True):
    """Motor angle a sinusoid."""

    log: str
    frequency_Hz: Positive
    pad_thickness_mm: Positive | None = None


class Adaptation(Struct, kw_only=True):
    """Park brake training without the reference force, judged on another log."""

    training: str
    judge: str
    pad_thickness_mm: Positive | None = None


class Gear(Struct, kw_only=True):
    """One state of wear of the gear."""

    training: str
    judge: str | None = None
    pad_thickness_mm: Positive | None = None


class DiscCooling(Struct, kw_only=True):
    """Heated, then released at constant disc speed."""

    log: str
    disc_turns_per_s: Annotated[float, Meta(ge=0.0)]


class ThermalLogs(Struct, kw_only=True):
    """Second test rig: the disc turns, thermocouples stand in the pads."""

    tune: str | None = None
    validate: str | None = None
    heat_flux_map: str | None = None
    pad_cooling: str | None = None
    disc_cooling: tuple[DiscCooling, ...] = ()


class Integrated(Struct, kw_only=True):
    """Everything together on hot pads."""

    fit: str | None = None
    judge: str | None = None


class CampaignFile(Struct, kw_only=True):
    """CAMPAIGN.yaml. Paths are relative to the file."""

    rig: str
    corner: str = "FL"
    #: The rig's own description of its bus; it must agree with the layout that the daemon reads.
    dbc: str | None = None
    datasheet: str
    #: Of every log that states none, and of the pads that the calibration is for.
    pad_thickness_mm: Positive
    curves: tuple[Trial, ...] = ()
    random: tuple[Trial, ...] = ()
    adaptation: tuple[Adaptation, ...] = ()
    frequency_response: tuple[Sine, ...] = ()
    gear_wear: tuple[Gear, ...] = ()
    thermal: ThermalLogs | None = None
    integrated: tuple[Integrated, ...] = ()


class Actuator(Struct, kw_only=True):
    gear_gain_m_per_rad: Positive
    motor_torque_constant_Nm_per_A: Positive
    lumped_inertia_kg_m2: Positive
    max_motor_speed_rad_per_s: Positive
    rated_clamp_force_N: Positive
    pad_clearance_rad: Positive


class Resolver(Struct, kw_only=True):
    counts_per_revolution: Positive
    angle_is: str = ""


class PadNominal(Struct, kw_only=True):
    thickness_mm: Positive
    frontal_area_m2: Positive
    density_kg_per_m3: Positive
    specific_heat_J_per_kgK: Positive
    conductivity_W_per_mK: Positive


class DiscNominal(Struct, kw_only=True):
    mass_kg: Positive
    specific_heat_J_per_kgK: Positive
    effective_radius_m: Positive
    cooling_area_m2: Positive
    conductivity_W_per_mK: Positive


class Wheel(Struct, kw_only=True):
    pulses_per_revolution: Positive


class Datasheet(Struct, kw_only=True):
    """Nominal values of actuator, pads and disc, as the supplier states them."""

    actuator: Actuator
    resolver: Resolver
    pad: PadNominal
    disc: DiscNominal
    wheel: Wheel | None = None
    friction_coefficient: Positive


@dataclass(frozen=True)
class Excitation:
    """How much a log moves the brake.

    Attributes:
        travel_rad: between the smallest and the largest motor angle.
        reversals_per_s: turning points of the motor angle by more than a twentieth of the travel, per second of motion.
        force_N: largest reference force.
        noise_N: standard deviation of the reference force before the pads first touch.
    """

    travel_rad: float
    reversals_per_s: float
    force_N: float
    noise_N: float


@njit
def _turning_points(angle, threshold):
    count, direction, extreme = 0, 0, angle[0]
    for value in angle:
        if (direction >= 0 and value > extreme) or (direction <= 0 and value < extreme):
            if direction == 0 and abs(value - angle[0]) > threshold:
                direction = 1 if value > angle[0] else -1
            if direction != 0:
                extreme = value
        elif direction != 0 and abs(value - extreme) > threshold:
            count += 1
            direction = -direction
            extreme = value
    return count


def excitation(log: Log, clearance_rad: float) -> Excitation:
    """What a log excites; ``clearance_rad`` is the datasheet's, of which the first half is surely free of contact."""
    angle, force = log.samples["angle"], log.force_N
    travel = float(np.ptp(angle))
    reversals = _turning_points(angle, max(travel / 20.0, 1e-6)) if travel > 0.0 else 0
    moving = float(np.sum(log.samples["dt"][1:][np.diff(angle) != 0.0]))
    left = np.flatnonzero(angle - angle[0] > 0.5 * clearance_rad)
    free = np.isfinite(force) & (np.arange(len(angle)) < (left[0] if len(left) else 0))
    known = force[np.isfinite(force)]
    return Excitation(
        travel_rad=travel,
        reversals_per_s=reversals / moving if moving > 0.0 else 0.0,
        force_N=float(known.max()) if len(known) else np.nan,
        noise_N=float(np.std(force[free])) if free.sum() > 20 else np.nan,
    )


@dataclass
class Campaign:
    """A campaign with its logs; ``faults`` grows by one line for each log or step that could not serve."""

    path: Path
    file: CampaignFile
    datasheet: Datasheet
    faults: list[str] = field(default_factory=list)
    sources: dict[str, str] = field(default_factory=dict)

    def thickness(self, entry) -> float:
        """Pad thickness of an entry in mm; the campaign's where it states none."""
        return entry.pad_thickness_mm or self.file.pad_thickness_mm

    def fault(self, text: str) -> None:
        if text not in self.faults:
            self.faults.append(text)

    def load(self, name: str, part: str, need: str) -> Log | None:
        """A log, or None after a word about why it cannot serve as ``part`` and what was needed."""
        path = self.path.parent / name
        try:
            log = load_log(path, self.file.corner)
        except InputError as error:
            self.fault(f"{part}: {error}; needed: {need}; left out")
            return None
        self.sources[name] = hashlib.sha256(path.read_bytes()).hexdigest()
        if not np.isfinite(log.force_N).any():
            self.fault(f"{part}: {path}: holds no reference clamp force (RIG_{log.corner}_Force); needed: {need}; left out")
            return None
        return log

    def load_motion(self, name: str, part: str, need: str, *, reversals: tuple[float, float]) -> Log | None:
        """A log in which the motor moves at full frame rate, checked for enough force and for how often it turns.

        ``reversals`` bounds the turning points per second of motion that tell a slow clamp from random motion.
        """
        log = self.load(name, part, need)
        if log is None:
            return None
        actuator = self.datasheet.actuator
        found = excitation(log, actuator.pad_clearance_rad)
        cycle = float(np.median(log.samples["dt"][1:])) if len(log.samples) > 1 else np.inf
        lacking = None
        if len(log.samples) < 500 or cycle > 0.0041:
            lacking = f"{len(log.samples)} samples, one every {1e3 * cycle:.0f} ms"
        elif not found.force_N > 0.1 * actuator.rated_clamp_force_N:
            lacking = f"clamp force reaches only {1e-3 * found.force_N:.2f} kN of {1e-3 * actuator.rated_clamp_force_N:.0f} kN"
        elif not np.isfinite(found.noise_N):
            lacking = "does not begin with the brake released"
        elif not reversals[0] <= found.reversals_per_s <= reversals[1]:
            lacking = (
                f"motor turns round {found.reversals_per_s:.2f} times per second, "
                f"expected {reversals[0]:g} to {reversals[1]:g}: a log of another kind"
            )
        if lacking:
            self.fault(f"{part}: {self.path.parent / name}: {lacking}; needed: {need}; left out")
            return None
        return log


def _check_dbc(path: Path, corner: str) -> None:
    """Refuse a rig whose bus is laid out otherwise than the daemon's: its logs would be misread in silence."""
    theirs, ours = load_database(path), load_database(resource("dbc/emb.dbc"))
    names = [f"EMB_{corner}_Resolver", f"EMB_{corner}_Current", f"EMB_{corner}_Thermocouple", "VEH_WheelSpeed", "VEH_Status"]
    faults = []
    for name in names:
        try:
            found, expected = theirs.get_message_by_name(name), ours.get_message_by_name(name)
        except KeyError:
            faults.append(f"{path}: {name}: missing")
            continue
        layouts = [
            (message.frame_id, [(s.name, s.start, s.length, s.is_signed, s.scale, s.offset) for s in message.signals])
            for message in (found, expected)
        ]
        if layouts[0] != layouts[1]:
            faults.append(f"{path}: {name}: expected id, signals and factors as in the daemon's own DBC")
    if faults:
        raise InputErrors(faults)


def load_campaign(path: str | Path) -> Campaign:
    """Read a campaign and its datasheet; no log is read yet.

    Raises:
        InputErrors: every fault of either file with line and key.
        InputError: a file that the campaign needs is missing, or the corner is none.
    """
    path = Path(path)
    file = load_yaml(path, CampaignFile)
    corner_index(file.corner)
    datasheet = load_yaml(path.parent / file.datasheet, Datasheet)
    if file.dbc is not None:
        _check_dbc(path.parent / file.dbc, file.corner)
    return Campaign(path, file, datasheet)
