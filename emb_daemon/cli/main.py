"""emb-daemon: dispatch to one module per command, imported only when called."""

import argparse
import importlib.util
import io
import os
import sys
import types

from emb_daemon import __version__
from emb_daemon.errors import InputError, Unavailable

#: Commands and their descriptions. The module of the same name in this package has EXAMPLE, add_arguments and run.
COMMANDS = {
    "demo": "run a simulated car and the real daemon in one process: live view, summary, picture",
    "run": "run the daemon: estimate from a CAN bus, broadcast 250 times a second",
    "check": "check configuration, calibrations and DBC; list every fault",
    "replay": "run the daemon's estimator over logs, as fast as possible",
    "convert": "write another rig's log in the daemon's own format, by a mapping file",
    "identify": "identify a calibration from a rig campaign, and report the evidence",
    "diagnose": "find the effects that the model lacks, add them, and show the error before and after",
    "fleet": "analyse many units and drives: ingest, replay, learn, diagnose, prior, report",
    "effect": "write a term that diagnose found as an effect file",
    "simulate": "run a simulated car on a bus",
    "monitor": "show a running daemon's broadcasts live",
    "files": "list or print the files that ship with the package: DBC, configuration, calibration, systemd units",
    "compile": "compile the kernels into one library, for a box without a compiler",
    "export": "export the estimator for C programs and simulators: a header, or an FMU",
    "uds": "serve trouble codes and data to a workshop tester, over UDS",
    "xcp": "serve the estimator's signals and parameters to a measurement tool, over XCP",
    "a2l": "write the A2L file that describes these signals and parameters for the tool",
    "bench": "measure whether this machine meets the timing budgets",
    "adaptation": "show or reset what park brake adaptation has learned, or list all trainings",
}

#: Extras by the library that only they bring.
_EXTRAS = dict.fromkeys(("matplotlib", "plotly", "pyarrow", "scipy"), "offline") | {
    "dask": "fleet",
    "distributed": "fleet",
    "isotp": "workshop",
    "mcap": "live",
}
#: Commands that begin with long work and need one of these libraries at the end.
_NEED = {"demo": ("matplotlib",), "identify": ("scipy", "plotly"), "diagnose": ("scipy", "plotly"), "fleet": ("distributed",)}
#: Commands that work on a box without a compiler; all others need numba.
_WITHOUT_NUMBA = ("run", "check", "files", "monitor", "uds", "xcp", "a2l", "adaptation")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="emb-daemon", description="Virtual clamp force sensor for electro-mechanical brakes."
    )
    parser.add_argument("--version", action="version", version=f"emb-daemon {__version__}")
    subparsers = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for name, summary in COMMANDS.items():
        subparsers.add_parser(name, help=summary, add_help=False)
    return parser


def main(argv: list[str] | None = None) -> int:
    """Run a command; returns its exit status: 0 on success, 2 for wrong usage or unusable input, 1 if something that it needs
    is missing now."""
    own_process, argv = argv is None, sys.argv[1:] if argv is None else argv
    for stream in (sys.stdout, sys.stderr):
        # Characters that the terminal's encoding lacks are replaced; they must not end the program.
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    command = _parser().parse_known_args(argv[:1])[0].command
    if own_process and command not in _WITHOUT_NUMBA:
        # Not in a process of a caller, who may need python-can with asammdf.
        importlib.import_module("emb_daemon.wire.light_can")
    module = importlib.import_module(f"emb_daemon.cli.{command}")
    parser = argparse.ArgumentParser(
        prog=f"emb-daemon {command}",
        description=COMMANDS[command][0].upper() + COMMANDS[command][1:] + ".",
        epilog=f"example:\n  {module.EXAMPLE}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    module.add_arguments(parser)
    return _status(command, module, parser.parse_args(argv[1:]))


def _status(command: str, module: types.ModuleType, arguments: argparse.Namespace) -> int:
    """Exit status of a command; prints the error that ended it."""
    try:
        for library in (*_NEED.get(command, ()), *(() if command in _WITHOUT_NUMBA else ("numba",))):
            if importlib.util.find_spec(library) is None:
                raise ModuleNotFoundError(name=library)
        return module.run(arguments)
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    except ModuleNotFoundError as error:
        missing = (error.name or "").partition(".")[0]
        if missing not in (*_EXTRAS, "numba"):
            raise
        package = f"'emb_daemon[{_EXTRAS[missing]}]'" if missing in _EXTRAS else missing
        print(f"emb-daemon {command} needs {error.name}: pip install {package}", file=sys.stderr)
        return 2
    except Unavailable as error:
        print(error, file=sys.stderr)
        return 1
    except BrokenPipeError:
        # The reader of our output has gone; leave nothing for the interpreter to flush into the closed pipe.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:
        # An error with a file name is the user's; another one may be gone later.
        print(f"{error.filename or f'emb-daemon {command}'}: {error.strerror or error}", file=sys.stderr)
        return 2 if error.filename else 1
    except MemoryError:
        print(f"emb-daemon {command}: not enough memory on this machine", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130


if __name__ == "__main__":
    sys.exit(main())
