"""Files that matter are whole at every moment."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import processkit
import pytest

from emb_daemon import atomic
from emb_daemon.atomic import write_atomically, write_in_reserve

_WRITER = """
import sys
from functools import partial
from pathlib import Path
from emb_daemon import atomic
write = {"anew": atomic.write_atomically, "in reserve": partial(atomic.write_in_reserve, size=250_000)}[sys.argv[2]]
path, number = Path(sys.argv[1]), 0
print("ready", flush=True)
while True:
    number += 1
    write(path, str(number % 10).encode() * 200_000)
"""


@pytest.mark.parametrize("way", ["anew", "in reserve"])
def test_a_kill_at_any_moment_leaves_the_old_file_or_the_new(tmp_path, way):
    """Fifty writers, each killed at a random moment of its writing."""
    path = tmp_path / "state.json"
    rng = np.random.default_rng(11)
    seen = set()
    for _ in range(50):
        command = [sys.executable, "-c", _WRITER, path, way]
        writer = subprocess.Popen(command, stdout=subprocess.PIPE, env=processkit.environment())
        writer.stdout.readline()
        try:
            writer.wait(rng.uniform(0.0, 0.02))
        except subprocess.TimeoutExpired:
            writer.kill()
        writer.communicate()
        if path.exists():
            content = path.read_bytes().rstrip(b" ")
            assert len(content) == 200_000 and content == content[:1] * 200_000
            seen.add(content[:1])
    assert len(seen) > 1, "no writer lived long enough to show anything"


def test_failure_leaves_the_old_file_and_no_other(tmp_path, monkeypatch):
    path = tmp_path / "state.json"
    write_atomically(path, b"old")
    monkeypatch.setattr(os, "fsync", lambda handle: (_ for _ in ()).throw(OSError(28, "No space left on device")))
    with pytest.raises(OSError, match="No space") as caught:
        write_atomically(path, b"new")
    assert caught.value.filename == str(path), "the user's file, not a part of it"
    assert path.read_bytes() == b"old" and list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("exchanges", [True, False])
def test_a_file_with_a_reserve_has_its_room_from_the_first(tmp_path, monkeypatch, exchanges):
    """Where the file system cannot let two files change places it is written like any other."""
    if not exchanges:
        monkeypatch.setattr(atomic, "_exchange", lambda *_: False)
    path = tmp_path / "state.json"
    for content in (b"first", b"second, and longer", b"third"):
        write_in_reserve(path, content, 1000)
        assert path.read_bytes() == content.ljust(1000)
        assert [file.stat().st_size for file in tmp_path.iterdir()] == [1000, 1000]
    write_in_reserve(path, bytes(2000), 1000)
    write_in_reserve(path, b"fourth", 1000)
    assert path.read_bytes() == b"fourth".ljust(1000)
    with pytest.raises(OSError) as caught:
        write_in_reserve(tmp_path / "none" / "a", b"x", 1000)
    assert caught.value.filename == str(tmp_path / "none" / "a")


def test_a_file_is_readable_by_all_and_its_folder_must_exist(tmp_path):
    write_atomically(tmp_path / "a", b"x")
    assert (tmp_path / "a").stat().st_mode & 0o777 == 0o644
    with pytest.raises(OSError):
        write_atomically(tmp_path / "none" / "a", b"x")


def test_a_device_a_pipe_or_a_folder_is_not_replaced(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    for path in (tmp_path / "pipe", tmp_path / "folder", Path("/dev/null")):
        before = os.stat(path).st_ino
        with pytest.raises(OSError, match="expected a regular file or none") as caught:
            write_atomically(path, b"x")
        assert caught.value.filename == str(path) and os.stat(path).st_ino == before
