"""Calls side by side: on the cores of this machine, or on the workers of a dask cluster.

A cluster is the address of a scheduler, `tcp://...`. Its workers must have this package and the
folder that the calls write to, and one thread each, because torch's settings hold for a process.
"""

import logging
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

from dask.system import cpu_count
from tqdm import tqdm

from brokk_min.machine import require

TIMEOUT = 10  # s, in which a scheduler must answer


def side_by_side(
    calls: Mapping[str, Callable[..., Any]],
    clock: dict[str, float],
    needs: Mapping[str, Sequence[str]] | None = None,
    scheduler: str | None = None,
) -> list[Any]:
    """Results of calls in their order, each from a process of one thread.

    A call receives the results of those that it `needs`, which stand before it. The others begin
    in their order, so the longest should stand first. `clock` receives the seconds of each. The
    first exception is raised. On a single core the calls run in this process, one after the other.
    """
    needed = {name: (needs or {}).get(name, ()) for name in calls}
    done: dict[str, tuple[float, Any]] = {}
    if scheduler is None and cpu_count() == 1:
        for name, call in calls.items():
            done[name] = _timed(call, *(done[other] for other in needed[name]))
    else:
        with connect(scheduler, min(cpu_count(), len(calls))) as client:
            done = _submit(client, calls, needed)
    clock |= {name: done[name][0] for name in calls}
    return [done[name][1] for name in calls]


def _submit(
    client: Any, calls: Mapping[str, Callable[..., Any]], needed: Mapping[str, Sequence[str]]
) -> dict[str, tuple[float, Any]]:
    """Seconds and result of each call, in the order in which they end."""
    from distributed import as_completed  # slow to import

    jobs: dict[str, Any] = {}
    for name, call in calls.items():
        results = (jobs[other] for other in needed[name])
        jobs[name] = client.submit(_timed, call, *results, pure=False, priority=-len(jobs))
    names = {job.key: name for name, job in jobs.items()}
    done = {}
    bar = tqdm(as_completed(jobs.values()), total=len(jobs), unit="job", disable=None)  # type: ignore[no-untyped-call]
    for job in bar:
        done[names[job.key]] = job.result()
        bar.set_postfix_str(f"last: {names[job.key]}")
    return done


def _timed(call: Callable[..., Any], *needed: tuple[float, Any]) -> tuple[float, Any]:
    start = time.perf_counter()
    result = call(*(result for _, result in needed))
    return time.perf_counter() - start, result


@contextmanager
def connect(scheduler: str | None, workers: int) -> Iterator[Any]:
    """A dask client of the scheduler at an address, or (None) of processes on this machine.

    OSError: no scheduler answers there. ValueError: it has workers of several threads.
    """
    import dask
    from distributed import Client  # slow to import

    options: dict[str, Any] = {"address": scheduler, "timeout": TIMEOUT}
    if scheduler is None:  # all ports are on this machine's own address
        local = "127.0.0.1"
        options = {"n_workers": workers, "threads_per_worker": 1, "memory_limit": None}
        options |= {"host": local, "dashboard_address": f"{local}:0"}
        options |= {"silence_logs": logging.CRITICAL}
    environ = "distributed.nanny.pre-spawn-environ"  # of the processes that run the calls
    settings = {
        f"{environ}.MALLOC_TRIM_THRESHOLD_": 2**30,  # with dask's 64 kB a training takes 1.4 times
        "distributed.admin.large-graph-warning-threshold": "1TB",  # of logs
    }
    with dask.config.set(settings), Client(**options) as client:  # type: ignore[no-untyped-call]
        of_workers = client.scheduler_info(n_workers=-1)["workers"].values()
        threads = sorted({worker["nthreads"] for worker in of_workers} - {1})
        require(not threads, str(scheduler), "workers with --nthreads 1", threads)
        if scheduler is None:
            client.run(_hide_bars)
        yield client


def _hide_bars() -> None:
    """Close stderr, because the bars of several processes would mix."""
    sys.stderr = open(os.devnull, "w")  # noqa: SIM115
