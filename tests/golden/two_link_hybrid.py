r"""Port-Hamiltonian model of an arm with 2 joints, written by `spelgen build`.

2 rigid bodies with trained inertial parameters;
residual networks, zero unless a fit selects them: 1 learned function of q and 2 constants in M.
The potential energy depends on joints 1,2.
Sizes and starting values are the URDF's inertials.

Mass matrix: the joints each entry depends on, C where it is constant, . where it is always zero.

    2
    2   C

Joints, in the order of q, qd and tau:

    1  "joint1"  revolute   rad, Nm  -3.14159 .. 3.14159
    2  "joint2"  revolute   rad, Nm  -3.14159 .. 3.14159
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

FACTS = r"""{"format": 8, "robot": "two_link", "urdf": "two_link.urdf",
 "urdf_sha256": "d5393c842e189b72219c5ce02e115de571a94cd406b48898ea64b5431a395232",
 "spec_sha256": "231d901ddafe1d0a943e789643a0f16797c6eb31653efc1ebba8377f99a82be3",
 "options": {"angle_tolerance": 0.002, "assume": "kinematics", "depth": 2, "design": null, "joints": null,
  "preset": "hybrid", "tip": null, "width": 64},
 "joints": {"joint1": "revolute", "joint2": "revolute"}}"""


# ---- this arm; `Model`, at the end of the file, is made of these parts ----


def mass_entries(f: Sequence[Tensor], c: Sequence[Tensor]) -> Tensor:
    """Return R, what M has beside rigid bodies, (..., n, n), by its functions f(q) and its constants c."""
    # f1(q2)
    (f1,) = f
    c1, c2 = c
    m11 = 2 * f1 + c2
    return symmetric([m11], [f1, c1])


def make_parts(seed: int) -> tuple[ResidualTerms, BodyChain, InertialParameters, FrictionLaws, Row]:
    """Return what this arm's `Model` is made of, with random weights of this seed."""
    joints = Joints(
        revolute=(True, True), center=(0.0, 0.0), reach=(3.14159, 3.14159), speed=(10.0, 10.0),
        friction=(1.0, 1.0), armature=(0.1, 0.1),
    )  # fmt: skip
    generator = torch.Generator().manual_seed(seed)
    network = Network(generator, ((0.02, 1.0), (0.02, 1.0)), hidden=(((1,), 64),), outputs=(((1,), 1),))
    potential = Network(
        generator, ((1.0, 0.307), (1.0, 0.307)), hidden=(((0, 1), 32),), outputs=(((0, 1), 1),)
    )
    residuals = ResidualTerms(
        joints, (1.0, 1.0), mass_entries, functions=1, constants=2, network=network, potential=potential,
        scale=10.8194,
    )  # fmt: skip
    chain = BodyChain(
        n=2, gravity=(0.0, -9.81, 0.0), parent=(-1, 0), joint=(0, 1), revolute=(True, True), ratio=(1.0, 1.0),
        offset=(0.0, 0.0),
        placement=(
            ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0)),
            ((1.0, 0.0, 0.0, 1.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0)),
        ),
    )  # fmt: skip
    bodies = InertialParameters(
        (0.75, 0.0, 0.0, 0.5, 0.5, 0.0, 0.0, 0.1, 0.0, 1.0),
        (0.75, 0.0, 0.0, 0.5, 0.5, 0.0, 0.0, 0.1, 0.0, 1.0),
    )  # fmt: skip
    friction = FrictionLaws(
        friction=joints.friction, speed=joints.speed,
        reach=((0.0001, 0.0004, 0.0016, 0.0064, 0.025, 0.1), (0.0001, 0.0004, 0.0016, 0.0064, 0.025, 0.1)),
    )  # fmt: skip
    return (residuals, chain, bodies, friction, joints.armature)


class Model(ResidualDynamics):
    """The arm's dynamics: 2 rigid bodies with trained inertial parameters, and residual networks."""

    n = 2
    joint_names = ("joint1", "joint2")
    joint_types = ("revolute", "revolute")

    def __init__(self, seed: int = 0, dtype: torch.dtype = torch.float64) -> None:
        super().__init__(*make_parts(seed))
        self.to(dtype)
