"""Files with pieces of them replaced, in any number: none ends a reader, and what is read is what such a file may hold.

Run as ``python tests/fuzz/files.py {yaml,candump} [COUNT] [SEED]``; prints how many were read and refused, and the longest
time of one.
"""

import contextlib
import io
import math
import random
import re
import sys
import tempfile
import textwrap
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import msgspec
import numpy as np

from emb_daemon.calibration.files import dump_calibration
from emb_daemon.calibration.strict_yaml import load_yaml
from emb_daemon.calibration.types import Calibration, to_parameters
from emb_daemon.errors import InputError
from emb_daemon.logs.read import read_log
from emb_daemon.resources import resource
from emb_daemon.wire.frames import ERROR, EXTENDED, FD, REMOTE

_MEMORY = "/dev/shm" if Path("/dev/shm").is_dir() else None
#: No file of a few kilobytes takes longer, s of the processor.
_LONGEST_S = 2.0
CALIBRATION = resource("config/calibration.yaml").read_bytes().partition(b"provenance:")[0]
#: Its records and their part of it, each read as a file of its own: in as little as a fiftieth of the time.
RECORDS = [
    (field.type, textwrap.dedent(part.partition("\n")[2]).encode())
    for field in msgspec.structs.fields(Calibration)
    if isinstance(field.type, type) and issubclass(field.type, msgspec.Struct)
    for part in re.findall(rf"^{field.name}:\n(?: .*\n)+", CALIBRATION.decode(), re.MULTILINE)
]
LOG = b"".join(
    b"(%d.%06d) can0 %s\n" % (1, 1000 * number, frame)
    for number, frame in enumerate((b"100#0102030405060708", b"18FEF100#AA", b"123##311223344", b"7FF#R8", b"20000040#00") * 3)
)
#: What means something to a parser.
_PIECES = (
    b"( ) # ## #R #R9 . - 0 999999999999999999999999999999 \0 \xff { } [ ] :_ &a_ *a !!python/object:x ' \" nan .inf 1e999 "
    b"null true \t ?_ --- <<:"
)
_PIECES = [piece.replace(b"_", b" ") for piece in _PIECES.split(b" ")] + [b" ", b"\n"]


def edited(good: bytes, draw: random.Random) -> bytes:
    """A good file with one to four digits or pieces replaced: by random bytes, what means something, or other pieces."""
    content = bytearray(good)
    for _ in range(draw.randint(1, 4)):
        at, other = draw.randrange(len(good)), draw.randrange(len(good))
        if draw.random() < 0.6:
            while at < len(content) and not 48 <= content[at] <= 57:
                at += 1
            content[at : at + 1] = b"%d" % draw.randint(0, 9)
        else:
            new = draw.choice(
                (draw.randbytes(draw.randint(0, 20)), draw.choice(_PIECES), good[other : other + draw.randint(1, 40)])
            )
            content[at : at + draw.choice((0, 1, 5, 20))] = new
    return bytes(content)


def read_record(kind: type[msgspec.Struct], path: Path) -> None:
    """What is read is the same when it is written and read again: no number that is not finite, nothing lost."""
    value = load_yaml(path, kind)
    written = msgspec.json.encode(value)
    assert value == msgspec.json.decode(written, type=kind), written


def read_calibration(path: Path) -> None:
    value = load_yaml(path, Calibration)
    path.write_text(dump_calibration(value))
    assert load_yaml(path, Calibration) == value
    p = to_parameters(value)
    assert p["maximum_force"] > 0.0 and np.isfinite(p["curve"]).all() and 0.0 < p["gear_gain"] < math.inf


def _frames(path: Path) -> None:
    frames = read_log(path).frames
    assert len(frames) and np.all(frames["flags"] <= EXTENDED | REMOTE | ERROR | FD), "no mark of our own"
    assert np.all(frames["can_id"] < 1 << 29) and np.all(frames["length"] <= 64)


def run(goods: list[tuple[bytes, Callable[[Path], None]]], name: str, count: int, seed: int) -> tuple[int, float]:
    """How many of ``count`` edited files were read, and the longest time of one, s; the others were refused in one error. Each
    is one of ``goods``, of which all take about as much time together."""
    draw, taken, longest = random.Random(seed), 0, 0.0
    odds = [1.0 / len(good) for good, _ in goods]
    # A disk would take longer than the reader.
    with tempfile.TemporaryDirectory(dir=_MEMORY) as folder:
        path = Path(folder, name)
        for _ in range(count):
            [(good, read)] = draw.choices(goods, odds)
            path.write_bytes(content := edited(good, draw))
            began = time.process_time()
            try:
                # What a reader says of a log that is cut off is no finding.
                with contextlib.redirect_stderr(io.StringIO()):
                    read(path)
                taken += 1
            except InputError as error:
                assert str(error), content
            except BaseException:
                print(content, file=sys.stderr)
                raise
            longest = max(longest, time.process_time() - began)
    return taken, longest


_YAML = [(CALIBRATION, read_calibration), *((good, partial(read_record, kind)) for kind, good in RECORDS)]
TARGETS = {"yaml": (_YAML, "calibration.yaml"), "candump": ([(LOG, _frames)], "drive.log")}


def main() -> None:
    target, count, seed = (*sys.argv[1:], *("yaml", "1000000", "1")[len(sys.argv) - 1 :])
    # Compiled before the first is timed.
    run(*TARGETS[target], 10, 0)
    taken, longest = run(*TARGETS[target], int(count), int(seed))
    print(f"{target}, seed {seed}: {count} files, {taken} read, the others refused; the longest took {longest:.2f} s")
    assert longest < _LONGEST_S


if __name__ == "__main__":
    main()
