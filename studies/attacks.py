"""What an attacker on the bus can do who knows ids, layouts and E2E protection, but no key.

    python -m studies.attacks [--seed N] [--seconds S] [--frames N]

Without authentication, three attackers on a simulated drive: one who sends a forged resolver frame just before each genuine
one; one who plays back old samples, resolver and current, at the right counter just before the genuine ones; one who floods
the resolver's id with valid frames of any counter. Prints how many of their frames are taken; the share of answers from the
attack's begin on, the 20 s after it included, whose status is not Fault; and the largest change of those beyond three sigma,
and without any reason.

With authentication (`wire.secoc`), six attackers take turns until they have sent a million frames. Prints how many of theirs
and of the genuine frames are taken, and whether the forces are the same to the bit; and what verifying and signing cost.
"""

import argparse
from collections import Counter
from time import thread_time_ns

import numpy as np

from emb_daemon.adapt.adaptation import Adaptation
from emb_daemon.calibration.configuration import Setup
from emb_daemon.calibration.files import shipped_calibration
from emb_daemon.calibration.types import to_parameters
from emb_daemon.jit import njit
from emb_daemon.pipeline import Pipeline
from emb_daemon.plant.car import Car
from emb_daemon.plant.derive import plant_from_calibration
from emb_daemon.plant.scenarios import city_drive, commands_of
from emb_daemon.resources import resource
from emb_daemon.wire.contract import CYCLE_NS, FAULT
from emb_daemon.wire.e2e import COUNTER_MODULO, protect
from emb_daemon.wire.frames import FRAME
from emb_daemon.wire.layout import CORNERS, MOTOR_ANGLE, RESOLVER, default_layout, pack, unpack
from emb_daemon.wire.receive import ACCEPTED, new_reception, receive
from emb_daemon.wire.secoc import FRESHNESS_SET, Signer, Verifier, load_links

_RESOLVER, _CURRENT = 0x100, 0x110
#: Begin and end of the attack, s: before it every sender's schedule is known, and after it lasting effects show.
_FROM_S, _TO_S = 10.0, 40.0
#: Time between a forged frame and the genuine one after it, ms; amplitude of what it adds to the motor angle, rad, and period,
#: s, so that there is no step.
_AHEAD_MS, _ADDED_RAD, _SWINGS_S = (0.05, 0.5, 1.0, 2.1), 6.0, 2.0
#: Age of replayed frames, s: a whole number of turns of the counter.
_OLD_S = (0.06, 0.6, 3.0)
_FLOOD_PER_S = 6700
_START_NS = 1_000_000_000
#: One corner's links, and what is authenticated on them.
_RECEIVED, _SENT = load_links(corners=("FL",))
_AUTH, _FRESHNESS = _RECEIVED[0].authentication_id, _RECEIVED[0].freshness_id


@njit
def _moved(frames, signal, added):
    """Frames with ``added`` rad added to the motor angle, protected again."""
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


def drive(seconds: float, seed: int) -> np.ndarray:
    """Frames of one corner in the city."""
    plant = np.array([plant_from_calibration(shipped_calibration(), seed)])
    schedule = city_drive().first(seconds)
    return Car(plant, ("FL",), start_ns=_START_NS).run(commands_of(schedule, ("FL",)), schedule.drives)[0]


def estimated(frames: np.ndarray, adaptation: Adaptation | None = None) -> np.ndarray:
    """ESTIMATE rows of a corner with the shipped calibration."""
    pipeline = Pipeline(Setup(resource("config/emb.yaml")).parameters, ("FL",), capacity=1 << 17, adaptation=adaptation)
    pipeline.begin(int(frames["time_ns"][0]))
    _, count = pipeline.collect(frames, predictions=False)
    pipeline.answer(count)
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


def keys_of(seed: int) -> tuple[dict[str, bytes], bytes]:
    """Keys of all links by name, and one that no receiver knows."""
    rng = np.random.default_rng((seed, 7))
    keys = {link.name: rng.bytes(16) for link in (*_RECEIVED, *_SENT)}
    return keys, rng.bytes(16)


def signed(frames: np.ndarray, keys) -> np.ndarray:
    """A drive as its senders authenticate it."""
    return Signer(_RECEIVED, keys, 1).sign(frames).copy()


@njit
def _protect_anew(frames):
    for index in range(len(frames)):
        frame = frames[index]
        counter, status = (frame.data >> np.uint64(8)) & np.uint64(15), (frame.data >> np.uint64(12)) & np.uint64(15)
        frame.data = protect(frame.can_id, frame.data & ~np.uint64(0xFFFF), counter, status)


def _early(frames: np.ndarray, rng) -> np.ndarray:
    """Copies of the frames of authenticated messages, each up to 2 ms before the genuine one."""
    copies = frames[frames["time_ns"] > frames["time_ns"][0] + 250 * CYCLE_NS].copy()
    copies["time_ns"] -= rng.integers(50_000, 2_000_000, len(copies))
    return copies


def _with_code(frames: np.ndarray, code: np.ndarray) -> np.ndarray:
    """Authentication frames with another authenticator."""
    frames["data"] = frames["data"] & np.uint64((1 << 28) - 1) | code.astype(np.uint64) << np.uint64(28)
    return frames


def _forged_sets(genuine, rng, _keys):
    """Forged values, and a guessed authenticator under the expected freshness value."""
    forged = _early(genuine, rng)
    named = np.isin(forged["can_id"], [link.authentication_id for link in _RECEIVED])
    forged["data"] ^= np.where(named, 0, rng.integers(1, 2**16, len(forged)) << 16).astype(np.uint64)
    forged[named] = _with_code(forged[named], rng.integers(0, 2**36, named.sum()))
    return forged


def _guesses(genuine, rng, _keys):
    """Genuine values, and many guesses of their authenticator."""
    guesses = np.repeat(_early(genuine[genuine["can_id"] == _AUTH], rng), 4)
    return _with_code(guesses, rng.integers(0, 2**36, len(guesses)))


def _played_back(genuine, rng, _keys):
    """All frames of some turns of the counter ago, authentication included."""
    again = _early(genuine, rng)
    again["time_ns"] += rng.integers(1, 100) * COUNTER_MODULO * CYCLE_NS
    return again


def _played_back_as_expected(genuine, rng, keys):
    """The same, with the message counter that is expected now."""
    again = _played_back(genuine, rng, keys)
    now, named = genuine[genuine["can_id"] == _AUTH], again["can_id"] == _AUTH
    place = np.searchsorted(now["time_ns"], again["time_ns"][named]).clip(0, len(now) - 1)
    message = np.uint64(0xFF << 20)
    again["data"][named] = again["data"][named] & ~message | now["data"][place] & message
    return again


def _freshness_of_the_future(genuine, rng, _keys):
    """Trip and reset counters far ahead, after which all genuine frames would count as old, each with a guessed
    authenticator."""
    forged = _early(genuine[genuine["can_id"] == _AUTH], rng)
    forged = forged[: len(forged) // 2 * 2]
    counters = forged["data"][::2] & np.uint64(0xF00)
    forged["can_id"][::2] = _FRESHNESS
    forged["data"][::2] = counters | rng.integers(2**32, 2**48, len(counters), dtype=np.uint64) << np.uint64(16)
    forged["data"][1::2] = counters | np.uint64(FRESHNESS_SET << 16)
    forged["time_ns"][1::2] = forged["time_ns"][::2] + 1
    forged[1::2] = _with_code(forged[1::2], rng.integers(0, 2**36, len(counters)))
    return forged


def _another_key(genuine, rng, keys):
    """Frames that a sender with another key has authenticated."""
    theirs = Signer(_RECEIVED, dict.fromkeys(keys, keys["nobody"]), 1).sign(genuine[_of_drive(genuine)])
    return _early(theirs.copy(), rng)


FORGERIES = {
    "forged values and authenticators at the right time": _forged_sets,
    "authenticators guessed at the right time": _guesses,
    "played back, authentication included": _played_back,
    "played back under the freshness that is expected": _played_back_as_expected,
    "freshness of the future": _freshness_of_the_future,
    "authenticated with another key": _another_key,
}


def _of_drive(frames: np.ndarray) -> np.ndarray:
    """Mask of the frames that are not for authentication."""
    return ~np.isin(frames["can_id"], [can_id for link in _RECEIVED for can_id in (link.authentication_id, link.freshness_id)])


def forged(name: str, genuine: np.ndarray, rng: np.random.Generator, keys) -> np.ndarray:
    """Frames of one of the six attackers on the bus whose authentic frames are ``genuine``, rightly E2E protected."""
    frames = FORGERIES[name](genuine, rng, keys)
    _protect_anew(frames)
    return frames[(frames["time_ns"] > _START_NS) & (frames["time_ns"] < genuine["time_ns"][-1])]


def believed(genuine: np.ndarray, foreign: np.ndarray, keys) -> tuple[np.ndarray, int, int]:
    """Frames that `Verifier` passes on of both together; number of ``genuine`` frames that are missing, and of others that are
    accepted."""
    mixed = np.concatenate([foreign, genuine])
    heard = Verifier(_RECEIVED, keys, {}).verify(mixed[np.argsort(mixed["time_ns"], kind="stable")])
    taken, expected = heard[heard["flags"] == 0], genuine[_of_drive(genuine)]
    theirs, ours = (Counter(zip(part["can_id"].tolist(), part["data"].tolist(), strict=True)) for part in (taken, expected))
    return heard, (ours - theirs).total(), (theirs - ours).total()


def _authenticated(frames: np.ndarray, seed: int, count: int) -> None:
    keys, nobody = keys_of(seed)
    genuine = signed(frames, keys)
    keys["nobody"] = nobody
    good = estimated(Verifier(_RECEIVED, keys, {}).verify(genuine))
    totals = {name: np.zeros(4, int) for name in FORGERIES}
    turn = 0
    while sum(total[0] for total in totals.values()) < count:
        for number, (name, total) in enumerate(totals.items()):
            foreign = forged(name, genuine, np.random.default_rng((seed, turn, number)), keys)
            heard, missing, others = believed(genuine, foreign, keys)
            estimates = estimated(heard)
            changed = np.sum(estimates["force"] != good["force"]) if len(estimates) == len(good) else len(good)
            total += (len(foreign), others, missing, changed)
        turn += 1
    genuine_frames = turn * int(_of_drive(genuine).sum())
    print(f"\n| attack on authenticated frames | frames | accepted | genuine lost, of {genuine_frames} | forces changed |")
    print("|---|---|---|---|---|")
    for name, total in totals.items():
        print("| {} | {} | {} | {} | {} |".format(name, *total))
    print("| all together | {} | {} | {} | {} |".format(*sum(totals.values())))


def _cost(seed: int) -> None:
    """Median time of a tick of four corners, µs: of what the daemon hears and of what it sends; on the CPU, independent of
    other processes."""
    calibration = shipped_calibration()
    plants = np.array([plant_from_calibration(calibration, seed + k) for k in range(4)])
    schedule = city_drive().first(20.0)
    frames = Car(plants, CORNERS, start_ns=_START_NS).run(commands_of(schedule, CORNERS), schedule.drives)[0]
    received, sent = load_links()
    keys = {link.name: link.name.encode().ljust(16)[:16] for link in (*received, *sent)}
    car, verifier, signer = Signer(received, keys, 1), Verifier(received, keys, {}), Signer(sent, keys, 1)
    pipeline = Pipeline(np.repeat(to_parameters(calibration), 4), CORNERS)
    pipeline.begin(_START_NS)
    spent, answers = {"verify": [], "sign": []}, 0
    for cycle in np.split(frames, np.flatnonzero(np.diff((frames["time_ns"] - _START_NS) // CYCLE_NS)) + 1):
        authentic = car.sign(cycle)
        began = thread_time_ns()
        heard = verifier.verify(authentic)
        spent["verify"].append(thread_time_ns() - began)
        answer = pipeline.broadcast(pipeline.consume(heard)[1])
        began = thread_time_ns()
        signer.sign(answer)
        spent["sign"].append(thread_time_ns() - began)
        answers += len(answer)
    figures = [f"{name} {1e-3 * np.median(times):.0f} µs" for name, times in spent.items()]
    ticks = len(spent["sign"])
    print(
        f"\nA tick of four corners: {figures[0]} of {len(frames) / ticks:.1f} frames and their authentication that are heard,"
    )
    print(f"{figures[1]} of {answers / ticks:.1f} that are sent")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--frames", type=int, default=1_000_000, help="foreign frames among authenticated ones, at least")
    arguments = parser.parse_args()
    rng, frames = np.random.default_rng(arguments.seed), drive(arguments.seconds, arguments.seed)
    good = estimated(frames)
    attacks = [(f"forged, {ahead} ms ahead of the genuine frame", forged_ahead(frames, ahead)) for ahead in _AHEAD_MS]
    attacks += [(f"played back after {old} s, 0.5 ms ahead", played_back(frames, old)) for old in _OLD_S]
    attacks.append((f"{_FLOOD_PER_S} valid frames/s of any counter on one id", flood(frames, rng)))
    print(f"seed {arguments.seed}, {arguments.seconds:g} s\n")
    print("| attack | frames | accepted | usable | off by over 3 sigma, N | off without a reason, N |")
    print("|---|---|---|---|---|---|")
    for name, foreign in attacks:
        mixed = np.concatenate([frames, foreign])
        order = np.argsort(mixed["time_ns"], kind="stable")
        taken = _taken(mixed[order], order >= len(frames), new_reception(), default_layout())
        estimates = estimated(mixed[order])
        estimates = estimates[estimates["time_ns"] >= foreign["time_ns"][0]]
        usable = estimates[estimates["mode"] != FAULT]
        off = np.abs(usable["force"] - np.interp(usable["time_ns"], good["time_ns"], good["force"]))
        wrong = off[off > 3.0 * usable["sigma"]]
        unsaid = off[usable["reasons"] == 0]
        figures = (len(foreign), taken, len(usable) / len(estimates), wrong.max(initial=0.0), unsaid.max(initial=0.0))
        print("| {} | {} | {} | {:.0%} | {:.0f} | {:.0f} |".format(name, *figures))
    _authenticated(frames, arguments.seed, arguments.frames)
    _cost(arguments.seed)


if __name__ == "__main__":
    main()
