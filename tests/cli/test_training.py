"""`train` from the command line, for both agents."""

import re
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from helpers_cli import run
from helpers_machines import short_axes, small_net

from brokk_min._files import SHIPPED
from brokk_min.evaluation import baselines, sequences
from brokk_min.evaluation.rollout import title
from brokk_min.identification.net_file import fingerprint, save_net
from brokk_min.learning import checkpoint
from brokk_min.learning.policy import load_policy
from brokk_min.machine import BROKK_170
from brokk_min.settings import PPOConfig

ROOT = Path(__file__).parents[2]
SMALL = "--num-envs 8 --horizon 8 --minibatch-size 32 --total-steps 128"


@pytest.mark.parametrize(
    ("options", "interface", "learner"),
    [
        ("--gamma 0.8", "beyond", {"gamma": 0.8, "total_steps": 128, "num_envs": 8}),
        (
            "--paper --critic --clip 0.1 --actuator net.npz",
            "paper",
            {"clip": 0.1, "gae_lambda": 0.95},
        ),
    ],
)
def test_train__has_its_settings_from_the_line(
    tmp_path, capsys, monkeypatch, options, interface, learner
):
    """Without --actuator on the nets of the package; the policy's row is beside the PIDs'."""
    short = short_axes(60, 1)
    monkeypatch.setattr(sequences, "axis_sequences", lambda machine: short)
    monkeypatch.setattr(baselines, "LOOK_SECONDS", 0.5)
    monkeypatch.chdir(tmp_path)
    net = small_net(BROKK_170, np.random.default_rng(0))
    save_net(tmp_path / "net.npz", net)
    assert run(f"train {SMALL} {options} --hold-max-s 9 --seed 4") == 0
    printed = capsys.readouterr().out
    assert re.search(r"^128 steps: 0\.\d{4} m/s; the PID tuned by hand has 0\.", printed, re.M)
    errors = dict(re.findall(r"^(P.*\w|s.*\w) +(?:open|closed) +(\S+)", printed, re.M))
    assert float(errors["PID optimised"]) < float(errors["PID by hand"]) < 0.06
    paper = "rl_critic_nets" if "--critic" in options else "rl_paper"
    assert float(errors[title("rl" if interface == "beyond" else paper)]) > 0.06
    assert run(f"train {SMALL} {options}") == 2  # it is there
    policy = load_policy(tmp_path / "policy.npz", BROKK_170)
    shipped = load_policy(SHIPPED / "brokk170" / "policy.npz", BROKK_170).net
    assert fingerprint(policy.net) == fingerprint(net if "--actuator" in options else shipped)
    assert policy.interface == interface
    recipe = policy.training["recipe"]
    assert recipe["task"]["hold_max_s"] == 9 and policy.training["seed"] == 4
    assert learner.items() <= recipe["learner"].items()


def test_train__goes_on_only_if_it_is_told_to(tmp_path, capsys):
    (tmp_path / "p.npz.checkpoint").write_text("of a training")
    line = f"train --actuator missing.npz --out {tmp_path}/p.npz"
    assert run(line) == 2
    assert "checkpoint: expected --resume or no checkpoint, got one" in capsys.readouterr().err
    assert run(f"{line} --resume") == 1
    assert "missing.npz: no such file" in capsys.readouterr().err
    (tmp_path / "r.npz.checkpoint").touch()
    assert run(f"train --out {tmp_path}/r.npz --resume") == 2
    assert "expected no training with this name, got an empty checkpoint" in capsys.readouterr().err
    assert run(f"train --out {tmp_path}/s.npz --resume") == 2
    assert "s.npz.checkpoint: expected one to --resume from, got none" in capsys.readouterr().err
    (tmp_path / "q.npz.csv").mkdir()
    assert run(f"train --out {tmp_path}/q.npz --force") == 2
    assert "q.npz.csv: expected a file in an existing" in capsys.readouterr().err


def test_train__has_its_name_for_itself_while_it_runs(tmp_path, monkeypatch, capsys):
    """A second training of the name is refused, and may begin once the first one has ended."""
    save_net(tmp_path / "net.npz", small_net(BROKK_170, np.random.default_rng(0)))
    line = f"train --actuator {tmp_path}/net.npz --out {tmp_path}/p.npz {SMALL}"
    prepare, status, short = checkpoint.prepare, [], short_axes(10)

    def meanwhile(*arguments):
        monkeypatch.setattr(checkpoint, "prepare", prepare)
        status.append(run(f"{line} --seed 2"))
        return prepare(*arguments)

    monkeypatch.setattr(checkpoint, "prepare", meanwhile)
    monkeypatch.setattr(sequences, "axis_sequences", lambda machine: short)
    monkeypatch.setattr(baselines, "LOOK_SECONDS", 0.5)
    assert (run(line), status) == (0, [2])
    assert "p.npz.checkpoint: expected no training with this name" in capsys.readouterr().err
    assert {path.name for path in tmp_path.iterdir()} == {"net.npz", "p.npz", "p.npz.csv"}


def test_train__refuses_goals_that_the_machine_cannot_follow(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sequences, "STARTS_OF", 20)
    monkeypatch.chdir(tmp_path)
    text = "from dataclasses import replace\nfrom brokk_min.machine import BROKK_170\n"
    Path("m.py").write_text(f"{text}FAST = replace(BROKK_170, tool_speed=3.0)\n")
    assert run("train --machine m.py:FAST --actuator missing.npz") == 1
    assert "got 0: is tool_speed too large?" in capsys.readouterr().err
    two = "(replace(j, driven=j.name in ('q3', 'q4')) for j in BROKK_170.joints)"
    Path("m.py").write_text(f"{text}TWO = replace(BROKK_170, joints=tuple({two}))\n")
    assert run("train --machine m.py:TWO --actuator missing.npz") == 1
    assert "got 0: its joints do not move the tool along x, y, z" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["m.py"]


def test_porting_page__names_all_settings_and_no_others():
    """In the first column of its table of names."""
    page = (ROOT / "docs" / "porting.md").read_text(encoding="utf-8")
    table = page.partition("## Names of settings elsewhere")[2]
    named = re.findall(r"^\| `(\w+)`", table, re.M)
    assert named == [field.name for field in fields(PPOConfig)]
