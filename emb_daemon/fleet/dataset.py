"""A fleet's data set: a folder that every worker can access, Parquet partitioned by unit, corner and day.

::

    drives/unit=…/corner=…/day=…/DIGEST.parquet     samples of one log, DIGEST the beginning of the log's SHA-256
    ingested/PATH.json                              result for each log file, damaged ones included; PATH likewise of its path
    estimates/…, figures/…                          `fleet replay`, partitioned alike
    evidence/…, learned/…                           `fleet diagnose`, `fleet learn`: one file for each unit and corner

Files are complete at every moment and are never changed; writing a file again gives the same bytes. Copies of one log are one
drive of each unit that has them.
"""

import datetime
import hashlib
import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from emb_daemon.ahead.library import installed_digest
from emb_daemon.atomic import write_atomically
from emb_daemon.calibration.files import calibration_hash
from emb_daemon.calibration.types import Calibration
from emb_daemon.errors import InputError
from emb_daemon.estimator.records import SAMPLE
from emb_daemon.logs.columns import References
from emb_daemon.offline.log import Log
from emb_daemon.wire.frames import FRAME

#: Characters of a log's SHA-256 in its name: 64 bits; among 10⁷ logs two are alike with a chance of one in 10⁵.
DIGEST = 16
_FORMAT, _KEY = 1, b"emb_daemon"
#: Rows that are read at once.
_ROWS = 1 << 14
_FORCE = "clamp_force_ref_N"
#: Columns that a data set of format 1 may lack, because it is older than the support of force sensors. Zero: no sensor.
_OPTIONAL = {"sensor_force", "has_sensor_force"}


@dataclass(frozen=True, order=True)
class Drive:
    """One log's samples of one corner. ``day`` is ISO 8601; drives of one unit and corner sort by time."""

    unit: str
    corner: str
    day: str
    begin_ns: int
    digest: str

    @property
    def partition(self) -> Path:
        return partition(self.unit, self.corner) / f"day={quote(self.day, safe='')}"


@dataclass(frozen=True)
class About:
    """Information on the log in a drive's file, in addition to the samples. ``refused``: frames of the corner and the car that
    failed the checks of E2E, sequence or range, by verdict; ``notes``: remarks of the reader: truncated, resampled to the
    daemon's rate."""

    source: str
    refused: dict[str, int]
    notes: str


#: Digest of the sources of compiled code, as they were when the process began.
_kernels = cache(installed_digest)


def made_by(calibration: Calibration) -> str:
    """What a result is computed with, the calibration and the estimator, by their hashes. A result of others is computed anew,
    or an update would look like a change of the fleet on its day."""
    return f"{calibration_hash(calibration)} {_kernels()}"


def day_of(time_ns: int) -> str:
    """ISO 8601, in universal time."""
    return datetime.datetime.fromtimestamp(1e-9 * time_ns, datetime.UTC).date().isoformat()


def partition(unit: str, corner: str) -> Path:
    return Path(f"unit={quote(unit, safe='')}") / f"corner={corner}"


def folder_of(path: Path, *parts: str | Path) -> Path:
    """A folder of the data set, created if it does not exist. Raises InputError: it cannot be created."""
    folder = Path(path, *parts)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be a folder of the data set: {error.strerror}") from None
    return folder


def write_drive(root: Path, drive: Drive, about: About, samples: np.ndarray, force_N: np.ndarray) -> Path:
    """Write SAMPLE rows of one drive, and the reference force if there is one; completely or not at all."""
    import pyarrow
    import pyarrow.parquet

    columns = {name: np.ascontiguousarray(samples[name]) for name in SAMPLE.names}
    if np.isfinite(force_N).any():
        columns[_FORCE] = force_N
    table = pyarrow.table(columns)
    described = {"format": _FORMAT, **asdict(drive), **asdict(about)}
    table = table.replace_schema_metadata({_KEY: json.dumps(described, sort_keys=True)})
    sink = pyarrow.BufferOutputStream()
    pyarrow.parquet.write_table(table, sink, compression="zstd", compression_level=1)
    path = folder_of(root, "drives", drive.partition) / f"{drive.digest}.parquet"
    write_atomically(path, sink.getvalue())
    return path


def read_drive(root: Path, drive: Drive) -> tuple[Log, About]:
    """A drive as it was ingested. Raises InputError: no such drive, or not a file of a data set."""
    import pyarrow
    import pyarrow.parquet

    path = Path(root, "drives", drive.partition, f"{drive.digest}.parquet")
    try:
        # The names of the folders are not columns.
        file = pyarrow.parquet.ParquetFile(path)
        described, columns = json.loads(file.schema_arrow.metadata[_KEY]), file.schema_arrow.names
        samples, force = np.zeros(file.metadata.num_rows, SAMPLE), np.full(file.metadata.num_rows, np.nan)
        goals = {name: samples[name] for name in SAMPLE.names if name not in _OPTIONAL or name in columns}
        goals |= {_FORCE: force} if _FORCE in columns else {}
        start = 0
        # In pieces, because a long drive twice does not fit into a worker.
        for batch in file.iter_batches(_ROWS, use_threads=False):
            for name, goal in goals.items():
                goal[start : start + len(batch)] = batch.column(name).to_numpy(zero_copy_only=False)
            start += len(batch)
    except (OSError, KeyError, TypeError, ValueError, pyarrow.ArrowException) as error:
        raise InputError(f"{path}: not a drive of this data set: {error}") from None
    about = About(**{name: described[name] for name in About.__dataclass_fields__})
    log = Log(path, drive.corner, samples, samples["time_ns"], References(np.zeros(0, FRAME), drive.corner), force)
    return log, about


def drives(root: Path) -> list[Drive]:
    """Everything ingested, by unit, corner and time. Raises InputError: nothing was ingested."""
    if not (found := named(root)):
        raise InputError(f"{root}: holds no drives, expected a data set of emb-daemon fleet ingest")
    return sorted(found)


def named(root: Path) -> set[Drive]:
    """The drives that results name."""
    return {Drive(**entry) for known in read_results(root) for entry in known["drives"]}


def by_unit(found: list[Drive]) -> dict[tuple[str, str], list[Drive]]:
    """Drives by unit and corner."""
    groups: dict[tuple[str, str], list[Drive]] = {}
    for drive in found:
        groups.setdefault((drive.unit, drive.corner), []).append(drive)
    return groups


def read_results(root: Path) -> list[dict[str, Any]]:
    """Result for each log file: ``source``, ``size``, ``mtime_ns``, ``sha256`` (of a damaged file: of its path), ``notes``,
    ``fault`` (empty if the file is good) and its ``drives``."""
    return [json.loads(path.read_bytes()) for path in sorted(Path(root, "ingested").glob("*.json"))]


def note(root: Path, known: dict[str, Any]) -> None:
    """Store the result for a log file."""
    name = hashlib.sha256(known["source"].encode()).hexdigest()[:DIGEST]
    write_json(Path(root, "ingested", f"{name}.json"), known)


def write_json(path: Path, content: dict[str, Any]) -> None:
    """A file of the data set; the same content gives the same bytes."""
    folder_of(path.parent)
    write_atomically(path, json.dumps(content, sort_keys=True, indent=1).encode())


def forget(root: Path, drives: Iterable[Drive]) -> None:
    """Remove samples, estimates and figures of drives that no result names any more."""
    for drive in drives:
        for kind, ending in (("drives", "parquet"), ("estimates", "parquet"), ("figures", "json")):
            Path(root, kind, drive.partition, f"{drive.digest}.{ending}").unlink(missing_ok=True)
