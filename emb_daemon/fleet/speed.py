"""How fast one core replays a log, stage by stage: from the file as it was recorded, and from the data set's columns."""

import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from emb_daemon.calibration.types import Calibration, to_parameters
from emb_daemon.fleet.dataset import Drive, read_drive
from emb_daemon.fleet.ingest import Job, ingest
from emb_daemon.fleet.scores import Scorer
from emb_daemon.logs.candump import parse_candump
from emb_daemon.logs.read import log_ending, read_file, read_frames, unpack_gzip
from emb_daemon.offline import estimate
from emb_daemon.offline.log import samples_in
from emb_daemon.replay import Replay, corners_in

#: Number of runs of each stage. The fastest counts, because other load of the machine only slows a run.
_TIMES = 3


@dataclass(frozen=True)
class Stage:
    """One stage: processor time of one core over the log's samples, and the log's duration over that time."""

    name: str
    microseconds_a_sample: float
    times_real_time: float


def stages(path: Path, calibration: Calibration) -> list[Stage]:
    """Every stage from a log to estimates; complete replays last.

    Raises:
        InputError: not readable, or without samples.
    """
    raw, frames = read_file(path), read_frames(path)
    corner = corners_in(frames, path)[0]
    parameters = to_parameters(calibration)

    samples, _ = samples_in(frames, (corner,))
    seconds = 1e-9 * float(frames["time_ns"][-1] - frames["time_ns"][0])
    with tempfile.TemporaryDirectory() as folder:
        root, scorer = Path(folder), Scorer(calibration)
        drive = next(Drive(**entry) for entry in ingest(root, Job(path, "unit", ""))["drives"] if entry["corner"] == corner)
        work: dict[str, Callable] = {"unpack": lambda: unpack_gzip(path, raw)}
        if log_ending(path) == ".log":
            text = unpack_gzip(path, raw)
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


def _time(task: Callable) -> float:
    """Processor time of the fastest run, s."""
    task()
    spent = []
    for _ in range(_TIMES):
        begin = time.thread_time()
        task()
        spent.append(time.thread_time() - begin)
    return max(min(spent), 1e-9)
