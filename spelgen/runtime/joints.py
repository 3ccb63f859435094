"""What the parts of a model are told of the joints."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import torch
from torch import Tensor


class Joints(NamedTuple):
    """The joints, an entry for each; angles in rad and torques in Nm, lengths in m and forces in N."""

    revolute: tuple[bool, ...]
    center: tuple[float, ...]  # a prismatic joint is encoded as (q - center) / reach
    reach: tuple[float, ...]
    speed: tuple[float, ...]  # usual velocity
    friction: tuple[float, ...]  # usual size of the friction torque
    armature: tuple[float, ...]  # nominal rotor inertia times gear squared [kg m^2, kg]


def vector(values: Iterable[float]) -> Tensor:
    """The values as a float64 tensor."""
    return torch.tensor(list(values), dtype=torch.float64)
