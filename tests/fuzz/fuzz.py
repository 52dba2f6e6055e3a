"""Coverage-guided fuzzing: frames through pipeline and authentication, files of the state directory, YAML and log readers.

Run as ``python tests/fuzz/fuzz.py {frames,secoc,state,yaml,candump} [libFuzzer options]``; `make fuzz` runs each for a minute.
Bad input may give an InputError or be ignored; anything else is a finding, and so is a usable estimate that is no number, or a
frame believed that nobody authenticated. Kernels run as plain Python, so that the fuzzer sees their branches.
"""

import contextlib
import hashlib
import os
import sys
import tempfile
from functools import partial
from pathlib import Path

os.environ["NUMBA_DISABLE_JIT"] = "1"
import atheris

with atheris.instrument_imports(include=["emb_daemon"]):
    from files import CALIBRATION, LOG, RECORDS, read_calibration, read_record

    from emb_daemon.adapt import files, memory
    from emb_daemon.calibration.configuration import Setup
    from emb_daemon.errors import InputError
    from emb_daemon.logs.read import read_frames
    from emb_daemon.pipeline import Pipeline
    from emb_daemon.resources import resource
    from emb_daemon.wire.contract import INVALID
    from emb_daemon.wire.e2e import protect
    from emb_daemon.wire.frames import FRAME
    from emb_daemon.wire.secoc import Signer, Verifier, load_links

import numpy as np

_OURS = (0x100, 0x110, 0x120, 0x180, 0x181, 0x182, 0x200)
_parameters = Setup(resource("config/emb.yaml")).parameters
_folder = Path(tempfile.mkdtemp(prefix="fuzz-"))


def frames(data: bytes) -> None:
    """Each twelve bytes make a frame on one of our ids, most of them with the right protection and a counter in sequence."""
    feed = atheris.FuzzedDataProvider(data)
    pipeline = Pipeline(_parameters.copy(), ("FL",), capacity=64)
    pipeline.begin(0)
    now, counters = 0, dict.fromkeys(_OURS, 0)
    while feed.remaining_bytes() >= 10:
        frame = np.zeros(1, FRAME)
        can_id = _OURS[feed.ConsumeIntInRange(0, len(_OURS) - 1)]
        kind = feed.ConsumeIntInRange(0, 15)
        now += feed.ConsumeIntInRange(0, 8_000_000) if kind else feed.ConsumeIntInRange(-(10**12), 10**12)
        payload = feed.ConsumeIntInRange(0, 2**48 - 1)
        frame["time_ns"], frame["can_id"], frame["length"] = now, can_id, 8
        counters[can_id] = (counters[can_id] + 1) % 15
        frame["data"] = protect(can_id, np.uint64(payload << 16), counters[can_id], 0) if kind > 1 else payload
        start = 0
        while start < 1:
            # As the daemon does it, which tells of a long silence once.
            start, count = pipeline.collect(frame, start, predictions=False)
            count = pipeline.overdue(max(now, 0), count)
            pipeline.answer(count)
            for estimate in pipeline.estimates[:count]:
                usable = estimate["source"] != INVALID
                assert not usable or (np.isfinite(estimate["force"]) and estimate["sigma"] > 0.0), estimate
            pipeline.broadcast(count)


def _genuine() -> list[tuple]:
    """Rows of FRAME that a corner's sender would send in forty cycles, no two of them equal."""
    plain = np.zeros(80, FRAME)
    for number, frame in enumerate(plain):
        can_id, cycle = (0x100, 0x110)[number % 2], number // 2
        frame["data"] = protect(can_id, np.uint64((cycle + 1) << 16), cycle % 15, 0)
        frame["time_ns"], frame["can_id"], frame["length"] = 4_000_000 * cycle, can_id, 8
    return Signer(_links, _keys, 1).sign(plain).tolist()


_links = load_links(corners=("FL",))[0][:1]
_keys = {_links[0].name: bytes(16)}
_authentic = _genuine()
_verifier = Verifier(_links, _keys, {})
_unheard = _verifier.links.copy()
_rank = {row[1:3]: number for number, row in enumerate(_authentic)}


def secoc(data: bytes) -> None:
    """A byte tells what is next on the bus: what the sender sends, that with a change, something old, or anything. What is
    believed was sent by him, and later than all that was believed before."""
    rows, sent, now = [], 0, 0
    for at in range(0, len(data) - 3, 4):
        kind, first, second, third = data[at : at + 4]
        if sent < len(_authentic) and kind < 160:
            row = list(_authentic[sent])
            sent += 1
            if kind >= 140:
                continue
            if kind >= 100:
                row[1] ^= second << 8 * (first & 7)
        elif kind < 220 and sent:
            row = list(_authentic[first % sent])
        else:
            row = [0, first << 20 | second << 8 | third << 40, (0x100, 0x110, 0x130, 0x140)[third & 3], 8, 0]
        now += third * 20_000
        row[0] = now
        rows.append(tuple(row))
    _verifier.links[:] = _unheard
    believed = _verifier.verify(np.array(rows, FRAME))
    last = dict.fromkeys((0x100, 0x110), -1)
    for _, payload, can_id, _, flags in believed.tolist():
        if flags == 0 and can_id in last:
            assert _rank.get((payload, can_id), -1) > last[can_id], (payload, can_id)
            last[can_id] = _rank[payload, can_id]


_STORE = (
    b'{"format":2,"corner":"FL","actuator":"a","calibration":"c","current":{"date":"d","outcome":"accepted","note":"",'
    b'"ambient_C":1.0,"pad_rise_K":null,"values":{"k":1.0},"sigmas":{"k":0.1},"evidence":{"e":null}},"history":[]}'
)


def state(data: bytes) -> None:
    """A file of the state directory, its checksum right."""
    body = _edited(_STORE, data)
    with contextlib.suppress(ValueError):
        sealed = b'{"sha256":"%s","content":%s}' % (hashlib.sha256(body).hexdigest().encode(), body)
        files.decode(sealed, memory.Store, memory.FORMAT)


def _edited(good: bytes, data: bytes) -> bytes:
    """A good file with pieces of it replaced: random bytes alone never get past a reader's first line."""
    feed = atheris.FuzzedDataProvider(data)
    content = bytearray(good)
    while feed.remaining_bytes() >= 4:
        at = feed.ConsumeIntInRange(0, len(content))
        removed = feed.ConsumeIntInRange(0, 40)
        content[at : at + removed] = feed.ConsumeBytes(feed.ConsumeIntInRange(0, 40))
    return bytes(content)


def _file(name: str, data: bytes, read) -> None:
    path = _folder / name
    path.write_bytes(data)
    with contextlib.suppress(InputError):
        read(path)


#: First bytes from which the whole calibration is read.
_WHOLE = 253


def yaml(data: bytes) -> None:
    first = data[0] if data else 0
    kind, good = RECORDS[first % len(RECORDS)]
    good, read = (CALIBRATION, read_calibration) if first >= _WHOLE else (good, partial(read_record, kind))
    _file("calibration.yaml", _edited(good, data[1:]), read)


def candump(data: bytes) -> None:
    _file("drive.log", _edited(LOG, data), read_frames)


if __name__ == "__main__":
    target = {"frames": frames, "secoc": secoc, "state": state, "yaml": yaml, "candump": candump}[sys.argv.pop(1)]
    atheris.Setup(sys.argv, target)
    atheris.Fuzz()
