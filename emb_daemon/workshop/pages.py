"""The calibration's numbers as a measurement tool sees them: one segment of two pages, the files' and the working page.

FLOAT64 one after the other, by corner and then in the files' order of `runtime.pages.tunable`. What is written while the
daemon uses the working page takes effect with the last byte of a number, so that it never sees half of one.
"""

import hashlib
import struct
from collections.abc import Callable, Mapping

from emb_daemon.calibration.files import calibration_hash
from emb_daemon.calibration.parameters import value_of
from emb_daemon.calibration.types import Calibration
from emb_daemon.runtime.pages import Answer, Page, tunable

#: Where the segment begins; bytes of a number.
SEGMENT_ADDRESS, NUMBER_BYTES = 0x100000, 8
#: Pages, by number.
WORKING, FILES = 0, 1


def numbers(calibrations: Mapping[str, Calibration]) -> list[tuple[str, str]]:
    """Corner and key of every number of the segment, in its order."""
    return [(name, key) for name, calibration in calibrations.items() for key in tunable(calibration)]


def address_of(index: int) -> int:
    """Where the number at ``index`` of `numbers` stands."""
    return SEGMENT_ADDRESS + NUMBER_BYTES * index


def digest(calibrations: Mapping[str, Calibration]) -> str:
    """Eight hexadecimal digits of what stands where in the segment."""
    return hashlib.sha256(repr(numbers(calibrations)).encode()).hexdigest()[:8]


class Segment:
    """The two pages.

    Args:
        calibrations: of the files, by corner.
        ask: has the daemon take a page.
        on_page: whether the daemon estimates with other numbers than the files'.

    Attributes:
        shown: the page that is read and written.
        size: in bytes.
    """

    def __init__(self, calibrations: Mapping[str, Calibration], ask: Callable[[Page], Answer], on_page: Callable[[], bool]):
        self._numbers, self._ask, self._on_page = numbers(calibrations), ask, on_page
        self._hashes = {name: calibration_hash(calibration) for name, calibration in calibrations.items()}
        values = [value_of(calibrations[name], key) for name, key in self._numbers]
        self._files = struct.pack(f"<{len(values)}d", *values)
        self._working = self._taken = self._files
        self._used = FILES
        self.shown, self.size = WORKING, len(self._files)

    def read(self, address: int, size: int) -> bytes | None:
        """``size`` bytes of the page that is shown; None where not all of them can be read."""
        offset, content = address - SEGMENT_ADDRESS, self._working if self.shown == WORKING else self._files
        return content[offset : offset + size] if offset >= 0 and offset + size <= self.size else None

    def covers(self, address: int, size: int) -> bool:
        """Whether all of these bytes are the segment's."""
        return self.read(address, size) is not None

    @property
    def used(self) -> int:
        """The page that the daemon uses: the files' again after a reload, or a restart."""
        return FILES if self._taken != self._files and not self._on_page() else self._used

    def write(self, address: int, content: bytes) -> Answer:
        """Set bytes that it `covers` on the working page. If that is used the daemon is asked when a number is complete; what
        it refuses is undone."""
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
        """Let the working page be the files'."""
        self._working = self._files

    def use(self, page: int) -> Answer:
        """Have the daemon estimate with a page."""
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
