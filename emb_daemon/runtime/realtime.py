"""Real-time set-up of the process; each measure reports what it did or why it could not."""

import ctypes
import gc
import os
import sys
from collections.abc import Iterator

_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4


def _lock_memory() -> str:
    libc = ctypes.CDLL(None, use_errno=True)
    # MCL_ONFAULT: memory that is mapped but never touched, such as stacks of helper threads, need not be resident.
    if libc.mlockall(_MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT):
        return f"memory not locked: {os.strerror(ctypes.get_errno())} (raise LimitMEMLOCK)"
    return "memory locked"


def use_fifo(priority: int) -> str:
    """Give the calling thread SCHED_FIFO; returns a log line."""
    try:
        # For the calling thread only: threads that it starts, to read or write a file, get the ordinary scheduler.
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
    except OSError as error:
        return f"ordinary scheduling: SCHED_FIFO {priority} refused: {error.strerror} (raise LimitRTPRIO)"
    return f"SCHED_FIFO priority {priority}"


def _pin(cpu: int) -> str:
    try:
        os.sched_setaffinity(0, {cpu})
    except OSError as error:
        return f"not pinned to CPU {cpu}: {error.strerror}"
    return f"pinned to CPU {cpu}"


def settle_memory() -> None:
    """Exclude all live objects from garbage collection: a full collection takes ten periods, so none may run later."""
    gc.collect()
    gc.freeze()
    gc.disable()
    # A helper thread that parses a calibration releases the interpreter to the loop within this time.
    sys.setswitchinterval(0.0002)


def set_up(lock: bool, priority: int | None, cpu: int | None) -> Iterator[str]:
    """Apply the chosen measures, yielding one log line each."""
    if lock:
        yield _lock_memory()
    if cpu is not None:
        yield _pin(cpu)
    if priority is not None:
        yield use_fifo(priority)
