"""ONNX Runtime computes the same numbers as the torch model, for any batch size."""

import functools
import logging

import numpy as np
import onnx
import pytest
import torch
from exported_runs import COUPLED, MOTORS, arm_of, moved_model, readme_results
from onnxscript.values import TracedOnnxFunction
from torch.onnx._internal.exporter._registration import ONNXRegistry

from spelgen.arm.configured_arm import load_arm
from spelgen.dynamics.tip import tip_kinematics
from spelgen.emission.build import build
from spelgen.errors import RunError
from spelgen.exporting.describe import Trained
from spelgen.exporting.export import export
from spelgen.exporting.onnx_export import called_by_onnx, onnx_model, onnx_session
from spelgen.exporting.parity import check_parity

# entries that other entries contain are omitted: mass_matrix, bias and friction are in forward_dynamics
ENTRIES = (
    *("inverse_dynamics", "forward_dynamics", "gravity"),
    *("friction_step", "friction_memory", "tip_pose"),
)


@pytest.fixture(scope="module", autouse=True)
def functions_parsed_once():
    """Cache the list of torch's 500 ONNX operator functions and their parsed code, to save time.

    Without the cache, torch lists and parses them again for each exported file, which takes nearly a second.
    """
    parsed = property(functools.cache(TracedOnnxFunction.function_ir.fget))
    listed = staticmethod(functools.cache(ONNXRegistry.from_torchlib))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(TracedOnnxFunction, "function_ir", parsed)
        patch.setattr(ONNXRegistry, "from_torchlib", listed)
        yield


@pytest.fixture(scope="module")
def coupled(tmp_path_factory):
    """Return a hybrid model with random parameters and its arm: mimic joint, coupled motors and a passive joint."""
    urdf = tmp_path_factory.mktemp("coupled") / "coupled.urdf"
    urdf.write_text(COUPLED)
    urdf.with_suffix(".yaml").write_text(MOTORS)
    arm = load_arm(urdf)
    model = build(arm, "hybrid")
    with torch.no_grad():
        for parameter in model.parameters():
            parameter += 0.1
        model.raw_friction_compensation += 0.3
    return model.requires_grad_(False), arm


@pytest.fixture(scope="module")
def exported(coupled):
    """Return the ONNX export of the arm `coupled`, which the export has compared with the model to 1e-10."""
    model, arm = coupled
    return export(model, "onnx", arm=arm, entries=ENTRIES)


def test_onnx_equals_the_model(coupled, exported, tmp_path):
    """ONNX Runtime equals the model for another batch size than the export's own check."""
    model, arm = coupled
    assert "from the torch module" in exported.summary[0]
    session = onnx_session(exported.files["gravity.onnx"])
    q = torch.linspace(-1, 1, 7 * model.n, dtype=torch.float64).reshape(7, model.n)
    (gravity,) = session.run(["gravity"], {"q": q.numpy()})
    np.testing.assert_allclose(gravity, model.gravity(q).numpy(), rtol=1e-9, atol=1e-9)
    check_readme(exported, model, arm, tmp_path, 1e-9)


def check_readme(found, model, arm, folder, tolerance):
    """Run the Python example of the exported README; its friction states and results must equal the model's."""
    names = readme_results(found.files, folder)
    at = torch.ones(5, model.n, dtype=torch.float64)
    past = [model.memory(at)]
    tau, expected, tip = at, {}, tip_kinematics(arm)
    if "inverse_dynamics.onnx" in found.files:
        tau = expected["tau"] = model.inverse_dynamics(at, at, at, *past)
        expected["pose"] = tip.pose(at)
    else:
        expected["jacobian"] = tip.jacobian(at)
    expected["qdd"] = model.forward_dynamics(at, at, tau, *past)
    expected["z"] = model.memory_after(past[0], at)
    for key, value in expected.items():
        scale = value.abs().max()
        np.testing.assert_allclose(names[key].reshape(value.shape) / scale, value / scale, atol=tolerance)
    assert f"the tip is the link {tip.link};" in found.files["README.md"].decode()


def test_onnx_in_single_precision(tmp_path):
    arm, model = arm_of("two_link"), moved_model("two_link", "closed-form")
    used = ("forward_dynamics", "friction_step", "friction_memory", "tip_jacobian")
    found = export(model, "onnx", arm=arm, entries=used, float32=True)
    graph = onnx.load_from_string(found.files["forward_dynamics.onnx"]).graph
    assert {x.type.tensor_type.elem_type for x in [*graph.input, *graph.output]} == {onnx.TensorProto.FLOAT}
    assert {x.data_type for x in graph.initializer} <= {onnx.TensorProto.FLOAT, onnx.TensorProto.INT64}
    check_readme(found, model, arm, tmp_path, 1e-4)
    with pytest.raises(
        RunError, match="got float32 for --to c, expected --to onnx and torch; C has -DNAME_FLOAT"
    ):
        export(model, "c", arm=arm, float32=True)


def test_the_files_are_plain_onnx_of_equal_bytes(coupled, exported):
    """ONNX files have standard operators only, and no metadata of this machine; a second export has the same bytes."""
    files = {name: content for name, content in exported.files.items() if name.endswith(".onnx")}
    assert files["gravity.onnx"] == onnx_model(coupled[0].prepared(), "gravity")
    for content in files.values():
        graph = onnx.load_from_string(content)
        onnx.checker.check_model(graph)
        assert {node.domain for node in graph.graph.node} == {""}
        assert not any(node.metadata_props for node in graph.graph.node)
    assert logging.getLogger("torch.onnx").level == logging.NOTSET
    inputs = onnx.load_from_string(files["forward_dynamics.onnx"]).graph.input
    shapes = {x.name: len(x.type.tensor_type.shape.dim) for x in inputs}
    assert shapes == {"q": 2, "qd": 2, "tau": 2, "z": 3}


@pytest.mark.parametrize("preset", ["spel", "minimal", "spel-kan", "phnode"])
def test_networks_are_exported_to_onnx(preset):
    """Presets of networks, which C and CasADi exports refuse, are exported to ONNX with all parts of the model."""
    trained = Trained(moved_model("two_link", preset), arm_of("two_link"))
    files = {"forward_dynamics": onnx_model(trained.model.prepared(), "forward_dynamics")}
    check_parity(called_by_onnx(files), trained, list(files), 1e-10)
    large = [x.raw_data for x in onnx.load_from_string(*files.values()).graph.initializer if x.raw_data[512:]]
    assert len(large) == len({bytes(sorted(x)) for x in large}), "the same weights, or their transpose, twice"
