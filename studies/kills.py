"""Is what was learned ever torn or lost? A daemon's pipeline that trains with a simulated car, killed at random moments while
other processes want its processor.

``python -m studies.kills COUNT SEED``. Each life begins from what the last one left, with pads of another thickness, and goes
as fast as the machine can. It says what it is about to keep, and what it has kept, before and after each write; half the
lives end at a moment drawn from all of it, half within some milliseconds of the beginning of a write. Of what is found then,
it must be the last that was kept or a later one that was accepted, whole, and the snapshot of the filter whole too. Exit
status 1 if one is not.
"""

import hashlib
import logging
import os
import select
import signal
import sys
import tempfile
import time
import traceback
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from emb_daemon.adapt import files
from emb_daemon.adapt.adaptation import Adaptation
from emb_daemon.adapt.memory import Memory, Store
from emb_daemon.adapt.snapshots import Snapshots
from emb_daemon.calibration.files import shipped_calibration
from emb_daemon.calibration.types import Calibration
from emb_daemon.estimator import restart
from emb_daemon.estimator.records import PARAMETERS
from emb_daemon.pipeline import Pipeline
from emb_daemon.plant.car import Car
from emb_daemon.plant.derive import plant_from_calibration
from emb_daemon.plant.scenarios import commands_of, park, rest

_CORNER = "FL"
#: A life's messages: "about to keep" and "kept", each followed by the store's digest; length of a message in bytes.
_ABOUT, _KEPT, _TELLS = b"A", b"K", 33
#: Time in which a parked car is asked for training and gives it, s.
_PARKED_S = 60.0
#: Time between one life and the next, ns: long enough for a brake to have cooled, whatever heated it unseen.
_NIGHT_NS = 8 * 3600 * 1_000_000_000
#: Latest moment of the kill after a write has begun, as a multiple of the time that a write takes.
_WRITING = 1.5


def digest(store: Store | None) -> bytes:
    """Digest of a store's file."""
    return hashlib.sha256(files.encode(store) if store else b"").digest()


class TellingMemory(Memory):
    """Writes to a pipe before and after it keeps a store."""

    def __init__(self, folder: Path, pipe: int):
        super().__init__(folder)
        self._pipe = pipe

    def save(self, store: Store) -> None:
        os.write(self._pipe, _ABOUT + digest(store))
        super().save(store)
        os.write(self._pipe, _KEPT + digest(store))


def live(memory: Memory, calibration: Calibration, pads_mm: float, night: int = 0) -> None:
    """Run a parked car, ``night`` nights after the first, until the daemon has asked for training and told its result.

    Evaluation and writing are done between two ticks, not by a helper thread, which would get no time in a simulation that
    runs faster than real time."""
    plant = plant_from_calibration(calibration, pad_thickness_mm=pads_mm)
    car = Car(np.atleast_1d(plant), (_CORNER,), 1)
    adaptation = Adaptation({_CORNER: calibration}, memory, lambda _: time.time_ns() + night * _NIGHT_NS)
    pipeline = Pipeline(np.zeros(4, PARAMETERS), (_CORNER,), capacity=64, adaptation=adaptation)
    adaptation.warm_up(pipeline.states[0], pipeline.parameters[0])
    pipeline.begin(0)
    schedule = rest(1.0) + park(1.0, _PARKED_S)
    # Released, so that the training stroke begins in the clearance.
    schedule.commands["mode"], schedule.commands["target"] = 0, 0.0
    commands = commands_of(schedule, (_CORNER,))
    for row in range(len(schedule)):
        _, count = pipeline.consume(car.tick(commands[row], schedule.drives[row]))
        car.receive(pipeline.broadcast(count))
        if pipeline.estimates["adapt_result"][:count].any():
            break
    adaptation.close(pipeline.states, pipeline.parameters)


@contextmanager
def _load(processes: int):
    """Keep so many processes computing without pause."""
    started = []
    try:
        for _ in range(processes):
            if (process := os.fork()) == 0:
                while True:
                    pass
            started.append(process)
        yield
    finally:
        for process in started:
            os.kill(process, signal.SIGKILL)
            os.waitpid(process, 0)


def _heard(pipe: int, seconds: float, until: bytes | None) -> bytes:
    """Messages of a life within ``seconds``, or up to the first that begins with ``until``."""
    said, end = b"", time.monotonic() + seconds
    while (left := end - time.monotonic()) > 0 and select.select([pipe], [], [], left)[0]:
        if not (more := os.read(pipe, _TELLS)):
            break
        said += more
        if more[:1] == until:
            break
    return said


def possible(last: bytes, said: bytes) -> tuple[list[bytes], int]:
    """Digests of the stores that may be found after a life that began with ``last`` and ``said`` these messages; and the
    number of writes that it completed."""
    accepted, kept = [last], 0
    for at in range(0, len(said), _TELLS):
        what, store = said[at : at + 1], said[at + 1 : at + _TELLS]
        # Once a store is kept, no earlier one may be found.
        accepted = [store] if what == _KEPT else [*accepted, store]
        kept += what == _KEPT
    return accepted, kept


def kills(count: int, seed: int, folder: Path, calibration: Calibration, load: int = 1) -> dict[str, int]:
    """Kill so many lives, and look at what each has left.

    Returns:
        ``kills``; ``kept`` writes that were completed and ``interrupted`` ones that were not; and, to be 0: ``torn`` files,
        ``lost`` stores, ``foreign`` ones that nobody accepted, ``snapshots`` that are torn.
    """
    rng = np.random.default_rng(seed)
    result = dict.fromkeys(("kills", "kept", "interrupted", "torn", "lost", "foreign", "snapshots"), 0)
    memory, last = Memory(folder), digest(None)
    # Lives are copies of this process, so that kernels are compiled once. The folder is on the disk that is tested.
    with tempfile.TemporaryDirectory(dir=folder) as scratch:
        for _ in range(2):
            begin = time.monotonic()
            live(Memory(Path(scratch)), calibration, 6.0)
        # Time from a life's begin to its write, and of a write, s.
        whole_s = (1 + load) * (time.monotonic() - begin)
        store, begin = Memory(Path(scratch)).read(_CORNER), time.monotonic()
        Memory(Path(scratch)).save(store)
        write_s = time.monotonic() - begin
    with _load(load):
        while result["kills"] < count:
            pads_mm, writing, after = rng.uniform(4.0, 10.0), rng.random() < 0.5, rng.random()
            ours, theirs = os.pipe()
            life = os.fork()
            if life == 0:
                try:
                    live(TellingMemory(folder, theirs), calibration, pads_mm, result["kills"])
                    os._exit(0)
                except BaseException:
                    traceback.print_exc()
                    os._exit(1)
            os.close(theirs)
            begin = time.monotonic()
            said = _heard(ours, 60.0, _ABOUT) if writing else _heard(ours, after * whole_s, None)
            if writing:
                whole_s = time.monotonic() - begin
                time.sleep(after * _WRITING * write_s)
            os.kill(life, signal.SIGKILL)
            os.waitpid(life, 0)
            said += _heard(ours, 1.0, None)
            os.close(ours)
            result["kills"] += 1
            accepted, kept = possible(last, said)
            result["kept"] += kept
            result["interrupted"] += len(accepted) > 1
            try:
                found = digest(memory.read(_CORNER))
            except ValueError:
                result["torn"] += 1
                continue
            if found not in accepted:
                result["lost" if found in (last, digest(None)) else "foreign"] += 1
            last = found
            snapshots = Snapshots(folder, restart.SNAPSHOT)
            with_learned = Adaptation({_CORNER: calibration}, memory, lambda _: 0).in_use(_CORNER)
            _, _, warning = snapshots.load(_CORNER, with_learned)
            result["snapshots"] += "damaged" in (warning or "")
    return result


def main() -> int:
    count, seed = int(sys.argv[1]), int(sys.argv[2])
    logging.disable(logging.WARNING)
    with tempfile.TemporaryDirectory() as folder:
        result = kills(count, seed, Path(folder), shipped_calibration())
    print(f"seed {seed}: " + ", ".join(f"{number} {name}" for name, number in result.items()))
    return int(any(result[name] for name in ("torn", "lost", "foreign", "snapshots")))


if __name__ == "__main__":
    sys.exit(main())
