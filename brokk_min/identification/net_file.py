"""Files of actuator nets: one `.npz`, weights plus a JSON header; nothing in it is executed."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from brokk_min._files import expected, load_arrays, save_arrays
from brokk_min.actuator import ActuatorNet
from brokk_min.beyond.net_ensemble import NetEnsemble
from brokk_min.beyond.valve_nets import ValveNet
from brokk_min.machine import Array, Machine, require

KIND = "actuator net 6"
CLASSES = {"paper": ActuatorNet, "valve": ValveNet, "ensemble": NetEnsemble}  # by name in files
NAMES = {kind: name for name, kind in CLASSES.items()}


def net_arrays(net: ActuatorNet) -> tuple[dict[str, Any], dict[str, Array]]:
    """Header and arrays of nets, as in their file."""
    header: dict[str, Any] = {"reads": NAMES[type(net)]}
    arrays: dict[str, Array] = {}
    for name, value in vars(net).items():
        if name == "weights":
            arrays |= {f"weight_{i}": weight for i, weight in enumerate(value)}
        else:
            (arrays if isinstance(value, np.ndarray) else header)[name] = value
    return header, arrays


def net_from_arrays(path: Path, header: Mapping[str, Any], arrays: Mapping[str, Any]) -> Any:
    """Nets from `net_arrays`; ValueError, with `path`, for what is no net."""
    with expected(path, "a complete actuator net"):
        kind = CLASSES[header["reads"]]
        for name, array in arrays.items():
            joints = len(header["joints"])
            rows = array.shape[:1]
            require(rows == (joints,), name, f"a row for each of {joints} joints", array.shape)
        found = {**header, **arrays, "joints": tuple(header["joints"])}
        found["weights"] = tuple(arrays[f"weight_{i}"] for i in range(6))
        net = kind(**{field.name: found[field.name] for field in fields(kind)})
        inputs = net.input_scale.shape[-1]
        require(3 * net.history <= inputs, "history", f"samples of {inputs} inputs", net.history)
        order = bool((vars(net)["output_low"] < vars(net)["output_high"]).all())
        require(order, "output_low", "less than output_high", "as much or more")
        scaled = bool((net.input_scale > 0).all())
        require(scaled, "input_scale", "positive numbers", net.input_scale.min())
        net.predict(np.zeros((1, len(net.joints), 3, net.history), np.float32))  # do shapes fit?
        return net


def fingerprint(net: ActuatorNet) -> str:
    """Hash of header and arrays of the nets; files of gains hold it."""
    header, arrays = net_arrays(net)
    digest = hashlib.sha256(json.dumps(header, sort_keys=True).encode())
    for name, array in arrays.items():
        digest.update(name.encode() + np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:16]


def select_nets(machine: Machine, net: ActuatorNet) -> ActuatorNet:
    """The nets of the machine's driven joints; ValueError: of another machine, or not of all."""
    wanted = (machine.name, machine.rate, machine.history, machine.velocity_samples)
    found = (net.machine, net.rate, net.history, net.velocity_samples)
    require(found == wanted, "actuator", f"nets with name, rate, samples {wanted}", found)
    joints = tuple(machine.names[i] for i in machine.driven)
    known = set(joints) <= set(net.joints)
    require(known, "joints", f"nets for {list(joints)}", list(net.joints))
    index = [net.joints.index(name) for name in joints]
    if "dead_zones" in vars(net):  # of nets that read openings
        zones, given = vars(net)["dead_zones"][index], machine.dead_zones[machine.driven]
        same = np.allclose(zones, given)
        require(same, "dead_zone", f"those of the nets {zones.tolist()}", given.tolist())
    changes: dict[str, Any] = {"joints": joints, "weights": tuple(w[index] for w in net.weights)}
    changes |= {name: x[index] for name, x in vars(net).items() if isinstance(x, np.ndarray)}
    return replace(net, **changes)


def save_net(path: Path, net: ActuatorNet) -> None:
    """Write nets as one `.npz`: weights plus a JSON header."""
    header, arrays = net_arrays(net)
    save_arrays(path, KIND, header, **arrays)


def load_net(path: Path, machine: Machine | None = None) -> ActuatorNet:
    """Read nets that `save_net` wrote; for a `machine`: `select_nets` of them."""
    with expected(path, "actuator nets"):
        net: ActuatorNet = net_from_arrays(path, *load_arrays(path, KIND))
        return select_nets(machine, net) if machine else net
