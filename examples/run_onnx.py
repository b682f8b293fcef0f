"""A policy without this package: NumPy and onnxruntime alone drive a toy plant at 20 Hz.

Run it as `python run_onnx.py FILE.onnx`, with what `brokk-min export` made of a policy of
`brokk-min train --paper`. It drives until Ctrl-C.
"""

import json
import signal
import sys
import time

import numpy as np
import onnxruntime


def load(path):
    """The net of a file and what the file tells of it."""
    try:
        net = onnxruntime.InferenceSession(path)
    except Exception as error:  # onnxruntime has one for each cause
        sys.exit(f"{path}: expected a file of brokk-min export, got: {error}")
    told = {k: json.loads(text) for k, text in net.get_modelmeta().custom_metadata_map.items()}
    if told.get("interface") != "paper":
        sys.exit(f"{path}: expected a policy of train --paper, got {told.get('interface')}")
    return net, told


def tool_position(geometry, q):
    """Position of the tool [m] (3,), by T = Rz(theta) Tz(d) Tx(a) Rx(alpha) of each joint."""
    (x, y, z), p = np.eye(3), np.zeros(3)
    for (a, alpha, d, theta, *_, kind), q_i in zip(geometry, q):
        theta, d = (theta, d + q_i) if kind == "prismatic" else (theta + q_i, d)
        x, y = np.cos(theta) * x + np.sin(theta) * y, np.cos(theta) * y - np.sin(theta) * x
        p = p + d * z + a * x
        y, z = np.cos(alpha) * y + np.sin(alpha) * z, np.cos(alpha) * z - np.sin(alpha) * y
    return p


def tick(net, told, h, q, u, v_goal):
    """History (n, 3, H) of q, q_dot, u, once `u` led to `q`; the next u (n,) of full command."""
    h = np.roll(h, -1, axis=2)  # the newest is last
    h[:, 0, -1], h[:, 2, -1] = q, u
    t = np.arange(samples := told["velocity_samples"]) / told["rate"]
    h[:, 1, -1] = np.polyfit(t, h[:, 0, -samples:].T, 1)[0]  # slope of the newest angles
    v_tool = tool_position(told["geometry"], q + 1e-20j * h[:, 1, -1]).imag / 1e-20  # J q_dot
    driven = np.isin(told["joints"], told["driven"])
    x = np.concatenate([v_goal, v_tool, q[~driven], h[driven, :2].ravel(), h[driven, 2].ravel()])
    x = np.float32((x - told["mean"]) / told["scale"])
    action = net.run(None, {"observation": x[None]})[0][0].clip(-1, 1)
    u = np.zeros(len(q))  # locked joints have 0
    u[driven] = np.rint(told["pwm_limit"] * action) / 127
    return h, u


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C ends it without a word
    net, told = load(sys.argv[1])
    q = np.array([(low + high) / 2 for *_, low, high, _ in told["geometry"]])  # rad
    u, dt = 0 * q, 1 / told["rate"]
    h = np.stack([q, u, u], axis=1)[..., None].repeat(told["history"], axis=2)
    while True:  # the toy plant has joints that turn at 0.5 u rad/s
        h, u = tick(net, told, h, q, u, np.array([0.0, 0.0, 0.1]))  # up at 0.1 m/s
        q = q + dt * 0.5 * u
        print(f"u {u.round(2)} of full command, q {q.round(3)} rad", flush=True)
        time.sleep(dt - time.monotonic() % dt)
