"""What rigid bodies are fitted towards: a Gaussian over their weights, centred on where they start.

Bodies are taken link by link. Friction and armatures are guessed from the drives' efforts: such a guess is mostly wrong
by factors that all joints share (torques measured before the gear or after it, one make of gear), so a joint's own
deviation is small beside the common one.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch

from spelgen.settings.fits import GaussianPrior

Kinds = Mapping[str, str]
"""Of weights by name: what they stand for, as `dynamics.parameters.ParameterInfo` has it."""

ADAPTED = ("armature", "bodies", "offset")  # kinds whose deviations the fit finds
SHARED = {
    "armature": "shared_armature",
    "sizes": "shared_sizes",
    "velocities": "shared_velocities",
    "fractions": "shared_fractions",
}
"""The options that say how far all joints may be off together, by the option of one joint's own deviation."""


def covariance(prior: GaussianPrior, weights: Mapping[str, torch.Tensor], kinds: Kinds) -> torch.Tensor:
    """Return the covariance (K, K) of weights with these names and shapes, flattened one after the other."""
    count = sum(weight.numel() for weight in weights.values())
    matrix, friction, first = torch.zeros(count, count).double(), torch.zeros(count).double(), 0
    for name, weight in weights.items():
        row = torch.arange(first, first + weight.numel())
        field = prior_field(kinds[name])
        matrix[row, row] = torch.full((len(row),), getattr(prior, field)).double().square()
        if field in SHARED:
            # of fractions, each element of the bristles by itself
            for of_joints in row.view(len(weight), -1).mT:
                matrix[of_joints[:, None], of_joints] += getattr(prior, SHARED[field]) ** 2
        if kinds[name] in ("sizes", "effects"):
            friction[row] = prior.shared_friction
        first += weight.numel()
    return matrix + friction.outer(friction)


def most_probable(
    prior: GaussianPrior,
    guess: GaussianPrior,
    masks: Mapping[str, torch.Tensor],
    away: torch.Tensor,
    posterior: torch.Tensor,
) -> GaussianPrior:
    """Return the prior with the deviations of `ADAPTED` kinds that make the data more probable.

    masks: (K,) by kind, which weights are of it. away: (K,) of the most probable weights from the prior's centre.
    posterior: (K, K) covariance of the weights after the fit. A step of MacKay's
    fixed point (Bayesian Interpolation, Neural Computation 4:415, 1992), whose end is the maximum of the marginal
    likelihood in Laplace's approximation, times a scaled inverse chi-squared density of the deviation's square with c
    degrees of freedom about ``guess``: (|away|^2 + c guess^2) / (g + c) where the data determine g weights.
    """
    deviations, freedom = {}, prior.degrees_of_freedom
    for kind in ADAPTED:
        mask = masks[kind]
        count = int(mask.sum())
        centre = torch.eye(count).double()
        if kind in SHARED and count:
            # how far all joints are off together says nothing about the deviation of a single joint
            centre -= 1 / count
        spread = centre @ posterior[mask][:, mask] @ centre
        determined = float(centre.trace() - spread.trace() / getattr(prior, kind) ** 2)
        squares = float((centre @ away[mask]).square().sum()) + freedom * getattr(guess, kind) ** 2
        deviations[kind] = (squares / (max(determined, 0.0) + freedom)) ** 0.5
    return prior.model_copy(update=deviations)


def prior_field(kind: str) -> str:
    """Return the option of `GaussianPrior` that is for a kind of weights."""
    return "sizes" if kind in ("effects", "load_dependence") else kind
