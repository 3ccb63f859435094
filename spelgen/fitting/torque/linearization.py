"""Linearized joint torques: Jacobian rows, normal equations, projections, and Bayesian ridge regression."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch
import torch.nn.functional as F


class JointRows(NamedTuple):
    """Linearized torque residual of one joint: residual(theta + s) = residual - jacobian @ s[columns].

    theta (K,) are the parameters of the model, with inertial parameters for the bodies (see `TorqueJacobian`).

    Attributes:
        joint: index of the joint.
        columns: (C,), indices of the C entries of theta on which the torque of the joint depends.
        jacobian: (T, C), derivatives of the modelled torque with respect to these entries.
        residual: (T,) [Nm, N], torque residual at theta.
    """

    joint: int
    columns: torch.Tensor
    jacobian: torch.Tensor
    residual: torch.Tensor


@dataclass(frozen=True, eq=False)
class LinearTerms:
    """Linear terms of one joint's torque, whose P weights are eliminated by variable projection.

    features: F, (T, P), torques per unit weight. penalty: diagonal of D, (P,), the penalty on squared weights.

    Let r be the torque residual without these terms. The weights are the ridge solution w(r) = (F^T F + D)^-1 F^T r.
    The cost |r - F w(r)|^2 + |D^1/2 w(r)|^2 then depends only on the other parameters of the model, and is the squared
    length of a vector that is linear in r. F does not depend on the other parameters, so the same linear map turns the
    Jacobian of r into the Jacobian of this vector (Golub and Pereyra, SIAM J. Numer. Anal. 10:413, 1973).
    """

    features: torch.Tensor
    penalty: torch.Tensor

    @cached_property
    def ridge(self) -> torch.Tensor:
        """Matrix (F^T F + D)^-1 F^T, (P, T), which maps a torque residual (T,) to the weights (P,).

        F (T, P) are the features, D is the diagonal matrix of the penalty.
        """
        # The ridge matrix is cached, so that the small matrix (P, P) is factorized once for all columns of the
        # Jacobian.
        gram = self.features.mT @ self.features + self.penalty.diag()
        ridge: torch.Tensor = torch.linalg.solve(gram, self.features.mT)
        return ridge

    def weights(self, torque: torch.Tensor) -> torch.Tensor:
        """Return the weights (P, ...) of the linear terms, the ridge solution for a torque residual (T, ...)."""
        return self.ridge @ torque

    def residual(self, torque: torch.Tensor) -> torch.Tensor:
        """Return the vector (T + P, ...) whose squared length is the ridge cost for a torque residual (T, ...).

        The first T entries are the residual after the ridge fit. The last P entries are the weights times the square
        roots of their penalties.
        """
        weights = self.weights(torque)
        return torch.cat([torque - self.features @ weights, self.penalty.sqrt().diag() @ weights])


NO_TERMS: Mapping[int, LinearTerms] = {}


class RigidProjection(NamedTuple):
    """Projection of joint torques onto the rigid-body and friction model, per joint.

    If a torque (T,) were added to a joint, a fit would change the model's parameters theta by posterior_gain @
    jacobian^T @ torque to absorb it.

    jacobian: one matrix (T, C) per joint, derivatives of its torque with respect to the C entries of theta that affect
    it (see `TorqueJacobian.joint_rows`). posterior_gain: one matrix (C, C) per joint, the posterior covariance of these
    entries divided by the variance of the joint's torque noise.
    """

    jacobian: tuple[torch.Tensor, ...]
    posterior_gain: tuple[torch.Tensor, ...]

    def orthogonalize(self, joint: int, torque: torch.Tensor) -> torch.Tensor:
        """Return P torques on a joint, `torque` (T, P) [Nm, N], minus the parts that the model would absorb, (T, P).

        If such a torque were added to the measured torque and the rigid-body and friction parameters were refitted, the
        torque residual would change by the result.
        """
        jacobian = self.jacobian[joint]
        return torque - jacobian @ (self.posterior_gain[joint] @ (jacobian.mT @ torque))

    def errors(self, residual: torch.Tensor, size: int) -> torch.Tensor:
        """Return the torque errors of S segments, (S, size, n) [Nm, N], from the residual (S size, n) of a fit.

        The residual of a fit is smaller than the errors, since the parameters absorb a part of the errors. The
        corrected residual is (1 - H)^(-1/2) residual, with the segment's block H of the hat matrix. If errors are
        independent, it has the covariance of the noise (Bell and McCaffrey, Survey Methodology 28:169, 2002).
        """
        errors: torch.Tensor = residual.unflatten(0, (-1, size)).clone()
        for joint, (jacobian, gain) in enumerate(zip(self.jacobian, self.posterior_gain, strict=True)):
            rows = jacobian.unflatten(0, (-1, size))
            values, vectors = torch.linalg.eigh(torch.eye(size).double() - rows @ gain @ rows.mT)
            # H (size, size) is the block of the hat matrix of one segment of `size` samples. If the segment determines
            # many parameters, some eigenvalues of 1 - H are near zero, and (1 - H)^(-1/2) would enlarge the residual
            # too much. The eigenvalues of 1 - H therefore have the lower bound 1 / size: the residual is enlarged by at
            # most sqrt(size).
            scale = values.clamp(min=1 / size).rsqrt().unsqueeze(-1)
            errors[..., joint] = (vectors @ (scale * (vectors.mT @ errors[..., joint : joint + 1])))[..., 0]
        return errors


def concatenate_blocks(rows: Iterable[JointRows], joints: int) -> list[JointRows]:
    """Return the Jacobian rows of each joint, concatenated over the blocks of samples, one `JointRows` per joint."""
    blocks: list[list[JointRows]] = [[] for _ in range(joints)]
    for block in rows:
        blocks[block.joint].append(block)
    result = []
    for of_joint in blocks:
        jacobian = torch.cat([block.jacobian for block in of_joint])
        residual = torch.cat([block.residual for block in of_joint])
        result.append(of_joint[0]._replace(jacobian=jacobian, residual=residual))
    return result


def normal_equations(
    rows: Iterable[JointRows], noise: torch.Tensor, count: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return J^T W J (K, K) and J^T W r (K,) for K parameters, with Jacobian J, torque residual r, W = 1 / noise^2.

    Args:
        rows: Jacobian rows of all joints and blocks.
        noise: (n,) standard deviations of the torque noise [Nm, N].
        count: number K of parameters.
    """
    curvature, descent = torch.zeros(count, count).double(), torch.zeros(count).double()
    for joint, columns, jacobian, residual in rows:
        curvature[columns[:, None], columns] += jacobian.mT @ jacobian / noise[joint] ** 2
        descent[columns] += jacobian.mT @ residual / noise[joint] ** 2
    return curvature, descent


def least_squares_residual(
    rows: Sequence[JointRows], noise: torch.Tensor, free: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return two results of unconstrained least squares: squared residual (n,) and effective parameters (n,).

    The first is the sum of the squared residual of each joint [Nm^2, N^2]. The second is the effective number of
    parameters of each joint: the trace of its block of the hat matrix J (J^T W J)^+ J^T W, W = 1 / noise^2.

    Args:
        rows: Jacobian rows of all joints and blocks.
        noise: (n,) standard deviations of the torque noise [Nm, N], which weight the joints.
        free: (K,) mask of the K parameters, True for parameters that are fitted.
    """
    curvature, descent = normal_equations(rows, noise, len(free))
    inverse = torch.zeros_like(curvature)
    # The pseudo-inverse is used, since unconstrained least squares has no prior and some inertial parameters affect no
    # torque.
    inverse[free[:, None] & free] = _pseudo_inverse(curvature[free][:, free]).flatten()
    step = inverse @ descent
    squared_residual, gamma = torch.zeros(2, len(noise)).double()
    for joint, columns, jacobian, residual in rows:
        squared_residual[joint] += (residual - jacobian @ step[columns]).square().sum()
        gamma[joint] += ((jacobian @ inverse[columns[:, None], columns]) * jacobian).sum() / noise[joint] ** 2
    return squared_residual, gamma


def _pseudo_inverse(curvature: torch.Tensor) -> torch.Tensor:
    """Return the pseudo-inverse (K, K) of the curvature matrix (K, K) of K parameters.

    The matrix is first scaled to a unit diagonal, since the parameters have different units. Small eigenvalues of the
    scaled matrix are treated as zero.
    """
    length = curvature.diagonal().sqrt()
    scale = torch.where(length > 0, 1 / length, 0.0)
    scale = scale * scale[:, None]
    # The curvature is a sum over samples: eigenvalues below the rounding errors of this sum are treated as zero.
    inverse: torch.Tensor = torch.linalg.pinv(curvature * scale, rtol=1e-10, hermitian=True)
    return inverse * scale


class BayesianRidge(NamedTuple):
    """Result of `bayesian_ridge` for P weights in G groups.

    Attributes:
        coef: (P,), weights, the ridge solution for `penalty`.
        penalty: (P,), penalty on the squared weights: lambda / alpha times the correlation length.
        alpha: precision of the noise.
        lambda_: (G,), prior precision of the weights of each group.
        gamma: (G,), effective number of weights of each group.
        n_iter: number of fixed-point iterations.
        converged: True if the iterations have converged.
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
    """Fit a linear model, target = features @ coef + noise, with one prior precision per group of its P weights.

    The noise precision alpha and the precisions lambda of the weights maximize the marginal likelihood (MacKay,
    Bayesian Interpolation, Neural Computation 4:415, 1992). The names are as in scikit-learn's `BayesianRidge`.

    Let w be the k weights of a group, with posterior covariance S. One iteration is gamma = k - lambda tr S, lambda =
    gamma / |w|^2, and 1 / alpha = |target - features @ coef|^2 / count. MacKay divides by count - gamma; with far more
    samples than weights, the difference is negligible.

    Args:
        products: (P + 1, P + 1) Gram matrix of the columns of `append_target`.
        count: number of samples.
        groups: (P,) index of the group of each weight.
        correlation_length: number of samples per independent error, by which the log likelihood is divided.
    """
    gram, moment, square = products[:-1, :-1], products[:-1, -1], float(products[-1, -1])
    member = F.one_hot(groups.long()).double()  # member: (P, G), 1 if the weight is in the group, otherwise 0
    excited = gram.diagonal() > 0
    # `size` is the number k of weights of each group, `variance` is the variance of the noise, 1 / alpha.
    size, variance = member.sum(dim=0), square / count
    feature_square = (member.mT @ gram.diagonal() / count / size).clamp(min=1e-300)
    # Weights of zero would be a fixed point of the iteration. Therefore the initial precision of each group is the one
    # with which the group explains 10 % of the variance of the target.
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
        # The iteration ends if the noise variance changes by less than 0.1 %, which is below its sampling error.
        converged = abs(variance - previous) < 1e-3 * previous
    return BayesianRidge(coef, penalty, 1 / max(variance, 1e-300), lambda_, gamma, n_iter, converged)


def append_target(features: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Return P features (T, P) with the target (T,) as the last column, (T, P + 1), for a Gram matrix of both."""
    return torch.cat([features, target.unsqueeze(-1)], dim=1)
