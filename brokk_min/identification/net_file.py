"""Files of actuator nets: one `.npz`, weights plus a JSON header; nothing in it is executed."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from brokk_min._files import expected, load_arrays, save_arrays
from brokk_min.actuator import ActuatorNet
from brokk_min.beyond.net_ensemble import NetEnsemble
from brokk_min.beyond.valve_nets import ValveNet
from brokk_min.machine import Array, Machine, require

KIND = "actuator net 5"
HEADER = ("joints", "history", "rate", "velocity_samples", "machine", "training")
ARRAYS = ("input_mean", "input_scale", "output_low", "output_high", "q_low", "q_high")
CLASSES = {"paper": ActuatorNet, "valve": ValveNet, "ensemble": NetEnsemble}  # by name in files
NAMES = {kind: name for name, kind in CLASSES.items()}


def net_arrays(net: ActuatorNet) -> tuple[dict[str, Any], dict[str, Array]]:
    """Header and arrays of nets, as in their file; ValueError: a class that is not in `CLASSES`."""
    known = ", ".join(kind.__name__ for kind in NAMES)
    require(type(net) in NAMES, "net", f"one of {known}", type(net).__name__)
    header = {name: getattr(net, name) for name in HEADER}
    header["training"] = dict(net.training)
    header["reads"] = NAMES[type(net)]
    arrays = {name: getattr(net, name) for name in ARRAYS}
    arrays |= {f"weight_{i}": weight for i, weight in enumerate(net.weights)}
    if isinstance(net, ValveNet):
        arrays["dead_zones"] = net.dead_zones
    return header, arrays


def net_from_arrays(path: Path, header: Mapping[str, Any], arrays: Mapping[str, Any]) -> Any:
    """Nets from `net_arrays`; ValueError, with `path`, for what is no net."""
    with expected(path, "a complete actuator net"):
        fields = {name: header[name] for name in HEADER}
        fields |= {name: arrays[name] for name in ARRAYS}
        fields["joints"] = tuple(header["joints"])
        fields["weights"] = tuple(arrays[f"weight_{i}"] for i in range(6))
        if "dead_zones" in arrays:
            fields["dead_zones"] = arrays["dead_zones"]
        net = CLASSES[header["reads"]](**fields)
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
    """The nets of the machine's driven joints; ValueError: nets of another machine or estimator."""
    wanted = {
        "machine": machine.name,
        "rate": machine.rate,
        "history": machine.history,
        "velocity_samples": machine.velocity_samples,
    }
    found = {name: getattr(net, name) for name in wanted}
    require(found == wanted, "actuator", f"nets for {machine.name} with {wanted}", found)
    return joint_nets(net, [machine.names[i] for i in machine.driven])


def joint_nets(net: ActuatorNet, joints: Sequence[str]) -> ActuatorNet:
    """The nets of some joints, in the order given; ValueError: a joint without a net."""
    known = set(joints) <= set(net.joints)
    require(known, "joints", f"nets for {list(joints)}", list(net.joints))
    index = [net.joints.index(name) for name in joints]
    names = (*ARRAYS, "dead_zones") if isinstance(net, ValveNet) else ARRAYS
    arrays = {name: getattr(net, name)[index] for name in names}
    weights = tuple(weight[index] for weight in net.weights)
    return replace(net, joints=tuple(joints), weights=weights, **arrays)


def save_net(path: Path, net: ActuatorNet) -> None:
    """Write nets as one `.npz`: weights plus a JSON header."""
    header, arrays = net_arrays(net)
    save_arrays(path, KIND, header, **arrays)


def load_net(path: Path, machine: Machine | None = None) -> ActuatorNet:
    """Read nets that `save_net` wrote; for a `machine`: those of its driven joints.

    ValueError as in `net_from_arrays`, or nets that are not for the machine.
    """
    with expected(path, "actuator nets"):
        net: ActuatorNet = net_from_arrays(path, *load_arrays(path, KIND))
        return select_nets(machine, net) if machine else net
