"""The log path: read, decode, estimate; and the cost of one compiled step."""

import tempfile
import time
from pathlib import Path

import numpy as np

from emb_daemon.calibration.files import load_calibration
from emb_daemon.calibration.types import to_parameters
from emb_daemon.logs.read import read_frames
from emb_daemon.logs.write import write_frames
from emb_daemon.offline import estimate, load_log
from emb_daemon.plant.derive import plant_from_calibration
from emb_daemon.plant.scenarios import city_drive, simulate_log
from emb_daemon.replay import Replay
from emb_daemon.resources import resource
from emb_daemon.wire.layout import load_database

_REPEATS = 5
_ONE_BY_ONE = 20_000


def _median_s(function) -> float:
    taken = []
    for _ in range(_REPEATS):
        begin = time.perf_counter()
        function()
        taken.append(time.perf_counter() - begin)
    return float(np.median(taken))


def measure_logs(seconds: float = 120.0) -> dict:
    """Median figures over a simulated single-corner log of ``seconds``, in memory's page cache and with kernels compiled."""
    calibration = load_calibration(resource("config/calibration.yaml"))
    frames, _ = simulate_log(plant_from_calibration(calibration, 0), city_drive(), seconds)
    parameters = to_parameters(calibration)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "drive.log"
        write_frames(path, frames)
        log = load_log(path)
        estimate(log.samples[:10], parameters)
        Replay(calibration).run(path)
        read = _median_s(lambda: read_frames(path))
        replay = _median_s(lambda: Replay(calibration).run(path))
    step = _median_s(lambda: estimate(log.samples, parameters)) / len(log.samples)
    database = load_database(resource("dbc/emb.dbc"))
    known = {message.frame_id for message in database.messages}
    some = [
        (int(frame["can_id"]), int(frame["data"]).to_bytes(8, "little"))
        for frame in frames[:_ONE_BY_ONE]
        if int(frame["can_id"]) in known
    ]
    one_by_one = _median_s(lambda: [database.decode_message(can_id, data) for can_id, data in some]) / len(some)
    return {
        "seconds": seconds,
        "frames": len(frames),
        "step_us": 1e6 * step,
        "read_frames_per_s": len(frames) / read,
        "replay_frames_per_s": len(frames) / replay,
        "replay_times_real_time": seconds / replay,
        "cantools_decode_frames_per_s": 1.0 / one_by_one,
    }
