"""A rig campaign's logs: read once, checked for what their part needs, and left out with a message when they do not have
it."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from emb_daemon.calibration.fields import Struct
from emb_daemon.calibration.strict_yaml import load_yaml
from emb_daemon.errors import InputError, InputErrors
from emb_daemon.identify.campaign_file import CampaignFile, Datasheet, DiscCooling, Recording, Training
from emb_daemon.jit import njit
from emb_daemon.logs.currents import other_motor
from emb_daemon.logs.read import read_with_digest
from emb_daemon.offline import Log, corner_index, load_log
from emb_daemon.resources import resource
from emb_daemon.wire.layout import load_database

#: Bounds of the turning points of the motor angle per second of motion: of a slow clamp, and of random motion.
SLOW, RANDOM = (0.0, 1.0), (1.0, 100.0)
NEED_RANDOM = "random motor angle from the released position to a tenth of the rated force or more"
NEED_INTEGRATED = "training and braking heat at full frame rate"
#: A log has full frame rate with two seconds of samples that are no further apart than 1.025 cycles, s. Share of the rated
#: force that a log must reach to identify a curve.
_LEAST_SAMPLES, _LONGEST_CYCLE_S, _LEAST_FORCE = 500, 0.0041, 0.1
#: Share of the rated force that no brake reaches: its motor or its screw ends before. A thousandth of a log's values may
#: exceed it, since sensors have outliers.
_IMPOSSIBLE, _OUTLIERS = 2.0, 1e-3
#: Correlation of force and angle below minus which the sign of one is wrong; curves have 0.9 and more.
_AGAINST = 0.5
#: Samples with a reference force before which the motor has not left its place: 80 ms.
_AT_REST = 20
#: Relative difference of a disc's speed from the campaign's at which a log is another one.
_SPEED_TOLERANCE = 0.2


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


def _excitation(log: Log, clearance_rad: float) -> tuple[float, bool, float]:
    """How much a log moves the brake; ``clearance_rad`` is the datasheet's, of which the first half is certainly free of
    contact. Returns (largest reference force in N, whether there are some before the pads first touch, turning points of the
    motor angle by more than a twentieth of its travel per second of motion)."""
    angle, force = log.samples["angle"], log.force_N
    travel = float(np.ptp(angle))
    reversals = _turning_points(angle, max(travel / 20.0, 1e-6)) if travel > 0.0 else 0
    moving = float(np.sum(log.samples["dt"][1:][np.diff(angle) != 0.0]))
    left = np.flatnonzero(angle - angle[0] > 0.5 * clearance_rad)
    known = np.isfinite(force)
    rests = len(left) > 0 and np.sum(known[: left[0]]) > _AT_REST
    return float(force[known].max()), bool(rests), reversals / moving if moving > 0.0 else 0.0


def _runs_against(log: Log) -> bool:
    """Whether the force falls with rising motor angle, which no clamping brake's does."""
    known = np.isfinite(log.force_N)
    angle, force = log.samples["angle"][known], log.force_N[known]
    return bool(np.ptp(angle) > 0.0 and np.ptp(force) > 0.0 and np.corrcoef(angle, force)[0, 1] < -_AGAINST)


@dataclass
class Campaign:
    """A campaign with its logs; ``faults`` gets one line for each log that cannot be used and each value that contradicts the
    datasheet."""

    path: Path
    file: CampaignFile
    datasheet: Datasheet
    #: What reads a log's FRAME array and digest: `logs.read.read_with_digest`, or a mapping's for another rig's logs.
    read: Callable[[Path], tuple[np.ndarray, str]] = read_with_digest
    faults: list[str] = field(default_factory=list)
    #: Logs used, by name in the campaign: SHA-256 of the file.
    sources: dict[str, str] = field(default_factory=dict)
    _logs: dict[str, Log | InputError] = field(default_factory=dict, repr=False)
    _reference_late_s: float = 0.0

    @property
    def pad_thickness_mm(self) -> float:
        """Of the pads that the calibration is for."""
        return self.file.pad_thickness_mm or self.datasheet.pad.thickness_mm

    def thickness(self, entry: Recording | Training) -> float:
        """Pad thickness of an entry in mm; the campaign's where it states none."""
        return entry.pad_thickness_mm or self.pad_thickness_mm

    def move_reference(self, late_s: float) -> None:
        """Have every log with the reference force at its own time, which came ``late_s`` after the resolver's."""
        self._reference_late_s = late_s
        self._logs = {name: self._in_time(log) for name, log in self._logs.items()}

    def fault(self, text: str) -> None:
        if text not in self.faults:
            self.faults.append(text)

    def compare_with_datasheet(self, key: str, value: float) -> None:
        """Report a value beyond the datasheet's tolerance: more often it is a wrong unit or sensor gain than an unusual
        motor."""
        stated, tolerance = self.datasheet.stated(key)
        if abs(value / stated - 1.0) > tolerance:
            self.fault(
                f"{key}: identified {value:.4g}, datasheet {stated:.4g} within {100.0 * tolerance:g} %: "
                "check scale and sign of current, force and angle"
            )

    def _in_time(self, log: Log | InputError) -> Log | InputError:
        late_s = self._reference_late_s
        return log.with_reference_earlier(late_s) if late_s and isinstance(log, Log) else log

    def _read(self, name: str) -> Log:
        def read(path):
            frames, self.sources[name] = self.read(path)
            return frames

        if name not in self._logs:
            try:
                self._logs[name] = self._in_time(load_log(self.path.parent / name, self.file.corner, read))
            except InputError as error:
                self._logs[name] = error
        if isinstance(found := self._logs[name], InputError):
            self.sources.pop(name, None)
            raise found
        return found

    def load(self, name: str | None, part: str, need: str) -> Log | None:
        """A log; None without a name, or after a message why it cannot be used as ``part`` and what is needed."""
        if name is None:
            return None
        try:
            log = self._read(name)
        except InputError as error:
            self.fault(f"{part}: {error}; needed: {need}; left out")
            return None
        if not np.isfinite(log.force_N).any():
            self.fault(
                f"{part}: {log.path}: holds no reference clamp force (RIG_{log.corner}_Force); needed: {need}; left out"
            )
            return None
        rated_N = self.datasheet.actuator.rated_clamp_force_N
        reached_N = float(np.nanquantile(log.force_N, 1.0 - _OUTLIERS))
        if reached_N > _IMPOSSIBLE * rated_N:
            self.fault(
                f"{part}: {log.path}: the reference force reaches {1e-3 * reached_N:.3g} kN, which no brake of "
                f"{1e-3 * rated_N:.3g} kN does: jammed, or in another unit; needed: {need}; left out"
            )
            return None
        return log

    def load_cooling(self, entry: DiscCooling) -> Log | None:
        """A log of disc cooling, if its disc turns as fast as the campaign says."""
        part, need = "thermal.disc_cooling", "a hot disc released at constant speed, with its thermocouple"
        log = self.load(entry.log, part, need)
        if log is None:
            return None
        speed = log.slow.wheel_speed[f"WheelSpeed{log.corner}"]
        # In the second half the brake is released.
        turns = float(np.median(speed[len(speed) // 2 :])) / (2.0 * np.pi) if len(speed) else np.nan
        if not abs(turns - entry.disc_turns_per_s) <= max(_SPEED_TOLERANCE * entry.disc_turns_per_s, 0.1):
            expected = f"{entry.disc_turns_per_s:g} turns per second in its second half, found {turns:.2g}"
            self.fault(f"{part}: {log.path}: disc_turns_per_s: expected {expected}; needed: {need}; left out")
            return None
        return log

    def load_motion(self, name: str, part: str, need: str, *, reversals: tuple[float, float]) -> Log | None:
        """A log in which the motor moves at full frame rate, checked for enough force and for how often it turns.

        ``reversals`` bounds the turning points per second of motion that tell a slow clamp from random motion."""
        log = self.load(name, part, need)
        if log is None:
            return None
        actuator = self.datasheet.actuator
        force_N, rests, reversals_per_s = _excitation(log, actuator.pad_clearance_rad)
        cycle = float(np.median(log.samples["dt"][1:])) if len(log.samples) > 1 else np.inf
        lacking = None
        if len(log.samples) < _LEAST_SAMPLES or cycle > _LONGEST_CYCLE_S:
            apart = float(np.median(np.diff(log.time_s))) if len(log.samples) > 1 else np.inf
            lacking = f"{len(log.samples)} samples, one every {1e3 * apart:.0f} ms"
            if cycle > _LONGEST_CYCLE_S:
                lacking += ", and the way between two is unknown; expected 100 Hz or a slower motion"
            else:
                lacking += f"; expected {_LEAST_SAMPLES} of them, two seconds"
        elif not force_N > _LEAST_FORCE * actuator.rated_clamp_force_N:
            lacking = f"clamp force reaches only {1e-3 * force_N:.2f} kN of {1e-3 * actuator.rated_clamp_force_N:.0f} kN"
        elif _runs_against(log):
            lacking = "the force falls where the motor angle rises: turn the angle round (`scale: -1` of the mapping)"
        elif not rests:
            lacking = "does not begin with the motor at rest in the released position"
        elif not reversals[0] <= reversals_per_s <= reversals[1]:
            lacking = (
                f"motor turns round {reversals_per_s:.2f} times per second, "
                f"expected {reversals[0]:g} to {reversals[1]:g}: a log of another kind"
            )
        if lacking:
            motor = actuator.motor_torque_constant_Nm_per_A, actuator.lumped_inertia_kg_m2
            lacking = "; ".join([lacking, *other_motor(log.samples, *motor)])
            self.fault(f"{part}: {self.path.parent / name}: {lacking}; needed: {need}; left out")
            return None
        return log


def _check_dbc(path: Path, corner: str) -> None:
    """Refuse a rig whose bus has another layout than the daemon's, because its logs would be misread without notice."""
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


def _missing(value, folder: Path, key: str = "") -> list[str]:
    """A line for each log that is named but does not exist."""
    if isinstance(value, tuple):
        return [line for number, entry in enumerate(value) for line in _missing(entry, folder, f"{key}[{number}]")]
    if isinstance(value, Struct):
        fields = value.__struct_fields__
        return [line for name in fields for line in _missing(getattr(value, name), folder, f"{key}.{name}".strip("."))]
    is_log = isinstance(value, str) and key.rpartition(".")[2] not in ("rig", "corner", "dbc", "datasheet")
    return [f"{key}: {folder / value}: no such file"] if is_log and not (folder / value).is_file() else []


def load_campaign(path: str | Path, read: Callable[[Path], tuple[np.ndarray, str]] = read_with_digest) -> Campaign:
    """Read a campaign and its datasheet; no log is read yet. ``read`` as in `Campaign`. Raises InputErrors: every fault of
    either file with line and key; every log that is not there. Raises InputError: a file that the campaign needs is missing,
    or the corner is none."""
    path = Path(path)
    file = load_yaml(path, CampaignFile)
    corner_index(file.corner)
    datasheet = load_yaml(path.parent / file.datasheet, Datasheet)
    if missing := _missing(file, path.parent):
        raise InputErrors([f"{path}: {line}" for line in missing])
    if file.dbc is not None:
        _check_dbc(path.parent / file.dbc, file.corner)
    return Campaign(path, file, datasheet, read)
