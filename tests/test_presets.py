"""Each preset is the model of its paper; test_contracts.py has the properties that all presets share."""

import math
from dataclasses import replace
from pathlib import Path
from typing import get_args

import pytest
import torch
from emitted import (
    NETWORKS,
    bounded,
    built,
    frictionless,
    network_inputs,
    outputs_alone,
    random_model,
)
from lie_group import geodesic_distance, group_rates
from published_phnode import ByJvp, Published

from spelgen.arm.configured_arm import load_arm
from spelgen.design import Preset, load_design
from spelgen.emission.specify import make_spec
from spelgen.fitting.rollout import position_difference
from tests.lie_group import to_group

ROOT = Path(__file__).parents[1]
PRESETS = ["phnode", "spel", "spel-kan", "hybrid"]
KAN = replace(NETWORKS, net="kan")
ROBOTS = ("two_link", "rpr", "six_dof")
each_robot = pytest.mark.parametrize("robot", ROBOTS)


def states(n: int, count: int = 20) -> list[torch.Tensor]:
    """Return random q, qd, qdd and tau, (count, n) each."""
    generator = torch.Generator().manual_seed(0)
    return [1.5 * torch.randn(count, n, dtype=torch.float64, generator=generator) for _ in range(4)]


def near(ours: torch.Tensor, reference: torch.Tensor, bound: float = 1e-10) -> None:
    assert (ours - reference).abs().max() < bound * max(1.0, reference.abs().max().item())


def test_presets_are_the_files():
    files = {path.stem for path in (ROOT / "spelgen" / "presets").glob("*.yaml")}
    assert {name for name in get_args(Preset) if name in files} == files
    for name in files:
        assert make_spec(load_arm(ROOT / "robots" / "rpr.urdf"), name).design == load_design(name)


@pytest.mark.parametrize("robot", ["rpr", "six_dof", "panda"])
def test_kan_outputs_depend_only_on_their_own_joints(robot, tmp_path):
    model = random_model(robot, tmp_path, seed=2, design=KAN)
    outputs = built(robot)[1].outputs
    q = states(model.n)[0]
    network = model.mass.network
    before = outputs_alone(network, network_inputs(model, q))
    for joint in range(model.n):
        moved = q.clone()
        moved[:, joint] += 0.7
        changed = (outputs_alone(network, network_inputs(model, moved)) != before).any(dim=0)
        assert changed.tolist() == [joint in output.joints for output in outputs]


@pytest.mark.parametrize("preset", ["spel", "spel-kan"])
@each_robot
def test_spel_keeps_zeros_constants_and_relations(robot, preset, tmp_path):
    """M of spel has the zeros, constants and relations of the derived structure.

    Its networks depend on all joints, as in the paper (Wang, Chen and Ding, Sci Rep 15:33179, 2025).
    """
    model = random_model(robot, tmp_path, seed=1, preset=preset)
    for weight in model.mass.network.parameters():
        weight.data *= 0.5
    q = states(model.n, 100)[0] / 5
    assert not bounded(model, q).any(), "M was to be positive definite by itself"
    mass = model.mass_matrix(q).detach()
    for entry in built(robot)[1].entries:
        values = mass[:, entry.row, entry.column]
        assert entry.kind != "zero" or (values == 0).all()
        assert entry.kind != "constant" or (values - values[0]).abs().max() < 1e-12 * values[0].abs()
        assert entry.kind != "varying" or values.std() > 0


@pytest.mark.parametrize("part", ["mass.network", "potential", "input_network"])
@pytest.mark.parametrize("net", ["mlp", "kan"])
def test_networks_read_rotation_matrices(net, part, tmp_path):
    """Networks of phnode equal the networks of Wang, Chen and Ding (2025), computed here layer by layer.

    Their inputs are entries of the rotation matrix R (3, 3) of a revolute joint: cos q and sin q, without constant and
    repeated entries. For a prismatic joint they are the scaled position and 0. part: network; net: its type.
    """
    owner = random_model("rpr", tmp_path, seed=5, design=replace(load_design("phnode"), net=net))
    model, encoding = owner.get_submodule(part), owner.encoding
    q = states(3)[0]
    parts = to_group(owner.joint_types, q)
    slide = (parts[1][:, 2] - encoding.center[1]) * encoding.slope[1]
    turns = (parts[0], parts[2])
    cosines, sines = (torch.stack([x[:, k, 0] for x in turns], dim=-1) for k in (0, 1))
    layer = torch.stack([cosines[:, 0], slide, cosines[:, 1], sines[:, 0], 0 * slide, sines[:, 1]], dim=-1)
    count = len(model.weights)
    for index, (weight, level) in enumerate(zip(model.weights, model.biases, strict=True)):
        weight = weight * getattr(model, f"mask{index}")
        if net == "mlp":
            layer = layer @ weight.T + level
        else:
            grid = torch.linspace(-1, 1, weight.shape[-1], dtype=torch.float64)
            bumps = torch.exp(-(((layer.unsqueeze(-1) - grid) / (grid[1] - grid[0])) ** 2))
            layer = torch.einsum("big,oig->bo", bumps, weight) + level
        layer = torch.tanh(layer) if index < count - 1 else layer
    near(outputs_alone(model, network_inputs(owner, q)), layer)


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("robot", ["rpr", "six_dof"])
def test_reduced_model_is_the_port_hamiltonian_system_on_rotations(robot, preset, tmp_path):
    """The emitted module, with one axis per joint, equals the port-Hamiltonian system with three axes per joint.

    That system (lie_group.py) is eq. 15 and 18 of Wang, Chen and Ding (Sci Rep 15:33179, 2025) on rotation matrices,
    with automatic derivatives. Its velocities and forces about the two axes that the joint lacks are zero.
    """
    design = NETWORKS if preset == "hybrid" else None
    model = random_model(robot, tmp_path, seed=6, preset=preset, design=design)
    n = model.n
    q, p, _, tau = states(n)
    parts = to_group(model.joint_types, q)
    rates, forces = group_rates(model, parts, torch.nn.functional.pad(p.unsqueeze(-1), (2, 0)), tau)
    qd, force, _ = model(torch.zeros(()), torch.cat([q, p, tau], dim=-1)).chunk(3, dim=-1)
    near(forces[..., 2], force)
    assert forces[..., :2].abs().max() < 1e-12 * forces.abs().max()
    for i, (part, rate) in enumerate(zip(parts, rates, strict=True)):
        if model.joint_types[i] == "prismatic":
            near(rate, torch.nn.functional.pad(qd[:, i : i + 1], (2, 0)))
            continue
        spin = torch.zeros_like(part)
        spin[:, 1, 0], spin[:, 0, 1] = qd[:, i], -qd[:, i]
        near(rate, part @ spin)


@pytest.mark.parametrize("net", ["mlp", "kan"])
def test_phnode_is_its_three_axis_model_held_by_bearings(net, tmp_path):
    """phnode equals the three-axis model of Wang, Chen and Ding (2025) if each joint moves only along or about z.

    That model has H = 1/2 p^T M^-1 p + V with three momenta per joint, p (3 n,). For velocities only in z, as if
    bearings held the other axes, the z entries of p are the momenta of phnode, and -dH/dq are their rates.
    """
    model = frictionless(
        random_model("six_dof", tmp_path, seed=7, design=replace(load_design("phnode"), net=net))
    )
    n = model.n
    q, qd, _, _ = states(n)

    def inverse_mass(at: torch.Tensor) -> torch.Tensor:
        pose = model.at(at)
        return model.mass.inverse(pose.encoded, pose.parameters["mass"])

    inverse = inverse_mass(q).detach()
    assert torch.linalg.eigvalsh(inverse)[:, 0].min() > 0
    axes = torch.zeros(len(q), n, 3, dtype=torch.float64)
    axes[..., 2] = qd
    momenta = torch.linalg.solve(inverse, axes.flatten(-2).unsqueeze(-1))
    q.requires_grad_()
    kinetic = 0.5 * (momenta.mT @ inverse_mass(q) @ momenta).sum()
    (slope,) = torch.autograd.grad(kinetic + model.potential_energy(q).sum(), q)
    p = momenta.squeeze(-1)[:, 2::3]
    rate = model(torch.zeros(()), torch.cat([q, p], dim=-1))
    near(rate[..., :n], qd)
    near(rate[..., n:], -slope)


def test_geodesic_distance_is_the_angle_between():
    """The geodesic distance of rotations about one axis is the wrapped difference of their angles.

    It is exact for small angles, too.
    """
    angles = torch.tensor([1e-9, 1e-4, 0.5, 3.0, -3.0, math.pi - 1e-6, 7.0], dtype=torch.float64)
    zero, one = torch.zeros_like(angles), torch.ones_like(angles)
    c, s = angles.cos(), angles.sin()
    turned = torch.stack([c, -s, zero, s, c, zero, zero, zero, one], dim=-1).reshape(-1, 3, 3)
    wrapped = position_difference(angles.unsqueeze(-1), torch.zeros(len(angles), 1), ["revolute"])
    distance = geodesic_distance(torch.eye(3, dtype=torch.float64), turned)
    assert ((distance - wrapped.squeeze(-1).abs()).abs() < 1e-12 * (1 + distance)).all()
    hat = torch.tensor([[0, -0.3, 0.2], [0.3, 0, -0.1], [-0.2, 0.1, 0]], dtype=torch.float64)
    tilt = torch.linalg.matrix_exp(hat)
    angle = torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64).norm()
    near(geodesic_distance(turned, turned @ tilt), angle.expand(len(angles)), 1e-14)


def test_published_formulation_keeps_its_energy():
    """Without friction and input, the energy H of PHNODE in its published formulation is constant: dH/dt = 0."""
    torch.manual_seed(0)
    model = Published(2, 8, 8)
    for network in (model.dissipation.network, model.gains):
        torch.nn.init.zeros_(network[-1].weight)
        torch.nn.init.zeros_(network[-1].bias)
    rotation = torch.linalg.qr(torch.randn(5, 2, 3, 3, dtype=torch.float64))[0].flatten(1)
    zeta = torch.randn(5, 6, dtype=torch.float64)
    state = torch.cat([rotation, zeta], dim=-1)
    rate = model(state, torch.zeros(5, 2, dtype=torch.float64)).detach()

    def energy(x: torch.Tensor) -> torch.Tensor:
        inverse = model.inverse_mass(x[:, :18])
        speed = x[:, 18:].unsqueeze(-1)
        kinetic = 0.5 * (speed.mT @ torch.linalg.solve(inverse, speed)).flatten()
        return kinetic + model.potential(x[:, :18]).squeeze(-1)

    _, change = torch.func.jvp(energy, (state,), (rate,))
    assert change.abs().max() < 1e-12
    assert rate.abs().min() > 0


def test_one_jvp_equals_a_derivative_per_entry():
    torch.manual_seed(0)
    published, by_jvp = Published(2, 8, 4), ByJvp(2, 8, 4)
    by_jvp.load_state_dict(published.state_dict())
    state, tau = torch.randn(5, 24, dtype=torch.float64), torch.randn(5, 2, dtype=torch.float64)
    rates = [model(state.clone(), tau) for model in (published, by_jvp)]
    near(rates[1], rates[0], 1e-12)
    for rate in rates:
        rate.square().sum().backward()
    for (name, ours), reference in zip(by_jvp.named_parameters(), published.parameters(), strict=True):
        assert (ours.grad is None) == (reference.grad is None), name
        if ours.grad is not None:
            near(ours.grad, reference.grad, 1e-12)
