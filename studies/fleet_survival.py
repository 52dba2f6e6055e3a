"""Is a fleet's work the same, byte for byte, when a worker and the client are killed in the middle of it?

Logs of a small simulated fleet, a tenth of them damaged, go through ingest, replay and diagnose twice: undisturbed, and with
kill -9 of a worker, then of the client, at each stage; then the stage is resumed.
"""

import argparse
import gzip
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import psutil

from emb_daemon.fleet.dataset import read_results
from emb_daemon.logs.candump import format_candump
from emb_daemon.plant.derive import plant_from_calibration
from emb_daemon.plant.scenarios import simulate_log
from studies.fleet import _calibration, day_drive

_UNITS, _DAYS, _DAMAGED = 8, 5, 0.1
_DAY_NS = 86_400_000_000_000
#: Files of each stage that count its progress.
_STAGES = {"ingest": ("ingested/*.json",), "replay": ("figures/**/*.json",), "diagnose": ("evidence/**/*.npz",)}


def write_logs(folder: Path, seed: int) -> int:
    """Logs by unit, of which a tenth is damaged; returns how many are."""
    rng = np.random.default_rng(seed)
    paths = []
    for unit in range(_UNITS):
        plant = plant_from_calibration(_calibration(), unit)
        (folder / f"unit-{unit}").mkdir(parents=True)
        for day in range(_DAYS):
            frames, _ = simulate_log(
                plant, day_drive(rng), seed=day, reference=False, start_ns=20_000 * _DAY_NS + day * _DAY_NS
            )
            paths.append(folder / f"unit-{unit}" / f"day.{day}.log.gz")
            paths[-1].write_bytes(gzip.compress(format_candump(frames).encode(), 1))
    damaged = rng.choice(len(paths), round(_DAMAGED * len(paths)), replace=False)
    for number in damaged:
        content = bytearray(paths[number].read_bytes())
        content[len(content) // 3 : len(content) // 3 + 40] = rng.bytes(40)
        paths[number].write_bytes(content)
    return len(damaged)


def command(stage: str, logs: Path, root: Path) -> list[str]:
    given = [str(logs), "--output", str(root)] if stage == "ingest" else [str(root), "--resume"]
    return [sys.executable, "-m", "emb_daemon.cli.main", "fleet", stage, *given, "--workers", "2"]


def disturbed(stage: str, logs: Path, root: Path) -> str:
    """Run a stage, kill a worker at a third and the client at two thirds of its results; returns what was killed when."""
    total = _UNITS if stage == "diagnose" else _UNITS * _DAYS
    process = psutil.Popen(command(stage, logs, root), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    killed = ""
    while process.poll() is None:
        done = sum(len(list(root.glob(pattern))) for pattern in _STAGES[stage])
        if not killed and done >= total // 3:
            workers = [child for child in process.children(recursive=True) if "spawn_main" in " ".join(child.cmdline())]
            if workers:
                workers[0].kill()
                killed = f"worker at {done}"
        elif killed and done >= 2 * total // 3:
            os.kill(process.pid, signal.SIGKILL)
            process.wait()
            return f"{killed}, client at {done} of {total}"
        time.sleep(0.01)
    return f"{killed or 'nothing'} of {total}: it was done before the client was killed"


def content(root: Path) -> dict[str, bytes]:
    """Files of a data set by path; temporary ones of killed writers are no part of it."""
    found = {str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()}
    return {name: value for name, value in found.items() if not Path(name).name.startswith(".")}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        logs, calm, rough = (Path(folder, name) for name in ("logs", "calm", "rough"))
        damaged = write_logs(logs, arguments.seed)
        same = True
        for stage in _STAGES:
            subprocess.run(command(stage, logs, calm), check=True, capture_output=True)
            told = disturbed(stage, logs, rough)
            subprocess.run(command(stage, logs, rough), check=True, capture_output=True)
            same &= content(calm) == content(rough)
            print(f"{stage}: killed {told}; resumed: {'the same bytes' if same else 'NOT the same bytes'}", flush=True)
        listed = sum(bool(known["fault"]) for known in read_results(rough))
        print(f"{damaged} of {_UNITS * _DAYS} logs damaged, {listed} listed")
    return 0 if same and listed == damaged else 1


if __name__ == "__main__":
    sys.exit(main())
