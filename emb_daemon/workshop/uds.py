"""Requests and answers of UDS (ISO 14229-1): sessions, trouble codes and data, as bytes to bytes."""

from collections.abc import Callable, Mapping

from emb_daemon.workshop.trouble import AVAILABLE, Entry, TroubleMemory

SESSION, CLEAR, READ_CODES, READ_DATA, TESTER_PRESENT = 0x10, 0x14, 0x19, 0x22, 0x3E
_POSITIVE, _NEGATIVE, _SUPPRESS = 0x40, 0x7F, 0x80

#: Negative response codes (ISO 14229-1, A.1).
_NO_SERVICE, _NO_SUBFUNCTION, _WRONG_LENGTH, _TOO_LONG, _OUT_OF_RANGE, _CANNOT_WRITE = 0x11, 0x12, 0x13, 0x14, 0x31, 0x72

DEFAULT_SESSION, EXTENDED_SESSION = 0x01, 0x03
#: Time without a request after which the default session returns, s (ISO 14229-2, S3 server).
_SESSION_S = 5.0
#: Time to answer that is promised, ms, and after "response pending", 10 ms: clearing waits for the disk.
_P2_MS, _P2_EXTENDED_10MS = 1000, 500

#: Active session, as data.
_SESSION_DATA = 0xF186
#: Data that a freeze frame holds; and what a record number may be: the only one, or all.
FREEZE_FRAME = 0x1100
_RECORDS = (0x01, 0xFF)
_OCCURRENCES_AND_AGEING = 0x01
_ISO_14229_1 = 0x01
#: Longest message of ISO-TP on classic CAN, bytes.
_LONGEST = 4095


class _Refused(Exception):
    """A request is refused, with a negative response code."""


class Server:
    """Answers the requests of one tester. ``data``: functions that read each two-byte data identifier; F186 is the server's
    own."""

    def __init__(self, memory: TroubleMemory, data: Mapping[int, Callable[[], bytes]]):
        self._memory, self._data = memory, data
        self._session, self._heard_s = DEFAULT_SESSION, 0.0
        self._services = {
            SESSION: self._change_session,
            CLEAR: self._clear,
            READ_CODES: self._read_codes,
            READ_DATA: self._read_data,
            TESTER_PRESENT: lambda body: bytes([_subfunction(body, {0: 0})]),
        }

    def answer(self, request: bytes, now_s: float) -> bytes:
        """The response to a request; empty if none is to be sent."""
        if not request:
            return b""
        if now_s - self._heard_s > _SESSION_S:
            self._session = DEFAULT_SESSION
        self._heard_s = now_s
        service = request[0]
        try:
            if service not in self._services:
                raise _Refused(_NO_SERVICE)
            content = self._services[service](request[1:])
            if len(content) >= _LONGEST:
                raise _Refused(_TOO_LONG)
        except _Refused as refusal:
            return bytes([_NEGATIVE, service, refusal.args[0]])
        except OSError:
            return bytes([_NEGATIVE, service, _CANNOT_WRITE])
        silent = service in (SESSION, READ_CODES, TESTER_PRESENT) and request[1] & _SUPPRESS
        return b"" if silent else bytes([service | _POSITIVE]) + content

    def _change_session(self, body: bytes) -> bytes:
        session = _subfunction(body, {DEFAULT_SESSION: 0, EXTENDED_SESSION: 0})
        self._session = session
        return bytes([session]) + _P2_MS.to_bytes(2, "big") + _P2_EXTENDED_10MS.to_bytes(2, "big")

    def _clear(self, body: bytes) -> bytes:
        if len(body) != 3:
            raise _Refused(_WRONG_LENGTH)
        if not self._memory.clear(int.from_bytes(body, "big")):
            raise _Refused(_OUT_OF_RANGE)
        return b""

    def _read_codes(self, body: bytes) -> bytes:
        # Bytes that each subfunction takes: a status mask, or a code and a record number.
        kind = _subfunction(body, {0x01: 1, 0x02: 1, 0x04: 4, 0x06: 4, 0x0A: 0})
        entries = self._memory.entries
        if kind in (0x04, 0x06):
            code, record = int.from_bytes(body[1:4], "big"), body[4]
            if code not in entries or record not in _RECORDS:
                raise _Refused(_OUT_OF_RANGE)
            entry = entries[code]
            if kind == 0x04:
                content = _snapshot(entry)
            else:
                content = bytes([_OCCURRENCES_AND_AGEING, entry.occurrences, entry.aged]) if entry.occurrences else b""
            return bytes([kind]) + body[1:4] + bytes([entry.status]) + content
        found = [
            code.to_bytes(3, "big") + bytes([entry.status])
            for code, entry in entries.items()
            if kind == 0x0A or entry.status & body[1] & AVAILABLE
        ]
        if kind == 0x01:
            return bytes([kind, AVAILABLE, _ISO_14229_1]) + len(found).to_bytes(2, "big")
        return bytes([kind, AVAILABLE]) + b"".join(found)

    def _read_data(self, body: bytes) -> bytes:
        if not body or len(body) % 2:
            raise _Refused(_WRONG_LENGTH)
        content = b""
        for start in range(0, len(body), 2):
            identifier = int.from_bytes(body[start : start + 2], "big")
            if identifier == _SESSION_DATA:
                value = bytes([self._session])
            elif identifier in self._data:
                value = self._data[identifier]()
            else:
                raise _Refused(_OUT_OF_RANGE)
            content += body[start : start + 2] + value
        return content


def _subfunction(body: bytes, lengths: Mapping[int, int]) -> int:
    """The first byte without its top bit; ``lengths``: how many bytes follow each that is known."""
    if not body:
        raise _Refused(_WRONG_LENGTH)
    kind = body[0] & ~_SUPPRESS
    if kind not in lengths:
        raise _Refused(_NO_SUBFUNCTION)
    if len(body) != 1 + lengths[kind]:
        raise _Refused(_WRONG_LENGTH)
    return kind


def _snapshot(entry: Entry) -> bytes:
    if entry.frame is None:
        return b""
    return bytes([_RECORDS[0], 1]) + FREEZE_FRAME.to_bytes(2, "big") + entry.frame.encode()
