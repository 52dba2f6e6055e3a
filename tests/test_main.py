"""The command line's promises for every command: one clear line and an exit status, never a traceback."""

import errno
import importlib.util

import processkit
import pytest

from emb_daemon.cli import check
from emb_daemon.cli.main import main
from emb_daemon.errors import InputError, Unavailable
from emb_daemon.logs.candump import format_candump
from emb_daemon.logs.read import read_frames
from emb_daemon.plant.derive import plant_from_calibration
from emb_daemon.plant.scenarios import rest, simulate_log
from emb_daemon.resources import resource


@pytest.mark.parametrize(
    ("error", "status", "line"),
    [
        (InputError("a.yaml:3: motor: missing"), 2, "a.yaml:3: motor: missing"),
        (Unavailable("bus: vcan0: no such device"), 1, "bus: vcan0: no such device"),
        (IsADirectoryError(errno.EISDIR, "Is a directory", "report.html"), 2, "report.html: Is a directory"),
        (OSError(errno.ENOSPC, "No space left on device"), 1, "emb-daemon check: No space left on device"),
        (ModuleNotFoundError("x", name="scipy.optimize"), 2,
         "emb-daemon check needs scipy.optimize: pip install 'emb_daemon[offline]'"),
        (MemoryError(), 2, "emb-daemon check: not enough memory on this machine"),
        (KeyboardInterrupt(), 130, None),
    ],
)  # fmt: skip
def test_an_error_is_one_line_and_a_status(monkeypatch, capsys, error, status, line):
    def fail(arguments):
        raise error

    monkeypatch.setattr(check, "run", fail)
    assert main(["check", "--config", "emb.yaml"]) == status
    assert capsys.readouterr().err.splitlines() == ([line] if line else [])


def test_a_missing_module_of_the_package_is_a_defect(monkeypatch):
    def fail(arguments):
        raise ModuleNotFoundError("x", name="emb_daemon.nothing")

    monkeypatch.setattr(check, "run", fail)
    with pytest.raises(ModuleNotFoundError):
        main(["check", "--config", "emb.yaml"])


@pytest.mark.parametrize(
    ("arguments", "library"),
    [
        (["identify", "campaign.yaml", "--output", "calibration.yaml"], "scipy"),
        (["diagnose", "a.log", "--calibration", "c.yaml", "--output", "d"], "plotly"),
        (["demo"], "matplotlib"),
    ],
)
def test_a_command_names_missing_libraries_before_it_works(monkeypatch, capsys, arguments, library):
    found = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *rest: None if name == library else found(name, *rest))
    assert main(arguments) == 2
    assert capsys.readouterr().err == f"emb-daemon {arguments[0]} needs {library}: pip install 'emb_daemon[offline]'\n"


def test_a_closed_pipe_is_no_error(monkeypatch):
    def fail(arguments):
        raise BrokenPipeError(errno.EPIPE, "Broken pipe")

    monkeypatch.setattr(check, "run", fail)
    monkeypatch.setattr("emb_daemon.cli.main.os.dup2", lambda *_: None)
    assert main(["check", "--config", "emb.yaml"]) == 0


def test_a_terminal_without_our_characters_ends_no_command():
    code = "from emb_daemon.cli import check, main; check.run = lambda _: print('3 ± 1 kN') or 0; "
    code += "raise SystemExit(main.main(['check', '--config', 'x']))"
    done = processkit.python("-c", code, PYTHONIOENCODING="ascii:strict")
    assert (done.returncode, done.stdout, done.stderr) == (0, "3 ? 1 kN\n", "")


@pytest.mark.parametrize("seconds", ["0", "-1", "nan"])
def test_a_bench_without_time_is_wrong_usage(capsys, seconds):
    assert main(["bench", "--seconds", seconds]) == 2
    assert "expected at least 2" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ("simulate --seconds -1", "--seconds -1: expected more than 0; leave it out to run until Ctrl-C"),
        ("simulate --seconds inf", "--seconds inf: expected more than 0; leave it out to run until Ctrl-C"),
        ("simulate --seed -3", "--seed -3: expected 0 or more"),
        ("monitor --web 99999", "--web 99999: expected a port, 0 to 65535; 0 is any that is free"),
        ("uds --config {config} --state {tmp}/none", "{tmp}/none: no such state directory; give it with --state"),
        ("replay {tmp}/a.log --pad-thickness -1", "pad_thickness_mm: -1.0 outside"),
        ("replay {tmp}/a.log --pad-thickness 77",
         "pad_thickness_mm: 77.0 is too far from the measured thicknesses; expected 0 to 12.5"),
        ("fleet ingest {tmp}/a.log --output {tmp}/fleet --workers -1", "--workers -1: expected 1 or more"),
        ("fleet ingest {tmp}/a.log --output {tmp}/a.log",
         "{tmp}/a.log: cannot be a folder of the data set: File exists"),
    ],
)  # fmt: skip
def test_an_impossible_number_or_folder_is_refused_in_one_line(tmp_path, capsys, arguments, line):
    (tmp_path / "a.log").touch()
    names = {"tmp": tmp_path, "config": resource("config/emb.yaml")}
    assert main(arguments.format(**names).split()) == 2
    assert capsys.readouterr().err.startswith(line.format(**names))


def test_a_command_imports_no_reader_that_another_process_has_but_writes_its_format(tmp_path, calibration):
    pytest.importorskip("asammdf", reason="NOT RUN: the mf4 extra is not installed")
    frames, _ = simulate_log(plant_from_calibration(calibration), rest(0.4), reference=False)
    (tmp_path / "a.log").write_text(format_candump(frames))
    code = (
        "import sys; from emb_daemon.cli.main import main;"
        "assert main() == 0; assert 'can' in sys.modules and 'asammdf' not in sys.modules;"
        "sys.argv[-1] = sys.argv[-1].replace('.log', '.mf4'); assert main() == 0"
    )
    done = processkit.python("-c", code, "replay", tmp_path / "a.log", "--output", tmp_path / "sent.log")
    assert done.returncode == 0, done.stderr
    assert len(read_frames(tmp_path / "sent.mf4")) == len(read_frames(tmp_path / "sent.log")) > 0
