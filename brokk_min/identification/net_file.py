"""Files of actuator nets: one `.npz`, weights plus a JSON header; nothing in it is executed."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brokk_min.actuator import ActuatorNet
from brokk_min.identification.files import expected, load_arrays, load_header, located, whole_file
from brokk_min.identification.formats import NET_ARRAYS, NET_HEADER, check_fields
from brokk_min.machine import Machine

FORMATS = {6: 1, 9: 3}  # by the number of weights: 9 with `ActuatorNet.latents`
LARGEST_NET = 2**26  # bytes of a file
STATISTICS = [name for name in NET_ARRAYS if not name.startswith("weight_")]


def net_arrays(net: ActuatorNet) -> dict[str, Any]:
    """Nets as named arrays, as in the file; one of them is the JSON header."""
    header: dict[str, Any] = {"format": FORMATS[len(net.weights)], "kind": "actuator net"}
    for field in fields(net):
        if field.name not in (*STATISTICS, "weights"):
            header[field.name] = getattr(net, field.name)
    arrays = {"header": np.array(json.dumps(header))}
    arrays |= {name: getattr(net, name) for name in STATISTICS}
    return arrays | {f"weight_{i}": weight for i, weight in enumerate(net.weights)}


def fingerprint(net: ActuatorNet) -> str:
    """Hash of header and arrays of the nets; files of policies and gains hold it."""
    digest = hashlib.sha256()
    for name, array in net_arrays(net).items():
        digest.update(name.encode() + np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:16]


def net_from_arrays(path: Path, arrays: dict[str, NDArray[Any]], prefix: str = "") -> ActuatorNet:
    """Nets from `net_arrays`; ValueError, with `path` and field, for what is no net.

    `prefix` is that of the names of the arrays in the file.
    """
    number = 9 if "weight_6" in arrays else 6
    header = load_header(path, arrays, "actuator net", FORMATS[number])
    sizes: dict[str, int] = {}
    check_fields(path, header, NET_HEADER, sizes, prefix)
    found, H = arrays.get("input_mean", np.empty(0)), header["history"]
    inputs = 4 * H if found.shape[-1:] == (4 * H,) else 3 * H
    sizes |= {"inputs": inputs, "2 inputs": 2 * inputs}
    check_fields(path, arrays, NET_ARRAYS, sizes, prefix)
    for name in ("output", "q"):
        if not (arrays[f"{name}_low"] < arrays[f"{name}_high"]).all():
            low, high = (arrays[f"{name}_{end}"].tolist() for end in ("low", "high"))
            raise ValueError(f"{path}: {prefix}{name}_high: expected above {low}, got {high}")
    with expected(path, "a complete actuator net"):
        header["joints"] = tuple(header["joints"])
        header |= {name: arrays[name] for name in STATISTICS}
        return ActuatorNet(**header, weights=tuple(arrays[f"weight_{i}"] for i in range(number)))


def select_nets(machine: Machine, net: ActuatorNet) -> ActuatorNet:
    """The nets of the machine's driven joints; ValueError: nets of another machine or estimator."""
    wanted = {
        "machine": machine.name,
        "rate": machine.rate,
        "history": machine.history,
        "velocity_samples": machine.velocity_samples,
        "velocity_logged": False,  # a bus carries angles only
    }
    found = {name: getattr(net, name) for name in wanted}
    if found != wanted:
        raise ValueError(f"actuator: expected nets for {machine.name} with {wanted}, got {found}")
    return joint_nets(net, [machine.names[i] for i in machine.driven])


def joint_nets(net: ActuatorNet, joints: Sequence[str]) -> ActuatorNet:
    """The nets of some joints, in the order given; ValueError: a joint without a net.

    For shared latents the other joints count as at rest in the middle of their log.
    """
    if not set(joints) <= set(net.joints):
        raise ValueError(f"joints: expected nets for {list(joints)}, got {list(net.joints)}")
    index = [net.joints.index(name) for name in joints]
    arrays = {name: getattr(net, name)[index] for name in STATISTICS}
    weights = tuple(weight[index] for weight in net.weights)
    if len(weights) > 6:
        rest = -net.input_mean / net.input_scale  # standardised zeros
        rest[:, : net.history] = 0.0  # the mean angle
        z = np.einsum("ni,nil->nl", np.hstack([rest, np.abs(rest)]), net.weights[6])
        weights[8][0] += np.delete(z + net.weights[8], index, axis=0).sum(axis=0)
    return replace(net, joints=tuple(joints), weights=weights, **arrays)


def save_net(path: Path, net: ActuatorNet) -> None:
    """Write nets as one `.npz`: weights plus a JSON header."""
    with whole_file(path) as file:
        np.savez(file, **net_arrays(net))


def load_net(path: Path, machine: Machine | None = None) -> ActuatorNet:
    """Read nets that `save_net` wrote; for a `machine`: those of its driven joints.

    ValueError as in `net_from_arrays`, or nets that are not for the machine.
    """
    with located(path):
        net = net_from_arrays(path, load_arrays(path, largest=LARGEST_NET))
        return select_nets(machine, net) if machine else net
