"""Reads log files into the data set: each once, in any format; damaged files are listed and do not end the work."""

import contextlib
import hashlib
import io
import re
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from emb_daemon.errors import InputError
from emb_daemon.fleet.dataset import DIGEST, About, Drive, day_of, note, read_results, write_drive
from emb_daemon.logs.mapping import Mapping
from emb_daemon.logs.read import LOG_ENDINGS, log_ending, read_with_digest
from emb_daemon.offline import corner_index
from emb_daemon.offline.log import make_log, samples_in
from emb_daemon.pipeline import Pipeline
from emb_daemon.replay import corners_in
from emb_daemon.wire.layout import CORNER_MESSAGES, CORNERS, WHEEL_SPEED
from emb_daemon.wire.receive import BAD_LENGTH, VERDICTS

#: Default pattern for the unit in a path: the folder that contains the log.
UNIT_OF_PATH = r"(?P<unit>[^/]+)/[^/]+$"


@dataclass(frozen=True)
class Job:
    """A log file to ingest. ``mapping``: file that maps another rig's signals to ours, or None."""

    path: Path
    unit: str
    day: str
    mapping: Path | None = None


def jobs(root: Path, paths: Iterable[Path], pattern: str = UNIT_OF_PATH, mapping: Path | None = None) -> list[Job]:
    """Log files that are not in the data set yet, by path, size and time of change. ``pattern``: regular expression that finds
    ``unit``, and ``day`` if it has such a group, in a log's absolute path. Raises InputError: the pattern is not valid, has no
    group ``unit``, or does not match a path."""
    try:
        compiled = re.compile(pattern)
    except re.error as error:
        raise InputError(f"--unit {pattern}: not a regular expression: {error}") from None
    if "unit" not in compiled.groupindex:
        raise InputError(f"--unit {pattern}: expected a group (?P<unit>…)")
    known = {entry["source"]: entry for entry in read_results(root)}
    result = []
    for path in paths:
        path = Path(path).absolute()
        found = compiled.search(str(path))
        if not found:
            raise InputError(f"{path}: --unit {pattern} does not match")
        earlier = known.get(str(path))
        if earlier and (earlier["size"], earlier["mtime_ns"]) == _stamp(path):
            continue
        result.append(Job(path, found["unit"], found.groupdict().get("day") or "", mapping))
    return result


def log_files(paths: Iterable[Path]) -> list[Path]:
    """The given files, and all logs in the given folders, in order. Raises InputError: no such file, or a folder without
    logs."""
    found: list[Path] = []
    for path in paths:
        inside = sorted(file for file in path.rglob("*") if log_ending(file) in LOG_ENDINGS) if path.is_dir() else [path]
        if not inside or not inside[0].exists():
            raise InputError(f"{path}: {'holds no logs' if path.is_dir() else 'no such file'}")
        found += inside
    return found


def give_up(root: Path, job: Job, reason: str) -> dict[str, Any]:
    """Note a file that killed its workers."""
    known = _nothing_of(job) | {"fault": f"{job.path}: {reason}"}
    note(root, known)
    return known


def _nothing_of(job: Job) -> dict:
    """Result for a file before it is read, see `dataset.read_results`; named by its path, as its content is unknown."""
    size, mtime_ns = _stamp(job.path)
    digest = hashlib.sha256(str(job.path).encode()).hexdigest()
    return {
        "source": str(job.path), "size": size, "mtime_ns": mtime_ns, "sha256": digest, "notes": "", "fault": "", "drives": [],
    }  # fmt: skip


def _stamp(path: Path) -> tuple[int, int]:
    try:
        stat = path.stat()
    except OSError:
        return -1, -1
    return stat.st_size, stat.st_mtime_ns


def ingest(root: Path, job: Job) -> dict[str, Any]:
    """Ingest one log file; returns the result, see `dataset.read_results`."""
    known, words = _nothing_of(job), io.StringIO()
    try:
        with contextlib.redirect_stderr(words):
            read = Mapping(job.mapping).read_with_digest if job.mapping else read_with_digest
            frames, digest = read(job.path)
        notes = words.getvalue().strip()
        found = ingest_frames(root, frames, job.unit, digest[:DIGEST], str(job.path), notes, job.day)
        known |= {"sha256": digest, "notes": notes, "drives": [asdict(drive) for drive in found]}
    except (InputError, MemoryError) as error:
        known["fault"] = str(error) or "more than this machine's memory"
    note(root, known)
    return known


def ingest_frames(
    root: Path, frames: np.ndarray, unit: str, digest: str, source: str, notes: str = "", day: str = ""
) -> list[Drive]:
    """A FRAME array as drives of the data set, one for each corner in it. Raises InputError: no resolver sample of any
    corner."""
    corners = corners_in(frames, Path(source))
    begin_ns = int(frames["time_ns"][0])
    samples, pipeline = samples_in(frames, corners)
    result = []
    for corner in corners:
        index = corner_index(corner)
        log = make_log(samples[samples["corner"] == index], frames, corner, Path(source))
        drive = Drive(unit, corner, day or day_of(begin_ns), begin_ns, digest)
        write_drive(root, drive, About(source, _count_refused(pipeline, index), notes), log.samples, log.force_N)
        result.append(drive)
    return result


def _count_refused(pipeline: Pipeline, index: int) -> dict[str, int]:
    """Number of refused frames by verdict: those of the corner and of the car."""
    corner = pipeline.receptions["count"][CORNER_MESSAGES * index : CORNER_MESSAGES * (index + 1)].sum(axis=0)
    counts = corner + pipeline.receptions["count"][WHEEL_SPEED:].sum(axis=0)
    return {VERDICTS[verdict]: int(counts[verdict]) for verdict in range(BAD_LENGTH, len(VERDICTS)) if counts[verdict]}


assert CORNER_MESSAGES * len(CORNERS) == WHEEL_SPEED
