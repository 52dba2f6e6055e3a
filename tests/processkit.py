"""Python in a process of its own, which imports this tree whatever is installed."""

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent


def environment(**variables: str) -> dict[str, str]:
    """This process's environment with ``variables``, and this tree and its tests ahead of what is installed."""
    return os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests")])} | variables


def python(*arguments, **variables: str) -> subprocess.CompletedProcess[str]:
    """What ``python ARGUMENTS`` prints and how it ends, where these environment variables are set besides."""
    return subprocess.run([sys.executable, *arguments], capture_output=True, text=True, env=environment(**variables))


def command(*arguments, **variables: str) -> subprocess.CompletedProcess[str]:
    """The same of ``emb-daemon ARGUMENTS``."""
    return python("-m", "emb_daemon.cli.main", *arguments, **variables)
