"""Imports python-can without asammdf; commands and workers import this module first.

python-can imports asammdf wherever it is installed, and with it pandas: a third of a command's start-up time and 87 MiB, for
files that are read in another process (`logs.apart`).
"""

import sys

_ABSENT = "asammdf" not in sys.modules
if _ABSENT:
    sys.modules["asammdf"] = None
import can  # noqa: E402, F401

if _ABSENT:
    del sys.modules["asammdf"]
