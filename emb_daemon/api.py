"""The estimator for Python programs: over logs, and inside a control loop of your own.

import emb_daemon

log = emb_daemon.load_log("stop.log.gz")
estimates = emb_daemon.run(log)
estimates["force"], estimates["sigma"]          # N, one value per resolver sample
"""

from math import isfinite
from pathlib import Path
from typing import NamedTuple

import numpy as np

from emb_daemon.calibration.files import load_calibration, shipped_calibration
from emb_daemon.calibration.types import Calibration, to_parameters
from emb_daemon.errors import InputError
from emb_daemon.estimator.answer import answer
from emb_daemon.estimator.records import ESTIMATE, SAMPLE, new_state
from emb_daemon.estimator.status import names
from emb_daemon.estimator.step import SILENCE_S
from emb_daemon.logs.mapping import Mapping as Mapping
from emb_daemon.logs.resample import filled, frames_of
from emb_daemon.logs.series import Series
from emb_daemon.logs.stamps import LATEST_S, in_time
from emb_daemon.logs.write import reference_columns, table_columns
from emb_daemon.offline import Log, corner_index, estimate, log_of
from emb_daemon.offline import load_log as load_log
from emb_daemon.wire import contract

_NAN = float("nan")


class Answer(NamedTuple):
    """One estimate: force and its standard deviation in N, source and mode, pad temperatures in degC (NaN before they are
    known), the reasons not to trust it, and the facts from which they follow (`estimator.status.TABLE`)."""

    force_N: float
    sigma_N: float
    source: str
    mode: str
    stiffness_force_N: float
    torque_force_N: float
    contact_angle_rad: float
    stiffness_factor: float
    inner_surface_C: float
    inner_mean_C: float
    outer_surface_C: float
    outer_mean_C: float
    reasons: tuple[str, ...]
    facts: tuple[str, ...]


def run(log: Log, calibration: Calibration | str | Path | None = None) -> np.ndarray:
    """Estimates of a log as the daemon would have made them, one row per resolver sample.

    Args:
        calibration: a calibration or the path of a file; None: `shipped_calibration`.

    Returns:
        Structured array (`estimator.records.ESTIMATE`), shape (samples,): ``force``, ``sigma``, ``stiffness_force``,
        ``torque_force`` in N, ``contact_angle`` in rad, ``surface``, ``mean`` (n, 2) and ``depth`` (n, 2, 4) in degC for the
        inner and the outer pad, ``disc`` in degC, ``stiffness_factor``, ``mode``, ``source``, ``reasons``. Times are
        ``log.time_s``, reference forces ``log.force_N``.

    Raises:
        InputErrors: the calibration file is faulty.
    """
    return estimate(log.samples, to_parameters(_calibration(calibration)))


def table(log: Log, estimates: np.ndarray) -> dict[str, np.ndarray]:
    """Columns by name, with units in the names: the columns that `replay` writes, and the log's reference signals.

    ``pandas.DataFrame(table(...))``, ``polars.DataFrame(table(...))`` and ``pyarrow.table(table(...))`` accept it.

    Args:
        estimates: of `run`, shape (samples,).

    Raises:
        InputError: the estimates belong to another log.
    """
    if len(estimates) != len(log.samples):
        raise InputError(f"estimates: expected {len(log.samples)}, one for each sample of {log.path}, found {len(estimates)}")
    return table_columns(estimates, log.time_s) | reference_columns(log.reference, log.time_ns, log.force_N)


#: Arguments of `log_of_arrays`: message and signal of ours.
_ARRAYS = {
    "angle_rad": ("EMB_{}_Resolver", "MotorAngle"),
    "speed_rad_per_s": ("EMB_{}_Resolver", "MotorSpeed"),
    "current_A": ("EMB_{}_Current", "CurrentQ"),
    "inner_backplate_C": ("EMB_{}_Thermocouple", "InnerBackplateTemp"),
    "outer_backplate_C": ("EMB_{}_Thermocouple", "OuterBackplateTemp"),
    "caliper_C": ("EMB_{}_Thermocouple", "CaliperTemp"),
    "wheel_speed_rad_per_s": ("VEH_WheelSpeed", "WheelSpeed{}"),
    "wheel_pulse": ("VEH_WheelPulse", "WheelPulse{}"),
    "sensor_force_N": ("EMB_{}_ForceSensor", "SensorForce"),
    "force_N": ("RIG_{}_Force", "ClampForceRef"),
    "brake_torque_Nm": ("RIG_{}_Force", "BrakeTorqueRef"),
}


def log_of_arrays(
    time_s: np.ndarray,
    angle_rad: np.ndarray | None = None,
    speed_rad_per_s: np.ndarray | None = None,
    current_A: np.ndarray | None = None,
    *,
    current_mean_s: float | None = None,
    ambient_C: float = 20.0,
    corner: str = "FL",
    **columns: np.ndarray | float,
) -> Log:
    """Measurements of any sampling rate as a log for `run`, resampled to the daemon's rate as with a mapping file.

    Args:
        time_s: of each sample, shape (n,). Samples that were recorded twice are left out, and stamps that come in bunches are
            spread evenly, as for a file; a note on stderr says so.
        angle_rad: motor angle, multi-turn, any zero; if None, the integral of the speed.
        speed_rad_per_s: motor speed; if None, the derivative of the angle.
        current_A: torque-producing current; None if it was not measured.
        current_mean_s: time before its sample over which the current is a mean; None: the sampling period; 0: the current is
            instantaneous.
        ambient_C: as in `Estimator.step`; the park brake counts as released.
        columns: ``inner_backplate_C``, ``outer_backplate_C``, ``caliper_C``, ``wheel_speed_rad_per_s``, ``wheel_pulse``,
            ``sensor_force_N`` of a force sensor of low range that the calibration has, and of reference instruments
            ``force_N``, ``brake_torque_Nm``; arrays of shape (n,), with NaN where nothing was
            measured, or constants. If only one backing plate is given, it is used for both.

    Raises:
        InputError: neither angle nor speed, an unknown column, another number of values than times, no backing plate, times
            that go back by more than a second, are all the same, or are not numbers.
    """
    corner_index(corner)
    columns |= {"angle_rad": angle_rad, "speed_rad_per_s": speed_rad_per_s, "current_A": current_A}
    stamps, rows = _in_time(np.asarray(time_s, float), columns)
    messages = {"VEH_Status": {"AmbientTemp": ambient_C, "ParkBrake": 0.0, "BrakeRequest": 0.0, "VehicleSpeed": 0.0}}
    for name, values in columns.items():
        if name not in _ARRAYS:
            raise InputError(f"{name}: no such column; expected one of {', '.join(_ARRAYS)}")
        if values is None:
            continue
        message, signal = (part.format(corner) for part in _ARRAYS[name])
        source = float(values) if np.ndim(values) == 0 else Series.of(stamps, np.asarray(values, float)[rows])
        if name == "current_A" and isinstance(source, Series):
            source = source.averaged(None if current_mean_s is None else 1e9 * current_mean_s)
        messages.setdefault(message, {})[signal] = source
    if not isinstance(angle_rad if angle_rad is not None else speed_rad_per_s, np.ndarray | list | tuple):
        raise InputError("angle_rad, speed_rad_per_s: expected at least one of them")
    thermocouple = messages.get(f"EMB_{corner}_Thermocouple", {})
    if set(thermocouple) == {"CaliperTemp"}:
        raise InputError("caliper_C: expected inner_backplate_C or outer_backplate_C as well")
    return log_of(frames_of(filled(messages)), corner, Path("arrays"))


def _in_time(time_s: np.ndarray, columns: dict) -> tuple[np.ndarray, np.ndarray]:
    """`in_time` of times in s and of the values measured at them."""
    measured = {name: np.asarray(values, float) for name, values in columns.items() if values is not None and np.ndim(values)}
    for name, values in measured.items():
        if values.shape != time_s.shape:
            raise InputError(
                f"{name}: expected as many values as times, found shape {values.shape} for times of shape {time_s.shape}"
            )
    if not np.all(np.abs(time_s) < LATEST_S):
        raise InputError(f"time_s: {time_s[~(np.abs(time_s) < LATEST_S)][0]:g} is not a time in s")
    return in_time("arrays", np.rint(1e9 * time_s).astype(np.int64), list(measured.values()))


def _calibration(given: Calibration | str | Path | None) -> Calibration:
    if given is None:
        return shipped_calibration()
    return given if isinstance(given, Calibration) else load_calibration(Path(given))


def _known(value: float | None, otherwise: float = _NAN) -> tuple[bool, float]:
    """Whether there is a value, and the value or ``otherwise``; NaN and infinity are none."""
    return (True, value) if value is not None and isfinite(value) else (False, otherwise)


def _answer_of(e: np.void) -> Answer:
    """An ESTIMATE row for programs that know no numpy."""
    return Answer(
        force_N=float(e["force"]),
        sigma_N=float(e["sigma"]),
        source=contract.SOURCES[int(e["source"])],
        mode=contract.MODES[int(e["mode"])],
        stiffness_force_N=float(e["stiffness_force"]),
        torque_force_N=float(e["torque_force"]),
        contact_angle_rad=float(e["contact_angle"]),
        stiffness_factor=float(e["stiffness_factor"]),
        inner_surface_C=float(e["surface"][0]),
        inner_mean_C=float(e["mean"][0]),
        outer_surface_C=float(e["surface"][1]),
        outer_mean_C=float(e["mean"][1]),
        reasons=contract.reason_words(e["reasons"]),
        facts=names(e["facts"]),
    )


#: Fields of a SAMPLE that say whether an input is there, and the reason if it is not.
_LOST = {
    "has_current": contract.CURRENT_LOST,
    "has_thermocouple": contract.THERMOCOUPLE_LOST,
    "has_wheel_speed": contract.WHEEL_SPEED_LOST,
    "has_wheel_pulse": contract.WHEEL_PULSE_LOST,
}


class Estimator:
    """One corner's estimator, for a program that has its own bus, clock or simulation.

    It is the daemon's estimator: the same inputs give the same estimates. The first call compiles, or loads from the cache;
    later calls take some microseconds.
    """

    def __init__(self, calibration: Calibration | str | Path | None = None):
        """``calibration`` as in `run`."""
        self._parameters = np.atleast_1d(to_parameters(_calibration(calibration)))
        self.reset()
        self._sample = np.zeros(1, SAMPLE)
        self._estimate = np.zeros(1, ESTIMATE)
        self._sample["brake_torque"] = np.nan

    def reset(self) -> None:
        """Return to the initial state: the next call counts as the first."""
        self._state = new_state()

    def step(
        self,
        angle_rad: float,
        speed_rad_per_s: float,
        current_A: float | None = None,
        *,
        dt_s: float = contract.CYCLE_S,
        backplates_C: tuple[float, float] | None = None,
        caliper_C: float | None = None,
        ambient_C: float = 20.0,
        wheel_speed_rad_per_s: float | None = None,
        wheel_pulse: float | None = None,
        vehicle_speed_m_per_s: float = 0.0,
        sensor_force_N: float | None = None,
    ) -> Answer:
        """Take one sample and return its estimate.

        Args:
            angle_rad: motor angle at the sample, multi-turn, any zero. For the first 0.1 s the pads must be released and the
                motor must stand; otherwise the contact is unknown until both are seen.
            speed_rad_per_s: motor speed at the sample.
            current_A: torque-producing current, mean over the 4 ms before the sample; None if it is missing.
            dt_s: time since the last sample; ignored at the first call. After more than 0.1 s, and more than usual, an angle
                that has moved may count from another zero: the contact is then unknown as at the start.
            backplates_C: inner and outer backing plate; None if unknown, and the pads' temperatures then stay unknown.
            caliper_C: if None, the mean of the backing plates is used.
            wheel_speed_rad_per_s, wheel_pulse: speed of the disc, and 96 counts per turn modulo 4096; None if unknown.
            sensor_force_N: of a force sensor of low range at the sample; counts where the calibration has one.

        An argument that may be None may also be NaN or infinite; both mean missing.

        Raises:
            ValueError: another argument is not finite, or ``dt_s`` is not above zero. The state is then unchanged.
        """
        required = {"angle_rad": angle_rad, "speed_rad_per_s": speed_rad_per_s, "dt_s": dt_s, "ambient_C": ambient_C}
        for name, value in (required | {"vehicle_speed_m_per_s": vehicle_speed_m_per_s}).items():
            if not isfinite(value):
                raise ValueError(f"{name} = {value}: expected a finite number")
        if dt_s <= 0.0:
            raise ValueError(f"dt_s = {dt_s}: expected a time above zero")
        row = self._sample[0]
        row["dt"] = dt_s if self._state["started"][0] else 0.0
        row["angle"], row["speed"], row["was_silent"] = angle_rad, speed_rad_per_s, dt_s > SILENCE_S
        row["has_current"], row["current_q"] = _known(current_A)
        row["has_sensor_force"], row["sensor_force"] = _known(sensor_force_N)
        row["has_thermocouple"] = backplates_C is not None and all(map(isfinite, backplates_C))
        inner, outer = backplates_C if row["has_thermocouple"] else (_NAN, _NAN)
        row["inner_backplate"], row["outer_backplate"] = inner, outer
        row["caliper"] = _known(caliper_C, 0.5 * (inner + outer))[1]
        row["has_status"], row["ambient"], row["vehicle_speed"] = True, ambient_C, vehicle_speed_m_per_s
        row["has_wheel_speed"], row["wheel_speed"] = _known(wheel_speed_rad_per_s, 0.0)
        row["has_wheel_pulse"], row["wheel_pulse"] = _known(wheel_pulse, 0.0)
        row["reasons"] = sum(reason for known, reason in _LOST.items() if not row[known])
        answer(self._sample, 1, self._state, self._parameters, self._estimate)
        return _answer_of(self._estimate[0])
