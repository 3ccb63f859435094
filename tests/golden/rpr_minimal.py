r"""Port-Hamiltonian model of an arm with 3 joints, written by `spelgen build`.

3 learned functions of q and 2 constants make the mass matrix.
The potential energy depends on joint 3.
Sizes and starting values are the URDF's inertials.

Mass matrix: the joints each entry depends on, C where it is constant, . where it is always zero.

    2,3
    3    C
    2,3  .    C

Joints, in the order of q, qd and tau:

    1  "joint1"  revolute   rad, Nm  -2.96706 .. 2.96706
    2  "joint2"  prismatic  m, N     0.305 .. 1.27
    3  "joint3"  revolute   rad, Nm  -2.96706 .. 2.96706
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

FACTS = r"""{"format": 8, "robot": "rpr", "urdf": "rpr.urdf",
 "urdf_sha256": "aaacb65e5fa6a4caf626114ddf8869514f479b568dae43957e41214d3c6eff8d",
 "spec_sha256": "384ed242bd2040abcdccace69da8158a5b571533f36ae4dc3d68b08e30214e9b",
 "options": {"angle_tolerance": 0.002, "assume": "kinematics", "depth": 2, "design": null, "joints": null,
  "preset": "minimal", "tip": null, "width": 64},
 "joints": {"joint1": "revolute", "joint2": "prismatic", "joint3": "revolute"}}"""


# ---- this arm; `Model`, at the end of the file, is made of these parts ----


def mass_entries(f: Sequence[Tensor], c: Sequence[Tensor]) -> Tensor:
    """Return M without armature, (..., n, n), by its functions f(q) and its constants c."""
    # f1(q3), f2(q2,3), f3(q2,3)
    f1, f2, f3 = f
    c1, c2 = c
    return symmetric([f3], [f1, c2], [f2, 0, c1])


def make_parts(seed: int) -> tuple[Joints, Mass, Network, float, Friction]:
    """Return what this arm's `Model` is made of, with random weights of this seed."""
    joints = Joints(
        revolute=(True, False, True), center=(0.0, 0.7875, 0.0), reach=(2.96706, 0.4825, 2.96706),
        speed=(3.0, 1.0, 6.0), friction=(0.4, 0.4, 0.4), armature=(2.19, 0.782, 0.106),
    )  # fmt: skip
    generator = torch.Generator().manual_seed(seed)
    network = Network(
        generator, ((0.02, 1.0, 0.518), (0.02, 1.0, 0.518)), hidden=(((2,), 21), ((1, 2), 43)),
        outputs=(((2,), 1), ((1, 2), 2)),
    )  # fmt: skip
    mass = Mass(
        joints, mass_entries,
        functions=((-0.00167665, 1.36528), (-0.00154309, 0.0595527), (139.887, 12.6351)),
        constants=((0.0101411, 0.0101411), (5.33, 5.33)), net=network, margin=0.08,
    )  # fmt: skip
    potential = Network(
        generator, ((0.02, 0.02, 1.0), (0.02, 0.02, 1.0)), hidden=(((2,), 32),), outputs=(((2,), 1),)
    )
    network = Network(
        generator, ((0.1, 0.1, 0.1), (0.1, 0.1, 0.1), (0.3333, 1.0, 0.1667), (1.0, 1.0, 1.0)),
        hidden=(((0,), 8), ((1,), 8), ((2,), 8)), outputs=(((0,), 1), ((1,), 1), ((2,), 1)), depth=1,
    )  # fmt: skip
    friction = Friction(joints, network)
    return (joints, mass, potential, 0.703291, friction)


class Model(NetworkDynamics):
    """The arm's dynamics: 3 learned functions of q and 2 constants make the mass matrix."""

    n = 3
    joint_names = ("joint1", "joint2", "joint3")
    joint_types = ("revolute", "prismatic", "revolute")

    def __init__(self, seed: int = 0, dtype: torch.dtype = torch.float64) -> None:
        super().__init__(*make_parts(seed))
        self.to(dtype)

    @property
    def armature(self) -> Tensor:
        """Armature, the drives' part of M's diagonal, (n,) [kg m^2, kg]."""
        return self.mass.armature()

    @property
    def viscous(self) -> Tensor:
        """Friction torque by velocity, (n,) [Nm s/rad, N s/m]."""
        return self.friction.viscous()
