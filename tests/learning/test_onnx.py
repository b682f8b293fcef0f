"""An exported policy before onnxruntime, which nobody here wrote."""

import json

import numpy as np
import pytest

from brokk_min.actuator import INDICATOR_SCALE, REST_AFTER
from brokk_min.env import COMPENSATION, observation_scale
from brokk_min.identification.files import SHIPPED
from brokk_min.learning.onnx import export_onnx
from brokk_min.learning.policy import contract, load_policy
from brokk_min.machine import BROKK_170


@pytest.fixture(scope="module")
def policy():
    return load_policy(SHIPPED / "brokk170" / "policy.npz", BROKK_170)


@pytest.mark.parametrize("batch", [1, 256])
def test_export_onnx__computes_the_actions_of_the_policy(batch, policy, tmp_path):
    onnxruntime = pytest.importorskip("onnxruntime")
    export_onnx(tmp_path / "p.onnx", policy, BROKK_170)
    session = onnxruntime.InferenceSession(tmp_path / "p.onnx", providers=["CPUExecutionProvider"])
    rng = np.random.default_rng(2)
    obs = rng.normal(0, 1.5, (batch, 223)).astype(np.float32)
    (action,) = session.run(None, {"observation": obs})
    assert np.abs(action - policy.act(obs)).max() < 1e-5
    assert np.abs(action).max() > 0.3
    ends = [(e.name, e.shape, e.type) for e in (*session.get_inputs(), *session.get_outputs())]
    sizes = {"observation": 223, "action": 4}
    assert ends == [(name, ["batch", size], "tensor(float)") for name, size in sizes.items()]


def test_export_onnx__is_one_file_with_what_the_other_program_needs(policy, tmp_path):
    onnx = pytest.importorskip("onnx")
    export_onnx(tmp_path / "p.onnx", policy, BROKK_170)
    model = onnx.load(tmp_path / "p.onnx")
    assert not [tensor for tensor in model.graph.initializer if tensor.external_data]
    assert [node.op_type for node in model.graph.node] == ["Gemm", "Elu"] * 3 + ["Gemm"]
    assert model.ir_version == 8
    assert [(o.domain, o.version) for o in model.opset_import] == [("", 17)]
    metadata = {prop.key: json.loads(prop.value) for prop in model.metadata_props}
    scales = [np.float32(metadata.pop(name)) for name in ("mean", "scale")]
    np.testing.assert_array_equal(scales, observation_scale(BROKK_170))
    assert metadata.pop("indicator_scale") == INDICATOR_SCALE
    assert (metadata.pop("ramp"), metadata.pop("rest_s")) == (COMPENSATION, REST_AFTER["closed"])
    assert (metadata.pop("rest_opening"), metadata.pop("rest_zones")) == (0, [[0.07, 0.07]] * 5)
    assert metadata == contract(BROKK_170, paper=False)
    assert metadata["driven"] == ["q1", "q3", "q4", "q5"] and metadata["rate"] == 20.0
