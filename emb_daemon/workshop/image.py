"""The memory that a measurement tool reads: for each corner a page of signals and the parameters in use, read only.

Signals are those of `interface.signals`, four bytes each, little-endian: FLOAT32 for the estimator's floats, otherwise an
unsigned number. A packet on classic CAN carries seven bytes of data, so that a double would not fit.
"""

import numpy as np

from emb_daemon.estimator.records import ESTIMATE, PARAMETERS, SAMPLE
from emb_daemon.interface.signals import INPUTS, OUTPUTS, field_of
from emb_daemon.wire.layout import CORNERS

#: Bytes of a signal.
SIGNAL_BYTES = 4
#: Addresses: distance between corners, offset of a corner's PARAMETERS, and address of the text that identifies the memory.
CORNER_ADDRESS, PARAMETERS_ADDRESS, VERSION_ADDRESS = 0x10000, 0x1000, 0x80000

_PAGE_BYTES = SIGNAL_BYTES * (len(INPUTS) + len(OUTPUTS))


def is_float(index: int) -> bool:
    """Whether the signal at ``index`` of INPUTS and OUTPUTS is a FLOAT32."""
    return _place(index)[1].kind == "f"


def address_of(corner: int, index: int) -> int:
    """Address of a corner's signal at ``index`` of INPUTS and OUTPUTS."""
    return CORNER_ADDRESS * corner + SIGNAL_BYTES * index


def _place(index: int) -> tuple[bool, np.dtype, int]:
    """Whether a signal is a field of ESTIMATE, its type and its offset in bytes."""
    if index < len(INPUTS):
        return False, *field_of(SAMPLE, INPUTS[index].field)
    return True, *field_of(ESTIMATE, OUTPUTS[index - len(INPUTS)].field)


class Image:
    """Bytes by address. ``version``: the text at VERSION_ADDRESS. ``parameters``: the PARAMETERS array, shape (4,), that can
    be read."""

    def __init__(self, version: bytes):
        self.parameters: np.ndarray = np.zeros(len(CORNERS), PARAMETERS)
        self._pages = [bytes(_PAGE_BYTES)] * len(CORNERS)
        self._version = version
        places = [_place(index) for index in range(len(INPUTS) + len(OUTPUTS))]
        floats = [[i for i, (out, kind, _) in enumerate(places) if kind.kind == "f" and out == half] for half in (False, True)]
        self._floats = [(columns, [places[i][2] // 8 for i in columns]) for columns in floats]
        self._others = [(i, out, kind, offset) for i, (out, kind, offset) in enumerate(places) if kind.kind != "f"]

    def pages_of(self, samples: np.ndarray, estimates: np.ndarray) -> list[bytes]:
        """The page of signals for each row."""
        if not len(samples):
            return []
        halves = [np.ascontiguousarray(rows) for rows in (samples, estimates)]
        pages = np.zeros((len(samples), len(INPUTS) + len(OUTPUTS)), "<u4")
        for rows, (columns, words) in zip(halves, self._floats, strict=True):
            # A number too large for FLOAT32 becomes infinite.
            with np.errstate(over="ignore", invalid="ignore"):
                values = rows.view("f8").reshape(len(rows), -1)[:, words].astype("<f4")
            pages[:, columns] = values.view("<u4")
        for column, out, kind, offset in self._others:
            rows = halves[out]
            field = np.ndarray(len(rows), kind, rows, offset, (rows.dtype.itemsize,))
            pages[:, column] = field.astype("i8")
        return [page.tobytes() for page in pages]

    def show(self, corner: int, page: bytes) -> None:
        """Set a corner's signals to those of ``page``."""
        self._pages[corner] = page

    def read(self, extension: int, address: int, size: int) -> bytes | None:
        """``size`` bytes; None if not all of them can be read."""
        if extension:
            return None
        if address >= VERSION_ADDRESS:
            address, region = address - VERSION_ADDRESS, self._version
        else:
            corner, address = divmod(address, CORNER_ADDRESS)
            if corner >= len(CORNERS):
                return None
            region = self._pages[corner]
            if address >= PARAMETERS_ADDRESS:
                address, region = address - PARAMETERS_ADDRESS, self.parameters[corner].tobytes()
        return bytes(region[address : address + size]) if address + size <= len(region) else None
