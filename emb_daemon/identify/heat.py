"""Pads and disc out of logs with thermocouples: the estimator's own heat chain, its parameters by least squares.

Thesis 8.1 tunes conductivity and heat shares by hand on one log, 8.2 takes the disc's cooling from others; here one fit
takes both from all logs, because the pads lend heat to the disc and take it back.
"""

from dataclasses import dataclass

import numpy as np

from emb_daemon.errors import InputError
from emb_daemon.estimator.heat import TOUCHING_N, TURNING_RAD_PER_S
from emb_daemon.estimator.records import DEPTHS_M, THERMAL
from emb_daemon.identify.fitting import Block, least_squares
from emb_daemon.jit import njit
from emb_daemon.logs.columns import Decoder
from emb_daemon.logs.read import read_frames
from emb_daemon.models.thermal import CHAIN, LONGEST_S, NODES, at_depth, friction_power, heat_step, mean_temperature, mesh
from emb_daemon.offline import Log
from emb_daemon.wire.e2e import crc

#: Grid on which flags and torque are put together before they are averaged over a step.
_FINE_S = 0.1
#: A reference force at least this often tells when the pads touch; a rarer one leaves it to the brake request.
_OFTEN_S = 0.25
#: Time over which backing plate readings are averaged: they creep, their noise does not.
_PLATE_WINDOW_S = 1.0
#: Grids beyond this, of logs that last for hours, are stepped whole.
_COARSE_S = 0.5
#: Time between residuals. The model's errors, of the size of a thermocouple's noise (0.3 K), last for about a minute: each
#: residual is worth a twelfth of an independent one, which this standard deviation makes it.
_RESIDUAL_EVERY_S = 5.0
_RESIDUAL_SIGMA_K = 1.0
#: Pads that rise by less tell nothing.
_LEAST_RISE_K = 30.0


@dataclass(frozen=True)
class Nominal:
    """What the datasheet states; where the fits start, and what stays where a log is missing. SI units."""

    pad_thickness_m: float
    pad_area_m2: float
    pad_density_kg_per_m3: float
    pad_specific_heat_J_per_kgK: float
    pad_conductivity_W_per_mK: float
    disc_mass_kg: float
    disc_specific_heat_J_per_kgK: float
    disc_effective_radius_m: float
    disc_cooling_area_m2: float
    disc_conductivity_W_per_mK: float
    friction_coefficient: float


@dataclass(frozen=True)
class Recording:
    """What heats and cools the pads, on an even grid, and what was measured in them.

    Arrays have shape (n,) unless stated; temperatures in degC. Means hold for the step that starts at their row.

    Attributes:
        step_s: grid.
        inner, outer: backing plates.
        power: mean friction power, W, from the brake torque sensor.
        touching: pads press on the disc.
        speed: mean wheel speed, rad/s.
        force: mean reference clamp force, N.
        measured: shape (9, n): inner pad at 2, 4, 6, 8 mm, outer pad at the same, disc; NaN where there is none.
        dense: force and torque were recorded often enough for a friction coefficient at each row.
    """

    name: str
    step_s: float
    inner: np.ndarray
    outer: np.ndarray
    ambient: np.ndarray
    power: np.ndarray
    touching: np.ndarray
    speed: np.ndarray
    force: np.ndarray
    measured: np.ndarray
    dense: bool

    @property
    def time_s(self) -> np.ndarray:
        return self.step_s * np.arange(len(self.power))


@njit
def _sound(frames):
    sound = np.ones(len(frames), np.bool_)
    for row in range(len(frames)):
        if frames[row].can_id < 0x700:
            sound[row] = crc(frames[row].can_id, frames[row].data) == frames[row].data & np.uint64(0xFF)
    return sound


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


def default_step(duration_s: float) -> float:
    """Grid fine enough for what a log of that length does: 0.2 s up to fifteen minutes, 1 s over hours."""
    return 0.2 if duration_s < 930.0 else 0.5 if duration_s < 3600.0 else 1.0


def recording(log: Log, step_s: float | None = None) -> Recording:
    """Inputs and thermocouples of a log on an even grid.

    Motor frames of thermal logs are rare, so that vehicle and thermocouple frames are taken at their own rate: a brake
    application that ends a second late would heat the disc by degrees.

    Raises:
        InputError: no backing plate, wheel speed, force, torque or pad temperature in the log.
    """
    frames = read_frames(log.path)
    frames = frames[_sound(frames)]
    decoder = Decoder()
    origin = log.time_ns[0]
    plates = decoder.columns(frames, f"EMB_{log.corner}_Thermocouple")
    wheels = decoder.columns(frames, "VEH_WheelSpeed")
    status = decoder.columns(frames, "VEH_Status")
    reference = log.reference
    for what, times in (
        ("backing plate temperatures", plates["time_ns"]),
        ("wheel speeds", wheels["time_ns"]),
        ("vehicle status", status["time_ns"]),
        ("reference clamp force and brake torque", reference.time_ns),
        ("pad thermocouples", reference.pads["inner"][0]),
        ("pad thermocouples", reference.pads["outer"][0]),
    ):
        if len(times) < 2:
            raise InputError(f"{log.path}: no {what}; needed to identify heat")

    def seconds(time_ns):
        return 1e-9 * (time_ns - origin)

    duration = min(log.time_s[-1], seconds(reference.pads["inner"][0][-1]))
    step = default_step(duration) if step_s is None else step_s
    per_step = max(round(step / _FINE_S), 1)
    count = int(duration / step)
    if count < 10:
        raise InputError(f"{log.path}: {duration:.0f} s long; at least {10 * step:.0f} s are needed to identify heat")
    fine = np.arange(count * per_step) * (step / per_step)
    middle = fine + 0.5 * step / per_step
    times = seconds(reference.time_ns)
    force = np.interp(middle, times, reference.clamp_force_N)
    spacing = np.interp(middle, 0.5 * (times[1:] + times[:-1]), np.diff(times))
    often = spacing <= _OFTEN_S
    wheel_times, speeds = seconds(wheels["time_ns"]), wheels[f"WheelSpeed{log.corner}"]
    speed = _mean_between(fine, fine + step / per_step, wheel_times, speeds)
    turning = speed > TURNING_RAD_PER_S
    latest = np.clip(np.searchsorted(seconds(status["time_ns"]), middle) - 1, 0, None)
    requested = status["BrakeRequest"][latest] > 0.5
    # The request also covers clamping at standstill, for which only the force tells.
    touching = np.where(often | ~turning, force > TOUCHING_N, requested)
    torque = np.interp(middle, times, reference.brake_torque_Nm)
    pressed = (reference.clamp_force_N > TOUCHING_N) & (np.interp(times, wheel_times, speeds) > TURNING_RAD_PER_S)
    if pressed.any():
        torque = np.where(often, torque, np.interp(middle, times[pressed], reference.brake_torque_Nm[pressed]))
    power = np.where(touching & turning, np.maximum(torque, 0.0) * speed, 0.0)

    def averaged(values):
        return values.reshape(count, per_step).mean(axis=1)

    grid = step * np.arange(count)
    window = max(_PLATE_WINDOW_S, step)

    def plate(values):
        return _mean_between(grid - 0.5 * window, grid + 0.5 * window, seconds(plates["time_ns"]), values)

    measured = np.full((9, count), np.nan)
    for side, name in enumerate(("inner", "outer")):
        stamps, depths = reference.pads[name]
        for row in range(4):
            known = np.isfinite(depths[row])
            if known.sum() > 1:
                measured[4 * side + row] = np.interp(grid, seconds(stamps)[known], depths[row][known])
    known = np.isfinite(reference.disc_C)
    if known.sum() > 1:
        measured[8] = np.interp(grid, times[known], reference.disc_C[known])
    return Recording(
        name=str(log.path),
        step_s=step,
        inner=plate(plates["InnerBackplateTemp"]),
        outer=plate(plates["OuterBackplateTemp"]),
        ambient=np.interp(grid, seconds(status["time_ns"]), status["AmbientTemp"]),
        power=averaged(power),
        touching=averaged(touching) > 0.5,
        speed=averaged(speed),
        force=averaged(np.maximum(force, 0.0)),
        measured=measured,
        dense=bool(np.mean(often) > 0.9),
    )


@njit
def _simulate(parameters, step, longest, every, inner, outer, ambient, power, known, touching, speed, force, out):
    p = parameters[0]
    positions = p.node_position
    pads, work = np.empty((2, NODES)), np.empty((4, CHAIN))
    pads[0, :], pads[1, :] = inner[0], outer[0]
    disc = 0.5 * (inner[0] + outer[0])
    for row in range(len(power)):
        if row > 0:
            watts = 0.0
            if known:
                watts = power[row - 1]
            elif touching[row - 1] and speed[row - 1] > TURNING_RAD_PER_S:
                watts = friction_power(p, force[row - 1], speed[row - 1], 0.5 * (pads[0, 0] + pads[1, 0]))
            disc = heat_step(
                p,
                pads,
                disc,
                inner[row],
                outer[row],
                ambient[row],
                watts,
                touching[row - 1],
                speed[row - 1],
                step,
                work,
                longest,
            )
        if row % every == 0:
            into = out[row // every]
            for side in range(2):
                for index in range(len(DEPTHS_M)):
                    into[4 * side + index] = at_depth(pads[side], positions, DEPTHS_M[index])
                into[9 + side] = pads[side, 0]
                into[11 + side] = mean_temperature(pads[side], positions)
            into[8] = disc


def simulate(parameters: np.ndarray, r: Recording, torque_known: bool = True, every: int = 1) -> np.ndarray:
    """Temperatures by the estimator's heat chain over a recording, every ``every``-th row.

    Args:
        parameters: THERMAL, shape (1,).
        torque_known: heat by the brake torque sensor, else by the friction table and the reference force.

    Returns:
        Shape (rows, 13), degC: the nine of `Recording.measured`, both pad surfaces, both pad means.
    """
    out = np.empty((-(-len(r.power) // every), 13))
    longest = LONGEST_S if r.step_s <= _COARSE_S else r.step_s
    inputs = (r.inner, r.outer, r.ambient, r.power, torque_known, r.touching, r.speed, r.force)
    _simulate(parameters, r.step_s, longest, every, *inputs, out)
    return out


def nominal_parameters(nominal: Nominal) -> np.ndarray:
    """THERMAL, shape (1,): the datasheet's values, and for what no datasheet states the usual size.

    Conductances of pads on a disc: Limpert, Brake Design and Safety, 3rd ed., ch. 3; a released pad sits some 0.1 mm of
    air away (k / gap = 260 W/(m^2 K)). Free convection of a disc is 5 to 15 W/(m^2 K).
    """
    p = np.zeros(1, THERMAL)
    values = {
        "conductivity": nominal.pad_conductivity_W_per_mK,
        "conductivity_rise": 5e-4,
        "density": nominal.pad_density_kg_per_m3,
        "specific_heat": nominal.pad_specific_heat_J_per_kgK,
        "area": nominal.pad_area_m2,
        "thickness": nominal.pad_thickness_m,
        "node_position": mesh(nominal.pad_thickness_m),
        "heat_share": 0.05,
        "contact_conductance": 1500.0,
        "gap_conductance": 300.0,
        "surface_cooling_per_speed": 0.1,
        "backplate_conductance": 5000.0,
        "disc_heat_capacity": nominal.disc_mass_kg * nominal.disc_specific_heat_J_per_kgK,
        "disc_cooling": 10.0 * nominal.disc_cooling_area_m2,
        "disc_cooling_per_speed": 1.5 * nominal.disc_cooling_area_m2,
        "disc_radiating_area": 0.5 * nominal.disc_cooling_area_m2,
        "effective_radius": nominal.disc_effective_radius_m,
    }
    for name, value in values.items():
        p[name] = value
    return p


@dataclass(frozen=True)
class _Unknown:
    """``spread``: prior standard deviation; of the logarithm, or where ``scale`` is given of value / scale."""

    field: str
    key: str
    spread: float
    index: int | None = None
    scale: float | None = None
    low: float = 0.0
    high: float = np.inf


#: What is fitted. Datasheet values are told to 15 %, taken for two standard deviations; the rest is hardly known before.
UNKNOWNS = (
    _Unknown("conductivity", "pad.conductivity_W_per_mK", 0.075),
    _Unknown("conductivity_rise", "pad.conductivity_rise_per_K", 1.0, scale=1e-3, low=-1e-3, high=4e-3),
    _Unknown("specific_heat", "pad.specific_heat_J_per_kgK", 0.075),
    _Unknown("heat_share", "pad.inner_heat_share", 1.0, index=0),
    _Unknown("heat_share", "pad.outer_heat_share", 1.0, index=1),
    _Unknown("contact_conductance", "pad.contact_conductance_W_per_m2K", 1.0),
    _Unknown("gap_conductance", "pad.gap_conductance_W_per_m2K", 1.0),
    _Unknown("surface_cooling_per_speed", "pad.surface_cooling_per_speed_J_per_rad_m2K", 3.0, scale=0.1),
    _Unknown("backplate_conductance", "pad.backplate_conductance_W_per_m2K", 1.0),
    _Unknown("disc_heat_capacity", "disc.heat_capacity_J_per_K", 0.075),
    _Unknown("disc_cooling", "disc.cooling_W_per_K", 1.0),
    _Unknown("disc_cooling_per_speed", "disc.cooling_per_speed_J_per_rad_K", 1.0),
    _Unknown("disc_radiating_area", "disc.radiating_area_m2", 1.0, scale=0.1),
)


@dataclass(frozen=True)
class HeatFit:
    """Pads and disc.

    Attributes:
        parameters: THERMAL, shape (1,).
        sigmas: by key below ``thermal`` in a calibration.
        unexcited: keys of values that the logs hardly moved from where they started.
    """

    parameters: np.ndarray
    sigmas: dict[str, float]
    unexcited: tuple[str, ...]


def check_excitation(r: Recording) -> None:
    """Raises InputError unless friction heats the pads enough to tell how heat flows in them."""
    rise = np.nanmax(r.measured[:8]) - np.nanmin(r.measured[:8, 0]) if np.isfinite(r.measured[:8]).any() else 0.0
    if rise < _LEAST_RISE_K or r.power.max(initial=0.0) <= 0.0:
        raise InputError(f"{r.name}: pads rise by {rise:.0f} K; at least {_LEAST_RISE_K:.0f} K by braking are needed")


def _value(p, u: _Unknown) -> float:
    return float(p[u.field][0] if u.index is None else p[u.field][0, u.index])


def _write(p, u: _Unknown, value: float) -> None:
    if u.index is None:
        p[u.field] = value
    else:
        p[u.field][0, u.index] = value


def fit_heat(recordings: list[Recording], nominal: Nominal, progress=lambda share: None) -> HeatFit:
    """Pads and disc from recordings that heat and cool them.

    Residuals are strongly correlated and the equations are not quite the rig's, so that standard deviations come from
    leaving out one log at a time (one Gauss-Newton step from the solution for each), or, of fewer than four logs, one sixth
    of each: Wu, Annals of Statistics 14, 1986.
    """
    start = nominal_parameters(nominal)
    p = start.copy()
    first = np.array([_value(start, u) for u in UNKNOWNS])
    scale = np.array([u.scale or 1.0 for u in UNKNOWNS])
    linear = np.array([u.scale is not None for u in UNKNOWNS])
    spread = np.array([u.spread for u in UNKNOWNS])
    low = np.array([(u.low - v) / s if lin else -4.0 for u, v, s, lin in zip(UNKNOWNS, first, scale, linear, strict=True)])
    high = np.array([(u.high - v) / s if lin else 4.0 for u, v, s, lin in zip(UNKNOWNS, first, scale, linear, strict=True)])
    calls = 0

    def values(x):
        with np.errstate(over="ignore"):
            return np.where(linear, first + scale * x, first * np.exp(np.where(linear, 0.0, x)))

    def residual(r, every):
        known = np.isfinite(r.measured[:, ::every].T)
        known[:, :8] &= np.tile(np.array(DEPTHS_M) <= nominal.pad_thickness_m, 2)

        def of(x):
            nonlocal calls
            calls += 1
            progress(1.0 - np.exp(-calls / (100.0 * len(recordings))))
            for u, value in zip(UNKNOWNS, values(x), strict=True):
                _write(p, u, value)
            return (simulate(p, r, every=every)[:, :9] - r.measured[:, ::every].T)[known] / _RESIDUAL_SIGMA_K

        return of

    columns = np.arange(len(UNKNOWNS))
    blocks = [Block(residual(r, max(round(_RESIDUAL_EVERY_S / r.step_s), 1)), columns) for r in recordings]
    blocks.append(Block(lambda x: x / spread, columns))
    small = np.full(len(UNKNOWNS), 1.0)
    solution = least_squares(blocks, np.zeros(len(UNKNOWNS)), small, low, high, iterations=30, tolerance=1e-4)
    x = solution.x
    for u, value in zip(UNKNOWNS, values(x), strict=True):
        _write(p, u, value)
    found = p.copy()
    deviation, formal = _jackknife(blocks, x)
    unit = np.where(linear, scale, values(x))
    return HeatFit(
        parameters=found,
        sigmas={u.key: float(d) for u, d in zip(UNKNOWNS, unit * deviation, strict=True)},
        unexcited=tuple(u.key for u, s, prior in zip(UNKNOWNS, formal, spread, strict=True) if s > 0.5 * prior),
    )


def _jackknife(blocks: list[Block], x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(standard deviations by leaving out groups of residuals, formal ones); the last block, the prior, always stays in."""
    count = len(x)
    groups, normals, gradients = [], [], []
    for block in blocks:
        r = block.residual(x)
        jacobian = np.empty((len(r), count))
        for column in range(count):
            moved = x.copy()
            moved[column] += 1e-3
            jacobian[:, column] = (block.residual(moved) - r) / 1e-3
        parts = 1 if len(blocks) > 4 or block is blocks[-1] else 6
        for piece in range(parts):
            rows = slice(piece * len(r) // parts, (piece + 1) * len(r) // parts)
            normals.append(jacobian[rows].T @ jacobian[rows])
            gradients.append(jacobian[rows].T @ r[rows])
            groups.append(block is not blocks[-1])
    total = np.sum(normals, axis=0)
    # A value at its bound may leave it when a log is left out: it moves along with the rest.
    moves = np.array([np.linalg.solve(total - n, g) for n, g, out in zip(normals, gradients, groups, strict=True) if out])
    shares = len(moves)
    moves -= moves.mean(axis=0)
    variance = (shares - 1) / shares * np.sum(moves**2, axis=0)
    formal = np.diag(np.linalg.inv(total))
    return np.sqrt(variance + formal), np.sqrt(formal)
