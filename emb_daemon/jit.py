"""The one numba entry point of the package.

numba's disk cache is keyed on the file of the compiled function alone, so a change in a kernel that it calls, or in a
record layout, would go unnoticed. The cache folder is therefore named after all sources that compiled code can depend on.
"""

import hashlib
import os
from pathlib import Path

#: A source that mentions one of these takes part in compiled code.
_MARKS = (b"emb_daemon.jit", b"np.dtype(")


def _source_digest() -> str:
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.rglob("*.py")):
        content = path.read_bytes()
        if any(mark in content for mark in _MARKS):
            digest.update(content)
    return digest.hexdigest()[:16]


def _cache_root() -> Path:
    if chosen := os.environ.get("NUMBA_CACHE_DIR"):
        return Path(chosen)
    base = os.environ.get("CACHE_DIRECTORY") or os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(str(base).split(":")[0]) / "emb_daemon"


import numba  # noqa: E402
from numba.core import config  # noqa: E402

config.CACHE_DIR = str(_cache_root() / _source_digest())

#: Compile with numba, cached on disk. fastmath stays off: without fused multiply-add a replay is equal on every machine.
njit = numba.njit(cache=True, nogil=True)
