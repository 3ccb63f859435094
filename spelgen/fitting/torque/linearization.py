"""Linearized torque per joint: rows of the Jacobian, normal equations, and projections onto linear models."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch

from spelgen.fitting.torque.tuning import TUNING


class JointRows(NamedTuple):
    """Jacobian rows of one joint's torque: residual(x + s) = residual - jacobian @ s[columns].

    columns: (C,) parameters on which this torque depends. jacobian: (T, C). residual: (T,) [Nm, N].
    """

    joint: int
    columns: torch.Tensor
    jacobian: torch.Tensor
    residual: torch.Tensor


@dataclass(frozen=True, eq=False)
class LinearTerms:
    """Linear terms of one joint's torque, eliminated by variable projection.

    With the features F (T, P) and the diagonal penalty D (P,), the weights are the ridge solution w(r) for the residual
    r of all other parameters: w = (F^T F + D)^-1 F^T r. The cost |r - F w(r)|^2 + |D^1/2 w(r)|^2 depends on the other
    parameters only. It is the square of a residual that is linear in r, whose Jacobian is this linear map of the
    Jacobian of r, since F does not depend on these parameters (Golub and Pereyra, SIAM J. Numer. Anal. 10:413, 1973).

    penalty: of squared weights, in squares of the torque.
    """

    features: torch.Tensor
    penalty: torch.Tensor

    @cached_property
    def ridge(self) -> torch.Tensor:
        """Ridge estimator (P, T): weights per torque."""
        gram = self.features.mT @ self.features + self.penalty.diag()
        ridge: torch.Tensor = torch.linalg.solve(gram, self.features.mT)
        return ridge

    def weights(self, torque: torch.Tensor) -> torch.Tensor:
        """Return the ridge solution (P, ...) for a torque (T, ...) [Nm, N]."""
        return self.ridge @ torque

    def residual(self, torque: torch.Tensor) -> torch.Tensor:
        """Return the ridge residual (T + P, ...) of a torque (T, ...): torque residual, then penalties' roots."""
        weights = self.weights(torque)
        return torch.cat([torque - self.features @ weights, self.penalty.sqrt().diag() @ weights])


NO_TERMS: Mapping[int, LinearTerms] = {}


class RigidProjection(NamedTuple):
    """Projection of joint torques onto the rigid-body and friction model, per joint.

    jacobian: (T, C) with respect to theta (see `TorqueJacobian.joint_rows`). posterior_gain: (C, C), the posterior
    covariance of theta divided by the noise variance: posterior_gain @ jacobian^T @ torque is the change of theta by
    which a fit would absorb a torque (T,) on this joint.
    """

    jacobian: tuple[torch.Tensor, ...]
    posterior_gain: tuple[torch.Tensor, ...]

    def orthogonalize(self, joint: int, torque: torch.Tensor) -> torch.Tensor:
        """Return the part of torques (T, P) on a joint that the rigid-body and friction model cannot absorb."""
        jacobian = self.jacobian[joint]
        return torque - jacobian @ (self.posterior_gain[joint] @ (jacobian.mT @ torque))


def concatenate_blocks(rows: Iterable[JointRows], joints: int) -> list[JointRows]:
    """Return the rows of each joint, concatenated over the blocks of samples."""
    blocks: list[list[JointRows]] = [[] for _ in range(joints)]
    for block in rows:
        blocks[block.joint].append(block)
    return [
        of_joint[0]._replace(
            jacobian=torch.cat([block.jacobian for block in of_joint]),
            residual=torch.cat([block.residual for block in of_joint]),
        )
        for of_joint in blocks
    ]


def normal_equations(
    rows: Iterable[JointRows], noise: torch.Tensor, count: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return J^T W J (K, K) and J^T W r (K,) with W = 1 / noise^2.

    Args:
        rows: of all joints and blocks.
        noise: (n,) standard deviations [Nm, N].
        count: K, number of parameters.
    """
    curvature, descent = torch.zeros(count, count).double(), torch.zeros(count).double()
    for joint, columns, jacobian, residual in rows:
        curvature[columns[:, None], columns] += jacobian.mT @ jacobian / noise[joint] ** 2
        descent[columns] += jacobian.mT @ residual / noise[joint] ** 2
    return curvature, descent


def least_squares_residual(
    rows: Sequence[JointRows], noise: torch.Tensor, free: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return squared residual (n,) and effective number of parameters per joint (n,) of unconstrained least squares.

    The number is the trace of the joint's block of the hat matrix J (J^T W J)^+ J^T W.

    Args:
        rows: of all joints and blocks.
        noise: (n,) standard deviations [Nm, N], which weight the joints.
        free: (K,) mask of the parameters.
    """
    curvature, descent = normal_equations(rows, noise, len(free))
    inverse = torch.zeros_like(curvature)
    inverse[free[:, None] & free] = _pseudo_inverse(curvature[free][:, free]).flatten()
    step = inverse @ descent
    squared_residual, gamma = torch.zeros(2, len(noise)).double()
    for joint, columns, jacobian, residual in rows:
        squared_residual[joint] += (residual - jacobian @ step[columns]).square().sum()
        gamma[joint] += ((jacobian @ inverse[columns[:, None], columns]) * jacobian).sum() / noise[joint] ** 2
    return squared_residual, gamma


def _pseudo_inverse(curvature: torch.Tensor) -> torch.Tensor:
    """Return the pseudo-inverse (K, K) of a curvature (K, K), scaled to a unit diagonal for the rank decision."""
    length = curvature.diagonal().sqrt()
    scale = torch.where(length > 0, 1 / length, 0.0)
    scale = scale * scale[:, None]
    inverse: torch.Tensor = torch.linalg.pinv(
        curvature * scale, rtol=TUNING.min_relative_curvature, hermitian=True
    )
    return inverse * scale
