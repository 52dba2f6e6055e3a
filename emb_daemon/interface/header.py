"""The C header of the estimator: its records, two functions and one calibration, generated from the dtypes.

The functions are in the header: they call the library of ``emb-daemon compile``, which must have been made from the same
sources, or the program does not link.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from emb_daemon import __version__
from emb_daemon.ahead import signature
from emb_daemon.ahead.library import installed_digest, mark
from emb_daemon.calibration.files import calibration_hash
from emb_daemon.calibration.types import Calibration, to_parameters
from emb_daemon.estimator.answer import answer
from emb_daemon.estimator.records import ESTIMATE, PARAMETERS, SAMPLE, STATE
from emb_daemon.estimator.status import TABLE
from emb_daemon.interface.places import Place, places
from emb_daemon.interface.signals import describe
from emb_daemon.wire.contract import CYCLE_S, MODES, REASONS, SOURCES

#: The header, a template for `str.format`.
_TEXT = Path(__file__).with_name("emb.h.in").read_text(encoding="utf-8")
_KINDS = {"f": "double", "i": "int64_t", "b": "bool"}


def _declare(kind: np.dtype, name: str, shape: tuple[int, ...], describe_field, indent: str) -> Iterator[str]:
    """Lines of a member of a struct."""
    dimensions = "".join(f"[{size}]" for size in shape)
    if kind.names:
        yield f"{indent}struct {{"
        for field in kind.names:
            below = kind.fields[field][0]
            yield from _declare(below.base, field, below.shape, lambda _: "", indent + "    ")
        yield f"{indent}}} {name}{dimensions};"
    else:
        comment = describe_field(name)
        yield f"{indent}{_KINDS[kind.kind]} {name}{dimensions};{f' /* {comment} */' if comment else ''}"


def _struct(record: np.dtype, name: str, describe_field=lambda _: "") -> str:
    lines = ["typedef struct {"]
    for field in record.names:
        kind = record.fields[field][0]
        lines += _declare(kind.base, field, kind.shape, describe_field, "    ")
    return "\n".join([*lines, f"}} {name};"])


def _number(value) -> str:
    """A C expression of exactly this number, or of an array of them."""
    if value.ndim:
        return f"{{{', '.join(map(_number, value))}}}"
    if not np.issubdtype(value.dtype, np.floating):
        return str(int(value))
    return repr(float(value)) if np.isfinite(value) else f"{'-' if value < 0 else ''}(1.0 / 0.0)"


def _initialise(record: np.void, offset: int, keys: dict[int, Place], indent: str) -> Iterator[str]:
    """Lines that set those fields of a record that are not zero, with the calibration's key and unit in a comment."""
    for field in record.dtype.names:
        value, start = record[field], offset + record.dtype.fields[field][1]
        if not any(value.tobytes()):
            continue
        if value.dtype.names is None:
            place = keys.get(start)
            comment = f" /* {place.key.partition('[0]')[0] if value.ndim else place.key}, {place.unit} */" if place else ""
            yield f"{indent}.{field} = {_number(value)},{comment}"
            continue
        yield f"{indent}.{field} = {{"
        if value.ndim:
            for index, element in enumerate(value):
                yield f"{indent}    [{index}] = {{"
                yield from _initialise(element, start + index * value.itemsize, keys, indent + "        ")
                yield f"{indent}    }},"
        else:
            yield from _initialise(value, start, keys, indent + "    ")
        yield f"{indent}}},"


def header(calibration: Calibration) -> str:
    codes = [f"#define EMB_MODE_{word.upper()} {code}" for code, word in enumerate(MODES)]
    codes += [f"#define EMB_SOURCE_{word.upper()} {code}" for code, word in SOURCES.items()]
    codes += [f"#define EMB_{word.upper().replace(' ', '_')} {1 << bit:#x}" for bit, word in enumerate(REASONS)]
    codes += [f"#define EMB_FACT_{name.upper()} {1 << bit:#x}" for bit, name in enumerate(TABLE)]
    records = {"emb_sample": SAMPLE, "emb_estimate": ESTIMATE, "emb_parameters": PARAMETERS}
    asserts = [f'_Static_assert(sizeof({name}) == {record.itemsize}, "{name}");' for name, record in records.items()]
    asserts += [
        f'_Static_assert(offsetof({name}, {field}) == {record.fields[field][1]}, "{name}.{field}");'
        for name, record in records.items()
        for field in record.names
    ]
    keys = {place.offset: place for place in places(calibration)}
    return _TEXT.format(
        version=__version__,
        hash=calibration_hash(calibration),
        # The calibration's name must not end the comment, or a file could contain code.
        actuator=calibration.actuator.replace("*/", "* /"),
        cycle=CYCLE_S,
        codes="/* Codes of mode and source, and bits of reasons and facts. */\n" + "\n".join(codes),
        sample=_struct(SAMPLE, "emb_sample", lambda field: describe(SAMPLE, field)),
        estimate=_struct(ESTIMATE, "emb_estimate", lambda field: describe(ESTIMATE, field)),
        parameters=_struct(PARAMETERS, "emb_parameters"),
        state=STATE.itemsize,
        asserts="\n".join(asserts),
        mark=mark(installed_digest()),
        function=signature.name_in_c(answer),
        calibration="\n".join(_initialise(to_parameters(calibration), 0, keys, "    ")),
    )
