"""Derivatives of many states at once: which of torch's ways are right, and which one of torch itself is not."""

import pytest
import torch
from emitted import random_model
from torch.func import jacfwd, jacrev, vmap


def drawn(*shape: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    return torch.randn(*shape, dtype=torch.float64, generator=generator)


@pytest.mark.parametrize("preset", ["closed-form", "hybrid", "phnode"])
def test_each_states_jacobian_is_its_own(preset, tmp_path):
    model = random_model("rpr", tmp_path, seed=0, preset=preset).requires_grad_(False)
    states = tuple(0.3 * drawn(3, 4, 3))
    for function, ways in (
        (model.forward_dynamics, (jacrev,)),
        (model.inverse_dynamics, (jacrev, jacfwd)),
    ):
        alone = torch.stack([jacfwd(function)(*state) for state in zip(*states, strict=True)])
        for way in ways:
            torch.testing.assert_close(vmap(way(function))(*states), alone, rtol=1e-8, atol=1e-8)


@pytest.mark.xfail(
    reason="torch 2.13: when this passes, docs/model.md and PreparedModel.linearize can forget it"
)
def test_torch_differentiates_a_solution_forward_under_vmap():
    def solution(q: torch.Tensor) -> torch.Tensor:
        return torch.linalg.solve(torch.diag(2 + q.cos()) + torch.outer(q, q), q.unsqueeze(-1)).squeeze(-1)

    q = drawn(4, 3)
    alone = torch.stack([jacfwd(solution)(each) for each in q])
    torch.testing.assert_close(vmap(jacfwd(solution))(q), alone)
