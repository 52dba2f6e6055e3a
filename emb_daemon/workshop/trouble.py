"""Trouble codes: one for each reason of each corner, with ISO 14229-1's status bits, ageing and a freeze frame.

The codes survive a kill: the file is written as a whole, at once when a code fails for the first time, and within a second of
other changes. A new operation cycle begins when the server starts, which it does together with the box.
"""

import struct
from pathlib import Path

import msgspec

from emb_daemon.adapt import files
from emb_daemon.estimator.status import TABLE
from emb_daemon.wire.contract import INIT, REASONS
from emb_daemon.wire.layout import CORNERS

#: Status bits (ISO 14229-1, D.2).
TEST_FAILED, FAILED_THIS_CYCLE, PENDING, CONFIRMED = 1 << 0, 1 << 1, 1 << 2, 1 << 3
NOT_COMPLETED_SINCE_CLEAR, FAILED_SINCE_CLEAR, NOT_COMPLETED_THIS_CYCLE = 1 << 4, 1 << 5, 1 << 6
#: All supported bits; there is no warning lamp.
AVAILABLE = 0x7F

#: Number of messages EMB_c_EstimatorStatus in a row, 100 ms apart, that must contain a reason before its code fails: a reason
#: in a single message is over before a driver or a controller can react.
_MATURE = 3
#: Operation cycles without failure after which a confirmed code is deleted, like OBD's warm-up cycles (SAE J1979).
AGED = 40
#: Longest time until changes other than a first failure are written, s.
_WRITE_S = 1.0
_FORMAT = 1
FILE = "trouble.json"

CODES = len(CORNERS) * len(REASONS)
_ALL = 0xFFFFFF


def code_of(corner: int, reason: int) -> int:
    """The 24-bit code of a reason's bit number: C1, the corner's number and the reason's, failure type 0 (ISO 15031-6). The
    sixth reason of RL is 0x520500, which testers show as C1205."""
    return (0x5000 | corner << 8 | reason) << 8


_INDEX = {code_of(*divmod(index, len(REASONS))): index for index in range(CODES)}


class Frame(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The estimate at one moment: ``time_s`` since 1970; forces N, temperatures degC, contact angle rad, ``facts`` as
    `estimator.status.names` has them. None: not to be used. Fields with that default are not on the bus; files of earlier
    versions lack them."""

    time_s: int
    mode: int
    source: int
    force_N: float | None
    sigma_N: float | None
    temperatures_C: tuple[float | None, ...]
    contact_angle_rad: float | None
    stiffness_factor: float | None
    stiffness_force_N: float | None = None
    stiffness_sigma_N: float | None = None
    torque_force_N: float | None = None
    torque_sigma_N: float | None = None
    facts: tuple[str, ...] | None = None

    #: time u32, mode u8, source u8, force and sigma u16 N, four temperatures i16 0.1 degC, contact angle i16 0.1 rad,
    #: stiffness factor u16 0.0001, force and sigma of stiffness path and torque path u16 N, facts u32, a bit for each of the
    #: table; big-endian. All ones, or the most negative number, mean: not to be used.
    LAYOUT = ">IBBHHhhhhhHHHHHI"

    def encode(self) -> bytes:
        def unsigned(value: float | None, scale: float) -> int:
            return 0xFFFF if value is None else min(max(round(value / scale), 0), 0xFFFE)

        def signed(value: float | None, scale: float) -> int:
            return -0x8000 if value is None else min(max(round(value / scale), -0x7FFF), 0x7FFF)

        return struct.pack(
            self.LAYOUT, self.time_s & 0xFFFFFFFF, self.mode, self.source,
            unsigned(self.force_N, 1.0), unsigned(self.sigma_N, 1.0),
            *(signed(value, 0.1) for value in self.temperatures_C), signed(self.contact_angle_rad, 0.1),
            unsigned(self.stiffness_factor, 1e-4),
            unsigned(self.stiffness_force_N, 1.0), unsigned(self.stiffness_sigma_N, 1.0),
            unsigned(self.torque_force_N, 1.0), unsigned(self.torque_sigma_N, 1.0),
            0xFFFFFFFF if self.facts is None else sum(1 << bit for bit, name in enumerate(TABLE) if name in self.facts),
        )  # fmt: skip


class Entry(msgspec.Struct, forbid_unknown_fields=True):
    """One code. ``aged``: operation cycles without failure since the last one; ``occurrences``: number of failures;
    ``frame``: freeze frame of the first failure since the code was last cleared."""

    status: int = NOT_COMPLETED_SINCE_CLEAR | NOT_COMPLETED_THIS_CYCLE
    aged: int = 0
    occurrences: int = 0
    frame: Frame | None = None


class _Stored(msgspec.Struct, forbid_unknown_fields=True):
    format: int
    entries: dict[int, Entry]


class TroubleMemory:
    """All codes, stored in a folder."""

    def __init__(self, folder: Path):
        """Read the stored codes, and begin an operation cycle. Raises OSError if the folder cannot be written."""
        self.path: Path = folder / FILE
        self.warning: str = ""  #: why an existing file is not used; empty if it is used, or if there was none
        self.entries: dict[int, Entry] = {code: Entry() for code in _INDEX}  #: by code
        self._consecutive = [0] * CODES
        self._dirty_s: float | None = None
        try:
            stored = files.decode(files.read(self.path), _Stored, _FORMAT)
            if unknown := stored.entries.keys() - self.entries.keys():
                raise ValueError(f"unknown codes {sorted(unknown)}")
            self.entries |= stored.entries
        except FileNotFoundError:
            pass
        except (ValueError, OSError) as error:
            self.warning: str = f"{self.path}: {error}, {files.set_aside(self.path)}"
        for entry in self.entries.values():
            _begin_cycle(entry)
        self.save()

    def save(self) -> None:
        """Raises OSError; the old file is then unchanged."""
        files.write(self.path, _Stored(_FORMAT, self.entries))
        self._dirty_s = None

    def evaluate(self, corner: int, mode: int, reasons: int, frame: Frame, now_s: float) -> None:
        """Evaluate one EMB_c_EstimatorStatus. Mode INIT is skipped: no inputs are expected yet. Errors as `save`."""
        first = False
        if mode != INIT:
            for reason in range(len(REASONS)):
                entry, index = self.entries[code_of(corner, reason)], corner * len(REASONS) + reason
                self._consecutive[index] = self._consecutive[index] + 1 if reasons >> reason & 1 else 0
                before = entry.status
                if self._consecutive[index] >= _MATURE:
                    first |= _fail(entry, frame)
                elif self._consecutive[index] == 0:
                    entry.status &= ~(TEST_FAILED | NOT_COMPLETED_SINCE_CLEAR | NOT_COMPLETED_THIS_CYCLE)
                if entry.status != before and self._dirty_s is None:
                    self._dirty_s = now_s
        if first or (self._dirty_s is not None and now_s - self._dirty_s >= _WRITE_S):
            self.save()

    def clear(self, group: int) -> bool:
        """Clear a code, or with 0xFFFFFF all; False if there is no such code. Errors as `save`."""
        codes = list(self.entries) if group == _ALL else [group]
        if group != _ALL and group not in self.entries:
            return False
        kept, self.entries = self.entries, self.entries | {code: Entry() for code in codes}
        try:
            self.save()
        except OSError:
            self.entries = kept
            raise
        for code in codes:
            self._consecutive[_INDEX[code]] = 0
        return True


def _begin_cycle(entry: Entry) -> None:
    """End one operation cycle and begin the next."""
    if not entry.status & (FAILED_THIS_CYCLE | NOT_COMPLETED_THIS_CYCLE):
        entry.status &= ~PENDING
        entry.aged += bool(entry.status & CONFIRMED)
        if entry.aged >= AGED:
            entry.status &= ~CONFIRMED
            entry.aged, entry.occurrences, entry.frame = 0, 0, None
    entry.status = entry.status & ~(TEST_FAILED | FAILED_THIS_CYCLE) | NOT_COMPLETED_THIS_CYCLE


def _fail(entry: Entry, frame: Frame) -> bool:
    """Set a code to failed; returns whether this was the first failure since the code was last cleared."""
    first = entry.frame is None
    if not entry.status & TEST_FAILED:
        entry.occurrences = min(entry.occurrences + 1, 255)
    if first:
        entry.frame = frame
    entry.aged = 0
    entry.status |= TEST_FAILED | FAILED_THIS_CYCLE | PENDING | CONFIRMED | FAILED_SINCE_CLEAR
    entry.status &= ~(NOT_COMPLETED_SINCE_CLEAR | NOT_COMPLETED_THIS_CYCLE)
    return first
