"""How fast are the parts? Reading, decoding and estimating a log; a step, compiled and in plain Python; and, with a library
from ``emb-daemon compile``, the daemon with each of the two kinds of kernels.

``python -m studies.speed [KERNELS]``
"""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from emb_daemon.bench.loop import machine, measure_loop
from emb_daemon.calibration.files import shipped_calibration
from emb_daemon.calibration.types import to_parameters
from emb_daemon.estimator.records import PARAMETERS
from emb_daemon.logs.read import read_frames
from emb_daemon.logs.write import write_frames
from emb_daemon.offline import estimate, log_of
from emb_daemon.pipeline import Pipeline
from emb_daemon.plant.derive import plant_from_calibration
from emb_daemon.plant.scenarios import city_drive, simulate_log
from emb_daemon.replay import Replay
from emb_daemon.resources import resource
from emb_daemon.wire.layout import load_database

_REPEATS = 7
#: Length of the log.
_SECONDS = 120.0
_ONE_BY_ONE = 20_000
#: Number of samples for plain Python.
_PLAIN = 2000
#: Rounds of the comparison of kernels, and length of each, s.
_ROUNDS, _ROUND_S = 5, 4.0


def medians_s(*functions: Callable[[], object]) -> list[float]:
    """Median CPU time of each task. They take turns, so that other load of the machine affects all of them alike."""
    taken = np.zeros((_REPEATS, len(functions)))
    for repeat in range(_REPEATS):
        for column, function in enumerate(functions):
            begin = time.process_time()
            function()
            taken[repeat, column] = time.process_time() - begin
    return np.median(taken, axis=0).tolist()


def difference(one: np.ndarray, other: np.ndarray) -> float:
    """Largest relative difference of two arrays of ESTIMATE rows: 0 where they are the same to the last bit, infinite where a
    whole number or a flag differs, or one is NaN and the other is not."""
    largest = 0.0
    for name in one.dtype.names:
        a, b = one[name], other[name]
        if a.dtype.kind != "f":
            largest = largest if np.array_equal(a, b) else np.inf
            continue
        differ = (a != b) & ~(np.isnan(a) & np.isnan(b))
        if np.any(differ):
            off = np.abs(a[differ] - b[differ]) / np.maximum(np.abs(a[differ]), np.abs(b[differ]))
            largest = max(largest, float(np.max(np.nan_to_num(off, nan=np.inf))))
    return largest


def measure_logs() -> dict[str, Any]:
    """Figures by CPU time over a simulated single-corner log, in the page cache and with kernels compiled."""
    calibration = shipped_calibration()
    frames, _ = simulate_log(plant_from_calibration(calibration, 0), city_drive(), _SECONDS)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "drive.log"
        write_frames(path, frames)
        Replay(calibration).run(path)
        read, replay = medians_s(lambda: read_frames(path), lambda: Replay(calibration).run(path))
    bulk, one_by_one = _decoders(frames)
    return {
        "seconds": _SECONDS,
        "frames": len(frames),
        "read_frames_per_s": len(frames) / read,
        "replay_frames_per_s": len(frames) / replay,
        "replay_times_real_time": _SECONDS / replay,
        "decode_frames_per_s": bulk,
        "cantools_decode_frames_per_s": one_by_one,
        "step": measure_step(log_of(frames).samples, np.atleast_1d(to_parameters(calibration))),
    }


def _decoders(frames: np.ndarray) -> tuple[float, float]:
    """Frames per second that the pipeline decodes, E2E check and samples included, and that cantools decodes one by one."""
    database = load_database(resource("dbc/emb.dbc"))
    known = [message.frame_id for message in database.messages]
    some = frames[np.isin(frames["can_id"], known)][:_ONE_BY_ONE]
    pairs = [(int(frame["can_id"]), int(frame["data"]).to_bytes(8, "little")) for frame in some]
    # One for each turn, because a repeated frame is refused.
    pipelines = iter([Pipeline(np.zeros(4, PARAMETERS), ("FL",), capacity=_ONE_BY_ONE) for _ in range(_REPEATS)])

    def bulk() -> None:
        next(pipelines).collect(some, predictions=False)

    def one_by_one() -> None:
        for can_id, data in pairs:
            database.decode_message(can_id, data)

    return tuple(len(some) / taken for taken in medians_s(bulk, one_by_one))


def measure_step(samples: np.ndarray, parameters: np.ndarray) -> dict[str, Any]:
    """Time of the compiled step over SAMPLE rows, with PARAMETERS of shape (1,), and of the same in plain Python.

    Returns:
        ``compiled_us`` and ``plain_us`` of one step, and ``plain_difference`` as `difference` has it. Plain Python may
        differ in the last bit, because its x ** 2 is pow(), which may round differently from a product.
    """
    compiled = estimate(samples, parameters)
    [taken] = medians_s(lambda: estimate(samples, parameters))
    result: dict = {"samples": len(samples), "compiled_us": 1e6 * taken / len(samples)}
    with tempfile.TemporaryDirectory() as folder:
        files = [f"{folder}/{name}.npy" for name in ("samples", "parameters", "estimates")]
        np.save(files[0], samples[:_PLAIN])
        np.save(files[1], parameters)
        command = [sys.executable, "-m", "studies.speed", "--plain", *files]
        environment = os.environ | {"NUMBA_DISABLE_JIT": "1"}
        done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True)
        result["plain_us"] = float(done.stdout)
        result["plain_difference"] = difference(np.load(files[2]), compiled[:_PLAIN])
    return result


def _plain(samples: str, parameters: str, estimates: str) -> None:
    """In a process without a compiler: the step over files of numpy; prints the CPU time of one, us."""
    rows, calibrated = np.load(samples), np.load(parameters)
    begin = time.process_time()
    answers = estimate(rows, calibrated)
    print(1e6 * (time.process_time() - begin) / len(rows))
    np.save(estimates, answers)


def compare_kernels(library: str) -> dict[str, dict[str, Any]]:
    """Figures of the daemon with kernels from numba and with a library, in turn, so that a busy machine affects both alike;
    of each the round whose tick is the median."""
    codes = {"numba": "", "ahead": library}
    rounds = [{code: measure_loop(4, _ROUND_S, path) for code, path in codes.items()} for _ in range(_ROUNDS)]
    return {
        code: sorted((found[code] for found in rounds), key=lambda loop: loop["tick"]["p50_us"])[_ROUNDS // 2]
        for code in codes
    }


def _kernels(measured: dict) -> list[str]:
    rows = [
        ("start to ready, s", lambda loop: f"{loop['ready']['wall_s']:.2f}"),
        ("of them on a CPU, s", lambda loop: f"{loop['ready']['cpu_s']:.2f}"),
        ("resident, MiB", lambda loop: f"{loop['resident_KiB'][1] / 1024.0:.0f}"),
        ("tick, us, p50 / p99", lambda loop: _both(loop["tick"])),
        *((f"  {part}", lambda loop, part=part: _both(loop["parts"][part])) for part in measured["numba"]["parts"]),
        ("ticks missed", lambda loop: f"{loop['missed']} of {loop['ticks']}"),
        ("  held up by the machine", lambda loop: str(loop["held_up"])),
    ]
    lines = [f"{'4 corners, kernels':<38}{'from numba':>18}{'compiled ahead':>18}"]
    return lines + [f"  {name:<36}{figure(measured['numba']):>18}{figure(measured['ahead']):>18}" for name, figure in rows]


def _both(figures: dict) -> str:
    return f"{figures['p50_us']:.0f} / {figures['p99_us']:.0f}"


def _logs(logs: dict) -> list[str]:
    step, bulk, single = logs["step"], logs["decode_frames_per_s"], logs["cantools_decode_frames_per_s"]
    return [
        f"log of {logs['seconds']:g} s, {logs['frames']} frames, one corner, in million frames per second of CPU time:",
        f"  read {logs['read_frames_per_s'] / 1e6:.1f}; replayed {logs['replay_frames_per_s'] / 1e6:.2f}, "
        f"{logs['replay_times_real_time']:.0f} times real time",
        f"  decoded {bulk / 1e6:.1f} with E2E check; {single / 1e6:.2f} by cantools, frame by frame, without",
        f"step: {step['compiled_us']:.2f} us compiled, {step['plain_us']:.0f} in plain Python over numpy records; "
        f"estimates differ by {step['plain_difference']:.1g} at most",
    ]


def main() -> None:
    if sys.argv[1:2] == ["--plain"]:
        _plain(*sys.argv[2:])
        return
    print(machine(), *_logs(measure_logs()), sep="\n")
    if len(sys.argv) > 1:
        print("", *_kernels(compare_kernels(sys.argv[1])), sep="\n")


if __name__ == "__main__":
    main()
