"""Writes requirements-box.lock: the part of requirements.lock that runs in the car, for `pip install --require-hashes`;
requirements-ahead.lock: the same without the compiler, for a daemon whose kernels are compiled ahead; and
requirements-image.lock: what replay, identification and fleets need.

    python tools/lock_box.py [--check]

Run it where all of requirements.lock is installed (`make lock` does): what a package depends on is read from its metadata,
whatever Python or system it is for.
"""

import contextlib
import re
import sys
import tomllib
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
#: Files, what each holds the dependencies of (extras; ``""`` is the daemon itself), and what of them it leaves out.
LOCKS = {
    "requirements-box.lock": (("", "workshop"), ()),
    "requirements-ahead.lock": (("", "workshop"), ("numba", "llvmlite")),
    "requirements-image.lock": (("", "offline", "mf4", "formats", "fleet"), ()),
}
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")


def _name(requirement: str) -> str:
    return re.sub(r"[-_.]+", "-", _NAME.match(requirement)[0]).lower()


def box_lock(extras: tuple[str, ...], without: tuple[str, ...]) -> str:
    """The content of a lock file of ``extras``, ``without`` some packages, and what only they need."""
    blocks = re.split(r"(?m)^(?=\S)", (ROOT / "requirements.lock").read_text())
    pinned: dict[str, str] = {}
    for block in blocks:
        # A package may stand there once for each range of Pythons.
        if _NAME.match(block):
            pinned[_name(block)] = pinned.get(_name(block), "") + block
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    dependencies = project["optional-dependencies"] | {"": project["dependencies"]}
    waiting = [_name(line) for extra in extras for line in dependencies[extra]]
    needed: set[str] = set()
    while waiting:
        name = waiting.pop()
        if name not in needed and name in pinned and name not in without:
            needed.add(name)
            with contextlib.suppress(PackageNotFoundError):
                waiting += [_name(line) for line in requires(name) or () if "extra ==" not in line]
    return "".join(pinned[name] for name in sorted(needed))


if __name__ == "__main__":
    for file, (extras, without) in LOCKS.items():
        path = ROOT / file
        if sys.argv[1:] != ["--check"]:
            path.write_text(box_lock(extras, without))
        elif path.read_text() != box_lock(extras, without):
            sys.exit(f"{path}: out of date, run python tools/lock_box.py")
