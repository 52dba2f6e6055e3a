"""Properties of contact and adaptation that need many repetitions: false alarms, and wear over a life.

    python -m studies.adaptation alarms
    python -m studies.adaptation wear --output DIR

Everything here is simulated.
"""

import argparse
import json
import sys
import tempfile
from math import exp, sqrt
from pathlib import Path

import msgspec
import numpy as np

from emb_daemon.adapt.adaptation import Adaptation
from emb_daemon.adapt.memory import Entry, Memory, Store
from emb_daemon.calibration.files import shipped_calibration
from emb_daemon.calibration.types import Calibration, to_parameters
from emb_daemon.estimator.records import PARAMETERS, new_state
from emb_daemon.jit import njit
from emb_daemon.models.contact import CONTACT, engaged, threshold, torque_sigma, watch_closing
from emb_daemon.offline import estimate
from emb_daemon.offline.log import samples_in
from emb_daemon.offline.score import rmse
from emb_daemon.wire.contract import CYCLE_S


@njit
def _false_alarms(state, releases, p, contact_sigma, rng):
    """Alarms in ``releases`` moves from just before contact to the released position and back, at speeds spread evenly on a
    logarithmic scale up to the motor's; noise of current and speed as the calibration has it. Returns (alarms, samples)."""
    sigma, share = torque_sigma(p.torque_constant * p.current_sigma, p.inertia * p.speed_sigma / CYCLE_S)
    limit = threshold(share, p.current_correlation_time, CYCLE_S)
    rho = exp(-CYCLE_S / p.current_correlation_time)
    coloured = speed = 0.0
    alarms = samples = 0
    for _ in range(releases):
        pace = exp(rng.uniform(0.0, np.log(p.maximum_speed)))
        offset = 0.02 * p.offset_friction * rng.standard_normal()
        believed = contact_sigma * rng.standard_normal()
        alarmed = False
        for leg in range(2):
            x = -4.0 * contact_sigma if leg == 0 else -p.clearance
            direction = -1.0 if leg == 0 else 1.0
            while -p.clearance <= x <= -4.0 * contact_sigma or x == -p.clearance:
                before = speed
                speed = p.speed_sigma * rng.standard_normal()
                coloured = rho * coloured + sqrt(1.0 - rho * rho) * rng.standard_normal()
                torque = p.torque_constant * p.current_sigma * coloured - p.inertia * (speed - before) / CYCLE_S + offset
                watch_closing(state, torque, 0.0, direction, sigma, limit, x + believed, contact_sigma, 0.0, 0.0, True)
                alarmed |= engaged(state, x + believed, contact_sigma)
                x += direction * pace * CYCLE_S
                samples += 1
        alarms += alarmed
        state.engaged = False
    return alarms, samples


def false_alarms(calibration: Calibration, releases: int) -> dict:
    """False engagements in the clearance, with a contact angle known to 0.1 rad; simulated."""
    p = to_parameters(calibration)
    alarms, samples = _false_alarms(np.zeros(1, CONTACT)[0], releases, p, 0.1, np.random.default_rng(1))
    return {"releases": releases, "samples": int(samples), "false_alarms": int(alarms)}


#: Park cycles of a brake's life, and what its pads wear by in it.
_CYCLES, _WEAR_MM = 1000, 9.0


def wear(calibration: Calibration, trainings: int) -> dict:
    """Force error of a brake whose pads wear by 9 mm over 1000 park cycles, with adaptation and without.

    ``trainings`` cycles, evenly spread, have training motion, and the force is judged on random motor angles (thesis
    3.3.2) afterwards, in the state of wear then reached; the cycles between only wear the pads. The daemon is restarted each
    time, so that learned values come from its memory. The clearance stays the same, because the actuator follows wear.
    Simulated car, whose brake shares no force model with the estimator."""
    from emb_daemon.plant.car import Car
    from emb_daemon.plant.derive import plant_from_calibration
    from emb_daemon.plant.scenarios import commands_of, random_angle
    from studies.drives import training

    thickness = calibration.pad_thickness_mm
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for number in range(trainings + 1):
            mounted = thickness - _WEAR_MM * number / trainings
            plant = plant_from_calibration(calibration, pad_thickness_mm=mounted)
            rng = np.random.default_rng(1 + number)
            schedule = training(plant, high_N=18000.0) + random_angle(plant, 10.0, rng)
            car = Car(np.atleast_1d(plant), ("FL",), 1 + number)
            frames, truth = car.run(commands_of(schedule, ("FL",)), schedule.drives)
            samples, _ = samples_in(frames, ("FL",))
            row = {"cycle": number * _CYCLES // trainings, "pads_mm": mounted}
            for name, state in (("with", Path(folder)), ("without", None)):
                learner = Adaptation({"FL": calibration}, Memory(state), int) if state else None
                parameters = np.full(4, to_parameters(calibration), PARAMETERS)
                if learner:
                    learner.restore(parameters)
                estimates = estimate(samples, parameters, new_state(4), learner)
                judged = round(10.0 / CYCLE_S)
                error = estimates["force"][-judged:] - truth["force"][:, 0][-judged:]
                row[name] = {
                    "rmse_N": rmse(error),
                    "inside_two_sigma": float(np.mean(np.abs(error) < 2.0 * estimates["sigma"][-judged:])),
                }
                if learner:
                    row["outcome"] = learner.last_outcome("FL")
            rows.append(row)
    return {"cycles": _CYCLES, "trainings": trainings, "wear_mm": _WEAR_MM, "rows": rows}


def plot_wear(result: dict, path: Path) -> None:
    """Force error over park cycles as a picture."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 4.0), layout="constrained")
    axes = figure.subplots()
    for name, label in (("without", "calibration only"), ("with", "park brake adaptation")):
        cycles = [row["cycle"] for row in result["rows"]]
        axes.plot(cycles, [1e-3 * row[name]["rmse_N"] for row in result["rows"]], marker="o", markersize=3, label=label)
    axes.set(xlabel="park cycles", ylabel="clamp force RMSE / kN", ylim=(0.0, None))
    axes.set_title(f"{result['wear_mm']:g} mm of pad wear, simulated car")
    axes.legend()
    figure.savefig(path)


def specimen(number: int) -> Store:
    """A store in which every value contains ``number``, so that a mixture of two would be noticed."""
    value = float(number)
    entry = Entry(
        date=str(number), outcome="accepted", note="", ambient_C=value, pad_rise_K=value,
        values=dict.fromkeys("abcdefghijkl", value), sigmas=dict.fromkeys("abcdefghijkl", value),
        evidence=dict.fromkeys("mnopqr", value),
    )  # fmt: skip
    return Store(format=2, corner="FL", actuator="specimen", calibration=str(number), current=entry, history=(entry,) * 50)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("alarms", "wear"))
    parser.add_argument("--count", type=int, help="releases or trainings")
    parser.add_argument("--output", type=Path, default=Path(), metavar="DIR", help="where the picture goes")
    arguments = parser.parse_args()
    calibration = shipped_calibration()
    if arguments.what == "alarms":
        result = false_alarms(calibration, arguments.count or 100_000)
    else:
        result = wear(msgspec.structs.replace(calibration, pad_thickness_mm=10.0), trainings=arguments.count or 20)
        plot_wear(result, arguments.output / "wear.svg")
    json.dump(result, sys.stdout, indent=1)
    print()


if __name__ == "__main__":
    main()
