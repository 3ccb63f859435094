"""What a fit to torques says in words: how far the URDF was believed, and what the logs leave open."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch.func import functional_call, jacrev

from spelgen.dynamics.protocol import has_residuals
from spelgen.errors import Diagnostic
from spelgen.fitting.torque_fit import TorqueSolution
from spelgen.fitting.torque_jacobian import BLOCK, Asked, rigid_weights
from spelgen.fitting.torque_samples import TorqueSamples

if TYPE_CHECKING:
    from spelgen.emission.loading import EmittedModel

UNDETERMINED = 0.5  # relative standard deviation from which on logs do not determine an inertia
HARDLY = 5.0  # a factor within which the URDF is believed that is no belief any more
WEAK = 2.0  # torque missed, by what accelerates a joint, from which on its states are poorly predicted
POSITIONS = 50  # at which inertias are looked at


def torque_notes(model: EmittedModel, samples: TorqueSamples, found: TorqueSolution) -> Iterator[Diagnostic]:
    """Of rigid bodies that were fitted to samples."""
    names = np.array(model.joint_names)
    # a deviation s of a coordinate is a factor e^s in a root of the pseudo-inertia
    factor = float(np.exp(2 * found.prior.bodies))
    how = "hardly believed, only" if factor > HARDLY else "believed"
    message = f"the URDF's inertias are {how} to within a factor of {factor:.2g}"
    yield Diagnostic("info", "urdf-believed", "bodies", None, message)
    if found.compensated.any():
        value = model.friction_compensation.detach().numpy()
        each = ", ".join(f"{names[k]} {value[k]:.3g}" for k in np.flatnonzero(found.compensated))
        message = (
            "the measured torque falls as velocity grows, as of a drive that compensates friction unseen: "
            f"{each} Nm s/rad (N s/m) are added; check the torques' signs and what the controller subtracts"
        )
        yield Diagnostic("warning", "friction-compensated", "logs", None, message)
    if has_residuals(model):
        yield Diagnostic("info", "residuals", "model", None, _entered(found, names))
    q, _, qdd, *_ = (x[:: max(1, len(x) // POSITIONS)] for x in next(samples.blocks(BLOCK)))
    inertia, deviation = _inertia(model, q, found.covariance)
    if (undetermined := deviation > UNDETERMINED).any():
        message = (
            f"these logs hardly tell the inertia at {', '.join(names[undetermined])}: it is mostly a guess"
        )
        yield Diagnostic("warning", "inertia-undetermined", "logs", None, message)
    if (weak := found.residual > WEAK * inertia * qdd.std(dim=0).numpy()).any():
        message = (
            f"far more torque is missed than accelerates {', '.join(names[weak])}: torques are predicted, but motion "
            "under the measured torque may be predicted worse than by constant velocity; record faster motion"
        )
        yield Diagnostic("warning", "acceleration-unseen", "logs", None, message)


EFFECTS = {
    "raw_torque_splines": "a torque by position (spring, cable)",
    "raw_torque_ripple": "ripple",
    "raw_friction_splines": "friction that varies with position",
    "residual_potential": "a network in V",
    "residual_mass": "networks in M",
}


def _entered(found: TorqueSolution, names: np.ndarray) -> str:
    """What stands beside rigid bodies, with the part that it explains of what was missed where it acts."""
    if not found.residuals:
        return "nothing beside rigid bodies and friction's laws: held-out samples ask for no more"
    each = ", ".join(
        f"{EFFECTS[x.name]}{'' if x.joint is None else f' at {names[x.joint]}'} ({x.gain:.1%})"
        for x in found.residuals
    )
    return f"beside rigid bodies, with the part of the missed torque's squares that held-out samples lost: {each}"


def _inertia(model: EmittedModel, q: torch.Tensor, covariance: torch.Tensor) -> tuple[np.ndarray, np.ndarray]:
    """The mean diagonal of M at q (n,) [kg m^2, kg], and the standard deviations of its logarithm (n,)."""
    asked = Asked(model)
    weights = {f"model.{name}": x for name, x in rigid_weights(model).items()}
    count = sum(x.numel() for x in weights.values())

    def diagonal(changed: dict[str, torch.Tensor]) -> Any:
        mass = functional_call(asked, changed, (lambda other: other.mass_matrix(q),))
        return mass.diagonal(dim1=-2, dim2=-1).mean(dim=0)

    value = diagonal(weights).detach()
    slopes = jacrev(diagonal)(weights)
    slope = torch.cat([slopes[name].flatten(1).detach() for name in weights], dim=1) / value.unsqueeze(-1)
    variance = torch.einsum("jk,kl,jl->j", slope, covariance[:count, :count], slope)
    return value.numpy(), variance.clamp(min=0).sqrt().numpy()
