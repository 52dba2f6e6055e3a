"""What a worker imports first.

python-can imports asammdf wherever it is installed, for files that workers read in another process: 20 MiB of each.
"""

import sys

_ABSENT = "asammdf" not in sys.modules
if _ABSENT:
    sys.modules["asammdf"] = None
import can  # noqa: E402, F401

if _ABSENT:
    del sys.modules["asammdf"]
