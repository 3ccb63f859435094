"""Programs of torch.export compute the same numbers as the model, for any batch, and contain its parameters."""

import io

import torch
from exported_runs import arm_of, moved_model
from safetensors.torch import load

from spelgen.exporting.export import export


def test_programs_are_self_contained():
    """The check at export time compares every program with the model; here a batch of another size."""
    model = moved_model("two_link", "phnode")  # whose M and G are networks of all joints: every preset goes
    found = export(model, "torch", arm=arm_of("two_link"))
    program = torch.export.load(io.BytesIO(found.files["forward_dynamics.pt2"])).module()
    states = [torch.randn(7, model.n, dtype=torch.float64) for _ in range(3)]
    torch.testing.assert_close(program(*states), model.forward_dynamics(*states))
    weights = load(found.files["model.safetensors"])
    assert weights.keys() == model.state_dict().keys()
    assert len(found.files["README.md"].decode().splitlines()) == 5
