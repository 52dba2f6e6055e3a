"""Measured hardware: what the product makes of machines that nobody here built, beside the best plain fits.

    python -m studies.hardware --cranfield data/raw --embir futek_data --tmotor SysID --emps emps --output work

Each set is optional; what `tools/` needs of each is said there, with sources. Logs and reports stay in ``--output``.

Cranfield ball screw: the load of runs 6 to 10 is estimated without being given, by the pairs of clamping and releasing passes
that park brake training starts with (`adapt.pairs`), scaled on the normal runs 1 to 5. Beside it the best fit of each stroke
alone, from the same runs, which cannot know that friction has changed. Friction is called changed where it leaves the scatter
of the normal runs, and so is what it varies by once a turn of the screw: a balls' track broken at one place is passed once a
turn, wherever the nut is, and a lack of grease everywhere.

EMBiR dynamometer: `emb-daemon diagnose` on the first half of a run, judged on the second, and on runs of other days. Geared
robot motor: the same of every run, each judged on its own second half.
"""

import argparse
import importlib
import json
import sys
from pathlib import Path

import numpy as np

from emb_daemon.adapt.pairs import FORCE, FRICTION, WEIGHT, pairs_of_passes
from emb_daemon.adapt.records import TRAINING
from emb_daemon.calibration.files import load_calibration
from emb_daemon.calibration.types import to_parameters
from emb_daemon.cli.main import main as emb_daemon
from emb_daemon.offline.log import load_log, log_of
from emb_daemon.offline.score import rmse
from studies.plain import plain_fits

_TOOLS = Path(__file__).parent.parent / "tools"
STATES = ("normal", "lackLubrication1", "lackLubrication2", "backlash1", "backlash2", *(f"spalling{n}" for n in range(1, 9)))
_FIT, _JUDGE = range(1, 6), range(6, 11)
#: Scatter of the normal runs 1 to 5, in standard deviations, beyond which friction has changed: with five runs one in two
#: hundred leaves it by chance (Student, four degrees of freedom).
_CHANGED = 5.6
#: Share of friction below which a change is none: grease that is two or three kelvin warmer does as much.
_MATTERS = 0.05
#: A run of steps of the current against a damping load, and runs of other days.
EMBIR = "27_04_2021_16-28-22"
EMBIR_SLOW = "23_04_2021_16-51-18"
#: Orders about a screw's turn: what noise and a stroke's ends leave at the turn itself. A stroke of so many turns tells them
#: apart.
_BESIDE, _TURNS = (0.75, 0.85, 1.15, 1.25), 8.0
EMBIR_OTHERS = ("23_04_2021_19-57-18", "11_05_2021_18-12-52", "24_05_2021_15-00-36")


def tool(name: str):
    """A converter out of tools/ as a module; some share what others have."""
    if str(_TOOLS) not in sys.path:
        sys.path.append(str(_TOOLS))
    return importlib.import_module(name)


# -- Cranfield --------------------------------------------------------------------------------------------------------


def passes(part: dict, load_kgf: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Of one run whose load is not given: the pairs of its passes, the mean signed current of clamping and releasing, and the
    mean square (A²) of what it varies by once a turn of the screw, more than beside it."""
    cranfield = tool("cranfield_to_log")
    samples = log_of(cranfield.frames(part, load_kgf, with_load=False)).samples
    rows = np.zeros(len(samples), TRAINING)
    for name in TRAINING.names:
        if name in samples.dtype.names:
            rows[name] = samples[name]
    current = samples["current_q"][samples["has_current"]]
    pairs = pairs_of_passes(rows, np.atleast_1d(to_parameters(cranfield.calibration_to_start_from()))[0])
    return pairs, np.array([current[current > 0.0].mean(), current[current < 0.0].mean()]), _once_a_turn(samples)


def _once_a_turn(samples: np.ndarray) -> float:
    """Mean over the strokes: the current's friction and load change slowly along one, and are taken out of it as a quartic."""
    moving = np.flatnonzero(samples["has_current"])
    found = []
    for stroke in np.split(moving, np.flatnonzero(np.diff(moving) > 1) + 1):
        x, current = samples["angle"][stroke], samples["current_q"][stroke]
        if np.ptp(x) < 2.0 * np.pi * _TURNS:
            continue
        rest = current - np.polynomial.Polynomial.fit(x, current, 4)(x)
        power = [abs(2.0 * np.mean(np.exp(-1j * order * x) * rest)) ** 2 for order in (1.0, *_BESIDE)]
        found.append(power[0] - np.mean(power[1:]))
    return float(np.mean(found))


def _line(table: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    return np.linalg.lstsq(table, wanted, rcond=None)[0]


def cranfield(folder: Path) -> list[str]:
    """Load error of each state in kgf, and what became of its friction."""
    reading, found = tool("cranfield_to_log").read, {}
    for state in STATES:
        for (load, run), part in reading(folder / f"{state}.csv").items():
            pairs, currents, turn = passes(part, load)
            force, friction = (np.average(pairs[:, column], weights=pairs[:, WEIGHT]) for column in (FORCE, FRICTION))
            # The actuator's own direction, in which loads have both signs: what is clamped counts against it.
            sign = np.sign(load)
            found[state, load, run] = sign * force, friction, sign * currents, turn
    loads = sorted({load for _, load, _ in found})
    fit = [(load, *found["normal", load, run]) for load in loads for run in _FIT]
    wanted = np.array([load for load, *_ in fit], float)
    pair = _line(np.array([[force, 1.0] for _, force, *_ in fit]), wanted)
    strokes = [_line(np.array([_plain(currents[way]) for _, _, _, currents, _ in fit]), wanted) for way in range(2)]
    normal = {load: np.array([found["normal", load, run][1] for run in _FIT]) for load in loads}

    def turn(state: str, run: int) -> float:
        """Amplitude once a turn in A, mean over the loads."""
        return float(np.mean([max(found[state, load, run][3], 0.0) ** 0.5 for load in loads if (state, load, run) in found]))

    usual = np.array([turn("normal", run) for run in _FIT])
    broken = usual.mean() + _CHANGED * usual.std(ddof=1)
    lines = [
        "| state | stroke alone, kgf | pairs of passes, kgf | friction changed, runs | once a turn, mA | more, runs |",
        "|---|---|---|---|---|---|",
    ]
    for state in STATES:
        errors, plain, changed = [], [], []
        for run in _JUDGE:
            beyond = []
            for load in loads:
                force, friction, currents, _ = found[state, load, run]
                errors.append(pair @ [force, 1.0] - load)
                plain += [strokes[way] @ _plain(currents[way]) - load for way in range(2)]
                change = friction - normal[load].mean()
                certain = abs(change) > _CHANGED * normal[load].std(ddof=1)
                beyond.append(change / normal[load].mean() if certain else 0.0)
            changed.append(max(beyond, key=abs))
        count = int(np.sum(np.abs(changed) > _MATTERS))
        way = "" if not count else " up" if np.mean(changed) > 0.0 else " down"
        turns = np.array([turn(state, run) for run in _JUDGE])
        lines.append(
            f"| {state} | {rmse(plain):.1f} | {rmse(errors):.1f} | {count}/{len(changed)}{way} | {1e3 * turns.mean():.0f} "
            f"| {np.sum(turns > broken)}/{len(turns)} |"
        )
    return lines


def _plain(current: float) -> list[float]:
    """Regressors of the load on the mean current of a stroke: what three loads can fit."""
    return [current, current * current, 1.0]


# -- EMBiR ------------------------------------------------------------------------------------------------------------


def embir(folder: Path, work: Path) -> list[str]:
    """Torque error in N m before and after, beside plain fits, on the second half of a run and on other days."""
    convert, rows = tool("embir_to_log"), []
    for run in (EMBIR, EMBIR_SLOW, *EMBIR_OTHERS):
        if status := convert.main([str(folder / f"futek_test_{run}.csv"), "--output", str(work / run)]):
            sys.exit(status)
    gamma, base = convert.GEAR_GAIN_M_PER_RAD, work / EMBIR
    judged = {"second half": [base / "second_half.log"]}
    judged |= {f"another day ({run})": [work / run / "run.log"] for run in EMBIR_OTHERS}
    for name, validate in judged.items():
        rows.append(
            _diagnosed(f"steps, {name}", [base / "first_half.log"], base, validate, gamma, work / f"found_{len(rows)}")
        )
    slow = work / EMBIR_SLOW
    rows.append(_diagnosed("slow turning, left-out episodes", [slow / "run.log"], slow, [], gamma, work / "found_slow"))
    plain = ", ".join(f"{name} {error:.3f}" for name, error in _plain_of_halves(base).items())
    return [
        f"Plain fits of the first half on the second, N·m: {plain}.", "",
        "| logs | before, N·m | after, N·m | found |", "|---|---|---|---|", *rows,
    ]  # fmt: skip


def tmotor(folder: Path, work: Path) -> list[str]:
    """Torque error in N m before and after, beside plain fits, on the second half of each run."""
    convert = tool("tmotor_to_log")
    rows = ["| run | before | after | found | constant and offset | friction | saturation |", "|---|---|---|---|---|---|---|"]
    for path in sorted(folder.glob("*/log_adc_and_motor.csv")):
        base = work / path.parent.name
        if convert.main([str(path), "--output", str(base)]):
            continue
        first, second = (base / f"{half}_half.log" for half in ("first", "second"))
        row = _diagnosed(path.parent.name, [first], base, [second], convert.GEAR_GAIN_M_PER_RAD, base / "found")
        rows.append(" ".join([row, *(f"{error:.3f} |" for error in _plain_of_halves(base).values())]))
    return rows


def _diagnosed(name: str, logs: list[Path], base: Path, validate: list[Path], gamma: float, output: Path) -> str:
    others = ["--validate", *map(str, validate)] if validate else []
    calibration = str(base / "calibration.yaml")
    status = emb_daemon(["diagnose", *map(str, logs), "--calibration", calibration, *others, "--output", str(output)])
    if status:
        return f"| {name} | | | refused |"
    report = json.loads((output / "report.json").read_text())
    torque = report["paths"]["torque"]
    found = ", ".join(e["name"].replace("_", " ") for e in report["effects"] if e["accepted"]) or "nothing"
    return f"| {name} | {gamma * torque['rmse_before_N']:.3f} | {gamma * torque['rmse_after_N']:.3f} | {found} |"


def _plain_of_halves(base: Path) -> dict[str, float]:
    """Errors (N m) of plain fits to the first half on the second."""
    first, second = (load_log(base / f"{half}_half.log") for half in ("first", "second"))
    return plain_fits([first], [second], load_calibration(base / "calibration.yaml"))


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cranfield", type=Path, metavar="DIR", help="data/raw of Rocket-RAG")
    parser.add_argument("--embir", type=Path, metavar="DIR", help="futek_data of actuator-dynamometer")
    parser.add_argument("--tmotor", type=Path, metavar="DIR", help="SysID of TMotorCANControl")
    parser.add_argument("--emps", type=Path, metavar="DIR", help="with DATA_EMPS.mat and DATA_EMPS_PULSES.mat")
    parser.add_argument("--output", type=Path, required=True, metavar="DIR", help="for logs and reports")
    arguments = parser.parse_args(argv)
    lines = []
    if arguments.cranfield:
        lines += ["Cranfield ball screw, RMS error of the load on runs 6 to 10", "", *cranfield(arguments.cranfield), ""]
    if arguments.embir:
        lines += ["EMBiR dynamometer", "", *embir(arguments.embir, arguments.output), ""]
    if arguments.tmotor:
        lines += ["AK80-9, second half of each run, N·m", "", *tmotor(arguments.tmotor, arguments.output / "tmotor"), ""]
    if arguments.emps:
        lines += ["EMPS", "", *emps(arguments.emps, arguments.output / "emps"), ""]
    print("\n".join(lines))
    return 0


def emps(folder: Path, work: Path) -> list[str]:
    """The torque balance of the thesis completed to the published model."""
    convert = tool("emps_to_log")
    files = [str(folder / name) for name in ("DATA_EMPS.mat", "DATA_EMPS_PULSES.mat")]
    if status := convert.main([*files, "--output", str(work)]):
        sys.exit(status)
    validate = [work / "second_half.log", work / "pulses.log"]
    row = _diagnosed("second half and pulses", [work / "first_half.log"], work, validate, 1.0, work / "found")
    return ["| logs | before, N | after, N | found |", "|---|---|---|---|", row]


if __name__ == "__main__":
    sys.exit(main())
