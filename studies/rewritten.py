"""One recording, written again as a stranger could have: do names and figures stay, and is a wrong unit said?

    python -m studies.rewritten --fit first.log --judge second.log --calibration calibration.yaml [--only NAME] [--unmapped]

Logs as `emb-daemon convert` writes them become tables in other units, with signs turned round, other clocks and rates,
gaps, jitter, counts. Each is converted with the mapping that its stranger would write, diagnosed on the first logs and judged
on the second. With ``--unmapped`` the mapping stays that of the plain table, and what `convert` says of it is printed.
"""

import argparse
import contextlib
import io
import json
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import yaml

from emb_daemon.cli.main import main as emb_daemon
from emb_daemon.errors import InputError
from emb_daemon.offline import load_log

#: Columns of the plain table: ours, its signal and its unit.
COLUMNS = {
    "angle": ("EMB_FL_Resolver.MotorAngle", "rad"),
    "speed": ("EMB_FL_Resolver.MotorSpeed", "rad/s"),
    "current": ("EMB_FL_Current.CurrentQ", "A"),
    "force": ("RIG_FL_Force.ClampForceRef", "N"),
}
#: Counts of an encoder's turn; share of a sample by which jittered stamps are off; share of the rows whose stamp repeats;
#: gaps, and rows of the shortest and longest; error of a reference that nobody tared, N; what a drive calls a hundred per
#: cent, A.
_COUNTS, _JITTER, _REPEATS, _GAPS, _GAP_ROWS, _UNTARED_N, _RATED_A = 4096, 0.2, 0.05, 12, (3, 30), 700.0, 20.0

Table = dict[str, np.ndarray]


@dataclass(frozen=True)
class Rewritten:
    """A way to write a table."""

    rewrite: Callable[[Table], Table] = dict  #: plain columns with ``time`` in s → those of the stranger
    #: What the stranger's mapping says otherwise of a column; None of one that is not there.
    signals: Mapping[str, dict | None] = field(default_factory=dict)
    time: dict = field(default_factory=dict)  #: the same of the time
    separator: str = ","  #: between columns; with a semicolon decimals have a comma


def _in_units(**per_unit: float) -> Callable[[Table], Table]:
    return lambda table: table | {name: table[name] / size for name, size in per_unit.items()}


def _at(clock: Callable[[np.ndarray], np.ndarray]) -> Callable[[Table], Table]:
    return lambda table: table | {"time": clock(table["time"])}


def _rarer(rows: int, means: bool) -> Callable[[Table], Table]:
    def rewrite(table: Table) -> Table:
        cut = {name: values[: len(values) // rows * rows].reshape(-1, rows) for name, values in table.items()}
        averaged = ("current", "force") if means else ()
        return {name: values.mean(axis=1) if name in averaged else values[:, -1] for name, values in cut.items()}

    return rewrite


def _jittered(table: Table) -> Table:
    step = float(np.median(np.diff(table["time"])))
    return table | {"time": np.sort(table["time"] + _JITTER * step * _random().uniform(-1.0, 1.0, len(table["time"])))}


def _with_gaps(table: Table) -> Table:
    random, kept = _random(), np.ones(len(table["time"]), np.bool_)
    for begin in random.integers(0, len(kept) - _GAP_ROWS[1], _GAPS):
        kept[begin : begin + random.integers(*_GAP_ROWS)] = False
    return {name: values[kept] for name, values in table.items()}


def _with_repeats(table: Table) -> Table:
    again = _random().random(len(table["time"])) < _REPEATS
    return table | {"time": np.maximum.accumulate(np.where(again, table["time"][0], table["time"]))}


def _random() -> np.random.Generator:
    return np.random.default_rng(5)


def variants(rate_Hz: float) -> dict[str, Rewritten]:
    """Ways to write a table of so many rows a second, by name."""
    turn, degree = 2.0 * np.pi, np.pi / 180.0
    as_recorded = {"current": {"mean_ms": 1e3 / rate_Hz}}
    without_speed = {"speed": None}
    return {
        "as it is": Rewritten(),
        "half of the rate, means": Rewritten(_rarer(2, means=True)),
        "half of the rate, picked": Rewritten(_rarer(2, means=False), as_recorded),
        "third of the rate, means": Rewritten(_rarer(3, means=True)),
        "third of the rate, picked": Rewritten(_rarer(3, means=False), as_recorded),
        "no speed": Rewritten(signals=without_speed),
        "deg, rpm, mA, kN": Rewritten(
            _in_units(angle=degree, speed=np.pi / 30.0, current=1e-3, force=1e3),
            {"angle": {"unit": "deg"}, "speed": {"unit": "rpm"}, "current": {"unit": "mA"}, "force": {"unit": "kN"}},
        ),
        "deg/s, kgf": Rewritten(
            _in_units(speed=degree, force=9.80665), {"speed": {"unit": "deg/s"}, "force": {"unit": "kgf"}}
        ),
        "per cent of a current": Rewritten(_in_units(current=0.01 * _RATED_A), {"current": {"scale": 0.01 * _RATED_A}}),
        "current turned round": Rewritten(_in_units(current=-1.0), {"current": {"scale": -1}}),
        "current without its sign": Rewritten(lambda table: table | {"current": np.abs(table["current"])}),
        "motion turned round": Rewritten(_in_units(angle=-1.0, speed=-1.0), {"angle": {"scale": -1}, "speed": {"scale": -1}}),
        "force turned round": Rewritten(_in_units(force=-1.0), {"force": {"scale": -1}}),
        "ms": Rewritten(_at(lambda t: np.round(1e3 * t, 3)), time={"unit": "ms"}),
        "us since 1970": Rewritten(_at(lambda t: np.round(1e6 * t + 1.7e15)), time={"unit": "us"}),
        "s since 1970": Rewritten(_at(lambda t: t + 1.7e9)),
        "16 bit of ms": Rewritten(_at(lambda t: np.mod(np.round(1e3 * t) + 4e4, 2.0**16)), time={"unit": "ms"}),
        "32 bit of us": Rewritten(_at(lambda t: np.mod(np.round(1e6 * t) + 2.0**32 - 9e6, 2.0**32)), time={"unit": "us"}),
        "counted rows": Rewritten(_at(lambda t: np.round(t * rate_Hz)), time={"unit": None, "rate_Hz": rate_Hz}),
        "jittered stamps": Rewritten(_jittered),
        "gaps": Rewritten(_with_gaps),
        "repeated stamps": Rewritten(_with_repeats),
        "semicolons": Rewritten(separator=";"),
        "counts": Rewritten(
            lambda table: table | {"angle": np.rint(table["angle"] * _COUNTS / turn)},
            without_speed | {"angle": {"unit": "rev", "scale": 1.0 / _COUNTS}},
        ),
        "within one turn": Rewritten(
            lambda table: table | {"angle": np.mod(table["angle"] / degree, 360.0)},
            without_speed | {"angle": {"unit": "deg", "period": 360}},
        ),
        "untared": Rewritten(lambda table: table | {"force": table["force"] + _UNTARED_N}),
    }


def plain(path: Path) -> Table:
    """Columns of a log, the time in s."""
    log = load_log(path)
    samples = log.samples
    # A sample without a current of its own carries the last one.
    current = np.where(samples["has_current"], samples["current_q"], np.nan)
    found = {"angle": samples["angle"], "speed": samples["speed"], "current": current, "force": log.force_N}
    return {"time": log.time_s, **found}


def convert(log: Path, way: Rewritten, folder: Path, mapped: bool = True) -> tuple[int, Path, str]:
    """A log written again, and converted with the stranger's mapping, or that of the plain table if not ``mapped``.

    Returns:
        Exit status, where the log is, and what was said.
    """
    folder.mkdir(parents=True, exist_ok=True)
    before = plain(log)
    there = {name for name in COLUMNS if way.signals.get(name, {}) is not None and np.nan_to_num(before[name]).any()}
    table = {name: values for name, values in way.rewrite(before).items() if name in {"time", *there}}
    path, mapping, result = folder / f"{log.stem}.csv", folder / "mapping.yaml", folder / log.name
    lines = [way.separator.join(table)]
    for row in zip(*(values.tolist() for values in table.values()), strict=True):
        text = way.separator.join("" if value != value else f"{value:.17g}" for value in row)
        lines.append(text.replace(".", ",") if way.separator == ";" else text)
    path.write_text("\n".join(lines) + "\n")
    signals = {}
    for name, (signal, unit) in COLUMNS.items():
        if name in there:
            signals[signal] = {"signal": name, "unit": unit} | ((way.signals.get(name) or {}) if mapped else {})
        elif name == "force":
            signals[signal] = {"value": 0}
    time = {"signal": "time", "unit": "s"} | (way.time if mapped else {})
    time = {key: value for key, value in time.items() if value is not None}
    mapping.write_text(yaml.safe_dump({"format": 1, "time": time, "signals": signals}))
    status, said = _quietly(["convert", path, "--mapping", mapping, "--output", result])
    return status, result, said.replace(f"{folder}/", "")


def _quietly(arguments: Sequence[object]) -> tuple[int, str]:
    with contextlib.redirect_stdout(io.StringIO()) as said, contextlib.redirect_stderr(said):
        status = emb_daemon([str(argument) for argument in arguments])
    return status, said.getvalue()


def diagnosed(fit: Sequence[Path], judge: Sequence[Path], calibration: Path, folder: Path) -> str:
    """What a diagnosis finds, and the torque path's error on the judging logs before and after."""
    found = folder / "found"
    arguments = [*fit, "--calibration", calibration, "--validate", *judge, "--output", found]
    status, said = _quietly(["diagnose", *arguments])
    if status:
        return f"status {status}: {said.strip().splitlines()[-1]}"
    report = json.loads((found / "report.json").read_text())
    error = report["paths"]["torque"]
    names = [effect["name"] for effect in report["effects"] if effect["accepted"]]
    return f"{error['rmse_before_N']:.4g} -> {error['rmse_after_N']:.4g} N  {', '.join(names) or '-'}"


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--fit", type=Path, nargs="+", required=True, metavar="LOG")
    parser.add_argument("--judge", type=Path, nargs="+", required=True, metavar="LOG")
    parser.add_argument("--calibration", type=Path, required=True, metavar="FILE")
    parser.add_argument("--only", nargs="+", metavar="NAME", help="of these ways to write it")
    parser.add_argument("--unmapped", action="store_true", help="with the plain table's mapping: what is said?")
    arguments = parser.parse_args(argv)
    try:
        samples = load_log(arguments.fit[0]).samples
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    ways = variants(float(1.0 / np.median(samples["dt"][1:])))
    for name in arguments.only or ways:
        if name not in ways:
            parser.error(f"--only {name}: expected of {', '.join(ways)}")
        with tempfile.TemporaryDirectory() as folder:
            parts = [
                convert(log, ways[name], Path(folder) / part, not arguments.unmapped)
                for part, logs in (("fit", arguments.fit), ("judge", arguments.judge))
                for log in logs
            ]
            failed = next((said for status, _, said in parts if status), "")
            if arguments.unmapped or failed:
                text = (failed or parts[0][2]).strip()
            else:
                logs = [log for _, log, _ in parts]
                first, last = logs[: len(arguments.fit)], logs[len(arguments.fit) :]
                text = diagnosed(first, last, arguments.calibration, Path(folder))
        print(f"{name:26s} {text}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
