"""The calibration's numbers for a measurement tool: one segment with two pages, that of the files and the working page.

The numbers are FLOAT64, by corner and then in the order of `runtime.pages.tunable`. While the daemon uses the working page, a
written number takes effect with its last byte, so that the daemon never sees half of it.
"""

import hashlib
import struct
from collections.abc import Callable, Mapping

from emb_daemon.calibration.files import calibration_hash
from emb_daemon.calibration.parameters import value_of
from emb_daemon.calibration.types import Calibration
from emb_daemon.runtime.pages import Answer, Page, tunable

#: Address of the segment; bytes of a number.
SEGMENT_ADDRESS, NUMBER_BYTES = 0x100000, 8
#: Pages, by number.
WORKING, FILES = 0, 1


def numbers(calibrations: Mapping[str, Calibration]) -> list[tuple[str, str]]:
    """Corner and key of every number of the segment, in its order."""
    return [(name, key) for name, calibration in calibrations.items() for key in tunable(calibration)]


def address_of(index: int) -> int:
    """Address of the number at ``index`` of `numbers`."""
    return SEGMENT_ADDRESS + NUMBER_BYTES * index


def digest(calibrations: Mapping[str, Calibration]) -> str:
    """Eight hexadecimal digits that identify the layout of the segment."""
    return hashlib.sha256(repr(numbers(calibrations)).encode()).hexdigest()[:8]


class Segment:
    """The two pages, of the calibrations of the files. ``ask`` sends a page to the daemon; ``on_page``: whether that estimates
    with numbers that differ from the files."""

    def __init__(self, calibrations: Mapping[str, Calibration], ask: Callable[[Page], Answer], on_page: Callable[[], bool]):
        self._numbers, self._ask, self._on_page = numbers(calibrations), ask, on_page
        self._hashes = {name: calibration_hash(calibration) for name, calibration in calibrations.items()}
        values = [value_of(calibrations[name], key) for name, key in self._numbers]
        self._files = struct.pack(f"<{len(values)}d", *values)
        self._working = self._taken = self._files
        self._used = FILES
        self.shown: int = WORKING  #: the page that the tool reads and writes
        self.size: int = len(self._files)  #: in bytes

    def read(self, address: int, size: int) -> bytes | None:
        """``size`` bytes of the shown page; None if not all of them can be read."""
        offset, content = address - SEGMENT_ADDRESS, self._working if self.shown == WORKING else self._files
        return content[offset : offset + size] if offset >= 0 and offset + size <= self.size else None

    @property
    def used(self) -> int:
        """The page that the daemon uses; after a reload or a restart it is that of the files again."""
        return FILES if self._taken != self._files and not self._on_page() else self._used

    def write(self, address: int, content: bytes) -> Answer:
        """Set bytes of the working page, all of which can be read. If the daemon uses this page, each complete number is sent
        to the daemon; a number that it refuses is undone."""
        offset = address - SEGMENT_ADDRESS
        end = offset + len(content)
        self._working = self._working[:offset] + content + self._working[end:]
        if self.used != WORKING or end % NUMBER_BYTES:
            return Answer()
        answer = self.use(WORKING)
        if answer.refused:
            self._working = self._taken
        return answer

    def fill(self) -> None:
        """Copy the page of the files to the working page."""
        self._working = self._files

    def use(self, page: int) -> Answer:
        """Let the daemon estimate with a page."""
        content = self._working if page == WORKING else self._files
        values: dict[str, dict[str, float]] = {}
        for index, (name, key) in enumerate(self._numbers):
            place = slice(NUMBER_BYTES * index, NUMBER_BYTES * (index + 1))
            if content[place] != self._files[place]:
                [value] = struct.unpack("<d", content[place])
                values.setdefault(name, {})[key] = value
        answer = self._ask(Page(values, {name: self._hashes[name] for name in values}))
        if not answer.refused:
            self._used, self._taken = page, content
        return answer
