"""The estimates of every tick in memory that another process reads: a ring of rows, and the parameters in use.

The loop writes without waiting. A reader that is too late loses rows, and gets the number of lost rows.
"""

import hashlib
import mmap
import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from emb_daemon.atomic import write_atomically
from emb_daemon.estimator.records import ESTIMATE, PARAMETERS, SAMPLE
from emb_daemon.wire.layout import CORNERS

if TYPE_CHECKING:
    from emb_daemon.pipeline import Pipeline

#: Rows in the ring: two seconds of four corners at 250 Hz, enough for a reader of lowest priority.
ROWS = 2048
#: Only the newest half is read, so that the loop does not overwrite rows that are being read. The loop updates the count
#: after at most a quarter.
_READABLE, _AT_ONCE = ROWS // 2, ROWS // 4
#: Ticks between writing the parameters of one corner and of the next: learned values appear within a second.
_PARAMETERS_TICKS = 50

#: The complete file. ``written`` counts rows since the daemon's start; row ``n`` is at index ``n % ROWS``.
#: ``on_page`` is not 0 while a corner is estimated with another calibration than its file's (`runtime.pages`).
SHARED = np.dtype(
    [
        ("layout", "S16"),
        ("written", "i8"),
        ("on_page", "i8"),
        ("parameters", PARAMETERS, (len(CORNERS),)),
        ("samples", SAMPLE, (ROWS,)),
        ("estimates", ESTIMATE, (ROWS,)),
    ],
    align=True,
)
#: Largest age of a row that counts as present, ns: that of the first of the three messages in a row that fail a trouble code.
_PRESENT_NS = 300_000_000
#: Number of looks without a row after which no daemon counts as sharing. It is not a time, because a reader of lowest priority
#: may look seldom; it gets the first rows at its third look.
_LOOKS = 15
#: Version of the records above, on which writer and reader must agree.
LAYOUT_DIGEST = hashlib.sha256(repr((SHARED.descr, SHARED.itemsize)).encode()).hexdigest()[:16].encode()


def _field(memory, name: str) -> np.ndarray:
    kind, offset = SHARED.fields[name][:2]
    return np.frombuffer(memory, kind.base, int(np.prod(kind.shape)), offset)


def _bytes_of(rows: np.ndarray) -> np.ndarray:
    """Rows as bytes, shape (rows, size): copied as they are, not field by field."""
    return rows.view(np.uint8).reshape(len(rows), rows.dtype.itemsize)


class SharedEstimates:
    """The loop's side, which shares a pipeline's rows and parameters. ``path``: the file, in a folder that is kept in memory,
    such as /run; the loop would have to wait for a disk."""

    def __init__(self, path: Path, pipeline: "Pipeline"):
        """Raises OSError if the file cannot be written."""
        content = np.zeros((), SHARED)
        content["layout"], content["parameters"] = LAYOUT_DIGEST, pipeline.parameters
        self.path = path
        # The file gets its name only when it is complete. A reader of an earlier daemon's file keeps that file open.
        write_atomically(path, content.tobytes())
        with open(path, "r+b") as file:
            memory = mmap.mmap(file.fileno(), SHARED.itemsize)
        self._written, self._on_page = _field(memory, "written"), _field(memory, "on_page")
        self._copies = [
            (_bytes_of(_field(memory, name)), _bytes_of(rows))
            for name, rows in (("samples", pipeline.samples), ("estimates", pipeline.estimates))
        ]
        self._parameters = _bytes_of(_field(memory, "parameters")), _bytes_of(pipeline.parameters)
        self._count = self._ticks = 0

    def write(self, count: int) -> None:
        """Write the pipeline's first ``count`` rows."""
        for start in range(0, count, _AT_ONCE):
            end, place = min(start + _AT_ONCE, count), self._count % ROWS
            middle = min(end, start + ROWS - place)
            for ring, rows in self._copies:
                ring[place : place + middle - start] = rows[start:middle]
                if middle < end:
                    ring[: end - middle] = rows[middle:end]
            self._count += end - start
            # Written last, when the rows that it counts are complete.
            self._written[0] = self._count
        self._ticks += 1
        if self._ticks % _PARAMETERS_TICKS == 0:
            corner, (shared, used) = self._ticks // _PARAMETERS_TICKS % len(CORNERS), self._parameters
            shared[corner] = used[corner]

    def tell_page(self, on_page: bool) -> None:
        """Write whether a corner is estimated with another calibration than that of its file."""
        self._on_page[0] = on_page

    def close(self) -> None:
        self.path.unlink(missing_ok=True)


class EstimatesReader:
    """The reader's side, which may start before the daemon and end after it. ``connected``: whether a daemon's file is being
    read."""

    def __init__(self, path: Path):
        self.path = path
        self.trouble: str = ""  #: why an existing file is not read; empty if it is read, or if there is none
        #: PARAMETERS array, shape (4,), as the daemon uses them; zeros before the first file.
        self.parameters: np.ndarray = np.zeros(len(CORNERS), PARAMETERS)
        self._inode = self._taken = self._seen = 0
        self._memory: mmap.mmap | None = None

    @property
    def connected(self) -> bool:
        return self._memory is not None

    @property
    def on_page(self) -> bool:
        """Whether a corner is estimated with another calibration than its file's."""
        return self._memory is not None and bool(self._on_page[0])

    def look(self) -> None:
        """Look for the file of a daemon that has started or restarted; costs a system call."""
        try:
            with open(self.path, "rb") as file:
                status = os.fstat(file.fileno())
                if status.st_ino == self._inode:
                    return
                self._inode, self._memory = status.st_ino, None
                if status.st_size != SHARED.itemsize or file.read(len(LAYOUT_DIGEST)) != LAYOUT_DIGEST:
                    self.trouble = f"{self.path}: written by another version of the daemon"
                    return
                self._memory = mmap.mmap(file.fileno(), SHARED.itemsize, access=mmap.ACCESS_READ)
        except FileNotFoundError:
            self._inode, self._memory, self.trouble = 0, None, ""
            return
        except OSError as error:
            self.trouble = f"{self.path}: {error.strerror}"
            return
        self.trouble = ""
        self.parameters = _field(self._memory, "parameters")
        self._written, self._on_page = _field(self._memory, "written"), _field(self._memory, "on_page")
        self._rings = [_field(self._memory, name) for name in ("samples", "estimates")]
        self._taken = self._seen = int(self._written[0])

    def take(self) -> tuple[np.ndarray, np.ndarray, int]:
        """SAMPLE and ESTIMATE rows since the last call, and how many others were lost."""
        if self._memory is None:
            return np.zeros(0, SAMPLE), np.zeros(0, ESTIMATE), 0
        # A row is read one call after it was counted, because on some machines the count may be visible before the row.
        until, self._seen = self._seen, int(self._written[0])
        start = max(self._taken, self._seen - _READABLE)
        places = np.arange(start, max(until, start)) % ROWS
        samples, estimates = (ring[places] for ring in self._rings)
        # Rows that the loop may have overwritten meanwhile are discarded.
        torn = min(max(int(self._written[0]) - (ROWS - _AT_ONCE) - start, 0), len(places))
        lost = start - self._taken + torn
        self._taken = start + len(places)
        return samples[torn:], estimates[torn:], lost


class PresentEstimates:
    """The newest estimate of each corner, for readers that need no others. ``trouble``: why there are none; empty if there
    are."""

    def __init__(self, path: Path):
        self._reader = EstimatesReader(path)
        self._rows: dict[int, np.void] = {}
        self._now_ns = self._in_vain = 0
        self.trouble: str = ""

    def follow(self, now_ns: int) -> None:
        """Take what has been shared since the last call; ``now_ns`` on the monotonic clock."""
        self._reader.look()
        _, taken, _ = self._reader.take()
        # A prediction has neither the forces of the paths nor facts.
        self._rows.update((int(row["corner"]), row) for row in taken[taken["is_sample"]])
        self._now_ns, self._in_vain = now_ns, 0 if len(taken) else self._in_vain + 1
        why = self._reader.trouble or f"{self._reader.path}: no daemon shares its estimates there"
        self.trouble = why if self._in_vain > _LOOKS else ""

    def of(self, corner: int) -> np.void | None:
        """ESTIMATE of a corner's newest sample; None if there is none of the present."""
        row = self._rows.get(corner)
        return None if row is None or self._now_ns - row["time_ns"] > _PRESENT_NS else row
