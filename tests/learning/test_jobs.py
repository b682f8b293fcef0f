"""Calls run side by side, or on a cluster: each gets what it needs, and errors come back."""

import os
import time

import psutil
import pytest

from brokk_min.learning.jobs import connect, side_by_side

distributed = pytest.importorskip("distributed")


def process():
    return os.getpid()


def length(*results):
    return len(results), *results


def fail():
    raise ValueError("first: expected nothing, got an error")


def slow():
    time.sleep(0.05)
    return "slow"


def test_side_by_side__calls_get_what_they_need_and_return_by_name():
    calls = {"a": slow, "b": process, "c": length, "d": length}
    done = side_by_side(calls, {"c": ["b", "a"], "d": ["c"]})
    b = done["b"]
    assert done == {"a": "slow", "b": b, "c": (2, b, "slow"), "d": (1, (2, b, "slow"))}
    assert list(done) == list(calls) and b != os.getpid()


def test_side_by_side__raises_what_a_call_raises():
    with pytest.raises(ValueError, match="first: expected nothing, got an error"):
        side_by_side({"a": process, "b": fail})


def test_connect__no_other_computer_can_reach_the_workers():
    with connect(None, 1) as client:
        me = psutil.Process()
        family = [me, *me.children(recursive=True)]
        ports = [one for who in family for one in who.net_connections("inet")]
        listening = {one.laddr.ip for one in ports if one.status == psutil.CONN_LISTEN}
        assert listening == {"127.0.0.1"}
        assert client.submit(process).result() != os.getpid()
        threads = client.submit(os.getenv, "OMP_NUM_THREADS").result()
        assert threads == "1"


@pytest.mark.parametrize("threads", [1, 2])
def test_side_by_side__on_a_cluster_whose_workers_have_one_thread(threads):
    options = {"n_workers": 1, "processes": False, "dashboard_address": ":0", "protocol": "tcp"}
    with distributed.LocalCluster(threads_per_worker=threads, **options) as cluster:
        address = cluster.scheduler_address
        if threads == 1:
            assert side_by_side({"a": slow}, scheduler=address) == {"a": "slow"}
        else:
            message = rf"{address}: expected workers with --nthreads 1, got \[2\]"
            with pytest.raises(ValueError, match=message):
                side_by_side({"a": slow}, scheduler=address)
