"""Coverage-guided fuzzing: frames through the pipeline, YAML and log readers.

Run as ``python tests/fuzz/fuzz.py {frames,yaml,candump} [libFuzzer options]``; `make fuzz` runs each for a minute. Bad input
may give an InputError or be ignored; anything else is a finding, and so is a usable estimate that is no number. Kernels run as
plain Python, so that the fuzzer sees their branches.
"""

import contextlib
import os
import sys
import tempfile
from pathlib import Path

os.environ["NUMBA_DISABLE_JIT"] = "1"
import atheris

with atheris.instrument_imports(include=["emb_daemon"]):
    from emb_daemon.calibration.configuration import Setup
    from emb_daemon.calibration.files import load_calibration
    from emb_daemon.errors import InputError
    from emb_daemon.logs.read import read_frames
    from emb_daemon.pipeline import Pipeline
    from emb_daemon.resources import resource
    from emb_daemon.wire.contract import INVALID
    from emb_daemon.wire.e2e import protect
    from emb_daemon.wire.frames import FRAME

import numpy as np

_OURS = (0x100, 0x110, 0x120, 0x180, 0x181, 0x182, 0x200)
_CALIBRATION = resource("config/calibration.yaml").read_bytes()
_CALIBRATION = _CALIBRATION[: _CALIBRATION.index(b"provenance:")]
_LOG = b"".join(
    b"(%d.%06d) can0 %s\n" % (1, 1000 * number, frame)
    for number, frame in enumerate((b"100#0102030405060708", b"18FEF100#AA", b"123##311223344", b"7FF#R8", b"20000040#00") * 3)
)
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


def yaml(data: bytes) -> None:
    _file("calibration.yaml", _edited(_CALIBRATION, data), load_calibration)


def candump(data: bytes) -> None:
    _file("drive.log", _edited(_LOG, data), read_frames)


if __name__ == "__main__":
    target = {"frames": frames, "yaml": yaml, "candump": candump}[sys.argv.pop(1)]
    atheris.Setup(sys.argv, target)
    atheris.Fuzz()
