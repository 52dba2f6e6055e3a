"""Columns of any sampling rate as our frames.

Another rig's measurements are converted to our messages, E2E protected, with counters that count resolver cycles, so that the
pipeline is the only way into the estimator.
"""

from collections.abc import Mapping
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from emb_daemon.errors import tell
from emb_daemon.jit import njit
from emb_daemon.logs.columns import Decoder, absent_raw, crc_is_right, shipped_database
from emb_daemon.logs.series import CARRIED_PERIODS, LEAST_SAMPLES, RESOLVED, SAME_PERIOD, SPARSE_CYCLES, Series, correlation_of
from emb_daemon.wire.contract import CYCLE_NS, STATUS_DEGRADED
from emb_daemon.wire.e2e import COUNTER_MODULO, protect
from emb_daemon.wire.frames import FRAME
from emb_daemon.wire.layout import CORNERS, signal_columns

if TYPE_CHECKING:
    from cantools.database.can import Database, Message

#: Least share of a load that the other sign's is where it pulls as it pushes; what our message of the angle carries, more than
#: the travel of anything that clamps, rad.
_OTHER_SIGN, _CLAMPS_RAD = 0.2, 3355.0
#: Share of values outside our message's range that is too large for faults of an instrument; what a flag may be off by.
_MOST_BEYOND, _FLAG = 0.01, 0.01
#: Share of our message's range that a value may be below it and is sent as its end: a zero error. A wheel turns from more.
_ZERO_ERROR = 1e-3
#: Share of a cycle that a stamp may be short of a whole number of missing samples, or it is only late; share of a stamp's
#: deviation by which the clock of numbered samples follows it: jitter is averaged over some ten samples, and a sampling period
#: that is 5 % off leaves it a quarter of a cycle behind.
_MISSING, _FOLLOWED = 0.25, 0.2
#: Longest time without any motor's messages over which slow messages go on, ns: a hot brake cools for an hour.
_SILENT_NS = 3_600_000_000_000
#: Sampling period of a standing motor of which nothing was measured, ns.
_STANDING_NS = 1_000_000_000
#: Least share of a log's samples with consecutive counters: a working bus loses few frames.
_IN_TURN = 0.9
#: Number of periods from which a step of time is a pause.
_PAUSE = 10
#: Samples after which what was sent late for want of a processor no longer counts: some tenths of a second.
_MADE_UP = 64
#: A step of the angle that differs from the integrated speed by more than this angle (rad), plus the change of speed times the
#: time (s) between the sampling of both, looks to the estimator like a resolver that lost its zero. That happens once and not
#: repeatedly: largest share of such steps, and that of a machine whose force does not rest on its angle, and whose speed is
#: better than the change of an angle with late stamps as long as these are few: at three in a hundred a dynamometer's gained
#: nothing.
_SLIP_RAD, _SLIP_DELAY_S, _MOST_APART, _MOST_APART_BARE = 0.3, 0.01, 0.002, 0.02
#: Travel from which the angle's derivative is compared with the speed, rad; least correlation of both; largest deviation of
#: their ratio from 1, of which a filter's delay causes some hundredths, and from that of a unit that is then named.
_WAY_RAD, _CORRELATED, _OTHER_SCALE, _NAMED = 1.0, 0.8, 0.1, 0.04
#: Number of samples over which angle and speed are compared where their stamps jitter, which is a tenth as large beside it.
_AVERAGED = 10
#: Ratios of units that are often confused.
_RATIOS = {
    30.0 / np.pi: "rpm taken for rad/s, or the reverse",
    180.0 / np.pi: "degrees taken for radians, or the reverse",
    2.0 * np.pi: "turns taken for radians, or the reverse",
    6.0: "rpm taken for degrees per second, or the reverse",
    60.0: "turns per minute taken for turns per second, or the reverse",
    1e3: "a unit of time or a prefix that is wrong by a thousand",
}
#: Least step of the wire's MotorSpeed.
STEP_RAD_PER_S = 0.02
#: Signals of an E2E protected message that protection fills in.
HEADER = ("CRC", "Counter", "Status")
#: Cycle of a message whose DBC states none, ms.
_SLOW_MS = 40

#: Signals of one of our messages: where they come from, a constant, or None for an instrument that the rig does not have.
Signals = Mapping[str, Series | float | None]

#: By the last word of a message's name: which of its signals may be missing, and their substitutes.
SUBSTITUTES = {
    "Resolver": {
        "MotorSpeed": "it is the change of MotorAngle",
        "MotorAngle": "it is MotorSpeed added up, which drifts; force by the angle is not to be trusted for long",
    },
    "Thermocouple": {
        "InnerBackplateTemp": "it is taken to be the outer one's, and a difference between the pads goes unseen",
        "OuterBackplateTemp": "it is taken to be the inner one's, and a difference between the pads goes unseen",
        "CaliperTemp": "it is taken to be the mean of the backing plates",
    },
}


def fill_missing(name: str, signals: Signals, bare: bool = False) -> Signals:
    """A message's signals, at least one, completed by substitutes for missing ones (`SUBSTITUTES`); ``bare`` of a machine that
    clamps nothing."""
    if name.endswith("_Resolver"):
        angle, speed = signals.get("MotorAngle"), signals.get("MotorSpeed")
        if isinstance(angle, Series) and isinstance(speed, Series) and (why := _another_motion(angle, speed, bare)):
            tell(f"{name}: MotorSpeed {why}: left out, the change of the angle is taken")
            speed = None
        angle = speed.integral() if angle is None else angle
        return {"MotorAngle": angle, "MotorSpeed": angle.derivative() if speed is None else speed}
    if name.endswith("_Thermocouple"):
        plates = [signals[name] for name in ("InnerBackplateTemp", "OuterBackplateTemp") if name in signals]
        caliper = signals.get("CaliperTemp", _mean(plates[0], plates[-1]))
        return {"InnerBackplateTemp": plates[0], "OuterBackplateTemp": plates[-1], "CaliperTemp": caliper}
    return signals


def filled(messages: Mapping[str, Signals]) -> dict[str, Signals]:
    """A log's messages, each completed by `fill_missing`."""
    bare = {f"EMB_{corner}_Resolver" for corner in CORNERS if is_bare(corner, messages)}
    return {name: fill_missing(name, signals, name in bare) for name, signals in messages.items()}


def standing(messages: Mapping[str, Signals], angle_rad: float) -> dict[str, Series]:
    """Resolver signals of a motor that stands for as long as anything of ``messages`` was measured: at our rate where a
    current or a force is, which may be fast, else once a second, which is enough for what cools."""
    series = [(name, s) for name, signals in messages.items() for s in signals.values() if isinstance(s, Series)]
    measured = np.sort(np.concatenate([source.time_ns for _, source in series]))
    step_ns = CYCLE_NS if any(name.endswith(("_Current", "_Force")) for name, _ in series) else _STANDING_NS
    stretches = _stretches(measured, _SILENT_NS) if len(measured) else []
    times = np.concatenate([np.arange(first, last + 1, step_ns) for first, last in stretches] or [measured])
    return {
        name: Series(times, np.full(len(times), value)) for name, value in (("MotorAngle", angle_rad), ("MotorSpeed", 0.0))
    }


def _another_motion(angle: Series, speed: Series, bare: bool) -> str:
    """How speed and angle contradict each other; empty if they do not. Between sparse samples the motion is unknown, but not
    how far a speed that changes slowly goes."""
    steps = np.diff(angle.time_ns)
    # What a busy computer stamps late it makes up for in the next rows: neither is left out.
    near = (steps > 0) & (steps <= (_PAUSE if angle.is_sparse else CARRIED_PERIODS) * angle.period_ns)
    at = speed.sampled(angle.time_ns)
    way, turned = np.diff(angle.values), 0.5e-9 * (at[1:] + at[:-1]) * steps
    known = near & np.isfinite(turned)
    if not known.any():
        return ""
    went, told = way[known], turned[known]
    sums = [np.add.reduceat(column, np.arange(0, len(column), _AVERAGED)) for column in (went, told)]
    if angle.is_sparse:
        went, told = sums
    moved, explained = float(np.sum(np.abs(went))), float(np.sum(np.abs(told)))
    # The sum of noise is no travel.
    if min(moved, explained) > _WAY_RAD and abs(ratio := _ratio(went, told)) > 0.0:
        correlation = correlation_of(went, told)
        resolved = correlation_of(at[1:][known], at[:-1][known]) > RESOLVED
        # Stamps that jitter are noise of what the speed tells of a step, which makes the ratio less.
        is_off = abs(ratio - 1.0) > _OTHER_SCALE < abs(_ratio(*sums) - 1.0)
        if resolved and abs(correlation) > _CORRELATED and is_off:
            return f"is another motion than MotorAngle, which changes {ratio:.4g} times as fast ({_meaning(ratio)})"
    if angle.is_sparse:
        return ""
    apart = np.abs(way - turned) > _SLIP_RAD + _SLIP_DELAY_S * np.abs(np.diff(at))
    share = float(np.mean(apart[near]))
    if share <= (_MOST_APART_BARE if bare else _MOST_APART) or (bare and _is_one_motion(angle, at)):
        return ""
    return (
        f"is another motion than the change of MotorAngle in {100.0 * share:.1f} % of the samples (stamps of a busy computer?)"
    )


def _ratio(went: np.ndarray, told: np.ndarray) -> float:
    """How many times as far an angle ``went``, (n,), as its speed ``told``."""
    return float(went @ told / (told @ told)) if np.any(told) else 0.0


def _is_one_motion(angle: Series, speed: np.ndarray) -> bool:
    """Whether an angle and the ``speed`` at its times (n,) tell of one motion but for stamps that are late or early by half a
    period, however many: over many steps that adds no more to the way than in one, and another motion's adds up."""
    steps = np.diff(angle.time_ns)
    lasts_s, turns = 1e-9 * steps, 0.5 * (speed[1:] + speed[:-1])
    # What is stamped late by more is made up for in the next rows, too.
    known = (steps > 0) & (steps <= _PAUSE * angle.period_ns) & np.isfinite(turns)
    if np.sum(known) < _AVERAGED:
        return False
    first = np.arange(0, int(np.sum(known)), _AVERAGED)
    apart, fastest = (np.diff(angle.values) - turns * lasts_s)[known], np.abs(turns[known])
    changed = np.abs(np.add.reduceat(np.diff(speed)[known], first))
    allowed = _SLIP_RAD + _SLIP_DELAY_S * changed + 1e-9 * angle.period_ns * np.maximum.reduceat(fastest, first)
    return float(np.mean(np.abs(np.add.reduceat(apart, first)) > allowed)) <= _MOST_APART_BARE


def _meaning(ratio: float) -> str:
    """Possible causes of an angle that changes ``ratio`` times as fast as the speed says."""
    sign = "a direction turned round" if ratio < 0.0 else ""
    apart, text = min((abs(abs(ratio) / e - 1.0), text) for known, text in _RATIOS.items() for e in (known, 1.0 / known))
    if apart < _NAMED:
        return " and ".join(filter(None, [sign, text]))
    return sign if abs(abs(ratio) - 1.0) <= _OTHER_SCALE else " and ".join(filter(None, [sign, "a wrong unit or gear"]))


def _mean(first: Series | float, second: Series | float) -> Series | float:
    """Mean of two temperatures, at the times of one that is measured."""
    if not isinstance(first, Series):
        first, second = second, first
    if isinstance(first, Series):
        other = second.sampled(first.time_ns) if isinstance(second, Series) else second
        return Series(first.time_ns, 0.5 * (first.values + other))
    return 0.5 * (first + second)


@cache
def our_messages() -> "dict[str, tuple[Message, Database]]":
    """cantools message and its database by name: the daemon's messages and those of rigs."""
    databases = (shipped_database("dbc/emb.dbc"), shipped_database("dbc/rig.dbc"))
    return {message.name: (message, database) for database in databases for message in database.messages}


def cycle_ns(message: "Message") -> int:
    """Nominal cycle of a cantools message, ns."""
    return (message.cycle_time or _SLOW_MS) * 1_000_000


def frames_of(messages: Mapping[str, Signals]) -> np.ndarray:
    """FRAME array, in time order, of our messages by name.

    The resolver's samples are the clock of their corner. A message's signals that are left out are sent as zero, or as absent
    if a rig's instrument gives them."""
    ours = our_messages()
    ticks = {}
    for corner in CORNERS:
        if resolver := messages.get(f"EMB_{corner}_Resolver"):
            angle = next(source for source in resolver.values() if isinstance(source, Series))
            ticks[corner] = _clock(angle, is_unresolved(corner, messages))
    if not any(len(times) for times, _ in ticks.values()):
        return np.zeros(0, FRAME)
    stretches = _stretches(np.unique(np.concatenate([times for times, _ in ticks.values()])), _SILENT_NS)
    # A force sensor's frame comes before the other frames of its sample, which do not wait for it.
    in_turn = sorted(messages, key=lambda name: not name.endswith("_ForceSensor"))
    result = np.concatenate([_frames(*ours[name], messages[name], ticks, stretches) for name in in_turn])
    # Stable: at one instant slow messages come first and the resolver last, as the pipeline pairs it with its current.
    return result[np.argsort(result["time_ns"], kind="stable")]


def at_our_rate(frames: np.ndarray) -> np.ndarray:
    """Frames of a log in our own layout; if a resolver in it has another rate, above 50 Hz, all brought to ours.

    Frames with a wrong CRC, or whose sender says not to use them, are then left out."""
    decoder = Decoder()
    resolvers = [frames["can_id"] == decoder.can_id(f"EMB_{corner}_Resolver") for corner in CORNERS]
    if not any(_has_another_rate(frames[mine]) for mine in resolvers):
        return frames
    right = crc_is_right(frames) & (frames["data"] >> np.uint64(12) & np.uint64(0xF) <= STATUS_DEGRADED)
    rig, messages = Decoder("dbc/rig.dbc"), {}
    for name in our_messages():
        if name.startswith("RIG_"):
            columns = rig.columns(frames, name)
        elif name.startswith("VEH_") or is_received(name):
            columns = decoder.columns(frames[right], name)
        else:
            continue
        times = columns.pop("time_ns")
        signals = {key: Series.of(times, values) for key, values in columns.items() if key not in HEADER}
        signals = {key: series.averaged() if key == "CurrentQ" else series for key, series in signals.items()}
        if known := {key: series for key, series in signals.items() if len(series.time_ns)}:
            messages[name] = known
    return frames_of(messages)


def _has_another_rate(resolver: np.ndarray) -> bool:
    """Whether a single sender sends a corner's resolver frames at another rate that is high enough to interpolate.

    Counters of two senders, or of repeated frames, do not increase by one."""
    if len(resolver) < LEAST_SAMPLES:
        return False
    counters = (resolver["data"] >> np.uint64(8) & np.uint64(0xF)).astype(int)
    in_turn = np.diff(counters) % COUNTER_MODULO == 1
    if np.mean(in_turn) <= _IN_TURN:
        return False
    steps = np.diff(resolver["time_ns"])[in_turn]
    # The mean without pauses, in which a busy machine's delays cancel, unlike in the median.
    middle = np.median(steps)
    cycles = np.mean(steps[steps <= max(_PAUSE * middle, _PAUSE * CYCLE_NS)]) / CYCLE_NS
    # A delay that is as long as a pause is made up for by what was held up and follows at once.
    sent = np.concatenate([[0], np.cumsum(np.diff(counters) % COUNTER_MODULO)])
    ago = min(_MADE_UP, len(resolver) - 1)
    times = resolver["time_ns"]
    made_up = np.median((times[ago:] - times[:-ago]) / np.maximum(sent[ago:] - sent[:-ago], 1)) / CYCLE_NS
    other = min(abs(cycles - 1.0), abs(made_up - 1.0)) > SAME_PERIOD
    return bool(other) and middle < (1.0 - SAME_PERIOD) * SPARSE_CYCLES * CYCLE_NS


def is_received(message: str) -> bool:
    """Whether the daemon receives a corner's message."""
    return message.endswith(("_Resolver", "_Current", "_Thermocouple", "_ForceSensor"))


def _stretches(times: np.ndarray, silent_ns: float) -> list[tuple[int, int]]:
    """First and last of ascending times (at least one) between gaps longer than ``silent_ns``."""
    ends = np.flatnonzero(np.diff(times) > silent_ns)
    return list(zip(times[np.append(0, ends + 1)].tolist(), times[np.append(ends, -1)].tolist(), strict=True))


def _grid(stretches: list[tuple[int, int]], cycle_ns: int) -> tuple[np.ndarray, np.ndarray]:
    """Times every ``cycle_ns`` from the start of the first stretch that lie in a stretch, and the number of cycles before
    each."""
    origin = stretches[0][0]
    cycles = np.concatenate(
        [np.arange(-((origin - first) // cycle_ns), (last - origin) // cycle_ns + 1) for first, last in stretches]
    )
    return origin + cycles * cycle_ns, cycles


def _slow(message, signals: Signals, ticks: dict, stretches: list[tuple[int, int]]) -> tuple[np.ndarray, np.ndarray]:
    """Times of a slow message, and their numbers: its cycles, or where motors stand and nothing of it was measured more often,
    the motors' samples. A week's log of plates that cool would be sixty million frames."""
    samples = np.unique(np.concatenate([times for times, _ in ticks.values()]))
    measured = min((source.period_ns for source in signals.values() if isinstance(source, Series)), default=_STANDING_NS)
    if len(samples) > 1 and min(measured, np.median(np.diff(samples))) >= _STANDING_NS:
        return samples, np.arange(len(samples))
    return _grid(stretches, cycle_ns(message))


def _frames(message, database, signals: Signals, ticks: dict, stretches: list[tuple[int, int]]) -> np.ndarray:
    corner, kind = (*message.name.split("_"), "")[1:3]
    if corner in ticks and kind in ("Resolver", "Current", "ForceSensor", "Force"):
        times, cycles = ticks[corner]
        columns = {key: _fast(key, source, times) for key, source in signals.items()}
    else:
        times, cycles = _slow(message, signals, ticks, stretches)
        columns = {
            key: source.held(times, cycle_ns(message)) if isinstance(source, Series) else source
            for key, source in signals.items()
        }
    is_reference = message.name.startswith("RIG_")
    names = tuple(signal.name for signal in message.signals if signal.name not in HEADER)
    payload, usable = np.zeros(len(times), np.uint64), np.ones(len(times), bool)
    for layout, name in zip(signal_columns(database, message.name, names), names, strict=True):
        start, length = np.uint64(layout["start"]), int(layout["length"])
        source = columns.get(name, None if is_reference else 0.0)
        absent = np.full(len(times), absent_raw(length) if is_reference else 0)
        if source is None:
            raw = absent
        else:
            column = np.broadcast_to(np.asarray(source, float), times.shape)
            if name == "MotorAngle":
                column = _within(message.name, column, layout["low"], layout["high"])
            rounding = _FLAG if length == 1 else 0.5 * layout["factor"]
            below = max(rounding, _ZERO_ERROR * (layout["high"] - layout["low"]))
            at_end = (column > layout["low"] - below) & (column < layout["high"] + rounding)
            column = np.where(at_end, np.clip(column, layout["low"], layout["high"]), column)
            known = (column >= layout["low"]) & (column <= layout["high"])
            if (beyond := np.mean(np.isfinite(column) & ~known)) > _MOST_BEYOND:
                so = "count as not measured" if is_reference else "make no frames"
                much = np.max(np.abs(column[np.isfinite(column)])) / layout["high"]
                smaller = f" If so, a `scale` {much:.3g} times smaller would fit, with all that it is compared with"
                tell(
                    f"{message.name}: {name} is beyond {layout['low']:g} to {layout['high']:g} in {100.0 * beyond:.3g} % of "
                    f"the samples, which {so}; is its unit right?{smaller if much > 1.0 else ''}"
                )
            if length == 1 and (between := np.mean((column > _FLAG) & (column < 1.0 - _FLAG))) > _MOST_BEYOND:
                tell(
                    f"{message.name}: {name} is 0 or 1, and between them in {100.0 * between:.3g} % of the samples; less than "
                    "a half is sent as 0: `scale` it so that all that is meant by 1 is at least that"
                )
            raw = np.rint((np.where(known, column, layout["offset"]) - layout["offset"]) / layout["factor"]).astype(np.int64)
            if is_reference:
                raw = np.where(known, raw, absent)
            else:
                usable &= known
        payload |= (raw.astype(np.uint64) & np.uint64((1 << length) - 1)) << start
    frames = np.zeros(int(usable.sum()), FRAME)
    frames["time_ns"], frames["can_id"], frames["length"] = times[usable], message.frame_id, 8
    frames["data"] = payload[usable]
    if not is_reference:
        frames["data"] = _protected(payload[usable], message.frame_id, cycles[usable] % COUNTER_MODULO)
    return frames


@njit
def _protected(payloads, can_id, counters):
    """`protect` of an array of payloads."""
    protected = np.empty_like(payloads)
    for row in range(len(payloads)):
        protected[row] = protect(can_id, payloads[row], counters[row], 0)
    return protected


def _within(message: str, angle: np.ndarray, low: float, high: float) -> np.ndarray:
    """An angle (rad), shifted by whole turns where it leaves our message's range: the load of a motor that turns on and on
    depends on its current and not on its travel."""
    if not np.any((angle < low) | (angle > high)):
        return angle
    period = 2.0 * np.pi * np.floor((high - low) / (2.0 * np.pi))
    least, most = float(np.nanmin(angle)), float(np.nanmax(angle))
    told = f"covers {most - least:.4g} rad, more than our message carries and than anything that clamps"
    begin = ""
    if most - least <= high - low:
        told = f"goes from {least:.5g} to {most:.5g} rad, beyond what our message carries ({low:.5g} to {high:.5g} rad)"
        begin = f" If so, `offset: {-least:.0f}` in all logs of the rig lets it begin at 0"
    tell(f"{message}: MotorAngle {told}: it starts anew every {period:.5g} rad; is its unit right?{begin}")
    return low + np.mod(angle - low, period)


def _fast(name: str, source: Series | float | None, times: np.ndarray) -> np.ndarray | float | None:
    if not isinstance(source, Series):
        return source
    if name.startswith("Current"):
        return source.mean(times)
    if name == "MotorSpeed":
        return unrepeated(source.smoothed(times) if source.is_slow else source.sampled(times), np.arange(len(times)))
    return source.sampled(times)


def unrepeated(speed: np.ndarray | float, row: np.ndarray | int) -> np.ndarray | float:
    """Speeds in which that of a standing motor alternates by the message's least step.

    The estimator expects noise and takes a speed that repeats to the bit for frozen, but an encoder's speed at rest, or the
    derivative of an angle, is constant for minutes."""
    return np.where(np.abs(speed) < 0.5 * STEP_RAD_PER_S, STEP_RAD_PER_S * np.array([0.0, 1.0, 0.0, -1.0])[row % 4], speed)


def turns_free(corner: str, messages: Mapping[str, Signals]) -> bool:
    """Whether the load is constant, as a mapping states it or a column of known weights: the machine clamps nothing. A force
    that is 0 throughout was rather not measured."""
    force = messages.get(f"RIG_{corner}_Force", {}).get("ClampForceRef")
    if isinstance(force, Series):
        return bool(len(force.values)) and force.values[0] != 0.0 and not np.ptp(force.values)
    return isinstance(force, float | int)


def is_bare(corner: str, messages: Mapping[str, Signals]) -> bool:
    """Whether a machine clamps nothing: its load is constant, or pulls as it pushes, whichever way its sensor counts, or its
    motor turns on and on."""
    force, angle = messages.get(f"RIG_{corner}_Force", {}).get("ClampForceRef"), way_of(corner, messages)
    low, high = np.quantile(force.values, (0.01, 0.99)) if isinstance(force, Series) and len(force.values) else (0.0, 0.0)
    of_either_sign = min(-low, high) > _OTHER_SIGN * max(-low, high)
    turns_on = angle is not None and len(angle.values) and np.ptp(angle.values) > _CLAMPS_RAD
    return turns_free(corner, messages) or bool(of_either_sign or turns_on)


def way_of(corner: str, messages: Mapping[str, Signals]) -> Series | None:
    """A corner's measured motor angle, or else its speed added up."""
    resolver = messages.get(f"EMB_{corner}_Resolver", {})
    angle, speed = resolver.get("MotorAngle"), resolver.get("MotorSpeed")
    if angle is None and isinstance(speed, Series):
        return speed.integral()
    return angle if isinstance(angle, Series) else None


def is_unresolved(corner: str, messages: Mapping[str, Signals]) -> bool:
    """Whether a corner's motor moves too fast for its samples."""
    angle = way_of(corner, messages)
    return angle is not None and (angle.course_is_unknown if is_bare(corner, messages) else angle.way_is_unknown)


@njit
def _numbered(times):
    """The cycle of each sample, int64: every sample has one of its own, and where some are missing, so are their cycles. A
    sample's stamp is compared with where those before it put it, because stamps that jitter are no missing samples."""
    numbers, expected = np.zeros(len(times), np.int64), float(times[0])
    for row in range(1, len(times)):
        cycles = max(1, int(np.floor((times[row] - expected) / CYCLE_NS + _MISSING)))
        numbers[row] = numbers[row - 1] + cycles
        expected += cycles * CYCLE_NS
        expected += _FOLLOWED * (times[row] - expected)
    return numbers


def _clock(angle: Series, unresolved: bool) -> tuple[np.ndarray, np.ndarray]:
    """Times of the resolver samples and the cycle that each belongs to: the rig's own samples if its period is ours or too
    long to fill, a grid of our period otherwise."""
    times = angle.time_ns
    if len(times) < 3:
        return times, np.arange(len(times))
    if angle.is_ours or unresolved:
        return times, _numbered(times)
    return _grid(_stretches(times, CARRIED_PERIODS * angle.period_ns), CYCLE_NS)
