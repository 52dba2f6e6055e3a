"""Kernels compiled ahead, as the daemon finds, checks and calls them: without numba, and without a compiler.

A library is an ELF shared object followed by one line of JSON, the `Manifest`. It is used if it is complete, was made for this
processor from the sources that are installed (those that mention `emb_daemon.jit` or define records), and if no other user
could have written it.
"""

import ctypes
import grp
import hashlib
import importlib.util
import operator
import os
import platform
import pwd
import stat
import struct
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from emb_daemon.ahead.signature import Array, Kind, is_group
from emb_daemon.bounded import read_bounded
from emb_daemon.errors import InputError

#: A source that mentions one of these takes part in compiled code.
_MARKS = (b"emb_daemon.jit", b"emb_daemon.ahead.signature", b"np.dtype(")
_FORMAT = 1
#: A hundred times the size of such a library.
_MOST_BYTES = 20_000_000
#: Environment variable: the library to use; empty: none.
VARIABLE = "EMB_DAEMON_KERNELS"


class Target(NamedTuple):
    """``machine`` as uname says it; the ``cpu`` that LLVM compiles for, and the ``flags`` of /proc/cpuinfo that it takes."""

    machine: str
    triple: str
    cpu: str
    flags: tuple[str, ...]


#: The oldest processors of each kind that a brake's computer has: x86-64-v2 is of 2009.
TARGETS = {
    target.machine: target
    for target in (
        Target("x86_64", "x86_64-unknown-linux-gnu", "x86-64-v2",
               ("cx16", "lahf_lm", "popcnt", "pni", "sse4_1", "sse4_2", "ssse3")),
        Target("aarch64", "aarch64-unknown-linux-gnu", "cortex-a53", ("fp", "asimd", "crc32")),
    )
}  # fmt: skip


class Manifest(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Description of a library, stored in it."""

    format: int = _FORMAT
    #: Digest of the ELF object before this line, followed by the layouts.
    sha256: str
    #: `source_digest` of the package that it was made from.
    sources: str
    #: Machine by uname; the CPU that it was compiled for, and the flags of /proc/cpuinfo that this takes.
    machine: str
    cpu: str
    flags: tuple[str, ...]
    #: Versions of emb_daemon, numba and llvmlite that made it.
    made_by: str
    #: LAYOUT with all corners (`wire.layout`) of DBCs, by their SHA-256.
    layouts: dict[str, bytes]


class Refused(Exception):
    """A library that must not be used, and why."""


def source_digest(package: Path) -> str:
    """Digest of all sources in ``package`` that compiled code can depend on."""
    digest = hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        content = path.read_bytes()
        if any(mark in content for mark in _MARKS):
            digest.update(content)
    return digest.hexdigest()[:16]


def mark(sources: str) -> str:
    """Name of a symbol that a library of these ``sources`` has, for programs in C that must not be linked with another."""
    return f"emb_made_from_{sources}"


def installed_digest() -> str:
    """`source_digest` of this very package."""
    return source_digest(Path(__file__).parent.parent)


def who_else_writes(path: Path) -> str:
    """Which other user could have written a file or folder whose content is executed, or its parent; in words, empty if none.
    Files of root are accepted like one's own, and root accepts files of all users."""
    for place in (path, path.parent):
        status = place.stat()
        if not status.st_mode & stat.S_ISVTX:
            if status.st_mode & stat.S_IWOTH:
                return f"{place} is writable by anybody"
            if status.st_mode & stat.S_IWGRP and not _is_own_group(status.st_gid):
                return f"{place} is writable by a group with other users (id {status.st_gid})"
        if place == path and os.geteuid() != 0 and status.st_uid not in (0, os.geteuid()):
            return f"{place} belongs to another user"
    return ""


def _is_own_group(number: int) -> bool:
    """Whether a group is root's, or the group of the user's own name that many systems create, without other members."""
    try:
        user, group = pwd.getpwuid(os.geteuid()), grp.getgrgid(number)
    except KeyError:
        return number == 0
    return number == 0 or (group.gr_name == user.pw_name and not set(group.gr_mem) - {user.pw_name})


def default_path() -> Path:
    """Where ``emb-daemon compile`` puts the library and ``emb-daemon run`` looks for it."""
    return Path(sys.prefix, "lib", "emb_daemon", "kernels.so")


def find() -> Path | None:
    """The library to look at: what `VARIABLE` names, else that at `default_path`; None if there is none, or none is to be
    used."""
    named = os.environ.get(VARIABLE)
    if named == "" or os.environ.get("NUMBA_DISABLE_JIT", "0") != "0":
        return None
    path = Path(named) if named else default_path()
    return path if named or path.exists() else None


def seal(elf: bytes, layouts: dict[str, bytes], **manifest: str | tuple[str, ...]) -> bytes:
    """Bytes of a library's file: the ELF object, and the `Manifest` of these ``layouts`` and further fields."""
    return elf + b"\n" + msgspec.json.encode(Manifest(sha256=_sha256(elf, layouts), layouts=layouts, **manifest))


def _sha256(elf: bytes, layouts: dict[str, bytes]) -> str:
    return hashlib.sha256(b"".join([elf, *layouts.values()])).hexdigest()


def read_manifest(path: Path) -> Manifest:
    """Raises Refused for a file that is no such library or incomplete; OSError."""
    elf, _, line = read_bounded(path, _MOST_BYTES).rpartition(b"\n")
    try:
        manifest = msgspec.json.decode(line, type=Manifest)
    except msgspec.DecodeError:
        raise Refused("it is incomplete, or was not made by emb-daemon compile") from None
    if manifest.format != _FORMAT or _sha256(elf, manifest.layouts) != manifest.sha256:
        raise Refused("its content is damaged")
    return manifest


def _cpu_flags() -> set[str]:
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        name, _, value = line.partition(":")
        if name.strip().lower() in ("flags", "features"):
            return set(value.split())
    return set()


def check(path: Path) -> Manifest:
    """Raises Refused, with the reason, for a library that must not be used here; OSError."""
    if why := who_else_writes(path):
        raise Refused(why)
    manifest = read_manifest(path)
    if manifest.sources != (installed := installed_digest()):
        raise Refused(f"it was made from other sources ({manifest.sources}) than are installed ({installed})")
    if manifest.machine != platform.machine():
        raise Refused(f"it is for {manifest.machine}, this is {platform.machine()}")
    if lacking := set(manifest.flags) - _cpu_flags():
        raise Refused(f"it is for {manifest.cpu}, this processor has no {', '.join(sorted(lacking))}")
    return manifest


_loaded: ctypes.CDLL | None = None
_manifest: Manifest | None = None
_says = "kernels are compiled by numba"


def load() -> str:
    """Use the kernels of the library that is found by `find` in this process.

    Before anything that has kernels is imported. Returns why a library that is there is not used, numba being used instead;
    empty if one is used, or there is none. Raises InputError: numba is not installed either."""
    global _loaded, _manifest, _says
    path, why = find(), ""
    if path:
        try:
            if "emb_daemon.jit" in sys.modules:
                raise Refused("this process has already loaded other kernels")
            manifest = check(path)
            # Symbols of libm that a linker left undefined are resolved from the libraries already loaded.
            ctypes.CDLL("libm.so.6", mode=ctypes.RTLD_GLOBAL)
            _loaded, _manifest = ctypes.CDLL(str(path), mode=os.RTLD_NOW), manifest
            _says = f"kernels of {path}, compiled ahead for {manifest.cpu} by {manifest.made_by}"
        except (Refused, OSError) as refusal:
            why = f"kernels of {path} are not used: {getattr(refusal, 'strerror', None) or refusal}"
    if _loaded is None and importlib.util.find_spec("numba") is None:
        missing = f"{default_path()}: no such file; emb-daemon compile makes it"
        raise InputError(f"{why or missing}; and numba is not installed")
    return why


def description() -> str:
    """Which code runs, in words."""
    return _says


def in_use() -> bool:
    """Whether this process runs the kernels of a library."""
    return _loaded is not None


def layout_of(dbc: Path) -> bytes:
    """The LAYOUT that the library in use holds for a DBC; empty if it holds none."""
    return _manifest.layouts.get(hashlib.sha256(dbc.read_bytes()).hexdigest(), b"") if _manifest else b""


class _Words(threading.local):
    """Arguments of the last call, and the same as words for C; separate for each thread, because a function runs without the
    interpreter's lock."""

    def __init__(self, arguments: int, words: int):
        self.known = [object()] * arguments
        self.words = (ctypes.c_int64 * words)()
        self.address = ctypes.c_void_p(ctypes.addressof(self.words))


def bind(name: str, takes: tuple[Kind, ...], returns: int) -> Callable[..., int | tuple[int, ...]]:
    """The library's function ``name``, called like the Python function that it was made from.

    An argument that is the same object as in the last call is not converted again, because its address has not changed."""
    function = getattr(_loaded, name)
    places, end = [], returns
    for kind in takes:
        places.append((end, _writer(kind)))
        end += _size(kind)
    mine = _Words(len(takes), end)

    def call(*arguments):
        known, words = mine.known, mine.words
        for index, argument in enumerate(arguments):
            if known[index] is not argument:
                place, write = places[index]
                write(words, place, argument)
                known[index] = argument
        if function(mine.address):
            raise ArithmeticError(f"{name} failed")
        return words[0] if returns == 1 else tuple(words[:returns])

    return call


def _size(kind) -> int:
    """Words of an element of a signature."""
    if is_group(kind):
        return sum(map(_size, kind))
    return 1 + kind.dimensions if isinstance(kind, Array) else 1


def _address(array: np.ndarray) -> int:
    """Address of an array's first element: ``array.ctypes.data``, in a fifth of its time. It is the first field after the head
    that every object of CPython has."""
    return ctypes.c_void_p.from_address(id(array) + object.__basicsize__).value or 0


def _writer(kind) -> Callable[[ctypes.Array, int, Any], None]:
    """The function that writes an argument as words, from a place on. Raises TypeError for another kind of argument."""
    if is_group(kind):
        writers = [(sum(map(_size, kind[:index])), _writer(part)) for index, part in enumerate(kind)]

        def write_group(words, place, group):
            for (offset, write), part in zip(writers, group, strict=True):
                write(words, place + offset, part)

        return write_group
    if kind is float:

        def write_float(words, place, value):
            [words[place]] = struct.unpack("q", struct.pack("d", value))

        return write_float
    if kind in (int, bool):

        def write_integer(words, place, value):
            words[place] = operator.index(value)

        return write_integer
    if isinstance(kind, Array):
        dtype, dimensions = np.dtype(kind.dtype), kind.dimensions

        def write_array(words, place, array):
            if array.dtype != dtype or array.ndim != dimensions or not array.flags.c_contiguous:
                raise TypeError(f"expected a contiguous array of {dimensions} dimensions of {dtype.names or dtype}")
            words[place] = _address(array)
            words[place + 1 : place + 1 + dimensions] = array.shape

        return write_array

    def write_record(words, place, record):
        # A record that is not a view of an array has no lasting address.
        if not isinstance(record, np.void) or record.dtype != kind or record.flags.owndata:
            raise TypeError(f"expected a record within an array, of {kind.names}")
        words[place] = _address(np.asarray(record))

    return write_record
