"""Programs of torch.export compute the same numbers as the model, for any batch, and contain its parameters."""

import io

import pytest
import torch
from exported_runs import arm_of, moved_model, readme_results
from safetensors.torch import load

from spelgen.dynamics.tip import tip_kinematics
from spelgen.exporting.export import export


def test_programs_are_self_contained():
    """Exported programs contain their parameters, and equal the model for another batch size than at the export."""
    # phnode's M and G are networks of all joints: the preset that is hardest to trace
    model = moved_model("two_link", "phnode")
    found = export(model, "torch", arm=arm_of("two_link"), entries=("forward_dynamics",))
    program = torch.export.load(io.BytesIO(found.files["forward_dynamics.pt2"])).module()
    states = [torch.randn(7, model.n, dtype=torch.float64) for _ in range(3)]
    torch.testing.assert_close(program(*states), model.forward_dynamics(*states))
    weights = load(found.files["model.safetensors"])
    assert weights.keys() == model.state_dict().keys()


@pytest.mark.parametrize("float32", [False, True])
def test_the_lines_of_the_readme_run(tmp_path, float32):
    """The Python example of the exported README runs; its friction states and results equal the model's.

    This holds in single precision, too.
    """
    model, arm = moved_model("two_link", "closed-form"), arm_of("two_link")
    used = ("inverse_dynamics", "forward_dynamics", "friction_step", "friction_memory", "tip_jacobian")
    found = export(model, "torch", arm=arm, entries=used if float32 else (), float32=float32)
    names, at = readme_results(found.files, tmp_path), torch.ones(5, model.n, dtype=torch.float64)
    z = model.memory(at)
    tau = model.inverse_dynamics(at, at, at, z)
    expected = {"tau": tau, "qdd": model.forward_dynamics(at, at, tau, z), "z": model.memory_after(z, at)}
    expected["jacobian"] = tip_kinematics(arm).jacobian(at)
    for key, value in expected.items():
        assert names[key].dtype == (torch.float32 if float32 else torch.float64)
        torch.testing.assert_close(
            names[key].double(), value, rtol=1e-4 if float32 else 1e-10, atol=1e-5 * float32
        )
    assert f"the tip is the link {tip_kinematics(arm).link};" in found.files["README.md"].decode()
