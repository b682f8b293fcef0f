"""Histories, nets, and files of nets."""

from __future__ import annotations

import json
from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from helpers_machines import constant_net, random_net

from brokk_min.actuator import (
    ActuatorNet,
    append_command,
    initial_history,
    mu_law,
    mu_law_derivative,
    push,
)
from brokk_min.identification.net_file import load_net, save_net

# --- histories ------------------------------------------------------------------------------------


def test_a_history_by_hand():
    h = initial_history(np.array([0.5, -1.0]), 3)
    np.testing.assert_array_equal(h[1], [[-1, -1, -1], [0, 0, 0], [0, 0, 0]])
    h.setflags(write=False)
    sent = append_command(h, [0.1, 0.2])
    np.testing.assert_array_equal(sent[0], [[0.5, 0.5, 0.5], [0, 0, 0], [0, 0, 0.1]])
    np.testing.assert_array_equal(sent[1], [[-1, -1, -1], [0, 0, 0], [0, 0, 0.2]])
    seen = push(h, [0.1, 0.2], [0.6, -0.9], lambda angles: angles[..., -1] - angles[..., 0])
    np.testing.assert_allclose(seen[0], [[0.5, 0.5, 0.6], [0, 0, 0.1], [0, 0, 0.1]])
    np.testing.assert_allclose(seen[1], [[-1, -1, -0.9], [0, 0, 0.1], [0, 0, 0.2]])
    sent = append_command(seen, [0.3, 0.4])
    np.testing.assert_allclose(sent[0], [[0.5, 0.5, 0.6], [0, 0, 0.1], [0, 0.1, 0.3]])


def test_histories_have_leading_axes_and_keep_the_float_type():
    q = np.arange(6, dtype=np.float32).reshape(3, 2)
    h = push(initial_history(q, 5), q / 10, q + 1, lambda a: a[..., -1] - a[..., -2])
    assert h.shape == (3, 2, 3, 5) and h.dtype == np.float32
    np.testing.assert_array_equal(h[..., 0, -1], q + 1)
    np.testing.assert_array_equal(h[..., 0, -2], q)
    np.testing.assert_array_equal(h[..., 1, -1], 1)
    np.testing.assert_array_equal(h[..., 2, -1], q / 10)


@pytest.mark.parametrize("leading", [(), (1,), (7,), (2, 3)])
def test_prediction_against_a_loop_in_double_precision(leading):
    net = random_net(seed=len(leading), history=5, hidden=8)
    rng = np.random.default_rng(9)
    history = rng.uniform(-1, 1, (*leading, 3, 3, 5)).astype(np.float32)
    history.setflags(write=False)
    got = net.predict(history)
    assert got.shape == (*leading, 3)
    for index in np.ndindex(*leading):
        for j in range(3):
            w1, b1, w2, b2, w3, b3 = (torch.tensor(w[j]).double() for w in net.weights)
            x = torch.tensor(np.concatenate(list(history[index][j]))).double()  # q, q_dot, u
            x = (x - torch.tensor(net.input_mean[j])) / torch.tensor(net.input_scale[j])
            x = torch.relu(x @ w1 + b1)
            x = torch.relu(x @ w2 + b2)
            y = torch.sigmoid(x @ w3 + b3).item()
            low, high = float(net.output_low[j]), float(net.output_high[j])
            assert got[index][j] == pytest.approx(low + y * (high - low), abs=2e-5)
            assert low <= got[index][j] <= high


def test_what_nets_see_of_a_command_by_hand():
    """Openings 0.01 and 0.5 beyond a dead zone of 0.2: ln(1.5) and ln(26) of ln(51)."""
    u = np.array([-1.0, -0.2, 0.0, 0.1, 0.208, 0.6, 1.0])
    u.setflags(write=False)
    wanted = np.array([-1, 0, 0, 0, np.log(1.5) / np.log(51), np.log(26) / np.log(51), 1])
    np.testing.assert_allclose(mu_law(u, 0.2), wanted, atol=1e-12)
    np.testing.assert_array_equal(mu_law(u, 0.0), u)
    np.testing.assert_array_equal(mu_law_derivative(u, 0.0), 1)
    assert mu_law(np.float32([0.3]), 0.2).dtype == np.float32


@pytest.mark.parametrize("dead_zone", [0.0, 0.07, 0.3])
def test_the_slope_of_the_scale_is_a_difference(dead_zone):
    u = np.linspace(-0.999, 0.999, 400)
    ends = mu_law(u + 1e-7, dead_zone) - mu_law(u - 1e-7, dead_zone)
    np.testing.assert_allclose(mu_law_derivative(u, dead_zone), ends / 2e-7, rtol=1e-5, atol=1e-6)


def test_nets_that_know_a_dead_zone_are_nets_shown_other_commands():
    plain = random_net(history=5)
    net, rng = replace(plain, dead_zone=0.1), np.random.default_rng(2)
    history = rng.uniform(-1, 1, (6, 3, 3, 5))
    history[0, :, 2] *= 0.1  # not one command that opens a valve
    other = history.copy()
    other[:, :, 2] = mu_law(history[:, :, 2], 0.1)
    history.setflags(write=False)
    np.testing.assert_array_equal(net.velocity(history), plain.velocity(other))
    idle = history.copy()
    idle[0, :, 2] = 0.0
    np.testing.assert_array_equal(net.velocity(history)[0], net.velocity(idle)[0])
    assert (net.velocity(history)[1:] != plain.velocity(history)[1:]).all()


def test_a_file_from_before_dead_zones_holds_nets_that_see_plain_commands(tmp_path):
    net = replace(random_net(history=5), dead_zone=0.1)
    save_net(tmp_path / "net.npz", net)
    assert load_net(tmp_path / "net.npz").dead_zone == 0.1
    arrays = dict(np.load(tmp_path / "net.npz"))
    header = json.loads(str(arrays["header"]))
    del header["dead_zone"]
    np.savez(tmp_path / "old.npz", **arrays | {"header": np.array(json.dumps(header))})
    assert load_net(tmp_path / "old.npz").dead_zone == 0.0


def test_the_slope_of_nets_that_know_a_dead_zone_is_a_difference():
    net = random_net(history=4)
    net = replace(net, dead_zone=0.1, weights=tuple(w.astype(float) for w in net.weights))
    history = np.random.default_rng(3).uniform(-1, 1, (5, 3, 3, 4))
    slope = net.slope(history)[1]
    for kind in range(3):
        for sample in range(4):
            ends = []
            for step in (1e-6, -1e-6):
                other = history.copy()
                other[..., kind, sample] += step
                ends.append(net.velocity(other))
            difference = (ends[0] - ends[1]) / 2e-6
            np.testing.assert_allclose(slope[..., kind, sample], difference, rtol=1e-4, atol=1e-6)


def test_prediction_refuses_another_shape():
    with pytest.raises(ValueError) as caught:
        random_net().predict(np.zeros((4, 2, 3, 13), np.float32))
    assert str(caught.value) == "history: expected (..., 3, 3, 13), got (4, 2, 3, 13)"
    with pytest.raises(ValueError, match=r"got \(3, 3, 12\)"):
        random_net().predict(np.zeros((3, 3, 12), np.float32))


def test_a_step_of_the_simulation_by_hand():
    net = replace(constant_net([0.2, -0.4], False, ("a", "b")), velocity_samples=2)
    net = replace(net, q_low=np.float32([0.0, 0.985]), q_high=np.float32([1.0, 2.0]))
    history, q = net.step(
        initial_history(np.array([0.5, 1.0]), 13), np.array([0.5, 1.0]), [0.3, -0.1]
    )
    np.testing.assert_allclose(q, [0.51, 0.985], atol=1e-6)  # the second meets its stop
    np.testing.assert_allclose(history[:, 1, -1], [0.2, -0.3], atol=1e-5)
    np.testing.assert_allclose(history[:, 2, -2:], [[0, 0.3], [0, -0.1]])
    # beyond what training saw it may stay or come back, but go no further
    _, outside = net.step(history, np.array([1.5, 0.5]), [0.0, 0.0])
    np.testing.assert_allclose(outside, [1.5, 0.5], atol=1e-6)
    logged = replace(net, velocity_logged=True)
    history, _ = logged.step(
        initial_history(np.array([0.5, 1.0]), 13), np.array([0.5, 1.0]), [0.1, 0.1]
    )
    np.testing.assert_allclose(history[:, 1, -1], [0.2, -0.3], atol=1e-5)


def test_a_joint_without_a_command_that_stood_still_stays():
    net = constant_net([0.2, 0.2, 0.2, 0.2], False, ("a", "b", "c", "d"))
    history = initial_history(np.full(4, 0.5, np.float32), 13)
    history[1, 2, 1] = 0.01  # b had a command within the history that remains
    history[2, 0, -1:] = 0.503  # c has moved
    _, q = net.step(history, np.array([0.5, 0.5, 0.503, 0.5]), [0.0, 0.0, 0.0, 0.01])
    np.testing.assert_allclose(q, [0.5, 0.51, 0.513, 0.51], atol=1e-6)
    history[1, 2, 1], history[1, 2, 0] = 0.0, 0.01  # a tick later it is past
    _, q = net.step(history, np.full(4, 0.5), [0.0, 0.0, 0.0, 0.0])
    assert q[1] == 0.5


def test_commands_within_the_dead_zone_that_nets_know_move_nothing_that_stood_still():
    """Of 8.9 counts: 8 for the whole history are none, one of 9 is, and a joint that moved is for the net."""
    net = constant_net([0.2, 0.2, 0.2, 0.2], False, ("a", "b", "c", "d"))
    history = initial_history(np.full(4, 0.5, np.float32), 13)
    history[:, 2] = np.float32([[8], [-8], [8], [8]]) / np.float32(127)
    history[1, 2, 3] = -9 / 127
    history[2, 0, -1:] = 0.503
    np.testing.assert_allclose(
        replace(net, dead_zone=0.07).predict(history), [0, 0.2, 0.2, 0], atol=1e-6
    )
    np.testing.assert_allclose(net.predict(history), 0.2, atol=1e-6)  # these know none


def test_selected_nets_are_the_same_nets_in_another_order():
    net = random_net()
    history = np.random.default_rng(2).uniform(-1, 1, (6, 3, 3, 13)).astype(np.float32)
    every = net.predict(history)  # before: a cache of the whole must not leak into the part
    part = net.select(["j2", "j0"])
    assert part.joints == ("j2", "j0")
    np.testing.assert_allclose(part.predict(history[:, [2, 0]]), every[:, [2, 0]], atol=1e-6)
    assert part.output_low.tolist() == net.output_low[[2, 0]].tolist()
    with pytest.raises(ValueError, match=r"joints: expected nets for \['j0', 'q9'\], got"):
        net.select(["j0", "q9"])


# --- files ----------------------------------------------------------------------------------------


def test_a_net_survives_its_file(tmp_path):
    net = random_net()
    history = np.random.default_rng(2).uniform(-1, 1, (6, 3, 3, 13)).astype(np.float32)
    wanted = net.predict(history)  # fills whatever is cached, which must not be written
    save_net(tmp_path / "net.npz", net)
    again = load_net(tmp_path / "net.npz")
    for field in fields(ActuatorNet):
        one, two = getattr(net, field.name), getattr(again, field.name)
        if field.name == "weights":
            assert all(
                np.array_equal(a, b) and a.dtype == b.dtype for a, b in zip(one, two, strict=True)
            )
        else:
            assert np.array_equal(one, two), field.name
    np.testing.assert_array_equal(again.predict(history), wanted)


def saved(tmp_path, **changes):
    """A net file with some arrays changed (None: left out)."""
    path = tmp_path / "net.npz"
    save_net(path, random_net())
    with np.load(path) as file:
        arrays = dict(file)
    arrays |= changes
    np.savez(path, **{name: array for name, array in arrays.items() if array is not None})
    return path, arrays


def header(tmp_path, **changes) -> np.ndarray:
    _, arrays = saved(tmp_path)
    values = json.loads(str(arrays["header"])) | changes
    return np.array(json.dumps({k: v for k, v in values.items() if v is not None}))


def refusal(path) -> str:
    with pytest.raises(ValueError) as caught:
        load_net(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ") and "expected" in message and "got" in message
    return message


def test_files_that_are_no_net_are_refused_with_wanted_and_got(tmp_path):
    path = tmp_path / "net.npz"
    refusal(path)  # not there
    path.write_text("run,time\n")
    assert "readable .npz" in refusal(path)
    save_net(path, random_net())
    whole = path.read_bytes()
    for length in (0, 10, len(whole) // 2, len(whole) - 30):
        path.write_bytes(whole[:length])
        refusal(path)
    np.savez(path, time=np.arange(3))
    assert "header" in refusal(path)


@pytest.mark.parametrize("name", ["weight_0", "weight_5", "input_scale", "q_high", "header"])
def test_a_net_with_a_missing_array_is_refused_by_its_name(tmp_path, name):
    path, _ = saved(tmp_path, **{name: None})
    assert name in refusal(path)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"format": 99}, ["actuator net", "99"]),
        ({"format": None}, ["actuator net", "None"]),
        ({"kind": "policy"}, ["actuator net", "policy"]),
        ({"history": None}, ["history"]),
        ({"joints": None}, ["joints"]),
        ({"history": 7}, []),
        ({"joints": ["a", "b"]}, []),
        ({"colour": "red"}, ["colour"]),
    ],
)
def test_a_header_that_does_not_fit_is_refused(tmp_path, changes, words):
    path, _ = saved(tmp_path, header=header(tmp_path, **changes))
    message = refusal(path)
    assert all(word in message for word in words), message


@pytest.mark.parametrize("text", ["", "{", "3", "null", "[1, 2]", '"text"', "[]"])
def test_a_header_that_is_no_table_is_refused(tmp_path, text):
    path, _ = saved(tmp_path, header=np.array(text))
    refusal(path)


@pytest.mark.parametrize(
    ("name", "shape"),
    [
        ("weight_0", (3, 39, 31)), ("weight_1", (3, 31)), ("weight_2", (2, 32, 32)),
        ("weight_4", (3, 32, 2)), ("weight_5", (1, 1)), ("input_mean", (3, 38)),
        ("input_scale", (39,)), ("output_low", (2,)), ("q_low", (2,)), ("q_high", ()),
    ],
)  # fmt: skip
def test_arrays_of_another_shape_are_refused(tmp_path, name, shape):
    path, _ = saved(tmp_path, **{name: np.ones(shape, np.float32)})
    refusal(path)
