"""Files of nets: what is saved is loaded, and nothing else is."""

import json
from dataclasses import fields, replace

import numpy as np
import pytest
from helpers_machines import random_net, shared_net, small_net

from brokk_min.actuator import ActuatorNet
from brokk_min.identification.net_file import (
    fingerprint,
    joint_nets,
    load_net,
    save_net,
    select_nets,
)
from brokk_min.machine import BROKK_170


def saved(path, entries=None, **changes):
    """A net file with some arrays or header entries changed (None: left out)."""
    save_net(path, random_net())
    with np.load(path) as file:
        arrays = dict(file)
    if isinstance(entries, dict):
        header = json.loads(str(arrays["header"])) | entries
        entries = json.dumps({k: v for k, v in header.items() if v is not None})
    if entries is not None:
        arrays["header"] = np.array(entries)
    arrays |= changes
    np.savez(path, **{name: array for name, array in arrays.items() if array is not None})
    return path


@pytest.mark.parametrize(
    "net", [random_net(rows=4), replace(random_net(), dead_zone=0.1), shared_net(rows=4)]
)
def test_load_net__gives_the_net_that_was_saved(tmp_path, net):
    history = np.random.default_rng(2).uniform(-1, 1, (6, 3, 3, 13)).astype(np.float32)
    save_net(tmp_path / "net.npz", net)
    loaded = load_net(tmp_path / "net.npz")
    for field in fields(ActuatorNet):
        one, two = getattr(net, field.name), getattr(loaded, field.name)
        if field.name != "weights":
            assert np.array_equal(one, two), field.name
    for one, two in zip(net.weights, loaded.weights, strict=True):
        assert np.array_equal(one, two) and one.dtype == two.dtype
    np.testing.assert_array_equal(loaded.predict(history), net.predict(history))
    assert load_net(saved(tmp_path / "old.npz", {"dead_zone": None})).dead_zone == 0.0


@pytest.mark.parametrize(
    ("header", "message"),
    [
        ({"format": 99}, r"expected \(actuator net, format 1\), got \('actuator net', 99\)"),
        ({"kind": "policy"}, r"expected \(actuator net, format 1\), got \('policy', 1\)"),
        ({"colour": "red"}, "expected a complete actuator net, got .*'colour'"),
        ("[" * 2000, "expected a file with a JSON header, got maximum recursion depth"),
        ("3", "expected a file with a JSON header, got 'int' object"),
    ],
)  # fmt: skip
def test_load_net__names_what_is_wrong_in_a_header(tmp_path, header, message):
    """`tests/fuzz.py` makes the others, from the description of the fields."""
    with pytest.raises(ValueError, match=rf"net\.npz: {message}"):
        load_net(saved(tmp_path / "net.npz", header))


def test_load_net__wants_lower_bounds_below_upper_ones(tmp_path):
    path = saved(tmp_path / "net.npz", output_high=random_net().output_low)
    with pytest.raises(ValueError, match=r"net\.npz: output_high: expected above \[-0\."):
        load_net(path)


def test_fingerprint__differs_between_nets_and_survives_a_file(tmp_path):
    net = random_net()
    save_net(tmp_path / "net.npz", net)
    assert fingerprint(load_net(tmp_path / "net.npz")) == fingerprint(net)
    weights = (net.weights[0] + 1e-6, *net.weights[1:])
    others = [joint_nets(net, ["j1"]), replace(net, rate=25.0), replace(net, weights=weights)]
    assert len({fingerprint(other) for other in (net, *others)}) == 4


def test_select_nets__refuses_nets_of_another_machine_rate_or_estimator():
    net = small_net(BROKK_170, np.random.default_rng(0), BROKK_170.names)
    assert select_nets(BROKK_170, net).joints == ("q1", "q3", "q4", "q5")
    changes = {"machine": "other", "rate": 25.0, "history": 12, "velocity_samples": 3}
    for name, value in (changes | {"velocity_logged": True}).items():
        with pytest.raises(ValueError, match=f"actuator: expected nets for brokk170.*{value!r}"):
            select_nets(BROKK_170, replace(net, **{name: value}))
    with pytest.raises(ValueError, match=r"joints: expected nets for \['q1', 'q3', 'q4', 'q5'\]"):
        select_nets(BROKK_170, joint_nets(net, ["q1", "q3"]))


@pytest.mark.parametrize("joints", [["j2", "j0"], ["j1"], ["j0", "j1", "j2"]])
def test_joint_nets__count_the_others_as_at_rest_for_what_joints_share(joints):
    """As all nets together, while the others stand at their mean angles, without commands."""
    net = shared_net(rows=4)
    index = [net.joints.index(name) for name in joints]
    rng = np.random.default_rng(4)
    history = np.zeros((20, 3, 3, net.history), np.float32)
    history[..., 0, :] = net.input_mean[:, : net.history]
    history[:, index] = rng.uniform(-1, 1, (20, len(index), 3, net.history))
    few = joint_nets(net, joints)
    together = net.forward(history)[0][:, index]
    np.testing.assert_allclose(few.forward(history[:, index])[0], together, atol=1e-6)
    again = joint_nets(joint_nets(net, [*joints, *set(net.joints) - set(joints)]), joints)
    np.testing.assert_allclose(again.weights[8], few.weights[8], atol=1e-6)


def test_load_net__wants_all_weights_of_nets_that_share_latents(tmp_path):
    save_net(tmp_path / "net.npz", shared_net())
    assert len(joint_nets(load_net(tmp_path / "net.npz"), ["j0", "j2"]).weights) == 9
    with np.load(tmp_path / "net.npz") as file:
        arrays = dict(file)
    assert json.loads(str(arrays["header"]))["format"] == 3  # older programs refuse it
    for name in ("weight_6", "weight_7", "weight_8"):
        np.savez(tmp_path / "part.npz", **{key: arrays[key] for key in arrays if key != name})
        with pytest.raises(ValueError, match=r"expected .*actuator net"):
            load_net(tmp_path / "part.npz")
