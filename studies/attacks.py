"""What somebody on the bus can do who knows ids, layouts and E2E protection, and none of the brake's secrets: there are none.

    python -m studies.attacks [--seed N] [--seconds S]

Three attackers on a simulated drive: one who sends a forged resolver frame just before each genuine one; one who plays back
old samples, resolver and current, at the right counter just before the genuine ones; one who floods the resolver's id with
valid frames of any counter. Prints how many of their frames are taken; the share of answers from the attack's begin on, the
20 s after it included, whose status is not Fault; and the largest change of those beyond three sigma, and without any reason.
"""

import argparse

import numpy as np

from emb_daemon.calibration.configuration import Setup
from emb_daemon.calibration.files import load_calibration
from emb_daemon.jit import njit
from emb_daemon.pipeline import Pipeline
from emb_daemon.plant.car import Car
from emb_daemon.plant.derive import plant_from_calibration
from emb_daemon.plant.scenarios import city_drive, commands_of
from emb_daemon.resources import resource
from emb_daemon.wire.contract import CYCLE_NS, FAULT
from emb_daemon.wire.e2e import COUNTER_MODULO, protect
from emb_daemon.wire.frames import FRAME
from emb_daemon.wire.layout import MOTOR_ANGLE, RESOLVER, default_layout, pack, unpack
from emb_daemon.wire.receive import ACCEPTED, new_reception, receive

_RESOLVER, _CURRENT = 0x100, 0x110
#: From when to when the attackers are there: every sender's schedule is known by then, and what stays behind shows, s.
_FROM_S, _TO_S = 10.0, 40.0
#: How long before the genuine frame a forged one comes, ms; what it adds to the motor angle, rad, swinging in so many s: no
#: step gives it away.
_AHEAD_MS, _ADDED_RAD, _SWINGS_S = (0.05, 0.5, 1.0, 2.1), 6.0, 2.0
#: How old what is played back is: a whole number of turns of the counter, s.
_OLD_S = (0.06, 0.6, 3.0)
_FLOOD_PER_S = 6700
_START_NS = 1_000_000_000


@njit
def _moved(frames, signal, added):
    """Motor angles by ``added`` rad greater, protected anew."""
    mask = ((np.uint64(1) << np.uint64(signal.length)) - np.uint64(1)) << np.uint64(signal.start)
    for index in range(len(frames)):
        frame = frames[index]
        counter = (frame.data >> np.uint64(8)) & np.uint64(15)
        payload = (frame.data & ~mask & ~np.uint64(0xFFFF)) | pack(unpack(frame.data, signal) + added[index], signal)
        frame.data = protect(frame.can_id, payload, counter, 0)


@njit
def _taken(frames, strange, receptions, layout):
    """How many of the ``strange`` frames are accepted."""
    count = 0
    for index in range(len(frames)):
        _, verdict = receive(frames[index], receptions, layout[0])
        count += strange[index] and verdict == ACCEPTED
    return count


def _drive(seconds: float, seed: int) -> np.ndarray:
    plant = np.array([plant_from_calibration(load_calibration(resource("config/calibration.yaml")), seed)])
    schedule = city_drive().first(seconds)
    return Car(plant, ("FL",), start_ns=_START_NS).run(commands_of(schedule, ("FL",)), schedule.drives)[0]


def _estimates(frames: np.ndarray) -> np.ndarray:
    pipeline = Pipeline(Setup(resource("config/emb.yaml")).parameters, ("FL",), capacity=1 << 17)
    pipeline.begin(int(frames["time_ns"][0]))
    _, count = pipeline.consume(frames, predictions=False)
    return pipeline.estimates[:count].copy()


def _attacked(frames: np.ndarray) -> np.ndarray:
    seconds = 1e-9 * (frames["time_ns"] - _START_NS)
    return frames[(seconds >= _FROM_S) & (seconds < _TO_S)]


def forged_ahead(frames: np.ndarray, ahead_ms: float) -> np.ndarray:
    forged = _attacked(frames[frames["can_id"] == _RESOLVER]).copy()
    forged["time_ns"] -= round(1e6 * ahead_ms)
    swing = _ADDED_RAD * np.sin(2e-9 * np.pi / _SWINGS_S * (forged["time_ns"] - forged["time_ns"][0]))
    _moved(forged, default_layout()[0]["received"][RESOLVER, MOTOR_ANGLE], swing)
    return forged


def played_back(frames: np.ndarray, old_s: float) -> np.ndarray:
    fast = frames[np.isin(frames["can_id"], (_RESOLVER, _CURRENT))]
    again, cycles = fast.copy(), round(1e9 * old_s / CYCLE_NS)
    assert cycles % COUNTER_MODULO == 0
    again["time_ns"] += cycles * CYCLE_NS - 500_000
    return _attacked(again)


def flood(frames: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    span = _attacked(frames)["time_ns"]
    count = round(1e-9 * (span[-1] - span[0]) * _FLOOD_PER_S)
    noise = np.zeros(count, FRAME)
    noise["time_ns"] = np.linspace(span[0], span[-1], count).astype(np.int64)
    noise["can_id"], noise["length"] = _RESOLVER, 8
    for frame in noise:
        frame["data"] = protect(_RESOLVER, rng.integers(0, 2**48) << 16, rng.integers(0, COUNTER_MODULO), 0)
    return noise


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=60.0)
    arguments = parser.parse_args()
    rng, frames = np.random.default_rng(arguments.seed), _drive(arguments.seconds, arguments.seed)
    good = _estimates(frames)
    attacks = [(f"forged, {ahead} ms ahead of the genuine frame", forged_ahead(frames, ahead)) for ahead in _AHEAD_MS]
    attacks += [(f"played back after {old} s, 0.5 ms ahead", played_back(frames, old)) for old in _OLD_S]
    attacks.append((f"{_FLOOD_PER_S} valid frames/s of any counter on one id", flood(frames, rng)))
    print(f"seed {arguments.seed}, {arguments.seconds:g} s\n")
    print("| attack | frames | taken | usable | off by over 3 sigma, N | off without a reason, N |\n|---|---|---|---|---|---|")
    for name, foreign in attacks:
        mixed = np.concatenate([frames, foreign])
        order = np.argsort(mixed["time_ns"], kind="stable")
        taken = _taken(mixed[order], order >= len(frames), new_reception(), default_layout())
        estimates = _estimates(mixed[order])
        estimates = estimates[estimates["time_ns"] >= foreign["time_ns"][0]]
        usable = estimates[estimates["mode"] != FAULT]
        off = np.abs(usable["force"] - np.interp(usable["time_ns"], good["time_ns"], good["force"]))
        wrong = off[off > 3.0 * usable["sigma"]]
        unsaid = off[usable["reasons"] == 0]
        figures = (len(foreign), taken, len(usable) / len(estimates), wrong.max(initial=0.0), unsaid.max(initial=0.0))
        print("| {} | {} | {} | {:.0%} | {:.0f} | {:.0f} |".format(name, *figures))


if __name__ == "__main__":
    main()
