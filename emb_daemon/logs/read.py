"""Any log file as an array of frames."""

import gzip
import io
import sys
import zlib
from pathlib import Path

import numpy as np

from emb_daemon.errors import InputError
from emb_daemon.logs.candump import parse_candump
from emb_daemon.wire.frames import ERROR, EXTENDED, FD, FRAME, REMOTE, TRANSMITTED

_PYTHON_CAN = {".asc": "ASCReader", ".blf": "BLFReader", ".trc": "TRCReader", ".mf4": "MF4Reader", ".csv": "CSVReader"}


def _content(path: Path) -> bytes:
    """A file's bytes, unpacked if they are gzip's, whatever the file is called."""
    try:
        raw = path.read_bytes()
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from None
    if raw[:2] != b"\x1f\x8b":
        return raw
    try:
        return gzip.decompress(raw)
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise InputError(f"{path}: damaged gzip file ({error})") from None


def _candump(path: Path) -> np.ndarray:
    text = _content(path)
    frames, bad_line, unfinished = parse_candump(text)
    if bad_line and unfinished and bad_line > 1:
        print(f"{path}: line {bad_line} is cut off, left out", file=sys.stderr)
    elif bad_line:
        raise InputError(f"{path}:{bad_line}: not a candump line, expected '(seconds.fraction) interface id#data'")
    return frames


def _python_can(path: Path, reader_name: str) -> np.ndarray:
    import can
    from can.io.generic import TextIOMessageReader

    content = io.BytesIO(_content(path))
    try:
        kind = getattr(can, reader_name)
        reader = kind(io.TextIOWrapper(content) if issubclass(kind, TextIOMessageReader) else content)
        rows = [
            (
                round(message.timestamp * 1e9),
                int.from_bytes(message.data[:8], "little"),
                message.arbitration_id,
                len(message.data),
                EXTENDED * message.is_extended_id
                | REMOTE * message.is_remote_frame
                | ERROR * message.is_error_frame
                | FD * message.is_fd
                | TRANSMITTED * (not message.is_rx),
            )
            for message in reader
        ]
    except ImportError as error:
        raise InputError(f"{path}: reading this format needs an extra: pip install emb_daemon[mf4] ({error})") from None
    except Exception as error:
        raise InputError(f"{path}: not readable by python-can's {reader_name}: {error}") from None
    return np.array(rows, FRAME)


def read_frames(path: str | Path) -> np.ndarray:
    """All frames of a log as a FRAME array in file order; ``time_ns`` is the log's own clock.

    The format goes by the last ending alone (before ``.gz``), so that names with dots in them are fine.

    Raises:
        InputError: missing, damaged, empty or unknown file; names the file and the line where there are lines.
    """
    path = Path(path)
    ending = Path(path.stem).suffix.lower() if path.suffix.lower() == ".gz" else path.suffix.lower()
    if ending == ".log":
        frames = _candump(path)
    elif ending in _PYTHON_CAN:
        frames = _python_can(path, _PYTHON_CAN[ending])
    else:
        raise InputError(f"{path}: unknown log format, expected .log, .log.gz, .asc, .blf, .trc or .mf4")
    if not len(frames):
        raise InputError(f"{path}: holds no frames")
    return frames
