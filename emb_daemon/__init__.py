"""Virtual clamp force sensor for electro-mechanical brakes.

For Python programs: `load_log`, `log_of_arrays`, `run`, `table`, `Estimator`, `Mapping`, `load_calibration` and more; see
`emb_daemon.api`.
"""

from typing import TYPE_CHECKING

__version__ = "0.1.0"

if TYPE_CHECKING:
    from emb_daemon.api import (
        Answer,
        Calibration,
        Estimator,
        Log,
        Mapping,
        load_calibration,
        load_log,
        log_of_arrays,
        run,
        shipped_calibration,
        table,
    )

__all__ = [
    "Answer",
    "Calibration",
    "Estimator",
    "Log",
    "Mapping",
    "load_calibration",
    "load_log",
    "log_of_arrays",
    "run",
    "shipped_calibration",
    "table",
]


def __getattr__(name: str) -> object:
    # The daemon and --help need none of this, and it takes half a second to import.
    if name in __all__:
        from emb_daemon import api

        return getattr(api, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
