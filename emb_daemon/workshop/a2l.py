"""The A2L file (ASAM MCD-2 MC 1.61): signals of `interface.signals` and numbers of `interface.places` as `image` shows them,
and the numbers of `pages` where they may be written."""

import hashlib
import sys
from collections.abc import Mapping

from emb_daemon import __version__
from emb_daemon.calibration.parameters import parameter
from emb_daemon.calibration.types import Calibration
from emb_daemon.estimator.status import TABLE
from emb_daemon.interface.places import places
from emb_daemon.interface.signals import INPUTS, OUTPUTS, Signal
from emb_daemon.runtime.shared import LAYOUT_DIGEST
from emb_daemon.wire.contract import MODES, REASONS, SOURCES
from emb_daemon.wire.layout import CORNERS
from emb_daemon.workshop import pages
from emb_daemon.workshop.ifdata import A2ML, Connection, memory_segment, module_block
from emb_daemon.workshop.image import CORNER_ADDRESS, PARAMETERS_ADDRESS, VERSION_ADDRESS, address_of, is_float

#: Name of the file, which the slave states too.
NAME = "emb_daemon"
#: The text at VERSION_ADDRESS, by which a tool checks that file and slave belong together.
VERSION = f"emb_daemon {__version__} " + hashlib.sha256(
    LAYOUT_DIGEST + repr([signal.name for signal in INPUTS + OUTPUTS]).encode()
).hexdigest()[:12]  # fmt: skip

#: Slightly below the largest numbers of the formats, so that no reader rounds them to infinity.
_FLOAT32_MAX, _FLOAT64_MAX, _ULONG_MAX = 3.4e38, 1.79e308, 0xFFFFFFFF
#: Units in characters that every tool can read.
_ASCII = str.maketrans({"·": ".", "²": "^2", "³": "^3", "√": "sqrt ", "°": "deg"})
_CODES = {"mode": dict(enumerate(MODES)), "source": SOURCES}
_BITS = {"reasons": REASONS, "facts": tuple(TABLE)}

_FRAME = """\
ASAP2_VERSION 1 61
/begin PROJECT {name} "Virtual clamp force sensor"
  /begin MODULE {name} "{about}"
{interface}    /begin MOD_COMMON ""
      BYTE_ORDER MSB_LAST
      ALIGNMENT_LONG 4
      ALIGNMENT_FLOAT32_IEEE 4
      ALIGNMENT_FLOAT64_IEEE 8
    /end MOD_COMMON
    /begin MOD_PAR "{access}"
      VERSION "{version}"
      ADDR_EPK 0x{address:X}
      EPK "{epk}"
{segment}\
    /end MOD_PAR
    /begin RECORD_LAYOUT RL.FLOAT64
      FNC_VALUES 1 FLOAT64_IEEE COLUMN_DIR DIRECT
    /end RECORD_LAYOUT
{content}
  /end MODULE
/end PROJECT
"""


def _quote(text: str) -> str:
    return '"' + text.translate(_ASCII).replace("\\", "\\\\").replace('"', '\\"') + '"'


def _block(keyword: str, head: str, *lines: str) -> str:
    body = "".join(f"      {line}\n" for line in lines)
    return f"    /begin {keyword} {head}\n{body}    /end {keyword}"


def _limit(bound: float) -> str:
    # A bound below the smallest normal number means "greater than zero".
    bound = min(max(bound, -_FLOAT64_MAX), _FLOAT64_MAX)
    return repr(bound if abs(bound) >= sys.float_info.min else 0.0)


class _Methods:
    """Conversions, one for each unit and each list of words."""

    def __init__(self):
        self.blocks: dict[str, str] = {}

    def of_unit(self, unit: str) -> str:
        unit = "" if unit == "1" else unit.translate(_ASCII)
        name = "CM." + ("".join(letter if letter.isalnum() else "_" for letter in unit) or "NONE")
        self.blocks[name] = _block("COMPU_METHOD", f'{name} "" IDENTICAL "%12.6" {_quote(unit)}')
        return name

    def of_words(self, name: str, words: Mapping[int, str]) -> str:
        rows = [f"{code} {_quote(word)}" for code, word in sorted(words.items())]
        self.blocks[f"CT.{name}"] = _block("COMPU_VTAB", f'CT.{name} "" TAB_VERB {len(rows)}', *rows)
        self.blocks[f"CM.{name}"] = _block("COMPU_METHOD", f'CM.{name} "" TAB_VERB "%3.0" ""', f"COMPU_TAB_REF CT.{name}")
        return f"CM.{name}"


def _measurement(corner: int, index: int, signal: Signal, methods: _Methods) -> str:
    if is_float(index):
        kind, method = "FLOAT32_IEEE", methods.of_unit(signal.unit)
        limits = f"{-_FLOAT32_MAX!r} {_FLOAT32_MAX!r}"
    else:
        words = _CODES.get(signal.name)
        kind, method = "ULONG", methods.of_words(signal.name, words) if words else methods.of_unit("")
        limits = f"0 {_ULONG_MAX}"
    meaning = signal.meaning
    if bits := _BITS.get(signal.name):
        meaning += f", from the lowest: {', '.join(bits)}"
    head = f"{CORNERS[corner]}.{signal.name} {_quote(meaning)} {kind} {method} 0 0 {limits}"
    return _block("MEASUREMENT", head, f"ECU_ADDRESS 0x{address_of(corner, index):X}")


def version_of(calibrations: Mapping[str, Calibration], calibrate: bool) -> str:
    """The text at VERSION_ADDRESS; if numbers may be written, it also identifies their layout."""
    return f"{VERSION} {pages.digest(calibrations)}" if calibrate else VERSION


def make_a2l(calibrations: Mapping[str, Calibration], connection: Connection | None = None, calibrate: bool = False) -> bytes:
    """The file for a daemon that estimates the corners of ``calibrations``: ASCII, as ASAM MCD-2 MC requires.

    With ``connection`` it states how the server is reached; with ``calibrate`` it contains the numbers that may be written."""
    methods, blocks = _Methods(), []
    for name, calibration in calibrations.items():
        corner, numbers = CORNERS.index(name), places(calibration)
        blocks += [_measurement(corner, index, signal, methods) for index, signal in enumerate(INPUTS + OUTPUTS)]
        base = CORNER_ADDRESS * corner + PARAMETERS_ADDRESS
        for place in numbers:
            kind = f"VALUE 0x{base + place.offset:X} RL.FLOAT64 0 {methods.of_unit(place.unit)}"
            head = f'{name}.{place.key} "" {kind} {_limit(place.low)} {_limit(place.high)}'
            blocks.append(_block("CHARACTERISTIC", head, "READ_ONLY"))
        blocks += [
            _group(f"{name}.signals", f"inputs and estimates of {name}", "REF_MEASUREMENT",
                   [f"{name}.{signal.name}" for signal in INPUTS + OUTPUTS]),
            _group(f"{name}.calibration", calibration.actuator, "REF_CHARACTERISTIC",
                   [f"{name}.{place.key}" for place in numbers]),
        ]  # fmt: skip
    segment = ""
    if calibrate:
        written = pages.numbers(calibrations)
        for index, (name, key) in enumerate(written):
            number = parameter(calibrations[name], key)
            kind = f"VALUE 0x{pages.address_of(index):X} RL.FLOAT64 0 {methods.of_unit(number.unit)}"
            head = f'{name}.page.{key} "" {kind} {_limit(number.low)} {_limit(number.high)}'
            blocks.append(_block("CHARACTERISTIC", head, "REF_MEMORY_SEGMENT calibration"))
        for name in calibrations:
            members = [f"{name}.page.{key}" for corner, key in written if corner == name]
            blocks.append(
                _group(f"{name}.page", "calibration on the page in use: files or working page", "REF_CHARACTERISTIC", members)
            )
        segment = memory_segment(pages.SEGMENT_ADDRESS, pages.NUMBER_BYTES * len(written))
    file = _FRAME.format(
        name=NAME, about=", ".join(calibrations), version=__version__, address=VERSION_ADDRESS,
        epk=version_of(calibrations, calibrate), access="calibration" if calibrate else "read only", segment=segment,
        interface=(A2ML if connection or calibrate else "") + (module_block(connection, calibrate) if connection else ""),
        content="\n".join([*methods.blocks.values(), *blocks]),
    )  # fmt: skip
    return file.encode("ascii", "replace")


def _group(name: str, about: str, keyword: str, members: list[str]) -> str:
    return _block("GROUP", f"{name} {_quote(about)}", "ROOT", f"/begin {keyword}", *members, f"/end {keyword}")
