"""The view of an arm's positions on its joints' groups: rotations in SO(3), places in R^3; z is a joint's axis."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor


def to_group(joint_types: Sequence[str], q: Tensor) -> list[Tensor]:
    """Return, by joint, R in SO(3), (..., 3, 3), or r in R^3, (..., 3) [m], if prismatic, of q, (..., n)."""
    zero, one = torch.zeros_like(q), torch.ones_like(q)
    rows = [q.cos(), -q.sin(), zero, q.sin(), q.cos(), zero, zero, zero, one]
    rotations = torch.stack(rows, dim=-1).reshape(*q.shape, 3, 3)
    positions = torch.stack([zero, zero, q], dim=-1)
    elements = []
    for joint, kind in enumerate(joint_types):
        view = rotations if kind == "revolute" else positions
        elements.append(view.select(q.dim() - 1, joint))
    return elements


def from_group(joint_types: Sequence[str], elements: Sequence[Tensor]) -> Tensor:
    """Return q, (..., n), with angles in [-pi, pi]; the inverse of ``to_group``."""
    values = []
    for kind, element in zip(joint_types, elements, strict=True):
        if kind == "revolute":
            values.append(torch.atan2(element[..., 1, 0], element[..., 0, 0]))
        else:
            values.append(element[..., 2])
    return torch.stack(values, dim=-1)
