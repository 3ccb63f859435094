r"""Port-Hamiltonian model of an arm with 3 joints, written by `spelgen build`.

3 rigid bodies with trained inertial parameters.
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

from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

FACTS = r"""{"format": 8, "robot": "rpr", "urdf": "rpr.urdf",
 "urdf_sha256": "aaacb65e5fa6a4caf626114ddf8869514f479b568dae43957e41214d3c6eff8d",
 "spec_sha256": "bf47000c6a84ed5c58cf9cc0ee8a15c236856db6162d87e4195dbc677f457af5",
 "options": {"angle_tolerance": 0.002, "assume": "kinematics", "depth": 2, "design": null, "joints": null,
  "preset": "closed-form", "tip": null, "width": 64},
 "joints": {"joint1": "revolute", "joint2": "prismatic", "joint3": "revolute"}}"""


# ---- this arm; `Model`, at the end of the file, is made of these parts ----


def make_parts(seed: int) -> tuple[BodyChain, InertialParameters, FrictionLaws, Row]:
    """Return what this arm's `Model` is made of, with random weights of this seed."""
    chain = BodyChain(
        n=3, gravity=(0.0, 0.0, -9.81), parent=(-1, 0, 1), joint=(0, 1, 2), revolute=(True, False, True),
        ratio=(1.0, 1.0, 1.0), offset=(0.0, 0.0, 0.0),
        placement=(
            ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0)),
            ((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, -1.0, 0.0), (0.0, 1.0, 0.0, 0.154)),
            ((0.0, 1.0, 0.0, 0.0), (-1.0, 0.0, 0.0, -0.0203), (0.0, 0.0, 1.0, 0.0)),
        ),
    )  # fmt: skip
    bodies = InertialParameters(
        (0.005, 0.0, 0.0, 0.0, 0.013, 0.0, 0.0, 4.11710816, -4.48896, 5.01),
        (0.00299999125, 0.0, 0.0, 0.0, 0.00475139125, 0.55647375, -0.086275, 179.31762500875, -27.4125, 4.25),
        (0.000109255, 0.0, 0.0, 0.0, 0.010141145, -0.00536544, 0.09936, 0.004149255, -0.05832, 1.08),
    )  # fmt: skip
    friction = FrictionLaws(
        friction=(0.4, 0.4, 0.4), speed=(3.0, 1.0, 6.0),
        reach=(
            (0.0001, 0.0004, 0.0016, 0.0064, 0.025, 0.1), (1e-05, 4e-05, 0.00016, 0.00064, 0.0025, 0.01),
            (0.0001, 0.0004, 0.0016, 0.0064, 0.025, 0.1),
        ),
    )  # fmt: skip
    return (chain, bodies, friction, (2.19, 0.782, 0.106))


class Model(RigidBodyDynamics):
    """The arm's dynamics: 3 rigid bodies with trained inertial parameters."""

    n = 3
    joint_names = ("joint1", "joint2", "joint3")
    joint_types = ("revolute", "prismatic", "revolute")

    def __init__(self, seed: int = 0, dtype: torch.dtype = torch.float64) -> None:
        super().__init__(*make_parts(seed))
        self.to(dtype)
