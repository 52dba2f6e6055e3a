"""Work on a Dask cluster: an existing one by its scheduler's address, or processes of this machine.

Tasks are small, and their results are files that are either complete or missing. Dask can therefore repeat a task when a
worker dies, and a new client can continue the work of a killed one.
"""

import contextlib
import logging
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import islice
from typing import TYPE_CHECKING, Any, TypeVar

from emb_daemon.errors import InputError, Unavailable

if TYPE_CHECKING:
    from distributed import Client

#: Number of workers that a task may kill before it is given up; then the file is at fault and not the machine.
_LIVES = 3
#: Tasks that the scheduler holds per worker: enough that no worker waits for the client, few enough for 10⁷ logs.
_AHEAD = 20
#: Time without an answer after which a scheduler counts as missing, s; and number of such times without any worker after which
#: the work ends: starting one again takes some seconds.
_PATIENCE_S, _WITHOUT_WORKERS = 10, 6
#: Settings of Dask for tasks of seconds: a scheduler and two workers that watch themselves up to a hundred times a second use
#: a sixth of a core while they are idle.
_SETTINGS = {
    "distributed.admin.large-graph-warning-threshold": "1GB",
    "distributed.admin.tick.interval": "500ms",
    "distributed.admin.system-monitor.interval": "5s",
    "distributed.worker.memory.monitor-interval": "1s",
    "distributed.worker.profile.enabled": False,
}
_AGAIN = "run the same command again, with --resume if it has that option"


@contextlib.contextmanager
def cluster(address: str | None = None, workers: int | None = None) -> Iterator[Any]:
    """A `distributed.Client` of the scheduler at an address (``tcp://host:8786``), whose workers see the data set, or of so
    many ``workers`` of this machine, one for each core if neither is given. Raises Unavailable: no scheduler answers;
    InputError: the address is not valid."""
    # One thread each: a worker uses one core, and BLAS must not start more threads.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Arrow's own allocator would keep the memory that the largest drive took.
    os.environ.setdefault("ARROW_DEFAULT_MEMORY_POOL", "system")
    import dask
    import distributed

    # Where distributed's own settings are not there yet when ours are made, Dask takes all of them back with ours.
    assert distributed.__name__ in dask.config.config
    with (
        dask.config.set(_SETTINGS | {"distributed.scheduler.allowed-failures": _LIVES}),
        _connect(address) if address else _start_workers(workers or len(os.sched_getaffinity(0))) as client,
    ):
        yield client


def _connect(address: str) -> "Client":
    from distributed import Client

    try:
        return Client(address, timeout=_PATIENCE_S)
    except (OSError, TimeoutError):
        raise Unavailable(f"{address}: no scheduler answers there") from None
    except ValueError as error:
        raise InputError(f"--scheduler {address}: {error}, expected tcp://HOST:PORT") from None


@contextlib.contextmanager
def _start_workers(count: int) -> Iterator["Client"]:
    """A client of ``count`` processes of this machine, which end with the context."""
    from distributed import Client, LocalCluster

    local = LocalCluster(
        n_workers=count,
        threads_per_worker=1,
        host="127.0.0.1",
        dashboard_address="127.0.0.1:0",
        silence_logs=logging.ERROR,
        preload=["emb_daemon.wire.light_can"],
    )
    try:
        with Client(local) as client:
            try:
                yield client
            finally:
                # Distributed cannot close a worker that it is just starting again after its death.
                with contextlib.suppress(TimeoutError):
                    client.wait_for_workers(count, timeout=_PATIENCE_S)
    finally:
        # Results are in files. A worker that could not be closed, or that died before distributed registered it, ends with
        # this process.
        with contextlib.suppress(AssertionError, KeyError):
            local.close()


_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


def _first_done(client: "Client", futures: Iterable) -> set:
    """Those of some futures that are done, as soon as one is. Raises Unavailable: the scheduler or all workers are gone."""
    from distributed import CancelledError, wait

    absent = 0
    while absent < _WITHOUT_WORKERS:
        try:
            return wait(list(futures), timeout=_PATIENCE_S, return_when="FIRST_COMPLETED").done
        except CancelledError:
            raise Unavailable(f"the scheduler is gone; when it is back, {_AGAIN}") from None
        except TimeoutError:
            absent = 0 if client.scheduler_info(n_workers=-1)["workers"] else absent + 1
    raise Unavailable(f"no worker is left; {_AGAIN}")


def run(
    client: "Client",
    task: Callable[[_Item], _Result],
    items: Sequence[_Item],
    progress: Callable[[int, int], None] = lambda done, total: None,
    failed: Callable[[_Item, str], _Result] | None = None,
) -> list[_Result]:
    """``task(item)`` of every item, in their order. ``progress`` is called with the number of items done and of all items.

    ``failed`` gives, from item and reason, the result for an item whose task raises InputError or kills its worker even when
    it runs alone; without it such an error ends the work. Raises InputError: of a task; Unavailable: the scheduler or all
    workers are gone."""
    from distributed import CancelledError
    from distributed.scheduler import KilledWorker

    results: list = [None] * len(items)
    suspects: list[int] = []
    done = 0

    def submit(rows: Iterable[int]) -> dict[Any, int]:
        return {client.submit(task, items[row], pure=False): row for row in rows}

    def settle(row: int, future: Any, final: tuple[type[Exception], ...]) -> None:
        nonlocal done
        try:
            results[row] = future.result()
        except final as error:
            if failed is None:
                raise InputError(str(error)) from None
            results[row] = failed(items[row], str(error))
        except KilledWorker:
            suspects.append(row)
            return
        except CancelledError:
            raise Unavailable(f"the scheduler is gone; when it is back, {_AGAIN}") from None
        finally:
            future.release()
        done += 1
        progress(done, len(items))

    ahead = _AHEAD * max(1, len(client.scheduler_info(n_workers=-1)["workers"]))
    waiting = iter(range(len(items)))
    running = submit(islice(waiting, ahead))
    while running:
        for future in _first_done(client, running):
            settle(running.pop(future), future, (InputError,))
            running |= submit(islice(waiting, 1))
    # Dask blames a worker's death on every task that was there. Each is repeated alone to find the one that kills a worker.
    for row in suspects:
        alone = submit([row])
        for future in _first_done(client, alone):
            settle(row, future, (InputError, KilledWorker))
    return results
