"""ONNX Runtime gives what the model gives, at any batch size."""

import numpy as np
import onnx
import pytest
import torch
from exported_runs import COUPLED, MOTORS, arm_of, moved_model

from spelgen.building import build
from spelgen.exporting.export import export
from spelgen.exporting.onnx_export import onnx_session
from spelgen.loaded_arm import load_arm


@pytest.mark.parametrize("preset", ["closed-form", "hybrid"])
@pytest.mark.parametrize("robot", ["rpr", "scara", "ur10e"])
def test_onnx_gives_what_the_model_gives(robot, preset):
    """The check at export time compares every file with the model to 1e-10; here another batch size, by hand."""
    model = moved_model(robot, preset)
    found = export(model, "onnx", arm=arm_of(robot))
    session = onnx_session(found.files["gravity.onnx"])
    q = torch.linspace(-1, 1, 7 * model.n, dtype=torch.float64).reshape(7, model.n)
    (gravity,) = session.run(["gravity"], {"q": q.numpy()})
    np.testing.assert_allclose(gravity, model.gravity(q).numpy(), rtol=1e-9, atol=1e-9)
    assert len(found.files["README.md"].decode().splitlines()) == 5


@pytest.mark.parametrize("preset", ["closed-form", "hybrid"])
def test_followers_motors_and_passive_joints_go_along(preset, tmp_path):
    urdf = tmp_path / "coupled.urdf"
    urdf.write_text(COUPLED)
    urdf.with_suffix(".yaml").write_text(MOTORS)
    arm = load_arm(urdf)
    model = build(arm, preset)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter += 0.1
        model.raw_friction_compensation += 0.3
    assert "from the torch module" in export(model, "onnx", arm=arm).summary[0]


def test_the_file_tells_every_reader_how_matrices_are_inverted():
    """ONNX Runtime takes its own inverse; under another name it takes the one that stands in the file."""
    model = moved_model("ur10e", "closed-form")
    own = onnx.load_from_string(export(model, "onnx", arm=arm_of("ur10e")).files["forward_dynamics.onnx"])
    told = onnx.load_from_string(own.SerializeToString())
    told.functions[0].domain = told.opset_import[1].domain = "test"
    for node in told.graph.node:
        node.domain = "test" if node.op_type == "Inverse" else node.domain
    draw = np.random.default_rng(0)
    states = {name: draw.normal(size=(5, model.n)) for name in ("q", "qd", "tau")}
    states["z"] = np.zeros((5, 4 * model.n))
    first, second = (onnx_session(each.SerializeToString()).run(None, states)[0] for each in (own, told))
    np.testing.assert_allclose(first, second, rtol=1e-10)
