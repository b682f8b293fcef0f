"""`examples/run_onnx.py` sends what `Policy` sends, without this package."""

import re
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers_bus import random_policy
from helpers_cli import run

from brokk_min._files import SHIPPED
from brokk_min.actuator import append_sample, initial_history
from brokk_min.env import measure
from brokk_min.learning.onnx import export_onnx
from brokk_min.machine import BROKK_170, read_encoder
from examples.telescopic_crane import TELESCOPIC_CRANE

pytest.importorskip("onnxscript")
pytest.importorskip("onnxruntime")
from examples import run_onnx

PROGRAM = Path(run_onnx.__file__)


@pytest.mark.parametrize("machine", [BROKK_170, TELESCOPIC_CRANE], ids=lambda m: m.name)
def test_commands__are_those_of_the_controller(machine, tmp_path):
    """While the goal changes, the joints obey, and those that are locked move by themselves."""
    policy = random_policy("paper", machine)
    export_onnx(tmp_path / "p.onnx", policy)
    net, told = run_onnx.load(tmp_path / "p.onnx")
    rng = np.random.default_rng(0)
    q = (machine.column("q_min") + machine.column("q_max")) / 2
    u, memory, sent = np.zeros(machine.n), policy.start(1), []
    history = initial_history(np.float32(read_encoder(machine, q))[None], machine.history)
    h = history[0]
    window = machine.velocity_samples, machine.dt
    for v_goal in rng.uniform(-0.2, 0.2, (4, 3)).repeat(15, axis=0):
        history = append_sample(history, u, read_encoder(machine, q)[None], *window)
        expected, memory = policy(measure(machine, history, v_goal[None]), memory)
        h, u = run_onnx.tick(net, told, h, read_encoder(machine, q), u, v_goal)
        np.testing.assert_allclose(u, expected[0], atol=1e-6)
        q = q + machine.dt * np.where(np.isin(range(machine.n), machine.driven), 0.4 * u, 0.05)
        sent.append(u)
    assert np.std(sent, axis=0)[machine.driven].min() > 0.005


def test_our_agent_and_other_files__are_refused_in_one_line(tmp_path):
    """It reads what it computes from memory, so NumPy alone would need its whole interface."""
    path = tmp_path / "p.onnx"
    for write in (lambda: None, lambda: path.write_text("u")):
        write()
        with pytest.raises(SystemExit, match=f"^{path}: expected a file of brokk-min export, got"):
            run_onnx.load(str(path))
    export_onnx(path, random_policy("beyond"))
    wanted = "expected a policy of train --paper, got beyond"
    with pytest.raises(SystemExit, match=f"^{path}: {wanted}$"):
        run_onnx.load(path)


def test_program__runs_where_this_package_cannot_be_imported(tmp_path):
    """On a policy that `brokk-min export` wrote; it prints a line each tick."""
    policy = SHIPPED / BROKK_170.name / "policy_paper.npz"
    assert run("export --policy", policy, "--out", tmp_path / "p.onnx") == 0
    pipe = subprocess.PIPE
    command = [sys.executable, "-c", BLOCKED, PROGRAM, tmp_path / "p.onnx"]
    started = subprocess.Popen(command, text=True, cwd=tmp_path, stdout=pipe, stderr=pipe)
    try:
        printed = [started.stdout.readline() for _ in range(5)]
        started.send_signal(signal.SIGINT)
        assert started.communicate(timeout=60)[1] == ""  # Ctrl-C ends it without a word
    finally:
        started.kill()
    assert all(re.fullmatch(r"u \[.*\] of full command, q \[.*\] rad\n", line) for line in printed)


BLOCKED = """
import runpy, sys
sys.modules.update(brokk_min=None, torch=None)
sys.argv = sys.argv[1:]
runpy.run_path(sys.argv[0], run_name="__main__")
"""
