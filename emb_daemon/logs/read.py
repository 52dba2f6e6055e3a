"""Any log file as an array of frames."""

import bz2
import contextlib
import gzip
import hashlib
import io
import lzma
import os
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import islice
from pathlib import Path

import numpy as np

from emb_daemon.bounded import read_input
from emb_daemon.errors import InputError, tell
from emb_daemon.logs.apart import mdf_columns
from emb_daemon.logs.blf import read_blf
from emb_daemon.logs.candump import parse_candump
from emb_daemon.logs.dialects import as_candump, tidied_trace, with_absolute_times
from emb_daemon.logs.inflate import inflate
from emb_daemon.logs.resample import at_our_rate
from emb_daemon.wire.contract import CYCLE_NS
from emb_daemon.wire.frames import ERROR, EXTENDED, FD, FRAME, REMOTE, row_of

#: First bytes of a log: the ending of its format.
_BEGINNINGS = {
    b"LOGG": ".blf", b"MDF     ": ".mf4", b"UnFinMF ": ".mf4", b";$FILEVERSION": ".trc", b"(": ".log", b"date ": ".asc",
}  # fmt: skip
#: How archives begin, and workbooks and NumPy's, which are such.
ZIP = b"PK\x03\x04"
#: First bytes of a packed file: its packer, and what opens it.
_PACKED = {
    b"\x1f\x8b": ("gzip", lambda file: gzip.GzipFile(fileobj=file)),
    b"BZh": ("bzip2", bz2.BZ2File),
    b"\xfd7zXZ": ("xz", lzma.LZMAFile),
}
#: Where and how what nothing here reads begins, what it is, and what would do.
_OF_MESSAGES, _ARCHIVE = "expected what it holds as CSV, Parquet or .mat", "unpack it first"
_UNREAD = (
    (0, b"#ROSBAG", "a ROS bag", _OF_MESSAGES),
    (0, b"\x89MCAP", "a ROS 2 bag", _OF_MESSAGES),
    (0, b"SQLite format 3", "a database, as ROS 2 bags are", _OF_MESSAGES),
    (0, b"\x80\x04\x95", "a pickle of Python", _OF_MESSAGES),
    (0, b"\x80\x05\x95", "a pickle of Python", _OF_MESSAGES),
    (0, b"%PDF", "a PDF", _OF_MESSAGES),
    (0, b"<!DOCTYPE html", "a web page", "download the file itself"),
    (0, b"<html", "a web page", "download the file itself"),
    (0, b"version https://git-lfs", "a pointer of Git LFS to a file that is not here", "`git lfs pull` fetches that"),
    (0, b"7z\xbc\xaf", "a 7z archive", _ARCHIVE),
    (0, b"Rar!", "a RAR archive", _ARCHIVE),
    (0, b"\x28\xb5\x2f\xfd", "packed by zstd", _ARCHIVE),
    (0, b"\x04\x22\x4d\x18", "packed by lz4", _ARCHIVE),
    (257, b"ustar", "a tar archive", _ARCHIVE),
)
#: How python-can's tables begin; number of bytes shown of a text that does not.
_CSV, _SHOWN_BYTES = b"timestamp,arbitration_id", 60
#: Number of ids listed if the expected ones are not in a log.
_LISTED = 8


def _most_bytes() -> int:
    """Largest size of a log, in bytes: a quarter of this machine's memory, because what is made of it needs memory too."""
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 4


def log_ending(path: Path) -> str:
    """The ending that decides a log's format: the last one before that of a packer."""
    return Path(path.stem).suffix.lower() if path.suffix.lower() in (".gz", ".bz2", ".xz") else path.suffix.lower()


def ending_of_content(content: bytes) -> str:
    """A log's format by its first bytes, as its ending; empty if they do not show it."""
    return next((ending for beginning, ending in _BEGINNINGS.items() if content.startswith(beginning)), "")


def needs_extra(path: Path, error: ImportError, extra: str = "mf4") -> InputError:
    """The error for a format of which a library is not installed."""
    return InputError(f"{path}: this format needs an extra: pip install emb_daemon[{extra}] ({error})")


def read_file(path: Path) -> bytes:
    """The one place where a log file is read."""
    return read_input(path, _most_bytes())


def unpack(path: Path, raw: bytes) -> bytes:
    """A file's bytes, unpacked if it was packed, whatever it is called; a truncated one up to its end. Raises InputError:
    damaged, too large once it is unpacked, or of a kind that nothing here reads."""
    content = _unpacked(path, raw)
    for at, begins, what, would_do in _UNREAD:
        if content.startswith(begins, at):
            raise InputError(f"{path}: is {what}, which is not read; {would_do}")
    return content


def _unpacked(path: Path, raw: bytes) -> bytes:
    packer, opened = next((how for beginning, how in _PACKED.items() if raw.startswith(beginning)), ("", None))
    if opened is None:
        return raw
    if packer == "gzip":
        # For a file that is not one complete stream, Python's module says what is wrong and how much can be read.
        with contextlib.suppress(InputError):
            content, complete = inflate(raw, zlib.MAX_WBITS | 16, _most_bytes())
            if complete:
                return content
    parts, left = [], _most_bytes()
    try:
        with opened(io.BytesIO(raw)) as file:
            while part := file.read1(1 << 20):
                parts.append(part)
                left -= len(part)
                if left < 0:
                    raise InputError(f"{path}: unpacks to more than {_most_bytes()} bytes, a quarter of this machine's memory")
    except (OSError, zlib.error, lzma.LZMAError) as error:
        raise InputError(f"{path}: damaged {packer} file ({error})") from None
    except EOFError:
        content = b"".join(parts)
        tell(f"{path}: cut off, read up to there ({len(content)} bytes)")
        return content
    return b"".join(parts)


@dataclass(frozen=True)
class Recorded:
    """A log file as it stands: ``frames``, a FRAME array in file order, ``octets``, their payloads one after the other (those
    of CAN FD whole), ``names`` gives the channel of each frame, and ``digest`` is the SHA-256 of the file."""

    frames: np.ndarray
    octets: np.ndarray
    digest: str
    names: Callable[[], np.ndarray]

    @cached_property
    def channels(self) -> np.ndarray:
        """Of each frame, as text: as candump names it, by number in other formats, Vector's from 1."""
        return self.names()

    def payloads(self, rows: np.ndarray) -> list[bytes]:
        """Payloads of the frames with these row numbers."""
        ends = np.cumsum(self.frames["length"], dtype=np.int64)
        starts = ends - self.frames["length"]
        return [self.octets[start:end].tobytes() for start, end in zip(starts[rows], ends[rows], strict=True)]


#: Of a log's content: frames, payloads, and what gives the channels, as of `Recorded`.
_Parsed = tuple[np.ndarray, np.ndarray, Callable[[], np.ndarray]]


def _candump(path: Path, text: bytes) -> _Parsed:
    octets = np.zeros(len(text) // 2, np.uint8)
    frames, bad_line, unfinished = parse_candump(text, octets)
    if bad_line and unfinished and bad_line > 1:
        tell(f"{path}: line {bad_line} is cut off, left out")
    elif bad_line:
        raise InputError(f"{path}:{bad_line}: not a candump line, expected '(seconds.fraction) interface id#data'")

    def channels() -> np.ndarray:
        # Only when asked: the lines of a long log take more memory than its frames.
        lines = islice(filter(None, text.splitlines()), len(frames))
        return np.array([line.split(b" ", 2)[1].decode() for line in lines])

    return frames, octets, channels


def _blf(path: Path, content: bytes) -> _Parsed:
    frames, octets, channels, cut = read_blf(path, content, _most_bytes())
    if cut:
        tell(f"{path}: cut off, read up to there ({len(frames)} frames)")
    return frames, octets, lambda: channels.astype(str)


def _mf4(path: Path, content: bytes) -> _Parsed:
    try:
        columns = mdf_columns(path, content, 2 * _most_bytes())
    except ImportError as error:
        raise needs_extra(path, error) from None
    if not columns:
        raise InputError(f"{path}: holds no frames; a measurement's channels need a mapping without dbc")
    octets, frames = columns["octets"], np.zeros(len(columns["time_ns"]), FRAME)
    there = np.arange(octets.shape[1]) < columns["length"][:, None]
    data = np.zeros((len(frames), 8), np.uint8)
    width = min(8, octets.shape[1])
    data[:, :width] = np.where(there, octets, 0)[:, :width]
    frames["data"] = data.view("<u8")[:, 0]
    for name in ("time_ns", "can_id", "length"):
        frames[name] = columns[name]
    for name, flag in (("extended", EXTENDED), ("remote", REMOTE), ("error", ERROR), ("fd", FD)):
        frames["flags"] |= columns[name] * np.uint8(flag)
    return frames, octets[there], lambda: columns["channel"].astype(str)


def _python_can(reader_name: str, path: Path, content: bytes) -> _Parsed:
    import can
    from can.io.generic import TextIOMessageReader

    if reader_name == "TRCReader":
        content = tidied_trace(content)
    if reader_name == "ASCReader":
        content = with_absolute_times(content)
    kind, file, octets, rows, channels = getattr(can, reader_name), io.BytesIO(content), bytearray(), [], []
    try:
        for message in kind(io.TextIOWrapper(file) if issubclass(kind, TextIOMessageReader) else file):
            octets += message.data
            # Its reader numbers from zero what the tools number from one.
            channels.append(str(message.channel + 1 if reader_name == "ASCReader" else message.channel))
            rows.append(row_of(message, round(message.timestamp * 1e9)))
        frames = np.array(rows, FRAME)
    except Exception as error:
        if reader_name == "CSVReader" and not content.startswith(_CSV):
            # What its reader says is about columns of its own, which this text has not.
            begins = content[:_SHOWN_BYTES].decode(errors="replace").splitlines()[:1]
            raise InputError(
                f"{path}: begins with {begins}, as no log of frames that is known here does (python-can's CSV, SavvyCAN's, "
                "PEAK-Converter's); a table of signals needs --mapping of its columns (without dbc)"
            ) from None
        text = str(error) or type(error).__name__
        raise InputError(f"{path}: not readable by python-can's {reader_name}: {text}") from None
    return frames, np.frombuffer(octets, np.uint8), lambda: np.array(channels)


#: What parses a log, by the ending of its format.
_PARSERS: dict[str, Callable[[Path, bytes], _Parsed]] = {
    ".log": _candump,
    ".blf": _blf,
    ".mf4": _mf4,
    ".asc": partial(_python_can, "ASCReader"),
    ".trc": partial(_python_can, "TRCReader"),
    ".csv": partial(_python_can, "CSVReader"),
}
#: Endings of log files, before ``.gz``.
LOG_ENDINGS: tuple[str, ...] = tuple(_PARSERS)


def ids_in(frames: np.ndarray) -> str:
    """The most frequent ids of FRAME rows, in words."""
    found, counts = np.unique(frames["can_id"], return_counts=True)
    often = found[np.argsort(-counts, kind="stable")]
    listed = ", ".join(f"{can_id:#x}" for can_id in np.sort(often[:_LISTED]))
    return f"{listed} and {len(found) - _LISTED} more" if len(found) > _LISTED else listed


def read_frames(path: str | Path) -> np.ndarray:
    """All frames of a log as a FRAME array; ``time_ns`` is the log's own clock.

    They stand in file order; those of a log whose resolver has another rate than ours are brought to it
    (`resample.at_our_rate`), with a word on stderr. The format goes by how the file begins or, where that tells nothing, by
    the last ending alone (before ``.gz``), so that names with dots in them are fine. Raises InputError: missing, damaged,
    empty or unknown file; names the file and the line where there are lines."""
    return read_with_digest(path)[0]


def read_with_digest(path: str | Path) -> tuple[np.ndarray, str]:
    """`read_frames`, and the SHA-256 of the file as it was read."""
    recorded = read_log(path)
    frames = at_our_rate(recorded.frames)
    if frames is not recorded.frames:
        tell(f"{path}: sampled at another rate than every {CYCLE_NS // 1_000_000} ms, brought to it")
    return frames, recorded.digest


def read_log(path: str | Path) -> Recorded:
    """A log as it stands. Raises InputError: as `read_frames`."""
    path = Path(path)
    raw = read_file(path)
    content = unpack(path, raw)
    if rewritten := as_candump(content):
        content = rewritten
    ending = ".log" if rewritten else ending_of_content(content) or log_ending(path)
    if ending not in LOG_ENDINGS or content.startswith(ZIP):
        known = ".log, .log.gz, .asc, .blf, .trc or .mf4"
        raise InputError(
            f"{path}: unknown log format, expected {known} (unpack an archive first), or --mapping of a table's columns "
            "(without dbc)"
        )
    frames, octets, channels = _PARSERS[ending](path, content)
    if not len(frames):
        raise InputError(f"{path}: holds no frames")
    return Recorded(frames, octets, hashlib.sha256(raw).hexdigest(), channels)
