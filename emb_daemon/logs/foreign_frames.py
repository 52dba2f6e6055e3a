"""Signals of another rig's frames, by its DBC."""

import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from emb_daemon.errors import InputError
from emb_daemon.logs import j1939
from emb_daemon.logs.read import Recorded
from emb_daemon.logs.stamps import in_time
from emb_daemon.wire.frames import ERROR, EXTENDED, REMOTE

if TYPE_CHECKING:
    from cantools.database.can import Message

    from emb_daemon.logs.mapping import Mapping

#: Share of the payloads that may be missing in a gateway's copy, or at the beginning of a log.
_LOST_COPIES = 0.1
#: What DBCs call a raw value that is none, once words are apart; and a flag that says that all is well.
_APART = re.compile(r"[\W_]+|(?<=[a-z])(?=[A-Z])")
_NO_VALUE = re.compile(
    r"(?i)\b(sna|n a|unavailable|(not|nicht) (available|valid|defined|used|verf.*)|invalid|undefined|unknown|reser\w*|init\w*|"
    r"error\w*|fault\w*|fail\w*|(\w* )?fehler\w*|ung.ltig|no (data|signal|value))\b"
)
_FREE_OF = re.compile(r"(?i)(no|not|kein|ohne) (error|fault|fail|fehler)")


def decoded(
    mapping: "Mapping", path: Path, recorded: Recorded, wanted: Iterable[tuple[str | None, str]]
) -> dict[tuple[str | None, str], tuple[np.ndarray, np.ndarray]]:
    """Times and values of the rig's signals by bus and name, without those in frames that are too short."""
    found = {}
    by_message: dict[tuple[str | None, str], list[str]] = {}
    for bus, signal in sorted(wanted, key=str):
        by_message.setdefault((bus, signal.rpartition(".")[0]), []).append(signal)
    for (bus, name), signals in by_message.items():
        message = mapping.databases[bus].get_message_by_name(name)
        rows = _rows(mapping, path, recorded, message, mapping.channels[bus])
        in_group = j1939.is_group(message) and not np.any(recorded.frames["can_id"][rows] == message.frame_id)
        payloads = recorded.payloads(rows)
        readers = {signal: alone(message, signal.rpartition(".")[2]) for signal in signals}
        columns = {signal: np.array([read(payload) for payload in payloads]) for signal, read in readers.items()}
        if in_group or message.protocol == "j1939":
            parameters = {signal: message.get_signal_by_name(signal.rpartition(".")[2]) for signal in columns}
            columns = {signal: j1939.known(parameters[signal], values) for signal, values in columns.items()}
        # Each multiplexed part counts as a message of its own.
        for part in [[signal] for signal in columns] if message.is_multiplexed() else [list(columns)]:
            heard = np.any([np.isfinite(columns[signal]) for signal in part], axis=0)
            values = [columns[signal][heard] for signal in part]
            stamps, kept = in_time(f"{path}: {', '.join(part)}", recorded.frames["time_ns"][rows[heard]], values)
            found |= {(bus, signal): (stamps, column[kept]) for signal, column in zip(part, values, strict=True)}
    return found


def _rows(mapping: "Mapping", path: Path, recorded: Recorded, message, channel: str | None) -> np.ndarray:
    """Of a message's frames. Raises InputError: the log has nothing of the channel, or the message comes from two channels
    or senders and the mapping names none."""
    frames = recorded.frames
    flags = frames["flags"] & (EXTENDED | REMOTE | ERROR)
    of_kind = flags == EXTENDED * message.is_extended_frame
    mine = of_kind & (frames["can_id"] == message.frame_id)
    if not mine.any() and j1939.is_group(message):
        mine = of_kind & (j1939.group_of(frames["can_id"]) == j1939.group_of(message.frame_id))
        if len(senders := np.unique(frames["can_id"][mine])) > 1:
            raise InputError(
                f"{path}: {message.name} comes from several senders, as {', '.join(map(hex, senders.tolist()))}; give "
                "it the right one's id in the DBC"
            )
    channels = recorded.channels
    if channel is not None:
        if channel not in (known := np.unique(channels).tolist()):
            raise InputError(f"{path}: nothing of channel {channel}, which {mapping.path} names; found {', '.join(known)}")
        mine &= channels == channel
    elif len(known := np.unique(channels[mine]).tolist()) > 1 and not _is_copied(recorded, mine, channels):
        raise InputError(
            f"{path}: {message.name} ({message.frame_id:#x}) comes from channels {', '.join(known)}, and not the same; "
            f"name the right one in {mapping.path} (`buses:`, `channel`)"
        )
    return np.flatnonzero(mine)


def alone(message: "Message", name: str) -> Callable[[bytes], float]:
    """Function that reads one signal of a message (cantools) from a payload, even if others overlap with it in the DBC; NaN if
    the payload is too short or belongs to other multiplexed signals, or if the DBC calls the value one that is not available.
    Raises cantools.database.Error: the message has no room for it."""
    from cantools.database import DecodeError
    from cantools.database.can import Message

    signal = message.get_signal_by_name(name)
    if not message.is_multiplexed():
        message = Message(
            message.frame_id, message.name, message.length, [signal], is_extended_frame=message.is_extended_frame
        )
    nothing = {
        float(signal.raw_to_scaled(raw, decode_choices=False))
        for raw, choice in (signal.choices or {}).items()
        if _NO_VALUE.search(text := _APART.sub(" ", str(choice))) and not _FREE_OF.match(text)
    }

    def read(payload: bytes) -> float:
        try:
            value = float(message.decode(payload, decode_choices=False, allow_truncated=True).get(name, np.nan))
        except DecodeError:
            return np.nan
        return np.nan if value in nothing else value

    return read


def _is_copied(recorded: Recorded, mine: np.ndarray, channels: np.ndarray) -> bool:
    """Whether two channels carry the same frames of a message: a gateway's copy, or two loggers of one bus."""
    rows = np.flatnonzero(mine)
    payloads = np.array([payload.hex() for payload in recorded.payloads(rows)])
    by_channel = [set(payloads[channels[rows] == channel].tolist()) for channel in np.unique(channels[rows])]
    fewest = min(by_channel, key=len)
    return all(len(fewest - other) <= _LOST_COPIES * len(fewest) for other in by_channel)
