"""Calls run side by side, or on a cluster: each gets what it needs, and errors come back."""

import os
import time
from functools import partial

import psutil
import pytest

from brokk_min.learning import jobs
from brokk_min.learning.jobs import side_by_side

distributed = pytest.importorskip("distributed")


def length(*results):
    return len(results), *results


def test_side_by_side__calls_get_what_they_need_and_return_by_name():
    slow = partial(time.sleep, 0.05)
    calls = {"a": slow, "b": os.getpid, "c": length, "d": length}
    done = side_by_side(calls, {"c": ["b", "a"], "d": ["c"]})
    b = done["b"]
    assert done == {"a": None, "b": b, "c": (2, b, None), "d": (1, (2, b, None))}
    assert list(done) == list(calls) and b != os.getpid()


def span(seconds, *results):
    began = time.monotonic()
    time.sleep(seconds)
    return began, time.monotonic()


def test_side_by_side__a_free_core_takes_the_next_call(monkeypatch):
    """No call is queued behind a long one while another core has shorter ones."""
    monkeypatch.setattr(jobs, "cpu_count", lambda: 2)
    seconds = {"first": 0.1, "long": 1.5, "short": 0.5, "second": 0.3, "third": 0.3}
    calls = {name: partial(span, time) for name, time in seconds.items()}
    done = side_by_side(calls, {name: ["first"] for name in calls if name != "first"})
    assert done["second"][0] < done["third"][0] and done["third"][1] < done["long"][1]


def test_side_by_side__raises_what_a_call_raises():
    with pytest.raises(ValueError, match="invalid literal for int"):
        side_by_side({"a": os.getpid, "b": partial(int, "x")})


def ports(pid):
    """Addresses at which a process and those that it started listen."""
    family = [psutil.Process(pid), *psutil.Process(pid).children(recursive=True)]
    found = [one for who in family for one in who.net_connections("inet")]
    return {one.laddr.ip for one in found if one.status == psutil.CONN_LISTEN}


def test_side_by_side__calls_have_one_thread_and_no_other_computer_can_reach_them():
    calls = {"ports": partial(ports, os.getpid()), "n": partial(os.getenv, "OMP_NUM_THREADS")}
    assert side_by_side(calls) == {"ports": {"127.0.0.1"}, "n": "1"}


@pytest.mark.parametrize("threads", [0, 1, 2])
def test_side_by_side__on_a_cluster_whose_workers_have_one_thread(threads, monkeypatch):
    monkeypatch.setattr(jobs, "PATIENCE", 0.1)
    options = {
        "n_workers": min(threads, 1),
        "processes": False,
        "dashboard_address": ":0",
        "protocol": "tcp",
    }
    with distributed.LocalCluster(threads_per_worker=threads, **options) as cluster:
        address = cluster.scheduler_address
        if threads == 1:
            assert side_by_side({"a": os.getpid}, scheduler=address) == {"a": os.getpid()}
        else:
            none = f"{address}: expected a worker within 0.1 s, got none"
            several = rf"{address}: expected workers with --nthreads 1, got \[2\]"
            message = several if threads else none
            with pytest.raises(ValueError, match=message):
                side_by_side({"a": os.getpid}, scheduler=address)
