"""Calls side by side: on the cores of this machine, or on the workers of a dask cluster.

A cluster is the address of a scheduler, `tcp://...`. Its workers must have this package and the
folder that the calls write to, and one thread each, because torch's settings hold for a process.
"""

import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

from dask.system import cpu_count
from tqdm import tqdm

from brokk_min.machine import require

HOST = "127.0.0.1"  # of a scheduler of our own: no other computer can reach it
TIMEOUT = 10  # s, in which the scheduler of a cluster must answer


def side_by_side(
    calls: Mapping[str, Callable[..., Any]],
    needs: Mapping[str, Sequence[str]] | None = None,
    scheduler: str | None = None,
) -> dict[str, Any]:
    """Results of calls by their names, each from a process of one thread.

    A call receives the results of those that it `needs`, which stand before it. The others begin
    in their order, so the longest should stand first. The first exception is raised.
    """
    from distributed import as_completed  # slow to import

    with connect(scheduler, min(cpu_count(), len(calls))) as client:
        jobs: dict[str, Any] = {}
        for name, call in calls.items():
            results = [jobs[other] for other in (needs or {}).get(name, ())]
            jobs[name] = client.submit(call, *results, pure=False, priority=-len(jobs))
        ended = as_completed(jobs.values(), with_results=True)  # type: ignore[no-untyped-call]
        bar = tqdm(ended, total=len(jobs), unit="job", disable=None)
        done = {job.key: result for job, result in bar}
        return {name: done[job.key] for name, job in jobs.items()}


@contextmanager
def connect(scheduler: str | None, workers: int) -> Iterator[Any]:
    """A dask client of the scheduler at an address, or (None) of processes on this machine.

    OSError: no scheduler answers there. ValueError: it has workers of several threads.
    """
    import dask
    from distributed import Client  # slow to import

    options: dict[str, Any] = {"address": scheduler, "timeout": TIMEOUT}
    if scheduler is None:
        options = {"n_workers": workers, "threads_per_worker": 1, "memory_limit": None}
        options |= {"host": HOST, "dashboard_address": f"{HOST}:0", "silence_logs": "CRITICAL"}
    environ = "distributed.nanny.pre-spawn-environ"  # of the processes that run the calls
    settings = {
        f"{environ}.MALLOC_TRIM_THRESHOLD_": 2**30,  # with dask's 64 kB a training takes 1.4 times
        f"{environ}.MALLOC_MMAP_THRESHOLD_": 2**30,  # glibc adapts it no more then
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
