"""The slave's side of XCP (ASAM MCD-1 XCP 1.x): reading, data acquisition and, on request, calibration, as packets to packets.

Only the working page of `pages` can be written, and the daemon checks it before use.

Each packet gets one response, whatever it contains; without a session only CONNECT is answered.
"""

import struct
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

from emb_daemon.runtime.pages import Answer
from emb_daemon.wire.contract import CYCLE_NS
from emb_daemon.wire.layout import CORNERS
from emb_daemon.workshop.image import Image
from emb_daemon.workshop.pages import FILES, SEGMENT_ADDRESS, WORKING, Segment

CONNECT = 0xFF
_RESPONSE, _ERROR, _EVENT = 0xFF, 0xFE, 0xFD
#: Error codes.
SYNCH, DAQ_ACTIVE, UNKNOWN, SYNTAX, OUT_OF_RANGE, WRITE_PROTECTED, ACCESS_DENIED = 0x00, 0x11, 0x20, 0x21, 0x22, 0x23, 0x24
PAGE_NOT_VALID, MODE_NOT_VALID, SEGMENT_NOT_VALID, SEQUENCE, DAQ_CONFIG = 0x26, 0x27, 0x28, 0x29, 0x2A
MEMORY_OVERFLOW, NOT_NOW = 0x30, 0x33
#: Event code for data that could not be sent to the master.
_OVERLOAD = 0x06

#: CONNECT: data acquisition, and calibration where there is a page to write; little-endian, byte addresses,
#: GET_COMM_MODE_INFO is there.
_ACQUISITION, _CALIBRATION, _MODE, _VERSION = 0x04, 0x01, 0x80, 0x01
_DAQ_RUNNING = 0x40
#: GET_DAQ_PROCESSOR_INFO: dynamic lists, prescaler, time stamps; overload is reported by an event.
_DAQ_PROPERTIES = 0x01 | 0x02 | 0x10 | 0x80
#: Supported bits of SET_DAQ_LIST_MODE, and bits of the answer to GET_DAQ_LIST_MODE.
_TIMESTAMP, _SELECTED, _RUNNING = 0x10, 0x01, 0x40
#: GET_DAQ_EVENT_INFO: for acquisition; the data of one event belong to one moment; cycle in ms.
_EVENT_PROPERTIES, MILLISECONDS = 0x04 | 0x80, 6
#: SET_CAL_PAGE: who is to use the page, and whether all segments are meant.
_BY_DAEMON, _BY_MASTER, _ALL_SEGMENTS = 0x01, 0x02, 0x80
#: GET_PAGE_INFO: daemon and tool may use the same page or different ones; the working page can be written, in use or not.
_READ_ONLY, _WRITABLE = 0x0F, 0x3F
#: Bit offset of an entry that consists of whole bytes.
_WHOLE = 0xFF
#: Largest numbers of lists, of entries in all, and of ODTs (an ODT's number is a byte below the codes of responses).
LISTS, _ENTRIES, _ODTS = 16, 4096, 0xFC
#: Steps of a DAQ configuration. Each may follow the step before it, allocating ODTs and entries also itself.
_NONE, _FREED, _LISTS_ALLOCATED, _ODTS_ALLOCATED, _ENTRIES_ALLOCATED = range(5)
#: Address extension of a text that the slave provides for upload.
_TEXT = 0xFF


class Refusal(Exception):
    """A command is refused; the argument is the error code of the answer."""


@dataclass(frozen=True)
class Transport:
    """Properties of a transport layer: bytes of a command and of data, bytes of a time stamp, its unit's code and length in
    ns, and the largest number of ODTs."""

    max_cto: int
    max_dto: int
    timestamp_bytes: int
    unit: int
    unit_ns: int
    odts: int = _ODTS


#: A data frame of an 8-byte bus has room for one signal beside a time stamp of two bytes, in 0.1 ms; 16 a cycle are half of a
#: bus at 1 Mbit/s.
ON_CAN = Transport(8, 8, 2, 5, 100_000, 16)
ON_UDP = Transport(252, 1400, 4, 3, 1000)


@dataclass
class _List:
    """A DAQ list: entries (extension, address, size) of each ODT; size 0: not written yet."""

    odts: list[list[tuple[int, int, int]]] = field(default_factory=list)
    event: int | None = None
    timestamps: bool = False
    prescaler: int = 1
    selected: bool = False
    running: bool = False
    waited: int = 0

    def run(self, running: bool) -> None:
        self.running, self.waited = running, 0


class Slave:
    """One session, begun anew by each CONNECT. ``clock``: monotonic time now, ns; ``name`` of the A2L ``file``, without its
    ending; ``segment``: the calibration, where it may be written."""

    def __init__(
        self, memory: Image, transport: Transport, clock: Callable[[], int], name: bytes, file: bytes,
        segment: Segment | None = None,
    ):  # fmt: skip
        self._memory, self._transport, self._clock, self._segment = memory, transport, clock, segment
        self._texts = {0: name, 1: name, 4: file}
        self.connected: bool = False  #: whether there is a session
        self._reset()
        commands = READING if segment is None else READING | CALIBRATING
        self._commands = {command.code: command for command in commands.values()}
        self._packet = b""

    def _reset(self) -> None:
        self._lists: list[_List] = []
        self._step = _NONE
        self._pointer: tuple[int, int, int] | None = None
        self._address, self._text = (0, 0), b""

    @property
    def acquiring(self) -> bool:
        return any(chosen.running for chosen in self._lists)

    def answer(self, packet: bytes) -> bytes:
        """The response to a packet; empty where there is none."""
        if not packet or not (self.connected or packet[0] == CONNECT):
            return b""
        try:
            if (command := self._commands.get(packet[0])) is None:
                raise Refusal(UNKNOWN)
            # Longer packets are padded to the frame's size.
            if len(packet) <= command.layout.size:
                raise Refusal(SYNTAX)
            self._packet = packet
            return bytes([_RESPONSE]) + (command.action(self, *command.layout.unpack_from(packet, 1)) or b"")
        except Refusal as refusal:
            return bytes([_ERROR, *refusal.args])

    def end(self) -> None:
        self.connected = False
        self._reset()

    def _connect(self, _mode: int) -> bytes:
        self._reset()
        self.connected = True
        resource = _ACQUISITION | _CALIBRATION * (self._segment is not None)
        return struct.pack("<BBBHBB", resource, _MODE, self._transport.max_cto, self._transport.max_dto, _VERSION, _VERSION)

    def _status(self) -> bytes:
        return struct.pack("<BBxH", _DAQ_RUNNING * self.acquiring, 0, 0)

    def _synch(self) -> None:
        raise Refusal(SYNCH)

    def _identify(self, kind: int) -> bytes:
        """0 and 1: name; 4: the file itself; for all others a text of length 0."""
        self._offer(self._texts.get(kind, b""))
        return struct.pack("<BHI", 0, 0, len(self._text))

    def _offer(self, text: bytes) -> None:
        self._address, self._text = (_TEXT, 0), text

    def _set_address(self, extension: int, address: int) -> None:
        self._address = extension, address

    def _upload(self, count: int) -> bytes:
        extension, address = self._address
        if not 0 < count < self._transport.max_cto:
            raise Refusal(OUT_OF_RANGE)
        content = self._text[address : address + count] if extension == _TEXT else self._content(extension, address, count)
        if content is None or len(content) < count:
            raise Refusal(ACCESS_DENIED)
        self._address = extension, address + count
        return content

    def _content(self, extension: int, address: int, count: int) -> bytes | None:
        if self._segment and not extension and (content := self._segment.read(address, count)) is not None:
            return content
        return self._memory.read(extension, address, count)

    def _short_download(self, count: int, extension: int, address: int) -> None:
        self._address = extension, address
        self._write(count, 8)

    def _write(self, count: int, header: int) -> None:
        """Write ``count`` bytes that follow ``header`` bytes of the packet."""
        (extension, address), content = self._address, self._packet[header : header + count]
        if not 0 < count <= self._transport.max_cto - header:
            raise Refusal(OUT_OF_RANGE)
        if len(content) < count:
            raise Refusal(SYNTAX)
        if extension or self._segment.read(address, count) is None:
            raise Refusal(ACCESS_DENIED)
        if self._segment.shown != WORKING:
            raise Refusal(WRITE_PROTECTED)
        self._check_taken(self._segment.write(address, content))
        self._address = extension, address + count

    @staticmethod
    def _check_taken(answer: Answer) -> None:
        if answer.refused:
            raise Refusal(NOT_NOW if answer.later else OUT_OF_RANGE)

    def _set_page(self, mode: int, segment: int, page: int) -> None:
        if not mode & (_BY_DAEMON | _BY_MASTER) or mode & ~(_BY_DAEMON | _BY_MASTER | _ALL_SEGMENTS):
            raise Refusal(MODE_NOT_VALID)
        self._check_page(0 if mode & _ALL_SEGMENTS else segment, page)
        if mode & _BY_DAEMON:
            self._check_taken(self._segment.use(page))
        if mode & _BY_MASTER:
            self._segment.shown = page

    def _page(self, mode: int, segment: int) -> bytes:
        if mode not in (_BY_DAEMON, _BY_MASTER):
            raise Refusal(MODE_NOT_VALID)
        self._check_page(segment)
        return bytes([0, 0, self._segment.used if mode == _BY_DAEMON else self._segment.shown])

    @staticmethod
    def _check_page(segment: int, page: int = WORKING) -> None:
        if segment:
            raise Refusal(SEGMENT_NOT_VALID)
        if page not in (WORKING, FILES):
            raise Refusal(PAGE_NOT_VALID)

    def _segment_information(self, mode: int, segment: int, information: int, _mapping: int) -> bytes:
        """Mode 0: address and length; 1: two pages, no mapping, neither compressed nor encrypted."""
        self._check_page(segment)
        if mode == 1:
            return bytes([2, 0, 0, 0, 0])
        if mode or information > 1:
            raise Refusal(OUT_OF_RANGE)
        return struct.pack("<xxxI", self._segment.size if information else SEGMENT_ADDRESS)

    def _page_information(self, segment: int, page: int) -> bytes:
        self._check_page(segment, page)
        return bytes([_WRITABLE if page == WORKING else _READ_ONLY, 0])

    def _copy_page(self, from_segment: int, from_page: int, to_segment: int, to_page: int) -> None:
        self._check_page(from_segment, from_page)
        self._check_page(to_segment, to_page)
        if to_page != WORKING or self._segment.used == WORKING:
            raise Refusal(WRITE_PROTECTED)
        if from_page == FILES:
            self._segment.fill()

    def _short_upload(self, count: int, extension: int, address: int) -> bytes:
        self._address = extension, address
        return self._upload(count)

    def _now(self) -> bytes:
        return struct.pack("<xHI", 0, self._ticks(self._clock()) & 0xFFFFFFFF)

    def _resolution(self) -> bytes:
        largest = min(self._transport.max_dto - 1, 0xFF)
        mode = self._transport.timestamp_bytes | self._transport.unit << 4
        return struct.pack("<BBBBBH", 1, largest, 1, 0, mode, 1)

    def _event_information(self, event: int) -> bytes:
        if event >= len(CORNERS):
            raise Refusal(OUT_OF_RANGE)
        self._offer(CORNERS[event].encode())
        return struct.pack("<6B", _EVENT_PROPERTIES, LISTS, len(self._text), CYCLE_NS // 1_000_000, MILLISECONDS, 0)

    def _list(self, number: int, idle: bool = False) -> _List:
        if number >= len(self._lists):
            raise Refusal(OUT_OF_RANGE)
        if idle and self._lists[number].running:
            raise Refusal(DAQ_ACTIVE)
        return self._lists[number]

    def _check_step(self, *before: int) -> None:
        if self._step not in before:
            raise Refusal(SEQUENCE)

    def _free(self) -> None:
        self._lists, self._step, self._pointer = [], _FREED, None

    def _allocate_lists(self, count: int) -> None:
        self._check_step(_FREED)
        if count > LISTS:
            raise Refusal(MEMORY_OVERFLOW)
        self._lists, self._step = [_List() for _ in range(count)], _LISTS_ALLOCATED

    def _allocate_odts(self, number: int, count: int) -> None:
        self._check_step(_LISTS_ALLOCATED, _ODTS_ALLOCATED)
        chosen = self._list(number, idle=True)
        if sum(len(other.odts) for other in self._lists if other is not chosen) + count > self._transport.odts:
            raise Refusal(MEMORY_OVERFLOW)
        chosen.odts, self._step = [[] for _ in range(count)], _ODTS_ALLOCATED

    def _allocate_entries(self, number: int, odt: int, count: int) -> None:
        self._check_step(_ODTS_ALLOCATED, _ENTRIES_ALLOCATED)
        chosen = self._list(number, idle=True)
        if odt >= len(chosen.odts):
            raise Refusal(OUT_OF_RANGE)
        if sum(len(entries) for other in self._lists for entries in other.odts) + count > _ENTRIES:
            raise Refusal(MEMORY_OVERFLOW)
        chosen.odts[odt], self._step = [(0, 0, 0)] * count, _ENTRIES_ALLOCATED

    def _set_pointer(self, number: int, odt: int, entry: int) -> None:
        chosen = self._list(number, idle=True)
        if odt >= len(chosen.odts) or entry >= len(chosen.odts[odt]):
            raise Refusal(OUT_OF_RANGE)
        self._pointer = number, odt, entry

    def _write_entry(self, bit: int, size: int, extension: int, address: int) -> None:
        if self._pointer is None:
            raise Refusal(SEQUENCE)
        number, odt, entry = self._pointer
        entries = self._list(number, idle=True).odts[odt]
        if entry >= len(entries) or bit != _WHOLE or not 0 < size < self._transport.max_dto:
            raise Refusal(OUT_OF_RANGE)
        if self._memory.read(extension, address, size) is None:
            raise Refusal(ACCESS_DENIED)
        entries[entry] = extension, address, size
        self._pointer = number, odt, entry + 1

    def _set_mode(self, mode: int, number: int, event: int, prescaler: int, priority: int) -> None:
        chosen = self._list(number, idle=True)
        if mode & ~_TIMESTAMP:
            raise Refusal(MODE_NOT_VALID)
        if event >= len(CORNERS) or not prescaler or priority:
            raise Refusal(OUT_OF_RANGE)
        chosen.event, chosen.timestamps, chosen.prescaler = event, bool(mode), prescaler

    def _mode(self, number: int) -> bytes:
        chosen = self._list(number)
        mode = _TIMESTAMP * chosen.timestamps | _SELECTED * chosen.selected | _RUNNING * chosen.running
        return struct.pack("<BxxHBB", mode, chosen.event or 0, chosen.prescaler, 0)

    def _start_stop_list(self, mode: int, number: int) -> bytes:
        chosen = self._list(number)
        if mode > 2:
            raise Refusal(MODE_NOT_VALID)
        if mode:
            self._check(chosen)
        if mode == 2:
            chosen.selected = True
        else:
            chosen.run(bool(mode))
        return bytes([self._first_odt(number)])

    def _start_stop(self, mode: int) -> None:
        """0: stop all; 1, 2: start, stop those that are selected."""
        if mode > 2:
            raise Refusal(MODE_NOT_VALID)
        concerned = [chosen for chosen in self._lists if mode == 0 or chosen.selected]
        for chosen in concerned:
            if mode == 1:
                # The list may have changed since it was selected.
                self._check(chosen)
        for chosen in concerned:
            chosen.run(mode == 1)
            chosen.selected = False

    def _check(self, chosen: _List) -> None:
        """Refuse a list that no frame can carry, or that has no event."""
        for number, entries in enumerate(chosen.odts):
            stamp = self._transport.timestamp_bytes * (chosen.timestamps and number == 0)
            if 1 + stamp + sum(size for *_, size in entries) > self._transport.max_dto:
                raise Refusal(DAQ_CONFIG)
        if chosen.event is None or not any(size for entries in chosen.odts for *_, size in entries):
            raise Refusal(DAQ_CONFIG)

    def _first_odt(self, number: int) -> int:
        return sum(len(earlier.odts) for earlier in self._lists[:number])

    def _ticks(self, time_ns: int) -> int:
        return time_ns // self._transport.unit_ns

    def data(self, corner: int, time_ns: int) -> Iterator[bytes]:
        """Packets that the running lists send for an estimate of a corner at ``time_ns``."""
        for number, chosen in enumerate(self._lists):
            if not chosen.running or chosen.event != corner:
                continue
            chosen.waited += 1
            if chosen.waited < chosen.prescaler:
                continue
            chosen.waited = 0
            first = self._first_odt(number)
            for odt, entries in enumerate(chosen.odts):
                parts = [bytes([first + odt])]
                if chosen.timestamps and odt == 0:
                    width = self._transport.timestamp_bytes
                    parts.append((self._ticks(time_ns) & (1 << 8 * width) - 1).to_bytes(width, "little"))
                # An entry was checked when it was written, so it can be read.
                parts += [self._memory.read(*entry) or b"" for entry in entries if entry[2]]
                yield b"".join(parts)

    def overload(self) -> bytes:
        """Tell the master that data were lost."""
        return bytes([_EVENT, _OVERLOAD])


class Command(NamedTuple):
    """A command's code, the fields that follow it in a packet, and the function that gives the response behind byte 0."""

    code: int
    layout: struct.Struct
    action: Callable[..., bytes | None]


def _table(rows: Iterable[tuple[str, int, str, Callable[..., bytes | None]]]) -> dict[str, Command]:
    return {name: Command(code, struct.Struct("<" + layout), action) for name, code, layout, action in rows}


#: Commands that the slave answers, by the standard's names: always, and only if numbers may be written.
READING = _table([
    ("CONNECT", CONNECT, "B", Slave._connect),
    ("DISCONNECT", 0xFE, "", Slave.end),
    ("GET_STATUS", 0xFD, "", Slave._status),
    ("SYNCH", 0xFC, "", Slave._synch),
    # No block mode, no interleaving.
    ("GET_COMM_MODE_INFO", 0xFB, "", lambda slave: bytes(7)),
    ("GET_ID", 0xFA, "B", Slave._identify),
    ("SET_MTA", 0xF6, "2xBI", Slave._set_address),
    ("UPLOAD", 0xF5, "B", Slave._upload),
    ("SHORT_UPLOAD", 0xF4, "BxBI", Slave._short_upload),
    ("SET_DAQ_PTR", 0xE2, "xHBB", Slave._set_pointer),
    ("WRITE_DAQ", 0xE1, "BBBI", Slave._write_entry),
    ("SET_DAQ_LIST_MODE", 0xE0, "BHHBB", Slave._set_mode),
    ("GET_DAQ_LIST_MODE", 0xDF, "xH", Slave._mode),
    ("START_STOP_DAQ_LIST", 0xDE, "BH", Slave._start_stop_list),
    ("START_STOP_SYNCH", 0xDD, "B", Slave._start_stop),
    ("GET_DAQ_CLOCK", 0xDC, "", Slave._now),
    ("GET_DAQ_PROCESSOR_INFO", 0xDA, "", lambda slave: struct.pack("<BHHBB", _DAQ_PROPERTIES, LISTS, len(CORNERS), 0, 0)),
    ("GET_DAQ_RESOLUTION_INFO", 0xD9, "", Slave._resolution),
    ("GET_DAQ_EVENT_INFO", 0xD7, "xH", Slave._event_information),
    ("FREE_DAQ", 0xD6, "", Slave._free),
    ("ALLOC_DAQ", 0xD5, "xH", Slave._allocate_lists),
    ("ALLOC_ODT", 0xD4, "xHB", Slave._allocate_odts),
    ("ALLOC_ODT_ENTRY", 0xD3, "xHBB", Slave._allocate_entries),
])  # fmt: skip
CALIBRATING = _table([
    ("DOWNLOAD", 0xF0, "B", lambda slave, count: slave._write(count, 2)),
    ("SHORT_DOWNLOAD", 0xED, "BxBI", Slave._short_download),
    ("SET_CAL_PAGE", 0xEB, "BBB", Slave._set_page),
    ("GET_CAL_PAGE", 0xEA, "BB", Slave._page),
    # One segment, none of whose pages can be frozen.
    ("GET_PAG_PROCESSOR_INFO", 0xE9, "", lambda slave: bytes([1, 0])),
    ("GET_SEGMENT_INFO", 0xE8, "BBBB", Slave._segment_information),
    ("GET_PAGE_INFO", 0xE7, "xBB", Slave._page_information),
    ("COPY_CAL_PAGE", 0xE4, "BBBB", Slave._copy_page),
])  # fmt: skip
