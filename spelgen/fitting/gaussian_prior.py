"""What a closed-form model is fitted towards: a Gaussian over its weights, centred on where they start.

Bodies are taken link by link. Friction and armatures are guessed from the drives' efforts: such a guess is mostly wrong
by factors that all joints share (torques measured before the gear or after it, one make of gear), so a joint's own
deviation is small beside the common one.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch

from spelgen.fitting.config import GaussianPrior

# weights of a module's parts, by how their names end
SIZES = ("raw_viscous", "raw_saturation", "raw_coulomb", "raw_stribeck")
KINDS = {
    "inertial_parameters.raw": "bodies",
    "raw_offset": "offset",
    "raw_gains": "gains",
    "armature.raw": "armature",
    "_velocity": "velocities",
    "raw_load_dependence": "sizes",
    "raw_bristle_fractions": "fractions",
    **dict.fromkeys(SIZES, "sizes"),
}


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
