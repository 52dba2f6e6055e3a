"""Promises of reception and pipeline, held to millions of frames at the speed of compiled code.

Run in tests/ as ``python -m fuzz.promises [FRAMES] [SEED]``: ten million by default. A simulated drive is taken again,
each time with other foreign frames and losses on the bus, drawn from the seed:

- *noise*: frames on any id, none of them with the right protection. Every genuine frame is taken, no other is, and the
  estimates are the same to the bit.
- *hostile*: genuine frames are lost, doubled, held up or damaged, and for a fifth of the drive there are protected frames with
  any payload, counter, status and time. What was taken is within its range, an estimate that may be used is a number whose
  sigma covers the true force, and what is sent is protected, in sequence, and says of itself what the estimate says.
"""

import sys
from functools import cache

import numpy as np
import wirekit

from emb_daemon.calibration.configuration import Setup
from emb_daemon.calibration.files import shipped_calibration
from emb_daemon.jit import njit
from emb_daemon.pipeline import Pipeline
from emb_daemon.plant.car import Car
from emb_daemon.plant.derive import plant_from_calibration
from emb_daemon.plant.scenarios import city_drive, commands_of
from emb_daemon.resources import resource
from emb_daemon.wire import contract
from emb_daemon.wire.e2e import COUNTER_MODULO, counter_of, crc, protect, status_of
from emb_daemon.wire.frames import FRAME
from emb_daemon.wire.layout import SLOTS, default_layout
from emb_daemon.wire.receive import ACCEPTED

_OURS = np.array([0x100, 0x110, 0x120, 0x180, 0x181, 0x182, 0x200])
_START_NS = 1_000_000_000
#: Share of the samples that may be off by more than three sigma, as in `studies.phases`; and cycles by which a frame that was
#: held up, and the sample counted by it, may be late.
_BEYOND, _LATE_CYCLES = 0.01, 13
_KEPT = ("time_ns", "cycle", "counter", "source", "force", "sigma", "stiffness_force", "contact_angle", "disc", "mean")


@cache
def _drive(seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Frames, and the true force of each cycle, N."""
    plant = np.array([plant_from_calibration(shipped_calibration(), 0)])
    schedule = city_drive().first(seconds)
    frames, truth = Car(plant, ("FL",), start_ns=_START_NS).run(commands_of(schedule, ("FL",)), schedule.drives)
    return frames, truth["force"][:, 0]


def _run(frames: np.ndarray):
    """Pipeline, estimates and broadcasts of frames in order of time."""
    pipeline = Pipeline(Setup(resource("config/emb.yaml")).parameters, ("FL",), capacity=1 << 16)
    pipeline.begin(_START_NS)
    start, estimates, sent = 0, [], []
    while start < len(frames):
        start, count = pipeline.consume(frames, start)
        estimates.append(pipeline.estimates[:count].copy())
        sent.append(pipeline.broadcast(count).copy())
    return pipeline, np.concatenate(estimates), np.concatenate(sent)


@njit
def _protect_all(frames, counters, statuses):
    for index in range(len(frames)):
        f = frames[index]
        f.data = protect(f.can_id, f.data & ~np.uint64(0xFFFF), counters[index], statuses[index])


@njit
def _damage_all(frames):
    """None keeps the right protection, not even by chance."""
    for index in range(len(frames)):
        f = frames[index]
        if np.uint8(f.data & np.uint64(0xFF)) == crc(f.can_id, f.data):
            f.data ^= np.uint64(1)


@njit
def _wrongly_protected(frames):
    count = 0
    for index in range(len(frames)):
        f = frames[index]
        count += np.uint8(f.data & np.uint64(0xFF)) != crc(f.can_id, f.data)
    return count


def _foreign(rng: np.random.Generator, count: int, begin_ns: int, end_ns: int) -> np.ndarray:
    frames = np.zeros(count, FRAME)
    frames["time_ns"] = np.sort(rng.integers(begin_ns, end_ns, count))
    frames["can_id"] = np.where(rng.random(count) < 0.9, rng.choice(_OURS, count), rng.integers(0, 2048, count))
    frames["length"], frames["data"] = 8, rng.integers(0, 2**64, count, dtype=np.uint64)
    return frames


def _off(estimates: np.ndarray, force_N: np.ndarray) -> np.ndarray:
    """By how much each estimate is off, N, from the nearest true force of the cycles about it."""
    about = np.lib.stride_tricks.sliding_window_view(np.pad(force_N, _LATE_CYCLES, mode="edge"), 2 * _LATE_CYCLES + 1)
    about = about[np.clip((estimates["time_ns"] - _START_NS) // contract.CYCLE_NS, 0, len(force_N) - 1)]
    return np.maximum(np.maximum(about.min(axis=1) - estimates["force"], estimates["force"] - about.max(axis=1)), 0.0)


def noise(rng: np.random.Generator, seconds: float, rate: int) -> int:
    """One drive in unprotected noise; returns how many frames it had."""
    genuine, _ = _drive(seconds)
    foreign = _foreign(rng, round(rate * seconds), _START_NS, int(genuine["time_ns"][-1]))
    foreign["length"] = rng.choice([0, 4, 7, 8, 8, 8, 8], len(foreign))
    foreign["flags"] = np.where(rng.random(len(foreign)) < 0.8, 0, rng.integers(0, 16, len(foreign)))
    _damage_all(foreign)
    quiet, expected, _ = _run(genuine)
    disturbed, estimates, _ = _run(wirekit.merged(genuine, foreign))
    assert len(estimates) == len(expected), "an estimate was lost or came besides"
    for name in _KEPT:
        assert estimates[name].tobytes() == expected[name].tobytes(), name
    taken = [pipeline.receptions["count"][:, ACCEPTED].tolist() for pipeline in (quiet, disturbed)]
    assert taken[0] == taken[1] and sum(taken[0]) > 0.9 * len(genuine), "a foreign frame was taken, or a genuine one was not"
    return len(genuine) + len(foreign)


def hostile(rng: np.random.Generator, seconds: float, rate: int) -> int:
    """One drive among protected foreign frames on a bad bus; returns how many frames it had."""
    genuine, force_N = _drive(seconds)
    kept = genuine[rng.random(len(genuine)) > rng.choice([0.0, 0.01, 0.3])].copy()
    doubled = kept[rng.random(len(kept)) < 0.02].copy()
    kept["time_ns"] += np.where(rng.random(len(kept)) < 0.01, rng.integers(0, 40_000_000, len(kept)), 0)
    kept["data"] ^= np.where(rng.random(len(kept)) < 0.01, rng.integers(0, 2**63, len(kept)), 0).astype(np.uint64)
    span_ns = int(genuine["time_ns"][-1]) - _START_NS
    begin_ns, end_ns = (_START_NS + round(share * span_ns) for share in rng.uniform(0.0, 0.8) + np.array((0.0, 0.2)))
    foreign = _foreign(rng, round(0.2 * rate * seconds * rng.choice([0.01, 0.1, 1.0])), begin_ns, end_ns)
    statuses = rng.choice([0, 0, 0, 1, 2, 15], len(foreign))
    _protect_all(foreign, rng.integers(0, COUNTER_MODULO + 1, len(foreign)), statuses)
    frames = wirekit.merged(kept, doubled, foreign)
    pipeline, estimates, sent = _run(frames)
    layout = default_layout()[0]
    for slot in range(SLOTS):
        values, known = pipeline.receptions["values"][slot], layout["received"][slot, : layout["received_count"][slot]]
        heard, rounding = np.isfinite(values[: len(known)]), 0.5 * known["factor"]
        within = (values[: len(known)] >= known["low"] - rounding) & (values[: len(known)] <= known["high"] + rounding)
        assert np.all(within | ~heard), slot
    usable = (estimates["mode"] != contract.FAULT) & (estimates["mode"] != contract.INIT)
    used = estimates[usable]
    assert len(used) > 0.1 * len(estimates), "hardly anything could be used"
    assert np.all(np.isfinite(used["force"])) and np.all(used["sigma"] > 0.0) and np.all(used["force"] >= 0.0)
    assert np.all(used["source"] != contract.INVALID)
    assert np.mean(_off(used, force_N) > 3.0 * used["sigma"]) < _BEYOND
    samples = estimates[estimates["is_sample"]]
    assert np.all(np.diff(samples["cycle"]) >= 1), "a cycle was answered twice"
    forces = sent[sent["can_id"] == 0x200]
    assert _wrongly_protected(sent) == 0 and len(forces) == len(estimates)
    assert np.array_equal(counter_of(forces["data"]), np.arange(len(forces)) % COUNTER_MODULO)
    assert np.array_equal(status_of(forces["data"]) <= contract.STATUS_DEGRADED, usable)
    return len(frames)


def main() -> None:
    wanted, seed = (int(word) for word in (*sys.argv[1:], *("10000000", "0")[len(sys.argv) - 1 :]))
    done, drives = 0, 0
    while done < wanted:
        rng = np.random.default_rng((seed, drives))
        try:
            done += (noise if drives % 2 else hostile)(rng, 60.0, 5000)
        except AssertionError as error:
            sys.exit(f"drive {drives} of seed {seed}: {error}")
        drives += 1
    print(f"{done} frames in {drives} drives of seed {seed}: every promise kept")


if __name__ == "__main__":
    main()
