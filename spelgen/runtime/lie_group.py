"""Joint positions as elements of SO(3) and R^3."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor


def to_group(q: Tensor, joint_types: Sequence[str]) -> list[Tensor]:
    """By joint, R in SO(3), (..., 3, 3), or r in R^3, (..., 3), if prismatic; z is its axis."""
    parts = []
    for kind, value in zip(joint_types, q.unbind(dim=-1), strict=True):
        zero, one = torch.zeros_like(value), torch.ones_like(value)
        if kind == "revolute":
            c, s = value.cos(), value.sin()
            rows = ((c, -s, zero), (s, c, zero), (zero, zero, one))
            parts.append(torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2))
        else:
            parts.append(torch.stack((zero, zero, value), dim=-1))
    return parts


def from_group(parts: Sequence[Tensor], joint_types: Sequence[str]) -> Tensor:
    """q, (..., n), with angles in [-pi, pi]; the inverse of ``to_group``."""
    values = [
        torch.atan2(part[..., 1, 0], part[..., 0, 0]) if kind == "revolute" else part[..., 2]
        for kind, part in zip(joint_types, parts, strict=True)
    ]
    return torch.stack(values, dim=-1)
