r"""Port-Hamiltonian model of an arm with 3 joints, written by `spelgen build`.

45 learned functions of q make M^-1 over all axes.
The potential energy depends on joints 1-3.
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

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

FACTS = r"""{"format": 8, "robot": "rpr", "urdf": "rpr.urdf",
 "urdf_sha256": "aaacb65e5fa6a4caf626114ddf8869514f479b568dae43957e41214d3c6eff8d",
 "spec_sha256": "ff9f8c624e611d175366c0257bfed2191becdfef33f20d0062bafbb1d287fcf3",
 "options": {"angle_tolerance": 0.002, "assume": "kinematics", "depth": 2, "design": null, "joints": null,
  "preset": "phnode", "tip": null, "width": 64},
 "joints": {"joint1": "revolute", "joint2": "prismatic", "joint3": "revolute"}}"""


# ---- this arm; `Model`, at the end of the file, is made of these parts ----


def make_parts(seed: int) -> tuple[Joints, Mass, Network, float, Friction, Network]:
    """Return what this arm's `Model` is made of, with random weights of this seed."""
    joints = Joints(
        revolute=(True, False, True), center=(0.0, 0.7875, 0.0), reach=(2.96706, 0.4825, 2.96706),
        speed=(3.0, 1.0, 6.0), friction=(0.4, 0.4, 0.4), armature=(2.19, 0.782, 0.106),
    )  # fmt: skip
    generator = torch.Generator().manual_seed(seed)
    network = Network(
        generator, ((0.02, 1.0, 0.518), (0.02, 1.0, 0.518)), hidden=(((0, 1, 2), 64),),
        outputs=(((0, 1, 2), 45),),
    )  # fmt: skip
    mass = Mass(
        joints, mean=((139.887,), (-0.00167665, 5.33), (-0.00154309, 0.0, 0.0101411)), network=network
    )
    potential = Network(
        generator, ((0.02, 0.02, 1.0), (0.02, 0.02, 1.0)), hidden=(((0, 1, 2), 32),),
        outputs=(((0, 1, 2), 1),),
    )  # fmt: skip
    network = Network(
        generator, ((0.1, 0.1, 0.1), (0.1, 0.1, 0.1), (1.0, 1.0, 1.0)), hidden=(((0, 1, 2), 64),),
        outputs=(((0, 1, 2), 45),),
    )  # fmt: skip
    friction = Friction(joints, network, axes=3)
    network = Network(
        generator, ((1.0, 1.0, 1.0), (1.0, 1.0, 1.0)), hidden=(((0, 1, 2), 64),), outputs=(((0, 1, 2), 9),)
    )
    return (joints, mass, potential, 0.703291, friction, network)


class Model(DenseInput):
    """The arm's dynamics: 45 learned functions of q make M^-1 over all axes."""

    n = 3
    joint_names = ("joint1", "joint2", "joint3")
    joint_types = ("revolute", "prismatic", "revolute")

    def __init__(self, seed: int = 0, dtype: torch.dtype = torch.float64) -> None:
        super().__init__(*make_parts(seed))
        self.to(dtype)
