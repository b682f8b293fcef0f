"""Files of actuator nets: one `.npz`, weights plus a JSON header; nothing in it is executed."""

import hashlib
import json
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brokk_min.actuator import ActuatorNet
from brokk_min.identification.files import expected, load_arrays, load_header, whole_file

FORMAT = 1
NET_ARRAYS = ("input_mean", "input_scale", "output_low", "output_high", "q_low", "q_high")


def net_arrays(net: ActuatorNet) -> dict[str, Any]:
    """Nets as named arrays, as in the file; one of them is the JSON header."""
    header: dict[str, Any] = {"format": FORMAT, "kind": "actuator net"}
    for field in fields(net):
        if field.name not in (*NET_ARRAYS, "weights"):
            header[field.name] = getattr(net, field.name)
    arrays = {"header": np.array(json.dumps(header))}
    arrays |= {name: getattr(net, name) for name in NET_ARRAYS}
    return arrays | {f"weight_{i}": weight for i, weight in enumerate(net.weights)}


def fingerprint(net: ActuatorNet) -> str:
    """Hash of header and arrays of the nets; files of policies and gains hold it."""
    digest = hashlib.sha256()
    for name, array in net_arrays(net).items():
        digest.update(name.encode() + np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:16]


def net_from_arrays(path: Path, arrays: dict[str, NDArray[Any]]) -> ActuatorNet:
    """Nets from `net_arrays`; ValueError, with `path`, for another format or shape."""
    header = load_header(path, arrays, "actuator net", FORMAT)
    with expected(path, "a complete actuator net"):
        header["joints"] = tuple(header["joints"])
        weights = tuple(arrays[f"weight_{i}"] for i in range(6))
        header |= {name: arrays[name] for name in NET_ARRAYS}
        net = ActuatorNet(**header, weights=weights)
        n, inputs, hidden = len(net.joints), 3 * net.history, weights[0].shape[-1]
        shapes = [(n, inputs, hidden), (n, hidden), (n, hidden, hidden), (n, hidden)]
        shapes += [(n, hidden, 1), (n, 1), (n, inputs), (n, inputs), (n,), (n,), (n,), (n,)]
        numbers = (*weights, *(arrays[name] for name in NET_ARRAYS))
        got = [array.shape for array in numbers]
        if got != shapes or any(array.dtype.kind != "f" for array in numbers):
            types = sorted({str(array.dtype) for array in numbers})
            raise ValueError(f"shapes {got} of {types} instead of {shapes} of floats")
    return net


def save_net(path: Path, net: ActuatorNet) -> None:
    """Write nets as one `.npz`: weights plus a JSON header."""
    with whole_file(path) as file:
        np.savez(file, **net_arrays(net))


def load_net(path: Path) -> ActuatorNet:
    """Read nets that `save_net` wrote; ValueError as in `net_from_arrays`."""
    return net_from_arrays(path, load_arrays(path))
