"""Files of nets: what is saved is loaded, and nothing else is."""

from dataclasses import replace

import numpy as np
import pytest
from helpers_machines import random_net, small_net

from brokk_min._files import save_arrays
from brokk_min.beyond.net_ensemble import NetEnsemble
from brokk_min.beyond.valve_nets import ValveNet
from brokk_min.identification import net_file
from brokk_min.identification.net_file import fingerprint, load_net, save_net, select_nets
from brokk_min.machine import BROKK_170

ZONES = np.array([[0.1, 0.2], [0.0, 0.05], [0.07, 0.07]])
VALVE = ValveNet(**vars(random_net(rows=4)), dead_zones=ZONES)
PAIRS = tuple(np.stack([w, 2 * w], axis=1) for w in VALVE.weights)
NETS = [random_net(), VALVE, NetEnsemble(**(vars(VALVE) | {"weights": PAIRS}))]


@pytest.mark.parametrize("net", NETS)
def test_load_net__gives_the_net_that_was_saved(tmp_path, net):
    save_net(tmp_path / "net.npz", net)
    loaded = load_net(tmp_path / "net.npz")
    assert type(loaded) is type(net)
    np.testing.assert_equal(vars(loaded), vars(net))
    assert fingerprint(loaded) == fingerprint(net)  # types of numbers, too


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kind": "policy 5"}, "expected .*actuator net 6 .*fit again.*, got 'policy 5'"),
        ({"reads": "valve"}, "expected a complete actuator net, got .*dead_zones"),
        ({"history": 10**9}, "history: expected samples of 39 inputs, got 1000000000"),
        ({"joints": ["a", "b"]}, "input_mean: expected a row for each of 2 joints, got .3, 39."),
    ],
)
def test_load_net__names_file_and_fault(tmp_path, change, message):
    path = tmp_path / "net.npz"
    header, arrays = net_file.net_arrays(random_net())
    save_arrays(path, "actuator net 6", header | change, **arrays)
    with pytest.raises(ValueError, match=rf"^{path}: {message}"):
        load_net(path)
    save_arrays(
        path, "actuator net 6", header, **arrays | {"input_scale": 0 * arrays["input_mean"]}
    )
    with pytest.raises(ValueError, match="input_scale: expected positive numbers, got"):
        load_net(path)
    save_arrays(path, "actuator net 6", header, **arrays | {"output_low": arrays["output_high"]})
    with pytest.raises(ValueError, match="output_low: expected less than output_high, got"):
        load_net(path)


def test_fingerprint__differs_between_nets():
    net = random_net()
    weights = (net.weights[0] + 1e-6, *net.weights[1:])
    others = [replace(net, joints=("b", "a", "c")), replace(net, rate=25.0)]
    others.append(replace(net, weights=weights))
    assert len({fingerprint(other) for other in (net, *others)}) == 4


def machine_with(names, zones):
    joints = [
        replace(BROKK_170.joints[0], name=x, encoder_node=i, dead_zone=tuple(zone))
        for i, (x, zone) in enumerate(zip(names, zones.tolist(), strict=True), 1)
    ]
    return replace(BROKK_170, name="some", joints=tuple(joints), q_start=())


@pytest.mark.parametrize("net", NETS)
def test_select_nets__predict_as_they_do_among_others(net):
    history = np.random.default_rng(4).uniform(-1, 1, (20, 3, 3, 13)).astype(np.float32)
    for joints in (["j2", "j0"], ["j1"]):
        index = [net.joints.index(name) for name in joints]
        alone = select_nets(machine_with(joints, ZONES[index]), net)
        assert alone.joints == tuple(joints)
        expected = net.predict(history)[:, index]
        np.testing.assert_allclose(alone.predict(history[:, index]), expected, atol=1e-6)
        np.testing.assert_array_equal(alone.output_low, net.output_low[index])
        if net is not NETS[0]:  # those that read openings belong to dead zones
            with pytest.raises(ValueError, match="dead_zone: expected those of the nets"):
                select_nets(machine_with(joints, ZONES[index] + 0.01), net)


def test_select_nets__refuses_nets_of_another_machine_rate_or_estimator(tmp_path):
    net = small_net(BROKK_170, np.random.default_rng(0), BROKK_170.names)
    assert select_nets(BROKK_170, net).joints == ("q1", "q3", "q4", "q5")
    refusal = "actuator: expected nets with .*'brokk170'"
    changes = {"machine": "other", "rate": 25.0, "history": 12, "velocity_samples": 3}
    for name, value in changes.items():
        with pytest.raises(ValueError, match=f"{refusal}.*{value!r}"):
            select_nets(BROKK_170, replace(net, **{name: value}))
    with pytest.raises(ValueError, match=r"joints: expected nets for \['j0', 'j9'\]"):
        select_nets(machine_with(["j0", "j9"], ZONES[:2]), random_net())
    save_net(tmp_path / "net.npz", replace(net, machine="other"))
    with pytest.raises(ValueError, match=rf"net\.npz: {refusal}"):
        load_net(tmp_path / "net.npz", BROKK_170)
