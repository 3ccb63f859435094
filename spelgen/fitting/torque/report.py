"""Notes of a fit to torques: width of the prior, selected residual terms, undetermined inertias."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import compress
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch.autograd.functional import jacobian

from spelgen.dynamics.protocol import residual_terms
from spelgen.dynamics.residuals import idle_residuals
from spelgen.errors import Diagnostic
from spelgen.fitting.functional_model import under_weights
from spelgen.fitting.torque.fit import TorqueSolution
from spelgen.fitting.torque.samples import TorqueSamples
from spelgen.fitting.torque.tuning import TorqueReportTuning
from spelgen.fitting.torque.weights import RigidWeights

if TYPE_CHECKING:
    from spelgen.emission.assemble import ArmModel

TUNING = TorqueReportTuning()

EFFECTS = {
    "raw_torque_splines": "a torque by position (spring, cable)",
    "raw_torque_ripple": "a torque that repeats with the turn (ripple, cogging)",
    "raw_friction_splines": "friction that varies with position",
    "residual_potential": "a network in V",
    "residual_mass": "networks in M",
}


def torque_notes(model: ArmModel, samples: TorqueSamples, solution: TorqueSolution) -> Iterator[Diagnostic]:
    """Yield what there is to tell of rigid bodies that were fitted to samples."""
    names = np.array(model.joint_names)
    # a body's weights are logarithms of its mass and of its sizes
    factor = float(np.exp(solution.prior.bodies))
    message = f"prior standard deviation of URDF masses: factor {factor:.2g}"
    yield Diagnostic("info", "urdf-prior", "bodies", None, message)
    if solution.compensated.any():
        yield _compensation(model, solution, names)
    if residual_terms(model) is not None:
        yield Diagnostic("info", "residuals", "model", None, _selected(solution, names))
    looked_at = samples.thinned(TUNING.positions).columns
    q, qdd = looked_at.q, looked_at.qdd
    inertia, deviation = _inertia(model, q, solution.covariance)
    undetermined = deviation > TUNING.undetermined
    if undetermined.any():
        joints = ", ".join(names[undetermined])
        message = f"these logs do not determine the inertia at {joints}; its value is mostly the prior"
        yield Diagnostic("warning", "inertia-undetermined", "logs", None, message)
    weak = solution.residual > TUNING.weak_acceleration * inertia * qdd.std(dim=0).numpy()
    if weak.any():
        message = (
            f"the torque residual exceeds the inertial torque at {', '.join(names[weak])}: a simulation may be worse "
            "than constant velocity; record faster motion"
        )
        yield Diagnostic("warning", "acceleration-unseen", "logs", None, message)


def _compensation(model: ArmModel, solution: TorqueSolution, names: np.ndarray) -> Diagnostic:
    value = model.friction_compensation.detach().numpy()
    joints = ", ".join(f"{names[k]} {value[k]:.3g}" for k in np.flatnonzero(solution.compensated))
    message = (
        "the measured torque decreases with velocity, as if the drive compensated friction: "
        f"{joints} Nm s/rad (N s/m) are added; check the torques' signs and what the controller subtracts"
    )
    return Diagnostic("warning", "friction-compensated", "logs", None, message)


def _selected(solution: TorqueSolution, names: np.ndarray) -> str:
    """Return what stands beside rigid bodies, with the fraction that it explains of what was missed where it acts."""
    if not solution.residuals:
        return "no residual terms selected (cross-validation)"
    parts = []
    for residual in solution.residuals:
        effect = EFFECTS[residual.name]
        if residual.joint is not None:
            effect += f" at {names[residual.joint]}"
        parts.append(f"{effect} ({residual.gain:.1%})")
    return (
        "residual terms selected by cross-validation, with the decrease of the mean squared torque residual: "
        + ", ".join(parts)
    )


def terms_in_use(model: ArmModel) -> list[str]:
    """Return what stands beside the rigid bodies of a model, by effect and joint."""
    names = model.joint_names
    residuals = residual_terms(model)
    if residuals is None:
        return []
    idle = idle_residuals(model)
    terms: list[str] = []
    for name, weights in residuals.named_parameters():
        if f"residuals.{name}" in idle:
            continue
        if name in EFFECTS:
            joints = compress(names, weights.any(dim=1).tolist())
            term = f"{EFFECTS[name]} at {', '.join(joints)}"
        elif name.startswith("potential."):
            term = EFFECTS["residual_potential"]
        else:
            term = EFFECTS["residual_mass"]
        if term not in terms:
            terms.append(term)
    return terms


def _inertia(model: ArmModel, q: torch.Tensor, covariance: torch.Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean diagonal of M at q (n,) [kg m^2, kg], and the standard deviations of its logarithm (n,)."""
    weights = RigidWeights(model).start

    def diagonal(*changed: torch.Tensor) -> torch.Tensor:
        by_name = dict(zip(weights, changed, strict=True))
        mass: torch.Tensor = under_weights(model, by_name, lambda other: other.mass_matrix(q))
        return mass.diagonal(dim1=-2, dim2=-1).mean(dim=0)

    value = diagonal(*weights.values()).detach()
    slopes = jacobian(diagonal, tuple(weights.values()))
    slope = torch.cat([by_weight.flatten(1) for by_weight in slopes], dim=1) / value.unsqueeze(-1)
    variance = torch.einsum("jk,kl,jl->j", slope, covariance, slope)
    return value.numpy(), variance.clamp(min=0).sqrt().numpy()
