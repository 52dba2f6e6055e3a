"""How fast one core replays a log, stage by stage: from the file as it was recorded, and from the data set's columns; how
fast its frames are read from other formats, beside python-can; how much faster several workers are than one, what memory each
takes, and what a day of a large fleet costs.

``python -m studies.fleet_speed LOG [WORKERS]``, with the shipped calibration; by default as many workers as cores.
"""

import os
import sys
import tempfile
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from resource import RUSAGE_CHILDREN, getrusage
from statistics import median
from typing import TYPE_CHECKING

import psutil

from emb_daemon.calibration.files import shipped_calibration
from emb_daemon.calibration.types import Calibration, to_parameters
from emb_daemon.fleet.cluster import cluster, run
from emb_daemon.fleet.dataset import DIGEST, Drive, read_drive, write_drive
from emb_daemon.fleet.ingest import Job, ingest
from emb_daemon.fleet.replaying import replay_drive
from emb_daemon.identify.text import rounded
from emb_daemon.logs.candump import parse_candump
from emb_daemon.logs.read import log_ending, read_file, read_frames, read_log, unpack
from emb_daemon.logs.write import write_frames
from emb_daemon.offline import estimate
from emb_daemon.offline.log import samples_in
from emb_daemon.replay import Replay, corners_in

if TYPE_CHECKING:
    from distributed import Client

#: Number of runs of each stage. The fastest counts, because other load of the machine only slows a run.
_TIMES = 3
#: Samples of all drives that several workers replay: seconds of one worker's time, in which giving out the work hardly counts.
_SCALED_SAMPLES = 2_000_000
#: Additions of a task that only computes: about as long as the replay of a minute.
_ADDITIONS = 3_000_000
#: Hours that a fleet of 10 000 cars drives in a day.
_FLEET_H = 10_000


@dataclass(frozen=True)
class Stage:
    """One stage: processor time of one core over the log's samples, and the log's duration over that time."""

    name: str
    microseconds_a_sample: float
    times_real_time: float


def stages(path: Path, calibration: Calibration) -> list[Stage]:
    """Every stage from a log to estimates; complete replays last. Raises InputError: not readable, or without samples."""
    # Not imported by the workers, whose memory would not be a fleet's.
    from emb_daemon.fleet.scores import Scorer

    raw, frames = read_file(path), read_frames(path)
    corner = corners_in(frames, path)[0]
    parameters = to_parameters(calibration)

    samples, _ = samples_in(frames, (corner,))
    seconds = 1e-9 * float(frames["time_ns"][-1] - frames["time_ns"][0])
    with tempfile.TemporaryDirectory() as folder:
        root, scorer = Path(folder), Scorer(calibration)
        drive = next(Drive(**entry) for entry in ingest(root, Job(path, "unit", ""))["drives"] if entry["corner"] == corner)
        work: dict[str, Callable] = {"unpack": lambda: unpack(path, raw)}
        if log_ending(path) == ".log":
            text = unpack(path, raw)
            work["parse"] = lambda: parse_candump(text)
        work |= {
            "check and decode": lambda: samples_in(frames, (corner,)),
            "estimate": lambda: estimate(samples, parameters),
            "read columns": lambda: read_drive(root, drive),
            "project on all causes": lambda: scorer.score(read_drive(root, drive)[0], drive),
            "replay from the file": lambda: Replay(calibration, corner).run(path),
            "replay from columns": lambda: estimate(read_drive(root, drive)[0].samples, parameters),
        }
        return [Stage(name, 1e6 * (spent := _time(task)) / len(samples), seconds / spent) for name, task in work.items()]


@dataclass(frozen=True)
class Reading:
    """A log read in bulk and by python-can, frame by frame; its duration over the processor time of each."""

    ending: str
    bulk: float
    one_by_one: float


def readings(path: Path) -> Iterator[Reading]:
    """Read the frames of a log from the formats that are read in bulk. Raises InputError: not readable."""
    import can

    frames = read_frames(path)
    seconds = 1e-9 * float(frames["time_ns"][-1] - frames["time_ns"][0])
    readers = {".log": can.CanutilsLogReader, ".blf": can.BLFReader, ".mf4": can.MF4Reader}
    with tempfile.TemporaryDirectory() as folder:
        for ending, reader in readers.items():
            copy = Path(folder, f"drive{ending}")
            write_frames(copy, frames)
            bulk, single = _time(partial(read_log, copy)), _spent(partial(_read_one_by_one, reader, copy))
            yield Reading(ending, seconds / bulk, seconds / single)


def _read_one_by_one(reader: type, path: Path) -> None:
    deque(reader(path), maxlen=0)


@dataclass(frozen=True)
class Scaling:
    """Speed of several workers over that of one: of a replay from columns that writes its estimates, and of additions, which
    shows what the machine has left for them; and the most memory that one of them took."""

    replay: float
    additions: float
    memory_MiB: float


def scaling(path: Path, calibration: Calibration, workers: int) -> Scaling:
    """Replay copies of a log's first drive with one worker and with several, in turns; medians. Raises InputError: not
    readable, or without samples."""
    with tempfile.TemporaryDirectory() as folder, cluster(None, 1) as one, cluster(None, workers) as several:
        root = Path(folder)
        first = Drive(**ingest(root, Job(path, "unit", ""))["drives"][0])
        log, about = read_drive(root, first)
        count = max(8 * workers, -(-_SCALED_SAMPLES // len(log.samples)))
        drives = [replace(first, digest=f"{number:0{DIGEST}x}") for number in range(count)]
        for drive in drives:
            write_drive(root, drive, about, log.samples, log.force_N)
        replay = partial(replay_drive, root, calibration=calibration)
        gains = [_gain(task, drives, one, several) for task in (replay, _add)]
        return Scaling(*gains, max(several.run(_peak_MiB).values()))


def _gain(task: Callable[[Drive], object], drives: list[Drive], one: "Client", several: "Client") -> float:
    def wall_s(client: "Client") -> float:
        begin = time.monotonic()
        run(client, task, drives)
        return time.monotonic() - begin

    rounds = [(wall_s(one), wall_s(several)) for _ in range(1 + _TIMES)]
    # The first loads the kernels.
    return median(alone / together for alone, together in rounds[1:])


def _add(_drive: Drive) -> int:
    return sum(range(_ADDITIONS))


def _peak_MiB() -> float:
    # Not getrusage, whose peak a process inherits from the one that started it.
    status = Path("/proc/self/status").read_text()
    return int(status.partition("VmHWM:")[2].split()[0]) / 1024.0


def _time(task: Callable) -> float:
    """Processor time of the fastest run, s."""
    task()
    return max(min(_spent(task) for _ in range(_TIMES)), 1e-9)


def _spent(task: Callable) -> float:
    """Processor time of one run, s, and of the processes that it starts."""
    begin = _processor_s()
    task()
    return _processor_s() - begin


def _processor_s() -> float:
    # The process that reads MDF4 files lives on, and has children of its own.
    children = sum(sum(child.cpu_times()[:4]) for child in psutil.Process().children())
    return time.process_time() + sum(getrusage(RUSAGE_CHILDREN)[:2]) + children


def main() -> None:
    path, calibration = Path(sys.argv[1]), shipped_calibration()
    workers = int(sys.argv[2]) if len(sys.argv) > 2 else len(os.sched_getaffinity(0))
    print(f"{'stage':<24}µs a sample   × real time")
    times = {}
    for stage in stages(path, calibration):
        times[stage.name] = stage.times_real_time
        print(f"{stage.name:<24}{stage.microseconds_a_sample:>11.2f}{stage.times_real_time:>14.0f}")
    print(f"{'read from':<12}× real time   by python-can   ratio")
    for reading in readings(path):
        # Significant digits: of a log of seconds MF4 files are read no faster than their reader's process begins.
        bulk, single, ratio = (rounded(x, 3) for x in (reading.bulk, reading.one_by_one, reading.bulk / reading.one_by_one))
        print(f"{reading.ending:<12}{bulk:>11g}{single:>16g}{ratio:>8g}")
    print(f"{_FLEET_H} h a day take:")
    for name in ("replay from columns", "project on all causes"):
        print(f"{name:<24}{_FLEET_H / times[name]:.1f} core-hours; a core-second is {times[name] / 3600.0:.2f} h of driving")
    gain = scaling(path, calibration, workers)
    print(f"{workers} workers replay {gain.replay:.2f} times as fast as one, and add {gain.additions:.2f} times as fast")
    print(f"a worker takes {gain.memory_MiB:.0f} MiB at most")


if __name__ == "__main__":
    main()
