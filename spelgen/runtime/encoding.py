"""Joint positions as the numbers that networks read, with derivatives written out."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from spelgen.runtime.joints import Joints, vector

Units = Sequence[tuple[int, ...]]  # of a layer: the joints that each may read


class JointEncoding(nn.Module):
    """cos q, sin q and, where some joint is prismatic, the scaled q: (..., 2 n) or (..., 3 n)."""

    def __init__(self, joints: Joints) -> None:
        super().__init__()
        self.prismatic = not all(joints.revolute)
        self.center = nn.Buffer(vector(joints.center))
        self.reach = nn.Buffer(vector(joints.reach))

    def forward(self, q: Tensor) -> Tensor:
        """Return the encoding of q."""
        columns = [q.cos(), q.sin()]
        return torch.cat([*columns, (q - self.center) / self.reach] if self.prismatic else columns, dim=-1)

    def jvp(self, encoded: Tensor, qd: Tensor) -> Tensor:
        """Return how fast the encoding changes along qd."""
        cos, sin = encoded.chunk(3 if self.prismatic else 2, dim=-1)[:2]
        columns = [-sin * qd, cos * qd]
        return torch.cat([*columns, qd / self.reach] if self.prismatic else columns, dim=-1)

    def vjp(self, encoded: Tensor, cotangent: Tensor) -> Tensor:
        """Return d/dq, (..., n), of what has the derivative ``cotangent`` by the encoding."""
        columns = 3 if self.prismatic else 2
        cos, sin = encoded.chunk(columns, dim=-1)[:2]
        by_cos, by_sin, *by_scaled = cotangent.chunk(columns, dim=-1)
        by_joint = by_sin * cos - by_cos * sin
        return by_joint + by_scaled[0] / self.reach if self.prismatic else by_joint


class NetworkInput(NamedTuple):
    """The inputs of a network: sensitivity * (matrix @ encoded + offset), (..., inputs)."""

    joints: tuple[int, ...]  # of each input
    sensitivity: Tensor
    matrix: Tensor  # (inputs, encoded)
    offset: Tensor


def joint_input(joints: Joints, chosen: Iterable[int], sensitivity: Sequence[float]) -> NetworkInput:
    """cos q and sin q of revolute joints, the scaled q of prismatic ones, times a joint's sensitivity."""
    n, encoded = joints.n, (2 if all(joints.revolute) else 3) * joints.n
    chosen = list(chosen)
    turning = [joint for joint in chosen if joints.revolute[joint]]
    sliding = [joint for joint in chosen if not joints.revolute[joint]]
    owners = (*turning, *turning, *sliding)
    columns = [*turning, *(n + joint for joint in turning), *(2 * n + joint for joint in sliding)]
    matrix = torch.eye(encoded, dtype=torch.float64)[columns]
    return NetworkInput(owners, vector(sensitivity[j] for j in owners), matrix, 0 * matrix.sum(dim=1))


def lie_group_input(joints: Joints, sensitivity: Sequence[float]) -> NetworkInput:
    """Of each joint the nine numbers of R in SO(3) or the three of r in R^3, times its sensitivity.

    z is the joint's axis, so R = [[cos q, -sin q, 0], [sin q, cos q, 0], [0, 0, 1]].
    """
    n = joints.n
    owners = [joint for joint in range(n) for _ in range(9 if joints.revolute[joint] else 3)]
    matrix = torch.zeros(len(owners), (2 if all(joints.revolute) else 3) * n, dtype=torch.float64)
    offset = torch.zeros(len(owners), dtype=torch.float64)
    for joint, revolute in enumerate(joints.revolute):
        first = owners.index(joint)
        if revolute:
            matrix[[first, first + 4], joint], offset[first + 8] = 1.0, 1.0
            matrix[first + 1, n + joint], matrix[first + 3, n + joint] = -1.0, 1.0
        else:
            matrix[first + 2, 2 * n + joint] = 1.0
    return NetworkInput(tuple(owners), vector(sensitivity[joint] for joint in owners), matrix, offset)


def with_velocities(inputs: NetworkInput, joints: Joints, axes: int) -> NetworkInput:
    """These inputs, then each joint's velocity along so many axes, of which the last is the joint's own.

    The network then reads the encoding and, behind it, the velocities, (..., encoded + n).
    """
    n = joints.n
    last = torch.eye(axes, dtype=torch.float64)[:, -1:]
    velocities = torch.kron(torch.eye(n, dtype=torch.float64), last)
    owners = (*inputs.joints, *(joint for joint in range(n) for _ in range(axes)))
    return NetworkInput(
        owners,
        sensitivity=F.pad(inputs.sensitivity, (0, axes * n), value=1.0),
        matrix=torch.ops.aten.block_diag([inputs.matrix, velocities]),
        offset=F.pad(inputs.offset, (0, axes * n)),
    )


def joint_mask(units: Units, below: Units) -> Tensor:
    """Return 1 where a unit may read a unit below it, which reads no other joints; (units, units below)."""
    rows = [[float(set(joints) <= set(unit)) for joints in below] for unit in units]
    return torch.tensor(rows, dtype=torch.float64)
