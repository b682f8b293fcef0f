"""The ONNX file of a policy: another program computes the same actions."""

from __future__ import annotations

import json
import sys

import numpy as np
import pytest

from brokk_min.identification.files import SHIPPED
from brokk_min.learning.onnx import export_onnx
from brokk_min.learning.policy import load_policy
from brokk_min.machine import BROKK_170

POLICY = load_policy(SHIPPED / "brokk170" / "policy.npz", BROKK_170)


def test_export_onnx__gives_the_same_actions_elsewhere(tmp_path):
    runtime = pytest.importorskip("onnxruntime")
    export_onnx(tmp_path / "p.onnx", POLICY)
    session = runtime.InferenceSession(tmp_path / "p.onnx")
    obs = np.random.default_rng(0).normal(size=(7, 171)).astype(np.float32)
    (action,) = session.run(["action"], {"observation": obs})
    np.testing.assert_allclose(action, POLICY.act(obs), atol=1e-4)
    texts = session.get_modelmeta().custom_metadata_map
    metadata = {name: json.loads(text) for name, text in texts.items()}
    assert metadata["machine"] == "brokk170"
    assert (metadata["ramp"], metadata["stand_s"]) == (0.01, 2.0)
    np.testing.assert_allclose(metadata["mean"], POLICY.mean)
    np.testing.assert_allclose(metadata["scale"], POLICY.scale)


def test_export_onnx__names_the_missing_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(ValueError, match=r"onnx: expected the extra brokk_min\[export\], got"):
        export_onnx(tmp_path / "p.onnx", POLICY)
