"""What heats and cools the pads of a log, on an even grid, and the estimator's heat chain run over it."""

from dataclasses import dataclass

import numpy as np

from emb_daemon.effects import paths as effects
from emb_daemon.effects.terms import SIGNALS
from emb_daemon.errors import InputError
from emb_daemon.estimator.heat import TOUCHING_N, conduct
from emb_daemon.estimator.records import DEPTHS_M, SAMPLE, STATE
from emb_daemon.jit import njit
from emb_daemon.models.thermal import LONGEST_S, at_depth, friction_power, mean_temperature
from emb_daemon.models.wheel import TURNING_RAD_PER_S
from emb_daemon.offline.log import Log

#: (longest duration of a log, step of its grid), both s.
_STEPS_S = ((930.0, 0.2), (3600.0, 0.5), (float("inf"), 1.0))
#: Share of steps with a reference force that often from which a friction coefficient is computed.
_DENSE = 0.9
#: Fine grid on which flags and torque are combined before they are averaged over a step, s.
_FINE_S = 0.1
#: Period of the reference force, s, up to which it says when the pads touch; otherwise the brake request does.
_OFTEN_S = 0.25
#: Time over which backing plate readings are averaged, s: the plates change slowly.
_PLATE_WINDOW_S = 1.0
#: Steps above this length, s, of logs that last for hours, are not divided further.
_COARSE_S = 0.5


@dataclass(frozen=True)
class Recording:
    """What heats and cools the pads, on an even grid, and what was measured in them.

    Arrays have shape (n,) unless stated; temperatures in degC. Means hold for the step that starts at their row."""

    name: str
    step_s: float  #: grid
    #: ``inner`` and ``outer``: backing plates; the air, where nothing of the pads was measured.
    inner: np.ndarray
    outer: np.ndarray
    ambient: np.ndarray
    power: np.ndarray  #: mean friction power, W, from the brake torque sensor
    touching: np.ndarray  #: pads press on the disc
    speed: np.ndarray  #: mean wheel speed, rad/s
    force: np.ndarray  #: mean reference clamp force, N
    measured: np.ndarray  #: shape (9, n): inner pad at 2, 4, 6, 8 mm, outer pad at the same, disc; NaN where there is none
    dense: bool  #: force and torque were recorded often enough for a friction coefficient at each row

    @property
    def time_s(self) -> np.ndarray:
        return self.step_s * np.arange(len(self.power))

    @property
    def has_pads(self) -> bool:
        """Whether anything was measured in the pads; of a disc alone nobody knows how warm they are, and a few per cent of
        the heat are theirs."""
        return bool(np.isfinite(self.measured[:8]).any())

    @property
    def disc_C(self) -> float:
        """The disc's temperature at the start: that of plates that have cooled with it, else its own."""
        own = self.measured[8][np.isfinite(self.measured[8])]
        return 0.5 * (self.inner[0] + self.outer[0]) if self.has_pads or not len(own) else float(own[0])


def _mean_between(start: np.ndarray, end: np.ndarray, times: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Mean of straight lines between (times, values), held at the ends, over each [start, end]."""
    times, values = (
        np.concatenate([[min(start[0], times[0]) - 1.0], times, [max(end[-1], times[-1]) + 1.0]]),
        np.concatenate([values[:1], values, values[-1:]]),
    )
    area = np.concatenate([[0.0], np.cumsum(0.5 * (values[1:] + values[:-1]) * np.diff(times))])

    def integral(t):
        index = np.clip(np.searchsorted(times, t, side="right") - 1, 0, len(times) - 2)
        elapsed = t - times[index]
        slope = (values[index + 1] - values[index]) / np.maximum(times[index + 1] - times[index], 1e-12)
        return area[index] + elapsed * (values[index] + 0.5 * slope * elapsed)

    return (integral(end) - integral(start)) / (end - start)


def recording(log: Log) -> Recording:
    """Inputs and thermocouples of a log on an even grid.

    Motor frames of thermal logs are rare, so that vehicle and thermocouple frames are taken at their own rate: a brake
    application that ends a second late would heat the disc by degrees. Raises InputError: no wheel speed, force or torque in
    the log, a torque beyond its number, no temperature of pads or disc, or of pads without their backing plates."""
    reference, slow = log.reference, log.slow
    channels = [(stamps, row) for stamps, depths in (reference.pads["inner"], reference.pads["outer"]) for row in depths]
    channels.append((reference.time_ns, reference.disc_C))
    channels = [(stamps[np.isfinite(row)], row[np.isfinite(row)]) for stamps, row in channels]
    has_plates = len(slow.thermocouples["time_ns"]) > 1
    _check(log, channels, has_plates)

    def seconds(time_ns):
        return 1e-9 * (time_ns - log.time_ns[0])

    duration = min(log.time_s[-1], next(seconds(stamps[-1]) for stamps, _ in channels if len(stamps)))
    step = next(step_s for longest_s, step_s in _STEPS_S if duration < longest_s)
    count = int(duration / step)
    if count < 10:
        raise InputError(f"{log.path}: {duration:.0f} s long; at least {10 * step:.0f} s are needed to identify heat")
    grid, window = step * np.arange(count), max(_PLATE_WINDOW_S, step)

    ambient = np.interp(grid, seconds(slow.status["time_ns"]), slow.status["AmbientTemp"])

    def plate(name):
        if not has_plates:
            return ambient
        times = seconds(slow.thermocouples["time_ns"])
        return _mean_between(grid - 0.5 * window, grid + 0.5 * window, times, slow.thermocouples[name])

    measured = np.full((9, count), np.nan)
    for row, (stamps, values) in enumerate(channels):
        if len(stamps) > 1:
            measured[row] = np.interp(grid, seconds(stamps), values)
    power, touching, speed, force, often = _braking(log, seconds, count, step)
    return Recording(
        name=str(log.path),
        step_s=step,
        inner=plate("InnerBackplateTemp"),
        outer=plate("OuterBackplateTemp"),
        ambient=ambient,
        power=power,
        touching=touching > 0.5,
        speed=speed,
        force=force,
        measured=measured,
        dense=bool(np.mean(often) > _DENSE),
    )


def _check(log: Log, channels: list[tuple[np.ndarray, np.ndarray]], has_plates: bool) -> None:
    most = max(len(stamps) for stamps, _ in channels[:8])
    for what, times in (
        ("temperature of pads or disc", channels[8][0] if most < 2 else range(most)),
        ("backing plate temperatures", range(2) if has_plates or most < 2 else ()),
        ("wheel speeds", log.slow.wheel_speed["time_ns"]),
        ("vehicle status", log.slow.status["time_ns"]),
        ("reference clamp force", log.reference.clamp_force_N[np.isfinite(log.reference.clamp_force_N)]),
        ("reference brake torque", log.reference.brake_torque_Nm[np.isfinite(log.reference.brake_torque_Nm)]),
    ):
        if len(times) < 2:
            raise InputError(f"{log.path}: no {what}; needed to identify heat")
    if log.full_torque:
        raise InputError(f"{log.path}: {log.full_torque}; a torque within it is needed to identify heat")


def _braking(log: Log, seconds, count: int, step: float) -> np.ndarray:
    """Friction power (W), whether pads touch (0 to 1), wheel speed (rad/s), clamp force (N) and whether force was recorded
    often, each a mean over the steps; shape (5, count)."""
    per_step = max(round(step / _FINE_S), 1)
    fine = np.arange(count * per_step) * (step / per_step)
    middle = fine + 0.5 * step / per_step
    reference, slow = log.reference, log.slow
    times, wheel_times = seconds(reference.time_ns), seconds(slow.wheel_speed["time_ns"])
    speeds = slow.wheel_speed[f"WheelSpeed{log.corner}"]
    force = np.interp(middle, times, reference.clamp_force_N)
    often = np.interp(middle, 0.5 * (times[1:] + times[:-1]), np.diff(times)) <= _OFTEN_S
    speed = _mean_between(fine, fine + step / per_step, wheel_times, speeds)
    turning = speed > TURNING_RAD_PER_S
    latest = np.clip(np.searchsorted(seconds(slow.status["time_ns"]), middle) - 1, 0, None)
    requested = slow.status["BrakeRequest"][latest] > 0.5
    # The request is also set at standstill, where only the force shows whether the pads touch.
    touching = np.where(often | ~turning, force > TOUCHING_N, requested)
    torque = np.interp(middle, times, reference.brake_torque_Nm)
    pressed = (reference.clamp_force_N > TOUCHING_N) & (np.interp(times, wheel_times, speeds) > TURNING_RAD_PER_S)
    if pressed.any():
        torque = np.where(often, torque, np.interp(middle, times[pressed], reference.brake_torque_Nm[pressed]))
    power = np.where(touching & turning, np.maximum(torque, 0.0) * speed, 0.0)
    columns = np.array([power, touching, speed, np.maximum(force, 0.0), often], float)
    return columns.reshape(5, count, per_step).mean(axis=2)


@njit
def _simulate(parameters, states, samples, step, longest, every, disc, inner, outer, ambient, power, known, touching, speed,
              force, out, signals):  # fmt: skip
    p, s, m = parameters[0], states[0], samples[0]
    e, t = p.effects, p.thermal
    s.temperature_known = m.has_wheel_speed = True
    m.dt = step
    s.pads[0, :], s.pads[1, :] = inner[0], outer[0]
    s.disc = disc
    for row in range(len(power)):
        if row > 0:
            _advance(s, p, m, longest, inner[row], outer[row], ambient[row])
        for side in range(2):
            s.mean[side] = mean_temperature(s.pads[side], t.node_position)
        s.touching, s.force, m.wheel_speed = touching[row], force[row], speed[row]
        s.power = power[row]
        if not known:
            surface = 0.5 * (s.pads[0, 0] + s.pads[1, 0])
            rubs = s.touching and m.wheel_speed > TURNING_RAD_PER_S
            fade = effects.pad_friction(e, s.effects, surface)
            s.power = friction_power(t, s.force, m.wheel_speed, surface) * fade if rubs else 0.0
        effects.look(e.terms, s, p, m)
        if len(signals) > 0:
            signals[row] = s.effects.terms.signal
        if row % every == 0:
            into = out[row // every]
            for side in range(2):
                for index in range(len(DEPTHS_M)):
                    into[4 * side + index] = at_depth(s.pads[side], t.node_position, DEPTHS_M[index])
                into[9 + side], into[11 + side] = s.pads[side, 0], s.mean[side]
            into[8] = s.disc


@njit
def _advance(s, p, m, longest, inner, outer, ambient):
    """Over the step that begins at the last row, to plates and ambient as they are at its end, degC."""
    inner, outer = effects.backplates(p.effects, s.effects, inner, outer, m.dt)
    conduct(s, p.thermal, p.effects, inner, outer, ambient, s.power, m.wheel_speed, m.dt, longest)


def simulate(
    parameters: np.void, r: Recording, torque_known: bool = True, every: int = 1, signals: np.ndarray | None = None
) -> np.ndarray:
    """Temperatures (degC, shape (rows, 13): the nine of `Recording.measured`, both pad surfaces, both pad means) by the
    estimator's heat chain, with effects and terms, over a recording, every ``every``-th row; heated by the brake torque sensor
    if ``torque_known``, else by the friction table and the reference force.

    ``signals``, shape (n, signals), is filled with what terms see (`effects.terms.SIGNALS`) at every row; what a recording
    does not hold is zero or no number."""
    own, out = np.atleast_1d(parameters), np.empty((-(-len(r.power) // every), 13))
    if signals is None:
        signals = np.zeros((0, len(SIGNALS)))
    else:
        # Without a term nobody looks.
        own = own.copy()
        own["effects"]["terms"]["count"] = np.maximum(own["effects"]["terms"]["count"], 1)
    longest = LONGEST_S if r.step_s <= _COARSE_S else r.step_s
    records = np.zeros(1, STATE), np.zeros(1, SAMPLE)
    inputs = (r.disc_C, r.inner, r.outer, r.ambient, r.power, torque_known, r.touching, r.speed, r.force)
    _simulate(own, *records, r.step_s, longest, every, *inputs, out, signals)
    return out
