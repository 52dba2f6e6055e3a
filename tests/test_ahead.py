"""Kernels compiled ahead: the same bytes as from numba, without it; and nothing else is ever taken for them."""

import argparse
import base64
import ctypes
import grp
import hashlib
import os
import platform
import pwd
import re
import subprocess
from pathlib import Path
from typing import NamedTuple

import adaptkit
import aheadkit
import numpy as np
import processkit
import pytest

from emb_daemon.ahead import library
from emb_daemon.ahead.library import Manifest, Refused, check, installed_digest, read_manifest, seal, who_else_writes
from emb_daemon.ahead.signature import Array
from emb_daemon.errors import Unavailable
from emb_daemon.estimator.records import SAMPLE
from emb_daemon.jit import ENTRIES
from emb_daemon.logs.read import read_frames
from emb_daemon.logs.write import write_frames
from emb_daemon.plant.scenarios import city_drive
from emb_daemon.resources import resource
from emb_daemon.runtime import bus, daemon
from emb_daemon.wire.cmac import KEY, new_key
from emb_daemon.wire.layout import CORNERS, LAYOUT, default_layout, load_layout

_LIBM = {"exp", "log", "pow", "sin", "sincos"}
_LIBC = {"memcpy", "memmove", "memset"}


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    """A drive, training while parked, and driving on: 130 s of one simulated corner."""
    heard = []

    def hear(frames):
        heard.append(frames.copy())
        return frames

    loop = adaptkit.ClosedLoop(tmp_path_factory.mktemp("learned"))
    for schedule in (city_drive(), adaptkit.parked(50.0), city_drive(), city_drive().first(20.0)):
        loop.run(schedule, spoil=hear)
    return np.concatenate(heard)


@pytest.mark.trial
def test_every_byte_is_as_from_numba(compiled, frames, tmp_path):
    log = tmp_path / "drive.log"
    write_frames(log, frames)
    arguments = [aheadkit.__file__, log, tmp_path / "ahead", tmp_path / "ahead.npz"]
    done = processkit.python(*arguments, EMB_DAEMON_KERNELS=str(compiled / "kernels.so"))
    assert done.returncode == 0, done.stderr
    print(done.stdout)
    expected, found = aheadkit.answered(read_frames(log), tmp_path / "numba"), np.load(tmp_path / "ahead.npz")
    assert expected["samples"] > 20_000 and "adaptation-FL.json" in expected, "the drive does not show much"
    assert list(expected) == list(found)
    for name in expected:
        assert np.array_equal(expected[name], found[name]), name


def _symbols(path: Path) -> tuple[set[str], set[str]]:
    """Names that an ELF file defines for others, and those that it needs."""
    listed = subprocess.run(["readelf", "--wide", "--symbols", path], capture_output=True, text=True, check=True).stdout
    rows = [line.split() for line in listed.splitlines()]
    seen = [(row[6], row[7].partition("@")[0]) for row in rows if len(row) > 7 and row[4] == "GLOBAL"]
    return {name for index, name in seen if index != "UND"}, {name for index, name in seen if index == "UND"}


_ONE = """
import sys
from hashlib import sha256
from pathlib import Path
import emb_daemon.wire.cmac
from emb_daemon.ahead.build import build
from emb_daemon.ahead.library import TARGETS, installed_digest
from emb_daemon.jit import ENTRIES
from emb_daemon.resources import resource
from emb_daemon.wire.layout import default_layout
layouts = {sha256(resource("dbc/emb.dbc").read_bytes()).hexdigest(): default_layout().tobytes()}
build(list(ENTRIES.values()), installed_digest(), TARGETS[sys.argv[1]], Path(sys.argv[2]), layouts)
print(*ENTRIES)
"""
_EXPAND = """
import sys
sys.modules |= dict.fromkeys(["numba", "cantools", "can"])
from emb_daemon.ahead import library
assert not library.load() and library.in_use()
import numpy as np
from emb_daemon.wire.layout import default_layout
from emb_daemon.wire.cmac import KEY, new_key
keys = np.zeros(1, KEY)
new_key(bytes(range(16)), keys[0])
print(keys.tobytes().hex(), default_layout().tobytes().hex())
"""


def test_one_kernel_alone_gives_the_bytes_of_numba_and_needs_nothing(tmp_path):
    """In seconds what the trials below show of all, which take minutes to compile."""
    path, keys = tmp_path / "kernels.so", np.zeros(1, KEY)
    done = processkit.python("-c", _ONE, platform.machine(), path, NUMBA_OPT="0", NUMBA_CACHE_DIR=str(tmp_path / "cache"))
    assert done.returncode == 0, done.stderr
    assert _symbols(path) == ({library.mark(installed_digest()), *done.stdout.split()}, set())
    done = processkit.python("-c", _EXPAND, EMB_DAEMON_KERNELS=str(path))
    new_key(bytes(range(16)), keys[0])
    assert done.stdout == f"{keys.tobytes().hex()} {default_layout().tobytes().hex()}\n", done.stderr


_DBC = resource("dbc/emb.dbc")
_DBC_SHA256 = hashlib.sha256(_DBC.read_bytes()).hexdigest()


def _holding(path: Path, monkeypatch, layouts: dict[str, bytes]) -> None:
    """As if a library were in use that holds these."""
    monkeypatch.setattr(library, "_manifest", read_manifest(_sealed(path, layouts=layouts)))


@pytest.mark.parametrize("corners", [CORNERS, ("FL",), ("RR", "FR"), CORNERS[1:]])
def test_the_layout_in_a_library_is_that_of_its_dbc(tmp_path, monkeypatch, corners):
    whole, expected = load_layout(), load_layout(corners=corners)
    _holding(tmp_path / "kernels.so", monkeypatch, {_DBC_SHA256: whole.tobytes()})
    monkeypatch.setattr("emb_daemon.wire.layout.load_database", None)
    assert load_layout(corners=corners).tobytes() == expected.tobytes()


def test_a_layout_of_another_dbc_is_not_used(tmp_path, monkeypatch):
    expected, other = load_layout().tobytes(), bytes(LAYOUT.itemsize)
    _holding(tmp_path / "kernels.so", monkeypatch, {"of another": other})
    assert load_layout().tobytes() == expected
    _holding(tmp_path / "kernels.so", monkeypatch, {_DBC_SHA256: other})
    assert load_layout().tobytes() == other and load_layout(_DBC).tobytes() == expected, "a DBC of one's own is read"


def test_nothing_is_needed_beyond_libc_and_libm(compiled):
    assert bus and daemon, "imported for their entry points"
    for name in ("kernels.so", "aarch64.o"):
        defined, needed = _symbols(compiled / name)
        assert defined == {library.mark(installed_digest()), *ENTRIES}, name
        assert needed <= _LIBM | _LIBC, name


def test_the_daemon_logs_which_code_it_runs(compiled, tmp_path):
    """Up to the point at which it finds no such interface."""
    config, path = aheadkit.ROOT / "config" / "emb.yaml", compiled / "kernels.so"
    arguments = ["run", "--config", config, "-i", "socketcan", "-c", "none0"]
    done = processkit.command(*arguments, EMB_DAEMON_KERNELS=str(path))
    assert done.returncode == 1 and f"kernels of {path}, compiled ahead" in done.stderr + done.stdout


# --- What is refused ----------------------------------------------------------------------------------------------------


def _sealed(path: Path, **changes) -> Path:
    """A library that fits this machine but for ``changes``; no code is in it."""
    manifest = {"sources": installed_digest(), "machine": platform.machine(), "cpu": "a CPU", "flags": (), "made_by": "a test"}
    path.write_bytes(seal(b"\x7fELF and more", **({"layouts": {"a DBC": b"its layout"}} | manifest | changes)))
    path.chmod(0o644)
    return path


def test_a_matching_library_is_accepted(tmp_path):
    assert check(_sealed(tmp_path / "kernels.so")).made_by == "a test"


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"sources": "0123456789abcdef"}, "made from other sources"),
        ({"machine": "riscv64"}, "it is for riscv64, this is"),
        ({"flags": ("avx4096",)}, "this processor has no avx4096"),
    ],
)
def test_a_library_that_does_not_match_is_refused(tmp_path, changes, why):
    with pytest.raises(Refused, match=why):
        check(_sealed(tmp_path / "kernels.so", **changes))


@pytest.mark.parametrize(
    "damage",
    [
        lambda whole: whole[: len(whole) // 2],
        lambda whole: whole[:-1],
        lambda whole: whole[8:],
        lambda whole: b"\x7fELF And more" + whole[13:],
        lambda whole: b"",
        lambda whole: whole.replace(b'"format":1', b'"format":2'),
        lambda whole: whole.replace(base64.b64encode(b"its layout"), base64.b64encode(b"Its layout")),
    ],
)
def test_a_damaged_library_is_refused(tmp_path, damage):
    path = _sealed(tmp_path / "kernels.so")
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(Refused, match=r"incomplete|damaged"):
        check(path)


def test_a_library_writable_by_anybody_is_refused(tmp_path):
    path = _sealed(tmp_path / "kernels.so")
    path.chmod(0o666)
    with pytest.raises(Refused, match="is writable by anybody"):
        check(path)
    path.chmod(0o644)
    tmp_path.chmod(0o777)
    with pytest.raises(Refused, match="is writable by anybody"):
        check(path)


@pytest.mark.parametrize("folder", [True, False])
@pytest.mark.parametrize(
    ("name", "members", "refused"),
    [("USER", [], False), ("USER", ["USER"], False), ("USER", ["other"], True), ("users", [], True)],
)
def test_a_library_writable_by_a_shared_group_is_refused(tmp_path, monkeypatch, folder, name, members, refused):
    """A group with the user's own name has, on many systems, nobody else in it."""
    path, user = _sealed(tmp_path / "kernels.so"), pwd.getpwuid(os.geteuid()).pw_name
    place = tmp_path if folder else path
    if os.geteuid() == 0:
        os.chown(place, -1, 4242)
    place.chmod(0o775)
    group = grp.struct_group((name.replace("USER", user), "x", 4242, [member.replace("USER", user) for member in members]))
    monkeypatch.setattr(library.grp, "getgrgid", lambda _: group)
    said = who_else_writes(path)
    assert said.startswith(f"{place} is writable by a group with other users") if refused else said == ""


def test_a_library_of_another_user_is_refused(tmp_path, monkeypatch):
    path = _sealed(tmp_path / "kernels.so")
    if path.stat().st_uid == 0:
        os.chown(path, 1234, -1)
    monkeypatch.setattr(os, "geteuid", lambda: 4321)
    with pytest.raises(Refused, match="belongs to another user"):
        check(path)


def _load(code: str = "", **variables) -> subprocess.CompletedProcess:
    """`library.load` in a process of its own."""
    code = f"import sys\n{code}\nfrom emb_daemon.ahead import library\nprint(library.load(), library.in_use())"
    return processkit.python("-c", code, **variables)


def test_a_refusal_is_reported_and_numba_is_used(tmp_path):
    path = _sealed(tmp_path / "kernels.so", sources="0123456789abcdef")
    done = _load(EMB_DAEMON_KERNELS=str(path))
    assert re.fullmatch(f"kernels of {path} are not used: it was made from other sources .* False\n", done.stdout), done.stderr
    # Sealed well, and yet no ELF file: the loader's own words.
    done = _load(EMB_DAEMON_KERNELS=str(_sealed(path)))
    assert done.stdout.startswith(f"kernels of {path} are not used: ") and done.stdout.endswith(" False\n"), done.stderr
    done = _load(EMB_DAEMON_KERNELS=str(tmp_path / "none.so"))
    assert done.stdout == f"kernels of {tmp_path / 'none.so'} are not used: No such file or directory False\n"


def test_no_library_is_used_after_numba_or_if_switched_off(tmp_path):
    path = _sealed(tmp_path / "kernels.so")
    done = _load("import emb_daemon.jit", EMB_DAEMON_KERNELS=str(path))
    assert done.stdout == f"kernels of {path} are not used: this process has already loaded other kernels False\n", done.stderr
    assert _load(EMB_DAEMON_KERNELS="").stdout == " False\n"
    assert _load(EMB_DAEMON_KERNELS=str(path), NUMBA_DISABLE_JIT="1").stdout == " False\n"


def test_without_library_and_numba_nothing_starts(tmp_path):
    done = _load("sys.modules['numba'] = None", EMB_DAEMON_KERNELS=str(tmp_path / "none.so"))
    assert "InputError" in done.stderr and f"kernels of {tmp_path / 'none.so'} are not used" in done.stderr
    done = _load("sys.modules['numba'] = None", EMB_DAEMON_KERNELS="")
    assert "numba is not installed" in done.stderr


def _without_numba(*arguments) -> subprocess.CompletedProcess:
    code = f"import sys; sys.modules['numba'] = None; from emb_daemon.cli.main import main; sys.exit(main({list(arguments)}))"
    return processkit.python("-c", code, EMB_DAEMON_KERNELS="")


def test_without_numba_files_are_checked_and_other_commands_name_what_is_missing():
    config = str(aheadkit.ROOT / "config" / "emb.yaml")
    done = _without_numba("check", "--config", config)
    assert done.returncode == 0, done.stderr
    done = _without_numba("replay", "some.log", "--output", "some.csv")
    assert (done.returncode, done.stderr) == (2, "emb-daemon replay needs numba: pip install numba\n")
    done = _without_numba("run", "--config", config, "-i", "virtual", "-c", "none")
    assert done.returncode == 2 and "numba is not installed" in done.stderr and done.stderr.count("\n") == 1


def test_the_commands_of_the_documentation_are_understood():
    from emb_daemon.cli import compile as command

    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    page = (aheadkit.ROOT / "docs" / "integration.md").read_text()
    lines = re.findall(r"(?m)^    emb-daemon compile(.*)$", page)
    assert len(lines) > 2
    for line in lines:
        parser.parse_args(line.split())


def test_without_a_linker_the_message_names_packages(monkeypatch):
    from emb_daemon.ahead.build import linker_for

    assert linker_for(platform.machine())[0] == "cc", "not the compiler that knows where libm is"
    monkeypatch.setenv("PATH", "")
    with pytest.raises(Unavailable, match="no linker for riscv64 is installed: gcc-riscv64-linux-gnu or lld has one"):
        linker_for("riscv64")


def test_an_unknown_machine_is_wrong_usage():
    done = processkit.command("compile", "--target", "riscv64")
    assert (done.returncode, done.stderr) == (2, "--target riscv64: expected x86_64 or aarch64\n")


def test_a_manifest_contains_what_was_sealed(tmp_path):
    manifest = read_manifest(_sealed(tmp_path / "kernels.so", flags=("sse4_2",)))
    assert isinstance(manifest, Manifest) and manifest.flags == ("sse4_2",)


@pytest.mark.parametrize(
    ("kind", "argument"),
    [
        (Array(SAMPLE), np.zeros(2)),
        (Array(SAMPLE), np.zeros((2, 2), SAMPLE)),
        (Array(np.int64), np.zeros(4, np.int64)[::2]),
        (SAMPLE, np.zeros(1)[0]),
        (SAMPLE, np.zeros(1, SAMPLE)),
        (int, 1.5),
    ],
)
def test_an_argument_of_another_kind_never_reaches_the_library(kind, argument):
    with pytest.raises(TypeError):
        _words(kind, argument)


def test_records_and_arrays_are_passed_where_they_are():
    rows = np.zeros(3, SAMPLE)
    assert _words(SAMPLE, rows[2]) == [rows.ctypes.data + 2 * SAMPLE.itemsize]
    assert _words(Array(SAMPLE), rows[1:]) == [rows.ctypes.data + SAMPLE.itemsize, 2]
    grid = np.zeros((2, 5))
    pair = Pair(Array(float, 2), int)
    assert _words(pair, Pair(grid, np.int64(-7))) == [grid.ctypes.data, 2, 5, -7]


class Pair(NamedTuple):
    first: object
    second: object


def _words(kind, argument) -> list[int]:
    words = (ctypes.c_int64 * library._size(kind))()
    library._writer(kind)(words, 0, argument)
    return list(words)
