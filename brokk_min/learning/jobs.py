"""Calls side by side: on the cores of this machine, or on the workers of a dask cluster.

A cluster is the address of a scheduler, `tcp://...`. Its workers must have this package and the
folder that the calls write to, and one thread each, because torch's settings hold for a process.
"""

import os
import sys
import uuid
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Any

import dask
from dask.system import cpu_count
from tqdm import tqdm

from brokk_min.machine import require

ENVIRON = "distributed.nanny.pre-spawn-environ"  # of the processes that run the calls
SETTINGS = {
    f"{ENVIRON}.MALLOC_TRIM_THRESHOLD_": 2**30,  # with dask's 64 kB a training takes 1.4 times
    f"{ENVIRON}.MALLOC_MMAP_THRESHOLD_": 2**30,  # glibc adapts it no more then
    "distributed.admin.large-graph-warning-threshold": "1TB",  # of logs
}
LOCAL = {"threads_per_worker": 1, "memory_limit": None, "silence_logs": "CRITICAL"}
LOCAL |= {"host": "127.0.0.1", "dashboard_address": "127.0.0.1:0"}  # no other computer reaches it
PATIENCE = 30  # s until a worker is there


def side_by_side(
    calls: Mapping[str, Callable[..., Any]],
    needs: Mapping[str, Sequence[str]] | None = None,
    scheduler: str | None = None,
) -> dict[str, Any]:
    """Results of calls by their names, each from a process of one thread.

    A call receives the results of those that it `needs`, which stand before it. The others begin
    in their order, so the longest should stand first. The first exception is raised. OSError: no
    scheduler answers. ValueError: it has no worker, or workers of several threads.
    """
    from distributed import Client, as_completed  # slow to import

    local = LOCAL | {"n_workers": min(cpu_count(), len(calls))}
    options: dict[str, Any] = {"address": scheduler, "timeout": 10} if scheduler else local
    with dask.config.set(SETTINGS), Client(**options) as client:  # type: ignore[no-untyped-call]
        with suppress(TimeoutError):
            client.wait_for_workers(1, timeout=PATIENCE)
        workers = client.scheduler_info(n_workers=-1)["workers"]
        require(len(workers) > 0, str(scheduler), f"a worker within {PATIENCE} s", "none")
        threads = sorted({worker["nthreads"] for worker in workers.values()} - {1})
        require(not threads, str(scheduler), "workers with --nthreads 1", threads)
        if scheduler is None:
            client.run(_hide_bars)
        # dask would let a core wait for calls that stand behind a long one on another: so here a
        # free one gets the next call by name; a cluster gets all at once, as workers come and go
        free = [*workers] if scheduler is None else [None] * len(calls)
        jobs: dict[str, Any] = {}
        done: dict[str, Any] = {}
        on: dict[str, str | None] = {}  # worker
        this = uuid.uuid4().hex  # of all that run on the cluster
        ended = as_completed(with_results=True)  # type: ignore[no-untyped-call]
        with tqdm(total=len(calls), unit="job", disable=None) as bar:
            while len(done) < len(calls):
                for name, call in calls.items():
                    needed = (needs or {}).get(name, ())
                    if free and name not in jobs and done.keys() >= {*needed}:
                        on[name] = free.pop()
                        results = [jobs[other] for other in needed]
                        how = {"key": (name, this), "priority": -len(jobs), "workers": on[name]}
                        how["allow_other_workers"] = scheduler is None  # of a worker that died
                        jobs[name] = client.submit(call, *results, **how)
                        ended.add(jobs[name])  # type: ignore[no-untyped-call]
                job, result = next(ended)
                done[job.key[0]] = result
                free.append(on[job.key[0]])
                bar.update()
        return {name: done[name] for name in calls}


def _hide_bars() -> None:
    """Close stderr, because the bars of several processes would mix."""
    sys.stderr = open(os.devnull, "w")  # noqa: SIM115
