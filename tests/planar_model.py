"""A planar two-joint arm: a hand-written model of it, and the module that is built from its URDF."""

from pathlib import Path
from typing import NamedTuple

import torch
from torch import nn

from spelgen.emission.specify import generate
from spelgen.runtime import Joint, PortHamiltonian

JOINTS = ("shoulder", "elbow")
LINK = """<link name="{name}"><inertial><origin xyz="0 0 -0.5"/><mass value="{mass}"/>
<inertia ixx="0.1" iyy="0.1" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
JOINT = """<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/><axis xyz="0 1 0"/>
<origin xyz="0 0 {z}"/><limit lower="-3" upper="3" effort="10" velocity="5"/></joint>"""
URDF = "".join(
    [
        '<robot name="planar"><link name="base"/>',
        LINK.format(name="upper", mass=1.5),
        LINK.format(name="lower", mass=1.0),
        JOINT.format(name="shoulder", parent="base", child="upper", z=0),
        JOINT.format(name="elbow", parent="upper", child="lower", z=-1),
        "</robot>",
    ]
)


def write_module(folder: Path, name: str = "module.py") -> Path:
    """Write the emitted module of the planar arm, with the smallest networks, and delete its URDF; return the path."""
    urdf = folder / "planar.urdf"
    urdf.write_text(URDF, encoding="utf-8")
    (folder / name).write_text(generate(urdf, "minimal", width=4, depth=1), encoding="utf-8")
    urdf.unlink()
    return folder / name


class Configuration(NamedTuple):
    """Configuration cache of the model: q (..., 2) and M (..., 2, 2)."""

    q: torch.Tensor
    mass: torch.Tensor


class Damping(nn.Module):
    """Viscous friction of both joints; its parameters are the logarithms of the coefficients."""

    def __init__(self) -> None:
        super().__init__()
        self.nominal = nn.Buffer(torch.ones(2, dtype=torch.float64))
        self.log = nn.Parameter(torch.full((2,), -2.0, dtype=torch.float64))


class Model(PortHamiltonian):
    """A user's own model of a planar arm: 7 parameters, no specification.

    M = [[a + 2 b cos q2, d + b cos q2], [d + b cos q2, d]], gravity of both links, and viscous friction.
    a = d + b^2 / d + e keeps M positive definite.
    """

    def __init__(self, seed: int = 0) -> None:
        super().__init__([Joint(name, "revolute", -3.0, 3.0, 5.0, 1.0, 0.0) for name in JOINTS])
        generator = torch.Generator().manual_seed(seed)
        noise = 0.01 * torch.randn(5, generator=generator, dtype=torch.float64)
        # initial values of b, log d and log e, with the symbols of M in the docstring of the class
        self.inertia = nn.Parameter(torch.tensor([0.5, 0.0, 0.0], dtype=torch.float64) + noise[:3])
        self.weight = nn.Parameter(noise[3:].clone())
        self.friction = Damping()

    def prepare(self) -> None:
        """Return None in place of a parameter cache, since nothing can be precomputed."""

    def configuration(self, q: torch.Tensor, prepared: None) -> Configuration:
        b, d = self.inertia[0], self.inertia[1].exp()
        product = b * q[..., 1].cos()
        m11, m12 = d + b**2 / d + self.inertia[2].exp() + 2 * product, d + product
        mass = torch.stack([m11, m12, m12, d.expand(m12.shape)], -1).unflatten(-1, (2, 2))
        return Configuration(q, mass)

    def potential_energy(self, q: torch.Tensor | Configuration) -> torch.Tensor:
        return -(self.weight * self.at(q).q.cumsum(-1).cos()).sum(-1)

    def gravity(self, q: torch.Tensor | Configuration) -> torch.Tensor:
        torque = self.weight * self.at(q).q.cumsum(-1).sin()
        return torque.flip(-1).cumsum(-1).flip(-1)

    def lagrangian_gradient(self, at: Configuration, qd: torch.Tensor) -> torch.Tensor:
        first, second = qd.unbind(-1)
        kinetic = -self.inertia[0] * at.q[..., 1].sin() * first * (first + second)
        return torch.stack([torch.zeros_like(kinetic), kinetic], -1) - self.gravity(at)

    def nonlinear_effects(self, q: torch.Tensor | Configuration, qd: torch.Tensor) -> torch.Tensor:
        at = self.at(q)
        rate = -self.inertia[0] * at.q[..., 1].sin() * qd[..., 1]
        mass_rate = torch.stack([2 * rate, rate, rate, torch.zeros_like(rate)], -1).unflatten(-1, (2, 2))
        return (mass_rate @ qd.unsqueeze(-1)).squeeze(-1) - self.lagrangian_gradient(at, qd)

    def friction_torque(
        self, q: torch.Tensor | Configuration, qd: torch.Tensor, *state: None
    ) -> torch.Tensor:
        return self.friction.log.exp() * qd


def true_model() -> Model:
    """Return the model that simulates the logs; its parameters differ from the initial parameters of `Model`."""
    model = Model()
    with torch.no_grad():
        model.inertia.copy_(torch.tensor([0.4, -0.5, -1.0]))
        model.weight.copy_(torch.tensor([3.0, 1.0]))
        model.friction.log.copy_(torch.tensor([-1.5, -2.5]))
    return model.requires_grad_(False)
