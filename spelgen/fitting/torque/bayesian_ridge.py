"""Bayesian ridge regression with one prior precision per group of weights.

MacKay, Bayesian Interpolation, Neural Computation 4:415 (1992), in the words of scikit-learn's `BayesianRidge`: the
noise precision alpha and the weights' precisions lambda maximize the marginal likelihood.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F

from spelgen.fitting.torque.tuning import SELECTION


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
    """Fit a linear model, target = features @ coef + noise, by evidence maximization.

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
    lambda_ = 10 * feature_square * size / max(variance, 1e-300)
    n_iter, converged = 0, False
    while n_iter < SELECTION.max_iter and not converged:
        n_iter += 1
        tempered = variance * correlation_length
        penalty = tempered * (member @ lambda_)
        covariance = torch.linalg.inv(gram / tempered + torch.diag(member @ lambda_))
        coef = covariance @ moment / tempered * excited
        gamma = (size - lambda_ * (member.mT @ covariance.diagonal())).clamp(min=1e-9)
        lambda_ = (gamma / (member.mT @ coef.square()).clamp(min=1e-300)).clamp(max=1e14)
        residual_square = square - float(2 * coef @ moment - coef @ gram @ coef)
        previous, variance = variance, max(residual_square, 1e-12 * square) / count
        converged = abs(variance - previous) < SELECTION.tolerance * previous
    return BayesianRidge(coef, penalty, 1 / max(variance, 1e-300), lambda_, gamma, n_iter, converged)


def append_target(features: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Return features (T, P) with the target (T,) as the last column, (T, P + 1)."""
    return torch.cat([features, target.unsqueeze(-1)], dim=1)
