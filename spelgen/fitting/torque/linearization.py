"""Linearized torque per joint: rows of the Jacobian, normal equations, projections, and Bayesian ridge regression."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch
import torch.nn.functional as F


class JointRows(NamedTuple):
    """Jacobian rows of one joint's torque: residual(theta + s) = residual - jacobian @ s[columns].

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
        # small (P, P): one factorization serves all columns of the Jacobian
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

    def errors(self, residual: torch.Tensor, size: int) -> torch.Tensor:
        """Return the errors of the torque per segment, (S, size, n) [Nm, N], from the residual (S size, n) of a fit.

        The errors of a segment are (1 - H)^(-1/2) residual, with its block H of the hat matrix: the covariance of
        independent errors is then that of the noise, however many parameters were fitted (Bell and McCaffrey, Survey
        Methodology 28:169, 2002).
        """
        errors: torch.Tensor = residual.unflatten(0, (-1, size)).clone()
        for joint, (jacobian, gain) in enumerate(zip(self.jacobian, self.posterior_gain, strict=True)):
            rows = jacobian.unflatten(0, (-1, size))
            values, vectors = torch.linalg.eigh(torch.eye(size).double() - rows @ gain @ rows.mT)
            # at least one sample's error remains of a segment that determines many parameters
            scale = values.clamp(min=1 / size).rsqrt().unsqueeze(-1)
            errors[..., joint] = (vectors @ (scale * (vectors.mT @ errors[..., joint : joint + 1])))[..., 0]
        return errors


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
    # pseudo-inverse: bodies have directions that no torque depends on, and there is no prior here
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
    # directions with less curvature than the rounding of products of sums are not determined by the samples
    inverse: torch.Tensor = torch.linalg.pinv(curvature * scale, rtol=1e-10, hermitian=True)
    return inverse * scale


class BayesianRidge(NamedTuple):
    """Result of `bayesian_ridge` for P weights in G groups.

    coef: (P,), the ridge solution for this penalty. penalty: (P,) of squared weights, lambda / alpha times the
    correlation length, in squares of the target. alpha: precision of the noise. lambda_: (G,) precisions of the
    weights. gamma: (G,) effective number of weights. n_iter, converged: of the fixed-point iteration.
    """

    coef: torch.Tensor
    penalty: torch.Tensor
    alpha: float
    lambda_: torch.Tensor
    gamma: torch.Tensor
    n_iter: int
    converged: bool


def bayesian_ridge(
    products: torch.Tensor, count: int, groups: torch.Tensor, correlation_length: float
) -> BayesianRidge:
    """Fit a linear model, target = features @ coef + noise, with one prior precision per group of weights.

    MacKay, Bayesian Interpolation, Neural Computation 4:415 (1992), in the words of scikit-learn's `BayesianRidge`: the
    noise precision alpha and the weights' precisions lambda maximize the marginal likelihood.

    With the k weights w of a group and their posterior covariance S, one iteration is lambda = gamma / |w|^2,
    gamma = k - lambda tr S, and 1 / alpha = |target - features @ coef|^2 / count. MacKay divides by count - gamma: with
    far more samples than weights the difference is negligible.

    Args:
        products: (P + 1, P + 1) Gram matrix of the columns of `append_target`.
        count: number of samples.
        groups: (P,) index of the group of each weight.
        correlation_length: number of samples per independent error, by which the log likelihood is divided.
    """
    gram, moment, square = products[:-1, :-1], products[:-1, -1], float(products[-1, -1])
    member = F.one_hot(groups.long()).double()  # (P, G)
    excited = gram.diagonal() > 0
    size, variance = member.sum(dim=0), square / count  # variance: 1 / alpha
    feature_square = (member.mT @ gram.diagonal() / count / size).clamp(min=1e-300)
    # initially each group has 10 % of the variance of the target
    # a start at zero weights would be a fixed point
    lambda_ = 10 * feature_square * size / max(variance, 1e-300)
    n_iter, converged = 0, False
    while n_iter < 30 and not converged:
        n_iter += 1
        tempered = variance * correlation_length
        penalty = tempered * (member @ lambda_)
        covariance = torch.linalg.inv(gram / tempered + torch.diag(member @ lambda_))
        coef = covariance @ moment / tempered * excited
        gamma = (size - lambda_ * (member.mT @ covariance.diagonal())).clamp(min=1e-9)
        lambda_ = (gamma / (member.mT @ coef.square()).clamp(min=1e-300)).clamp(max=1e14)
        residual_square = square - float(2 * coef @ moment - coef @ gram @ coef)
        previous, variance = variance, max(residual_square, 1e-12 * square) / count
        converged = abs(variance - previous) < 1e-3 * previous  # the noise needs three digits
    return BayesianRidge(coef, penalty, 1 / max(variance, 1e-300), lambda_, gamma, n_iter, converged)


def append_target(features: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Return features (T, P) with the target (T,) as the last column, (T, P + 1)."""
    return torch.cat([features, target.unsqueeze(-1)], dim=1)
