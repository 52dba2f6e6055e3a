"""Vector's binary logs (.blf), read in bulk: containers of compressed objects, of which one kind each is a frame.

Sizes that a file states are never trusted: no byte outside of an object is read as its own.
"""

import datetime
import struct
import zlib
from pathlib import Path

import numpy as np

from emb_daemon.errors import InputError
from emb_daemon.jit import njit
from emb_daemon.logs.inflate import inflate
from emb_daemon.wire.frames import ERROR, EXTENDED, FD, FRAME, REMOTE

#: Bytes of a file's header that are used, and where it has its own size and the time of its start.
_HEADER, _SIZE_AT, _START_AT = 72, 4, 40
#: Bytes of an object's header that all versions have, and of a container's; how the content of one is packed.
_BASE, _CONTAINER_HEADER = 16, 32
#: Size of the shortest frame's object.
_LEAST_FRAME = 40
_PLAIN, _DEFLATED = 0, 2
#: Kinds of objects.
_CAN, _CAN_2, _CAN_ERROR, _CAN_FD, _CAN_FD_64, _CONTAINER = 1, 86, 73, 100, 101, 10
_SIGNATURE = 0x4A424F4C
#: Unit of a time if its flag says ten microseconds; otherwise a nanosecond.
_TEN_MICROSECONDS_NS = 10_000
#: Of the kernel's answer: the rest is no object, or the beginning of one.
_DAMAGED, _UNFINISHED = -1, 0


@njit
def _number(content, at, size):
    value = 0
    for byte in range(size):
        value |= np.int64(content[at + byte]) << (8 * byte)
    return value


@njit
def _fill(content, at, size, frame):
    """Fill a frame's identifier, flags and length from an object; returns its channel, and where in the object its data begin
    and how many bytes of them there are. Channel -1: the object is no frame, -2: it is too short for one."""
    kind, version = _number(content, at + 12, 4), _number(content, at + 6, 2)
    body = at + (32 if version == 1 else 40)
    own = size - (body - at)
    if version != 1 and version != 2:
        return -1, 0, 0
    if kind in (_CAN, _CAN_2):
        id_at, data_at, most = 4, 8, 8
    elif kind == _CAN_ERROR:
        id_at, data_at, most = 16, 24, 8
    elif kind == _CAN_FD:
        id_at, data_at, most = 4, 20, 64
    elif kind == _CAN_FD_64:
        id_at, data_at, most = 4, 40, 64
    else:
        return -1, 0, 0
    if own < data_at:
        return -2, 0, 0
    channel, flags, there = _number(content, body, 2), 0, own - data_at
    if kind == _CAN_ERROR:
        length, remote, flags = np.int64(content[body + 10]), False, ERROR
    elif kind == _CAN_FD:
        length, remote = np.int64(content[body + 14]), content[body + 2] & 0x80 != 0
        flags = FD if content[body + 13] & 1 else 0
    elif kind == _CAN_FD_64:
        channel, length = np.int64(content[body]), np.int64(content[body + 2])
        told = _number(content, body + 12, 4)
        remote, flags = told & 0x10 != 0, FD if told & 0x1000 else 0
        # What follows the data says where it begins. Data that are stated but not there are zero.
        if content[body + 35]:
            there = min(there, content[body + 35] - (body - at) - data_at)
    else:
        length, remote = np.int64(content[body + 3]), content[body + 2] & 0x80 != 0
    can_id = _number(content, body + id_at, 4)
    frame.can_id = can_id & 0x1FFF_FFFF
    frame.flags = flags | (EXTENDED if can_id & 0x8000_0000 else 0) | (REMOTE if remote else 0)
    frame.length = 0 if remote else min(length, most)
    return channel, body + data_at, max(min(there, np.int64(frame.length)), 0)


@njit
def _parse(content, start_ns, frames, octets, channels):
    """Returns (frames filled, `_UNFINISHED` or `_DAMAGED`, where that begins)."""
    count, filled, at = 0, 0, 0
    while True:
        begin = at
        # Some kinds of objects are padded to a multiple of four bytes.
        while at + _BASE <= len(content) and at <= begin + 4 and _number(content, at, 4) != _SIGNATURE:
            at += 1
        if at + _BASE > len(content):
            return count, _UNFINISHED, begin
        size = _number(content, at + 8, 4)
        if at > begin + 4 or size < _BASE:
            return count, _DAMAGED, begin
        if at + size > len(content):
            return count, _UNFINISHED, begin
        frame = frames[count]
        channel, data_at, length = _fill(content, at, size, frame)
        if channel == -2:
            return count, _DAMAGED, begin
        if channel >= 0:
            unit = _TEN_MICROSECONDS_NS if _number(content, at + 16, 4) == 1 else 1
            frame.time_ns = start_ns + _number(content, at + 24, 8) * unit
            data = np.uint64(0)
            for byte in range(length):
                octets[filled + byte] = content[data_at + byte]
                if byte < 8:
                    data |= np.uint64(content[data_at + byte]) << np.uint64(8 * byte)
            frame.data = data
            channels[count] = channel
            filled += np.int64(frame.length)
            count += 1
        at += size


def _objects(path: Path, content: bytes, at: int, most_bytes: int) -> tuple[bytes, bool]:
    """What the containers hold, one after the other, and whether the last of them is cut off."""
    parts, end = [], at
    while at + _CONTAINER_HEADER <= len(content):
        signature, size, kind, method = struct.unpack_from("<I4xIIH", content, at)
        if signature != _SIGNATURE or size < _CONTAINER_HEADER:
            raise InputError(f"{path}: damaged, no object where one is due (byte {at})")
        if kind == _CONTAINER:
            part: bytes | memoryview = memoryview(content)[at + _CONTAINER_HEADER : at + size]
            if method == _DEFLATED:
                try:
                    part, _ = inflate(part, zlib.MAX_WBITS, most_bytes)
                except InputError as error:
                    raise InputError(f"{path}: damaged, container at byte {at} ({error})") from None
            elif method != _PLAIN:
                raise InputError(f"{path}: container at byte {at} is packed in an unknown way ({method})")
            if (most_bytes := most_bytes - len(part)) <= 0:
                raise InputError(f"{path}: unpacks to more than this machine has memory for")
            parts.append(part)
        else:
            # Some recorders write objects without a container.
            parts.append(memoryview(content)[at : at + size])
        end = at + size
        # As many bytes follow as its size is above a multiple of four.
        at = end + size % 4
    return b"".join(parts), at < len(content) or end > len(content)


def _start_ns(content: bytes) -> int:
    """When the log begins; zero if it does not say, as that of a recorder without a clock."""
    year, month, _, day, hour, minute, second, milliseconds = struct.unpack_from("<8H", content, _START_AT)
    try:
        start = datetime.datetime(year, month, day, hour, minute, second, tzinfo=datetime.UTC)
    except ValueError:
        return 0
    return round(start.timestamp()) * 1_000_000_000 + milliseconds * 1_000_000


def read_blf(path: Path, content: bytes, most_bytes: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, bool]:
    """FRAME array, payloads, one after the other, those of CAN FD whole, channels by number, and whether the log is cut off.
    Raises InputError: damaged, or larger than ``most_bytes`` once it is unpacked."""
    if len(content) < _HEADER or not content.startswith(b"LOGG"):
        raise InputError(f"{path}: not a BLF file")
    header = int.from_bytes(content[_SIZE_AT : _SIZE_AT + 4], "little")
    unpacked, cut = _objects(path, content, max(header, _HEADER), most_bytes)
    most = len(unpacked) // _LEAST_FRAME + 1
    frames, channels, octets = np.zeros(most, FRAME), np.zeros(most, np.uint16), np.zeros(len(unpacked), np.uint8)
    count, ended, at = _parse(np.frombuffer(unpacked, np.uint8), _start_ns(content), frames, octets, channels)
    if ended == _DAMAGED:
        raise InputError(f"{path}: damaged, no object where one is due (byte {at} of what is unpacked)")
    frames = frames[:count]
    return frames, octets[: int(frames["length"].sum(dtype=np.int64))], channels[:count], cut or at < len(unpacked)
