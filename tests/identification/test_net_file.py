"""Files of nets: what is saved is loaded, and nothing else is."""

from __future__ import annotations

import json
from dataclasses import fields, replace

import numpy as np
import pytest
from helpers_machines import random_net

from brokk_min.actuator import ActuatorNet
from brokk_min.identification.net_file import fingerprint, load_net, save_net


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


def refusal(path):
    with pytest.raises(ValueError) as caught:
        load_net(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ") and "expected" in message and "got" in message
    return message


def test_load_net__gives_the_net_that_was_saved(tmp_path):
    net = replace(random_net(), dead_zone=0.1)
    history = np.random.default_rng(2).uniform(-1, 1, (6, 3, 3, 13)).astype(np.float32)
    velocity = net.predict(history)
    save_net(tmp_path / "net.npz", net)
    loaded = load_net(tmp_path / "net.npz")
    for field in fields(ActuatorNet):
        one, two = getattr(net, field.name), getattr(loaded, field.name)
        if field.name != "weights":
            assert np.array_equal(one, two), field.name
    for one, two in zip(net.weights, loaded.weights, strict=True):
        assert np.array_equal(one, two) and one.dtype == two.dtype
    np.testing.assert_array_equal(loaded.predict(history), velocity)


def test_load_net__reads_a_file_without_a_dead_zone(tmp_path):
    assert load_net(saved(tmp_path / "net.npz", {"dead_zone": None})).dead_zone == 0.0


def test_load_net__refuses_files_that_are_no_net(tmp_path):
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
def test_load_net__names_a_missing_array(tmp_path, name):
    assert name in refusal(saved(tmp_path / "net.npz", **{name: None}))


@pytest.mark.parametrize(
    ("header", "words"),
    [
        ({"format": 99}, ["actuator net", "99"]),
        ({"format": None}, ["actuator net", "None"]),
        ({"kind": "policy"}, ["actuator net", "policy"]),
        ({"history": None}, ["history"]),
        ({"joints": None}, ["joints"]),
        ({"history": 7}, []),
        ({"joints": ["a", "b"]}, []),
        ({"colour": "red"}, ["colour"]),
        *[(text, []) for text in ("", "{", "3", "null", "[1, 2]", '"text"', "[]")],
    ],
)
def test_load_net__refuses_a_header_that_does_not_fit(tmp_path, header, words):
    message = refusal(saved(tmp_path / "net.npz", header))
    assert all(word in message for word in words), message


@pytest.mark.parametrize(
    ("name", "shape"),
    [
        ("weight_0", (3, 39, 31)), ("weight_1", (3, 31)), ("weight_2", (2, 32, 32)),
        ("weight_4", (3, 32, 2)), ("weight_5", (1, 1)), ("input_mean", (3, 38)),
        ("input_scale", (39,)), ("output_low", (2,)), ("q_low", (2,)), ("q_high", ()),
    ],
)  # fmt: skip
def test_load_net__refuses_arrays_of_another_shape_or_type(tmp_path, name, shape):
    refusal(saved(tmp_path / "net.npz", **{name: np.ones(shape, np.float32)}))
    text = np.full(getattr(random_net(), name, np.zeros((3, 1))).shape, "1.0")
    refusal(saved(tmp_path / "net.npz", **{name: text}))


def test_fingerprint__differs_between_nets_and_survives_a_file(tmp_path):
    net = random_net()
    save_net(tmp_path / "net.npz", net)
    assert fingerprint(load_net(tmp_path / "net.npz")) == fingerprint(net)
    weights = (net.weights[0] + 1e-6, *net.weights[1:])
    others = [net.select(["j1"]), replace(net, rate=25.0), replace(net, weights=weights)]
    assert len({fingerprint(other) for other in (net, *others)}) == 4
