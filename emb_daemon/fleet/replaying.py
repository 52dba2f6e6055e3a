"""Estimates of every drive by the daemon's own step, to the last bit those of `emb-daemon replay` on the same log."""

import json
from pathlib import Path
from typing import Any

from emb_daemon.calibration.types import Calibration, to_parameters
from emb_daemon.fleet.dataset import Drive, folder_of, made_by, read_drive, write_json
from emb_daemon.logs.write import reference_columns, table_columns, write_table
from emb_daemon.offline import estimate
from emb_daemon.replay import Result


def figures_path(root: Path, drive: Drive) -> Path:
    return Path(root, "figures", drive.partition, f"{drive.digest}.json")


def is_replayed(root: Path, drive: Drive, makers: str) -> bool:
    """Whether a drive's estimates exist, made by these (`dataset.made_by`)."""
    try:
        return json.loads(figures_path(root, drive).read_bytes())["made_by"] == makers
    except (OSError, ValueError, KeyError):
        return False


def replay_drive(root: Path, drive: Drive, calibration: Calibration) -> dict[str, Any]:
    """Write a drive's estimates (columns of the command-line contract, with the clamp force where a log has one) and figures;
    returns these. Raises InputError: the drive's file is missing or damaged."""
    log, about = read_drive(root, drive)
    estimates = estimate(log.samples, to_parameters(calibration))
    result = Result(log.path, log.time_ns, estimates, log.samples, log.reference, log.force_N)
    figures = result.figures | {"log": about.source, "refused": about.refused, "notes": about.notes}
    figures["made_by"] = made_by(calibration)
    columns = table_columns(estimates, 1e-9 * log.time_ns) | reference_columns(log.reference, log.time_ns, log.force_N)
    # A worker does not hold a long drive's samples while its columns are written.
    del log, result
    write_table(folder_of(root, "estimates", drive.partition) / f"{drive.digest}.parquet", columns)
    # Written after the estimates, so that existing figures imply existing estimates.
    write_json(figures_path(root, drive), figures)
    return figures
