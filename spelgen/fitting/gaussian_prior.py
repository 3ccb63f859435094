"""What rigid bodies are fitted towards: a Gaussian over its weights, centred on where they start.

Bodies are taken link by link. Friction and armatures are guessed from the drives' efforts: such a guess is mostly wrong
by factors that all joints share (torques measured before the gear or after it, one make of gear), so a joint's own
deviation is small beside the common one.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch

from spelgen.settings.fits import Adaptation, GaussianPrior

# weights of a module's parts, by how their names end
SIZES = ("raw_viscous", "raw_saturation", "raw_coulomb", "raw_stribeck")
KINDS = {
    "bodies.raw": "bodies",
    "raw_offset": "offset",
    "raw_friction_compensation": "friction_compensation",
    "raw_gains": "gains",
    "rotors.raw": "armature",
    "_velocity": "velocities",
    "raw_load_dependence": "sizes",
    "raw_bristle_fractions": "fractions",
    **dict.fromkeys(SIZES, "sizes"),
}

AS_FITTED = {
    "sizes": 0.1, "velocities": 0.1, "fractions": 0.1,
    "shared_sizes": 0.1, "shared_velocities": 0.1, "shared_friction": 0.3,
}  # fmt: skip
"""Warmth changes the friction of all joints by tens of per cent (Bittencourt and Gunnarsson, J. Dyn. Sys. Meas. Control
134:051013, 2012); a joint by itself changes less.
"""
PRIORS: dict[Adaptation, GaussianPrior] = {
    "load": GaussianPrior(bodies=10.0),  # nothing is known of it before
    "friction": GaussianPrior(**AS_FITTED),
    "unit": GaussianPrior(**AS_FITTED, bodies=0.1, gains=0.1, armature=0.1, shared_armature=0.1),
}
"""About a model that was fitted to another load, on another day, or to another unit of the same arm."""

ADAPTED = ("bodies", "offset")  # kinds whose deviations the fit finds


def kind_of(weight: str) -> str:
    """What the weights of this name are to `GaussianPrior`; StopIteration for a name that is not known here."""
    return next(kind for end, kind in KINDS.items() if weight.endswith(end))


def covariance(prior: GaussianPrior, weights: Mapping[str, torch.Tensor]) -> torch.Tensor:
    """Covariance of the weights with these names and shapes, flattened one after the other."""
    places, count = {}, 0
    for name, weight in weights.items():
        places[name] = torch.arange(count, count + weight.numel())
        count += weight.numel()
    own = torch.cat(
        [torch.full((len(place),), getattr(prior, kind_of(name))) for name, place in places.items()]
    )
    found = torch.diag(own.double().square())
    shared = {"armature": prior.shared_armature, "sizes": prior.shared_sizes}
    shared |= {"velocities": prior.shared_velocities}
    groups = [([place], shared.get(kind_of(name), 0.0)) for name, place in places.items()]
    friction = [place for name, place in places.items() if name.endswith(SIZES)]
    for together, deviation in [*groups, (friction, prior.shared_friction)]:
        if together:
            rows = torch.cat(together)
            found[rows[:, None], rows] += deviation**2
    return found


def most_probable(
    prior: GaussianPrior,
    guess: GaussianPrior,
    weights: Mapping[str, torch.Tensor],
    away: torch.Tensor,
    variance: torch.Tensor,
) -> GaussianPrior:
    """The prior with the deviations of `ADAPTED` kinds that make the data more probable.

    away: of the most probable weights from the prior's centre (K,); variance: of the weights after the fit (K,). A step
    of MacKay's fixed point (Bayesian Interpolation, Neural Computation 4:415, 1992), whose end is the maximum of the
    marginal likelihood in Laplace's approximation, times a scaled inverse chi-squared density of the deviation's square
    with c degrees of freedom about ``guess``: (|away|^2 + c guess^2) / (g + c) where the data determine g weights.
    """
    kinds = [kind for name, x in weights.items() for kind in [kind_of(name)] * x.numel()]
    found, count = {}, prior.degrees_of_freedom
    for kind in ADAPTED:
        own = torch.tensor([each == kind for each in kinds])
        determined = float((1 - variance[own] / getattr(prior, kind) ** 2).sum())
        squares = float(away[own].square().sum()) + count * getattr(guess, kind) ** 2
        found[kind] = (squares / (max(determined, 0.0) + count)) ** 0.5
    return prior.model_copy(update=found)
