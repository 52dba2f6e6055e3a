"""What a force sensor of low range is worth above its limit: drives with and without it, the same frames for both.

    python -m studies.force_sensor [--limits 3000 5000 8000] [--faults NAME,NAME] [--count N] [--seed S] [--processes N]

Drives of the simulated 30 kN brake with one fault or change each (`studies.faults`), or a fault of the sensor itself, up to
the parking, and never trained. Judged is where the true force is above the limit, from the onset on.
"""

import argparse
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import msgspec
import numpy as np

from emb_daemon.calibration.types import Calibration, ForceSensor, to_parameters
from emb_daemon.estimator.records import PARAMETERS
from emb_daemon.pipeline import Pipeline
from emb_daemon.plant import scenarios as sc
from emb_daemon.wire.contract import CYCLE_S, INVALID
from studies.faults import FAMILIES, SENSOR_FAULTS
from studies.grid import brake_of, prepare

#: Cycles between two looks of a fault at the running car.
_STRETCH = 20
#: Faults and changes of the brake, and of its current sensor, that a force sensor can tell of.
CHANGES = (
    "nominal", "tolerance", "contact_jump", "contact_slow", "knock_back", "disc_growth", "pads_thickness",
    "pads_compound", "wear", "torque_constant", "torque_constant_fade", "current_gain", "current_offset",
    "current_offset_later", "friction_scale", "cold_grease", "stribeck", "viscous", "gear_wear",
    "friction_asymmetry",
)  # fmt: skip


def sensor_of(limit_N: float) -> ForceSensor:
    """An ordinary strain gauge: noise and zero in a few thousandths of its range, gain to one per cent."""
    return ForceSensor(
        limit_N=limit_N,
        noise_N=0.002 * limit_N,
        offset_N=0.01 * limit_N,
        offset_walk_N_per_sqrt_s=0.0002 * limit_N,
        offset_N_per_K=0.0002 * limit_N,
        gain_relative=0.01,
    )


def _estimates(calibration: Calibration, frames: np.ndarray) -> np.ndarray:
    parameters = np.zeros(4, PARAMETERS)
    parameters[0] = to_parameters(calibration)
    pipeline, parts, start = Pipeline(parameters, ("FL",), capacity=1 << 14), [], 0
    pipeline.begin(int(frames["time_ns"][0]))
    while start < len(frames):
        start, count = pipeline.consume(frames, start)
        parts.append(pipeline.estimates[:count].copy())
    return np.concatenate(parts)


def drive(name: str, number: int, seed: int, limit_N: float):
    """(what was drawn, onset in s, time in s, true force in N, ESTIMATE rows without and with the sensor) of one drive."""
    brake = brake_of(None)
    mounted = msgspec.structs.replace(brake.calibration, force_sensor=sensor_of(limit_N))
    brake = brake._replace(calibration=mounted, own=mounted)
    fault, moments, known, car, schedule = prepare((name,), number, seed, brake, FAMILIES | SENSOR_FAULTS)
    schedule = schedule.first(moments["park"])
    commands, heard, force_N = sc.commands_of(schedule, ("FL",)), [], []
    for first in range(0, len(schedule), _STRETCH):
        fault.car(car, first * CYCLE_S)
        rows = slice(first, first + _STRETCH)
        frames, truth = car.run(commands[rows], schedule.drives[rows])
        heard.append(fault.bus(frames, first * CYCLE_S))
        force_N.append(truth["force"][:, 0])
    frames, force_N = np.concatenate(heard), np.concatenate(force_N)
    without, with_it = (
        _estimates(msgspec.structs.replace(known, force_sensor=has), frames) for has in (None, known.force_sensor)
    )
    row = np.clip(np.rint(without["time_ns"] / (1e9 * CYCLE_S)).astype(int) - 1, 0, len(force_N) - 1)
    return fault.size, fault.onset_s, 1e-9 * without["time_ns"], force_N[row], without, with_it


def judge(name: str, number: int, seed: int, limit_N: float) -> dict:
    """Squares of the errors above the limit of one drive, and how often they lie inside two sigma."""
    size, onset_s, time_s, force_N, without, with_it = drive(name, number, seed, limit_N)
    judged = (time_s >= onset_s) & (force_N > limit_N) & (without["source"] != INVALID) & (with_it["source"] != INVALID)
    figures = {"family": name, "number": number, "size": size, "limit_N": limit_N, "samples": int(judged.sum())}
    for word, estimates in (("without", without), ("with", with_it)):
        off = (estimates["force"] - force_N)[judged]
        figures[word] = float(np.sum(off * off))
        figures[f"inside_{word}"] = int(np.sum(np.abs(off) <= 2.0 * estimates["sigma"][judged]))
    return figures


def _line(name: str, of: list[dict]) -> str:
    if not (samples := sum(each["samples"] for each in of)):
        return f"{name:<24}{'never above the limit':>35}"
    rmse = {word: (sum(each[word] for each in of) / samples) ** 0.5 for word in ("without", "with")}
    inside = {word: 100.0 * sum(each[f"inside_{word}"] for each in of) / samples for word in rmse}
    worst = max(((e["with"] / e["without"]) ** 0.5 for e in of if e["without"] > 0.0), default=np.nan)
    return (
        f"{name:<24}{rmse['without']:>9.0f} N{rmse['with']:>9.0f} N{100.0 * rmse['with'] / rmse['without']:>8.0f} %"
        f"{100.0 * worst:>8.0f} %{inside['without']:>9.1f} %{inside['with']:>8.1f} %"
    )


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="python -m studies.force_sensor", description=__doc__.split("\n")[0])
    parser.add_argument("--limits", nargs="+", type=float, default=[3000.0, 5000.0, 8000.0], metavar="N", help="of the sensor")
    parser.add_argument("--faults", default=",".join([*CHANGES, *SENSOR_FAULTS]), metavar="NAME,NAME")
    parser.add_argument("--count", type=int, default=6, metavar="N", help="drives of each family (default 6)")
    parser.add_argument("--seed", type=int, default=1, metavar="S")
    parser.add_argument("--processes", type=int, default=2, metavar="N")
    parser.add_argument("--drives", action="store_true", help="print every drive")
    arguments = parser.parse_args(argv)
    names = arguments.faults.split(",")
    with ProcessPoolExecutor(arguments.processes, mp_context=get_context("spawn")) as pool:
        for limit in arguments.limits:
            tasks = [(name, number, arguments.seed, limit) for name in names for number in range(arguments.count)]
            found = list(pool.map(judge, *zip(*tasks, strict=True), chunksize=2))
            print(f"limit {limit:.0f} N{'without':>23}{'with':>11}{'ratio':>10}{'worst':>10}{'inside 2 sigma':>20}")
            for name in names:
                of = [each for each in found if each["family"] == name]
                if arguments.drives:
                    print(*(_line(f"  {each['number']} {each['size']}"[:24], [each]) for each in of), sep="\n")
                print(_line(name, of), flush=True)
            changed = [each for each in found if each["family"] in CHANGES[1:]]
            print(_line("all changes", changed or found), flush=True)


if __name__ == "__main__":
    main()
