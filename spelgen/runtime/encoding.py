"""Joint positions as the numbers that networks read, with derivatives written out."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from spelgen.runtime.joints import Joints, vector
from spelgen.runtime.parts import Units


class JointEncoding(nn.Module):
    """cos q, sin q and, where some joint is prismatic, the scaled q: (..., 2 n) or (..., 3 n)."""

    def __init__(self, joints: Joints) -> None:
        super().__init__()
        self.columns = 2 if all(joints.revolute) else 3
        self.center, self.reach = nn.Buffer(vector(joints.center)), nn.Buffer(vector(joints.reach))

    def forward(self, q: Tensor) -> Tensor:
        """Return the encoding of q."""
        return torch.cat([q.cos(), q.sin(), (q - self.center) / self.reach][: self.columns], dim=-1)

    def jvp(self, encoded: Tensor, qd: Tensor) -> Tensor:
        """Return how fast the encoding changes along qd."""
        cos, sin, *_ = encoded.chunk(self.columns, dim=-1)
        return torch.cat([-sin * qd, cos * qd, qd / self.reach][: self.columns], dim=-1)

    def vjp(self, encoded: Tensor, cotangent: Tensor) -> Tensor:
        """Return d/dq, (..., n), of what has the derivative ``cotangent`` by the encoding."""
        cos, sin, *_ = encoded.chunk(self.columns, dim=-1)
        by_cos, by_sin, *by_scaled = cotangent.chunk(self.columns, dim=-1)
        by_joint = by_sin * cos - by_cos * sin
        return by_joint + by_scaled[0] / self.reach if by_scaled else by_joint


class NetworkInput(NamedTuple):
    """The inputs of a network: sensitivity * (matrix @ encoded + offset), (..., inputs)."""

    joints: tuple[int, ...]  # of each input
    sensitivity: Tensor
    matrix: Tensor  # (inputs, encoded)
    offset: Tensor


def joint_input(joints: Joints, chosen: Iterable[int], sensitivity: Sequence[float]) -> NetworkInput:
    """cos q and sin q of revolute joints, the scaled q of prismatic ones, times a joint's sensitivity."""
    n, encoded, chosen = joints.n, (2 if all(joints.revolute) else 3) * joints.n, list(chosen)
    turning = [joint for joint in chosen if joints.revolute[joint]]
    sliding = [joint for joint in chosen if not joints.revolute[joint]]
    owners = (*turning, *turning, *sliding)
    columns = [*turning, *(n + joint for joint in turning), *(2 * n + joint for joint in sliding)]
    matrix = torch.eye(encoded, dtype=torch.float64)[columns]
    return NetworkInput(owners, vector(sensitivity[j] for j in owners), matrix, 0 * matrix.sum(dim=1))


def lie_group_input(joints: Joints, sensitivity: Sequence[float]) -> NetworkInput:
    """Of each joint, whose axis is z, the nine numbers of R in SO(3) or the three of r in R^3."""
    columns = 2 if all(joints.revolute) else 3
    cos, sin, *scaled = torch.eye(columns * joints.n, dtype=torch.float64).chunk(columns)
    zero = torch.zeros_like(cos[0])
    owners, rows, offset = [], [], []
    for joint, revolute in enumerate(joints.revolute):
        if revolute:
            # R by its rows; the last number is one, an offset
            inputs = [cos[joint], -sin[joint], zero, sin[joint], cos[joint], zero, zero, zero, zero]
        else:
            inputs = [zero, zero, scaled[0][joint]]
        owners += [joint] * len(inputs)
        rows += inputs
        offset += [0.0] * (len(inputs) - 1) + [float(revolute)]
    scale = vector(sensitivity[joint] for joint in owners)
    return NetworkInput(tuple(owners), scale, torch.stack(rows), vector(offset))


def with_velocities(inputs: NetworkInput, joints: Joints, axes: int) -> NetworkInput:
    """These inputs, then each joint's velocity along so many axes, of which the last is the joint's own.

    The network then reads the encoding and, behind it, the velocities, (..., encoded + n).
    """
    last = torch.eye(axes, dtype=torch.float64)[:, -1:]
    velocities = torch.kron(torch.eye(joints.n, dtype=torch.float64), last)
    return NetworkInput(
        (*inputs.joints, *(joint for joint in range(joints.n) for _ in range(axes))),
        sensitivity=F.pad(inputs.sensitivity, (0, len(velocities)), value=1.0),
        matrix=torch.ops.aten.block_diag([inputs.matrix, velocities]),
        offset=F.pad(inputs.offset, (0, len(velocities))),
    )


def joint_mask(units: Units, below: Units) -> Tensor:
    """Return 1 where a unit may read a unit below it, which reads no other joints; (units, units below)."""
    rows = [[float(set(joints) <= set(unit)) for joints in below] for unit in units]
    return torch.tensor(rows, dtype=torch.float64)
