"""Gaussian prior of the rigid-body and friction parameters x (K,), and the update of its standard deviations.

The mean is x before the fit. Inertial parameters of different links are independent. Friction and armatures are derived
from the effort limits of the drives, and their errors have a common factor (torques before or after the gear, one make
of gears): the standard deviation common to all joints is therefore larger than the one of a single joint.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import torch

from spelgen.fitting.torque.parameters import ParameterVector
from spelgen.settings.fits import GaussianPrior

ESTIMATED_GROUPS = ("armature", "bodies", "offset")
"""Groups whose standard deviations the fit estimates."""
SHARED = {
    "armature": "shared_armature",
    "sizes": "shared_sizes",
    "velocities": "shared_velocities",
    "fractions": "shared_fractions",
}
"""Options with the standard deviation common to all joints, by the option with the one of a single joint."""


@dataclass(frozen=True, eq=False)
class ParameterPrior:
    """Gaussian prior of the parameters x.

    rigid: names and groups of x. widths: standard deviations per group. hyperprior: their values before the fit. mean:
    (K,).
    """

    rigid: ParameterVector
    widths: GaussianPrior
    hyperprior: GaussianPrior
    mean: torch.Tensor

    @cached_property
    def precision(self) -> torch.Tensor:
        """Inverse covariance, (K, K)."""
        covariance = prior_covariance(self.widths, self.rigid.initial, self.rigid.groups)
        precision: torch.Tensor = torch.linalg.inv(covariance)
        return precision


def prior_covariance(
    widths: GaussianPrior, parameters: Mapping[str, torch.Tensor], groups: Mapping[str, str]
) -> torch.Tensor:
    """Return the prior covariance (K, K) of parameters of these names, shapes and groups, flattened in this order."""
    count = sum(x.numel() for x in parameters.values())
    matrix, friction, first = torch.zeros(count, count).double(), torch.zeros(count).double(), 0
    deviations: dict[str, float] = dict(widths)
    for name, x in parameters.items():
        rows = torch.arange(first, first + x.numel())
        option = width_option(groups[name])
        matrix[rows, rows] = torch.full((len(rows),), deviations[option]).double().square()
        if option in SHARED:
            # bristle fractions are (n, elements): each element has a common factor of its own
            for of_joints in rows.view(len(x), -1).mT:
                matrix[of_joints[:, None], of_joints] += deviations[SHARED[option]] ** 2
        if groups[name] in ("sizes", "effects"):
            friction[rows] = widths.shared_friction
        first += x.numel()
    return matrix + friction.outer(friction)


def update_widths(prior: ParameterPrior, x: torch.Tensor, covariance: torch.Tensor) -> ParameterPrior:
    """Return the prior after one fixed-point step of evidence maximization for the widths of `ESTIMATED_GROUPS`.

    MacKay, Bayesian Interpolation, Neural Computation 4:415 (1992): the fixed point s^2 = |x - mean|^2 / gamma, with
    the effective number of parameters gamma = k - tr(covariance) / s^2 of the group's k parameters, maximizes the
    marginal likelihood in Laplace's approximation. Here s^2 has a scaled inverse chi-squared hyperprior about its
    initial value s0^2, with c degrees of freedom: s^2 = (|x - mean|^2 + c s0^2) / (gamma + c).

    Args:
        prior: current prior.
        x: (K,) MAP estimate.
        covariance: (K, K) posterior covariance of x.
    """
    current: dict[str, float] = dict(prior.widths)
    initial: dict[str, float] = dict(prior.hyperprior)
    updated, freedom, deviation = {}, prior.widths.degrees_of_freedom, x - prior.mean
    for group in ESTIMATED_GROUPS:
        mask = prior.rigid.mask(group)
        count = int(mask.sum())
        centring = torch.eye(count).double()
        if group in SHARED and count:
            # the common factor has a width of its own: the width of single joints is estimated from the differences
            # between joints
            centring -= 1 / count
        spread = centring @ covariance[mask][:, mask] @ centring
        gamma = float(centring.trace() - spread.trace() / current[group] ** 2)
        squares = float((centring @ deviation[mask]).square().sum()) + freedom * initial[group] ** 2
        updated[group] = (squares / (max(gamma, 0.0) + freedom)) ** 0.5
    return replace(prior, widths=prior.widths.model_copy(update=updated))


def width_option(group: str) -> str:
    """Return the option of `GaussianPrior` with the standard deviation of a group."""
    return "sizes" if group in ("effects", "load_dependence") else group
