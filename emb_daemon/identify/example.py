"""A campaign as a template: files of a made-up rig with a bus of its own, to be replaced one by one."""

from pathlib import Path

import numpy as np

from emb_daemon.atomic import write_atomically
from emb_daemon.calibration.files import shipped_calibration
from emb_daemon.errors import InputError
from emb_daemon.offline import log_of
from emb_daemon.plant.derive import plant_from_calibration
from emb_daemon.plant.scenarios import Schedule, curve, random_angle, rest, simulate_log, stop
from emb_daemon.wire.layout import load_database

#: Where DBC, mapping, campaign and datasheet are.
FILES = Path(__file__).with_name("example_files")


def write_example(folder: Path) -> list[Path]:
    """Write DBC, mapping, datasheet, campaign and logs of a simulated rig; returns their paths. Raises InputError: the folder
    is there and not empty, or cannot be made."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"{folder}: expected an empty folder, or none yet")
    folder.mkdir(parents=True, exist_ok=True)
    files = sorted(FILES.iterdir())
    for file in files:
        write_atomically(folder / file.name, file.read_bytes())
    plant = plant_from_calibration(shipped_calibration(), seed=7)
    rng = np.random.default_rng(7)
    motions = {
        "slow": rest(0.5) + curve(plant, seconds=24.0),
        "random_1": rest(0.5) + random_angle(plant, 15.0, rng, high_N=25000.0),
        "random_2": rest(0.5) + random_angle(plant, 15.0, rng, high_N=25000.0),
        "stops": rest(1.0) + stop(8000.0, 4.0) + rest(1.0) + stop(20000.0, 4.0) + rest(1.0),
    }
    logs = [_record(folder / f"{name}.log", plant, motion, seed) for seed, (name, motion) in enumerate(motions.items())]
    return [*(folder / file.name for file in files), *logs]


def _record(path: Path, plant: np.void, motion: Schedule, seed: int) -> Path:
    """What the rig's bus would carry of a motion, in can-utils' format."""
    motion.drives["wheel_speed"] = 0.0
    log = log_of(simulate_log(plant, motion, seed=seed)[0])
    database = load_database(FILES / "rig.dbc")
    drive, bench = (database.get_message_by_name(name) for name in ("Drive", "Bench"))
    lines = []
    for sample, time_s, force_N in zip(log.samples, log.time_s, np.nan_to_num(log.force_N), strict=True):
        values = {
            "Position": np.degrees(sample["angle"]),
            "Speed": sample["speed"] * 30.0 / np.pi,
            "Iq": -1e3 * sample["current_q"] if sample["has_current"] else 0.0,
        }
        lines.append(f"({1.79e9 + time_s:.6f}) can0 {drive.frame_id:08X}##1{drive.encode(values).hex().upper()}\n")
        plate_C = sample["inner_backplate"] if sample["has_thermocouple"] else 22.0
        values = {"Load": 1e-3 * force_N, "Plate": plate_C + 273.15}
        lines.append(f"({1.79e9 + time_s + 4e-4:.6f}) can0 {bench.frame_id:03X}#{bench.encode(values).hex().upper()}\n")
    write_atomically(path, "".join(lines).encode())
    return path
