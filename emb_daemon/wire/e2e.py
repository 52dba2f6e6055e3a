"""AUTOSAR E2E Profile 1, variant 1A, over an eight-byte frame held as a little-endian integer.

CRC-8-SAE-J1850 (polynomial 0x1D), with start value and final XOR of the profile both zero against the CRC library's 0xFF
conventions, over the low and the high byte of the DataID and then payload bytes 1 to 7; counter 0..14.
Source: AUTOSAR FO R22-11 PRS E2EProtocol, section 6.2; the DataID is the CAN id.
"""

import numpy as np
from numpy.typing import NDArray

from emb_daemon.jit import Integer, njit

COUNTER_MODULO = 15


def _crc_table() -> np.ndarray:
    table = np.zeros(256, np.uint8)
    for value in range(256):
        crc = value
        for _ in range(8):
            crc = ((crc << 1) ^ 0x1D) & 0xFF if crc & 0x80 else crc << 1
        table[value] = crc
    return table


_TABLE = _crc_table()


@njit
def crc(can_id: Integer, data: Integer) -> Integer:
    """CRC byte of a frame: ``can_id`` is the DataID, ``data`` the payload as an integer, whose CRC byte is ignored."""
    value = _TABLE[can_id & 0xFF]
    value = _TABLE[value ^ np.uint8((can_id >> 8) & 0xFF)]
    for byte in range(1, 8):
        value = _TABLE[value ^ np.uint8((np.uint64(data) >> np.uint64(8 * byte)) & np.uint64(0xFF))]
    return value


@njit
def counter_of(data: Integer | NDArray[np.uint64]) -> Integer | NDArray[np.uint64]:
    """Counter of payloads, integers or uint64 arrays."""
    return (data >> np.uint64(8)) & np.uint64(0xF)


@njit
def status_of(data: Integer | NDArray[np.uint64]) -> Integer | NDArray[np.uint64]:
    """Status of payloads, integers or uint64 arrays."""
    return (data >> np.uint64(12)) & np.uint64(0xF)


@njit
def protect(can_id: Integer, payload: Integer, counter: Integer, status: Integer) -> Integer:
    """``payload`` (bits 16 to 63 set) with Status, Counter and CRC filled in, as an unsigned 64-bit integer."""
    data = np.uint64(payload) | (np.uint64(counter) << np.uint64(8)) | (np.uint64(status) << np.uint64(12))
    return data | np.uint64(crc(can_id, data))
