"""A prepared model (with precomputed constants of its parameters) has the same results as the model.

Its derivatives equal finite differences, and its integration steps converge with order four.
"""

import numpy as np
import pytest
import torch
from exported_runs import arm_of, moved_model

from spelgen.dynamics.protocol import residual_terms
from spelgen.dynamics.tip import tip_kinematics
from spelgen.emission.build import build


@pytest.fixture(scope="module", params=["closed-form", "hybrid", "spel"])
def pair(request):
    model = moved_model("rpr", request.param)
    return model, model.prepared(tip_kinematics(arm_of("rpr")))


def states(*shape):
    random = torch.Generator().manual_seed(1)
    return [0.4 * torch.randn(*shape, 3, generator=random, dtype=torch.float64) for _ in range(3)]


def test_a_prepared_model_equals_its_model(pair):
    model, prepared = pair
    q, qd, x = states(4, 2)
    same = [
        (prepared.mass_matrix(q), model.mass_matrix(q)),
        (prepared.gravity(q), model.gravity(q)),
        (prepared.bias(q, qd), model.nonlinear_effects(q, qd)),
        (prepared.friction_torque(q, qd), model.friction_torque(q, qd)),
        (prepared.forward_dynamics(q, qd, x), model.forward_dynamics(q, qd, x)),
        (prepared.inverse_dynamics(q, qd, x), model.inverse_dynamics(q, qd, x)),
    ]
    for found, expected in same:
        torch.testing.assert_close(found, expected)


def test_later_training_does_not_change_it(pair):
    model, prepared = pair
    q, qd, x = states()
    before = prepared.inverse_dynamics(q, qd, x)
    kept = [parameter.clone() for parameter in model.parameters()]
    for parameter in model.parameters():
        parameter += 0.3
    assert torch.equal(prepared.inverse_dynamics(q, qd, x), before)
    assert not torch.allclose(model.inverse_dynamics(q, qd, x), before)
    for parameter, old in zip(model.parameters(), kept, strict=True):
        parameter.copy_(old)


def test_momentum_rate_is_the_derivative_of_momentum(pair):
    _, prepared = pair
    q, qd, tau = states(4)
    qdd, h = prepared.forward_dynamics(q, qd, tau), 1e-6
    ahead, behind = (prepared.momentum(q + s * h * qd, qd + s * h * qdd) for s in (1, -1))
    torch.testing.assert_close(
        prepared.momentum_rate(q, qd, tau), (ahead - behind) / (2 * h), rtol=1e-5, atol=1e-6
    )


def test_linearize_is_the_derivative_of_rate_and_step(pair):
    _, prepared = pair
    given = torch.cat(states(3), dim=-1)  # inputs of the derivative: q, qd, tau
    z = prepared.memory(given[..., 3:6])

    def rate(x):
        q, qd, tau = x.chunk(3, dim=-1)
        return torch.cat([qd, prepared.forward_dynamics(q, qd, tau, z)], dim=-1)

    def step(x):
        return torch.cat(prepared.step(*x.chunk(3, dim=-1), 0.01, z)[:2], dim=-1)

    for function, dt in ((rate, None), (step, 0.01)):
        found = torch.cat(prepared.linearize(*given.chunk(3, dim=-1), dt, z), dim=-1)
        assert found.shape == (3, 6, 9)
        for k, unit in enumerate(1e-6 * torch.eye(9, dtype=torch.float64)):
            slope = (function(given + unit) - function(given - unit)) / 2e-6
            torch.testing.assert_close(found[..., k], slope, rtol=1e-4, atol=1e-5)


def test_linearization_of_a_batch_is_the_same_without_autograd_and_when_compiled(pair):
    _, prepared = pair
    inputs = states(4)
    expected = prepared.linearize(*inputs)
    for modes, model in (
        (torch.no_grad(), prepared),
        (torch.inference_mode(), prepared),
        (torch.enable_grad(), prepared.compile()),
    ):
        with modes:
            torch.testing.assert_close(model.linearize(*inputs), expected)


def test_rollout_is_steps_and_converges_to_the_fourth_order():
    prepared = moved_model("two_link", "closed-form").prepared()
    q, qd = (
        torch.tensor([0.3, -0.5]).double(),
        torch.tensor([2.0, 1.5]).double(),
    )  # initial velocities at which friction is smooth
    tau = torch.zeros(4, 2, dtype=torch.float64)
    found = prepared.rollout(q, qd, tau, 0.01)
    assert found.q.shape == found.qd.shape == (5, 2)
    fine = prepared.rollout(q, qd, tau, 0.01, substeps=64).q[-1]
    errors = [
        float((prepared.rollout(q, qd, tau, 0.01, substeps=k).q[-1] - fine).abs().max()) for k in (1, 2)
    ]
    assert errors[1] < errors[0] / 8


def test_kinematics_of_the_tip(pair):
    _, prepared = pair
    q = states()[0]
    assert prepared.pose(q).shape == (4, 4)
    eps = 1e-5
    for k, unit in enumerate(torch.eye(3).double()):
        moved = (prepared.pose(q + eps * unit) - prepared.pose(q - eps * unit))[:3, 3] / (2 * eps)
        np.testing.assert_allclose(prepared.jacobian(q)[:3, k], moved, atol=1e-4)
    with pytest.raises(ValueError, match="no tip: give"):
        moved_model("two_link", "closed-form").prepared().pose(q[:2])


def test_zero_terms_are_removed():
    """If residual terms are zero, the prepared model of hybrid omits them, and the model itself is unchanged."""
    model = build(arm_of("rpr"), "hybrid").requires_grad_(False)
    q, qd, x = states(4)
    assert residual_terms(model.prepared().model) is None
    torch.testing.assert_close(model.prepared().forward_dynamics(q, qd, x), model.forward_dynamics(q, qd, x))
    model.residuals.raw_torque_splines[1] += 1.0
    assert model.prepared().model.residuals.mass is None
    assert model.residuals.mass is not None
    torch.testing.assert_close(model.prepared().forward_dynamics(q, qd, x), model.forward_dynamics(q, qd, x))
