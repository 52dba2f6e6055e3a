"""emb-daemon fleet."""

import argparse
from collections.abc import Callable
from functools import partial

from emb_daemon.cli.options import CALIBRATION_HELP, add_mapping_argument, add_path, check_output, load_chosen
from emb_daemon.cli.progress import progress
from emb_daemon.errors import InputError, tell

EXAMPLE = """emb-daemon fleet ingest logs/ --output fleet
  emb-daemon fleet diagnose fleet --units units.csv
  emb-daemon fleet report fleet --output fleet.html"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    commands = parser.add_subparsers(dest="fleet_command", metavar="COMMAND", required=True)
    parsers = {
        name: commands.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
        for name, (_, text) in _COMMANDS.items()
    }
    ingest = parsers["ingest"]
    add_path(ingest, "logs", "log files of any format that replay reads, or folders", "LOG", nargs="+")
    add_path(ingest, "--output", "data set; created if it does not exist", "DIR", required=True)
    ingest.add_argument(
        "--unit",
        metavar="REGEX",
        help="finds the unit (?P<unit>…), optionally the day (?P<day>…), in a log's path (default: its folder is the unit)",
    )
    add_mapping_argument(ingest)
    for name in ("replay", "learn", "diagnose", "prior", "report"):
        add_path(parsers[name], "data", "data set of emb-daemon fleet ingest", "DIR")
    for name in ("replay", "learn", "diagnose", "prior"):
        add_path(parsers[name], "--calibration", CALIBRATION_HELP)
    for name in ("replay", "learn", "diagnose"):
        parsers[name].add_argument(
            "--resume", action="store_true", help="continue: keep existing results of the same calibration and estimator"
        )
    for name in ("ingest", "replay", "learn", "diagnose"):
        parsers[name].add_argument(
            "--scheduler", metavar="ADDRESS", help="address of a Dask cluster whose workers see DIR (default: this machine)"
        )
        parsers[name].add_argument("--workers", type=int, metavar="N", help="processes of this machine; default: one per core")
    add_path(parsers["diagnose"], "--units", "what units have in common: columns unit, batch, supplier, ...", "FILE.csv")
    add_path(parsers["prior"], "--output", "the calibration to write", "FILE.yaml", required=True)
    add_path(parsers["report"], "--output", "the page to write", "FILE.html", required=True)


def run(arguments: argparse.Namespace) -> int:
    workers = getattr(arguments, "workers", None)
    if workers is not None and workers < 1:
        raise InputError(f"--workers {workers}: expected 1 or more")
    return _COMMANDS[arguments.fleet_command][0](arguments)


def _work(arguments: argparse.Namespace, text: str, task: Callable, items: list, failed: Callable) -> list:
    """``task`` of every item on the cluster, with a bar on a terminal."""
    from emb_daemon.fleet.cluster import cluster
    from emb_daemon.fleet.cluster import run as run_on

    if not items:
        return []
    with progress(text) as show, cluster(arguments.scheduler, arguments.workers) as client:
        return run_on(client, task, items, lambda done, total: show(done / total), failed)


def _ingest(arguments: argparse.Namespace) -> int:
    from emb_daemon.fleet import dataset, ingest

    root = dataset.folder_of(arguments.output.absolute())
    paths = ingest.log_files(arguments.logs)
    jobs = ingest.jobs(root, paths, arguments.unit or ingest.UNIT_OF_PATH, arguments.mapping and arguments.mapping.absolute())
    before = dataset.named(root)
    done = _work(arguments, "reading logs", partial(ingest.ingest, root), jobs, partial(ingest.give_up, root))
    # Not before all are read: another file may now have the content, as when logs are rotated.
    dataset.forget(root, before - dataset.named(root))
    damaged = [known for known in done if known["fault"]]
    drives = sum(len(known["drives"]) for known in done)
    print(f"{len(done)} of {len(paths)} logs are new: {drives} drives, {len(damaged)} damaged")
    _print_faults([known["fault"] for known in damaged] + [known["notes"] for known in done if known["notes"]])
    return 0


def _replay(arguments: argparse.Namespace) -> int:
    from emb_daemon.fleet import dataset, replaying

    root, calibration = arguments.data.absolute(), load_chosen(arguments.calibration)
    drives, makers = dataset.drives(root), dataset.made_by(calibration)
    left = [d for d in drives if not (arguments.resume and replaying.is_replayed(root, d, makers))]
    task = partial(replaying.replay_drive, root, calibration=calibration)
    done = _work(arguments, "replaying", task, left, lambda _, reason: reason)
    faults = [text for text in done if isinstance(text, str)]
    seconds = sum(figures["seconds"] for figures in done if not isinstance(figures, str))
    print(f"{len(done) - len(faults)} of {len(drives)} drives replayed, {seconds / 3600.0:.2f} h")
    _print_faults(faults)
    return 0


def _print_faults(texts: list[str]) -> None:
    for text in texts:
        tell(f"  {text}")


def _diagnose(arguments: argparse.Namespace) -> int:
    from emb_daemon.calibration.files import calibration_hash
    from emb_daemon.fleet import dataset, findings, scores

    root, calibration = arguments.data.absolute(), load_chosen(arguments.calibration)
    factors = findings.read_units(arguments.units) if arguments.units else {}
    groups = list(dataset.by_unit(dataset.drives(root)).values())
    task = partial(scores.score_unit, root, calibration=calibration, resume=arguments.resume)
    done = _work(arguments, "scoring drives", task, groups, lambda drives, reason: {d.digest: reason for d in drives})
    silent = {digest: reason for unusable in done for digest, reason in unusable.items()}
    fleet = scores.read_fleet(root, calibration)
    found = findings.find(fleet, scores.Scorer(calibration).causes, calibration_hash(calibration), factors, silent)
    findings.save(found, root)
    _print(found)
    return 0


def _print(found) -> None:
    print(
        f"{len(found.units)} units, {found.drives} drives from {found.first_day} to {found.last_day}; "
        f"{len(found.silent)} of the drives cannot be used"
    )
    for title, group in (
        ("shared", found.groups), ("drift, per 30 days", found.drifts), ("season, per 10 K", found.seasons),
        ("unlike the others", found.outliers), ("ages unlike the others", found.ageing),
    ):  # fmt: skip
        print(f"{title}: {'nothing' if not group else ''}")
        for one in group:
            rivals = f"; or {', '.join(one.rivals)}" if one.rivals else ""
            print(f"  {one.where}: {one.cause} {one.size_N:+.0f} ± {one.sigma_N:.0f} N (chance {one.chance:.1g}){rivals}")


def _report(arguments: argparse.Namespace) -> int:
    from emb_daemon.fleet.page import fleet_page

    check_output(arguments.output, ())
    fleet_page(arguments.data.absolute()).write(arguments.output)
    return 0


def _learn(arguments: argparse.Namespace) -> int:
    from emb_daemon.fleet import dataset, learning

    root, calibration = arguments.data.absolute(), load_chosen(arguments.calibration)
    groups = list(dataset.by_unit(dataset.drives(root)).values())
    task = partial(learning.learn_unit, root, calibration=calibration, resume=arguments.resume)
    done = _work(arguments, "learning", task, groups, lambda _, reason: reason)
    learned = [result for result in done if not isinstance(result, str)]
    print(f"{len(learned)} units, {sum(result['trainings'] for result in learned)} trainings accepted")
    _print_faults([text for text in done if isinstance(text, str)])
    return 0


def _prior(arguments: argparse.Namespace) -> int:
    from emb_daemon.calibration.files import save_calibration
    from emb_daemon.fleet.learning import prior

    check_output(arguments.output, (arguments.calibration,), (".yaml",))
    calibration, population = prior(arguments.data.absolute(), load_chosen(arguments.calibration))
    save_calibration(calibration, arguments.output)
    for key, found in population.items():
        print(f"{key}: {found.mean:.6g} ± {found.sigma:.2g}, spread {found.spread:.2g} over {found.units} units")
    return 0


#: Function and description of each command.
_COMMANDS = {
    "ingest": (_ingest, "read log files into a data set by unit, corner and day; each once, damaged ones are listed"),
    "replay": (_replay, "compute estimates, figures and integrity of every drive, equal to those of emb-daemon replay"),
    "learn": (_learn, "run park brake adaptation over each unit's drives, one after the other"),
    "diagnose": (_diagnose, "find what distinguishes units and batches, and what drifts, by the disagreement of the paths"),
    "prior": (_prior, "write a calibration with the population's values, their spread, and bounds for adaptation"),
    "report": (_report, "write the findings as one page: map of units, worst ten, batches, trend, next action"),
}
