"""The daemon's code path over recorded frames, with the kernels that this process has; and a process that has a library's.

python tests/aheadkit.py LOG STATE OUTPUT
"""

import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent
_REFUSE_EXECUTABLE_GAIN = 65


def answered(frames, state: Path) -> dict:
    """All bytes that come of FRAME records, by name: rows, frames sent, states, files that are kept; and how many samples."""
    import numpy as np

    from emb_daemon.adapt.adaptation import Adaptation
    from emb_daemon.adapt.memory import Memory
    from emb_daemon.calibration.configuration import Setup
    from emb_daemon.pipeline import Pipeline
    from emb_daemon.runtime.rawcan import socket_pair

    setup = Setup(ROOT / "config" / "emb.yaml")
    here, there = socket_pair()
    here.send(frames[:64])
    heard = there.drain()
    found = {"drained": [heard[name].tobytes() for name in ("can_id", "length", "flags", "data")], "rows": [], "sent": []}
    here.close(), there.close()
    state.mkdir(exist_ok=True)
    samples = 0
    # The second start goes on from what the first one kept.
    for part in np.array_split(frames, [len(frames) * 3 // 4]):
        adaptation = Adaptation({"FL": setup.calibrations["FL"]}, Memory(state), int)
        pipeline = Pipeline(setup.parameters.copy(), ("FL",), setup.layout, capacity=64, adaptation=adaptation)
        pipeline.begin(int(part["time_ns"][0]))
        start = 0
        while start < len(part):
            start, count = pipeline.consume(part, start)
            samples += np.count_nonzero(pipeline.estimates["is_sample"][:count])
            # Not copies of the arrays: those need not hold what lies between two fields.
            found["rows"].append(pipeline.estimates[:count].tobytes())
            found["sent"].append(pipeline.broadcast(count).tobytes())
        adaptation.close(pipeline.states, pipeline.parameters)
    found |= {"states": [pipeline.states.tobytes()], "parameters": [pipeline.parameters.tobytes()]}
    found |= {file.name: [file.read_bytes()] for file in sorted(state.glob("*.json"))}
    return {name: np.frombuffer(b"".join(parts), np.uint8) for name, parts in found.items()} | {"samples": samples}


def main() -> None:
    """What `answered` gives, in a process that has a library and neither numba, LLVM nor memory that is both written and
    executed."""
    import ctypes

    refused = ctypes.CDLL(None).prctl(_REFUSE_EXECUTABLE_GAIN, 1, 0, 0, 0) == 0
    sys.modules["numba"] = sys.modules["llvmlite"] = sys.modules["asammdf"] = None
    from emb_daemon.ahead import library

    assert not library.load() and library.in_use()
    import numpy as np

    from emb_daemon.logs.read import read_frames

    log, state, output = sys.argv[1:]
    np.savez(output, **answered(read_frames(log), Path(state)))
    print(library.description(), "; executable memory refused" if refused else "; this kernel cannot refuse executable memory")


if __name__ == "__main__":
    main()
