"""Notes of a torque fit: prior width, selected residual terms, undetermined inertias."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import compress

import numpy as np
import torch

from spelgen.dynamics.parameters import idle_residuals
from spelgen.dynamics.protocol import residual_terms
from spelgen.emission.assemble import ArmModel
from spelgen.errors import Diagnostic, Severity
from spelgen.fitting.posterior import Posterior
from spelgen.fitting.torque.fit import TorqueSolution
from spelgen.fitting.torque.samples import TorqueSamples
from spelgen.fitting.torque.tuning import TUNING
from spelgen.runtime.motors import MotorInputs

TERM_NAMES = {
    "raw_torque_splines": "a torque by position (spring, cable)",
    "raw_torque_ripple": "a torque that repeats with the turn (ripple, cogging)",
    "raw_friction_splines": "friction that varies with position",
    "residual_potential": "a network in V",
    "residual_mass": "networks in M",
}


def torque_notes(model: ArmModel, samples: TorqueSamples, solution: TorqueSolution) -> Iterator[Diagnostic]:
    """Yield the notes of a fit of rigid bodies to samples."""
    names = np.array(model.joint_names)
    posterior = Posterior(model, solution.covariance, solution.torque_std.numpy())
    # the log-Cholesky parameters of a body are logarithms of its mass and radii
    factor = float(np.exp(solution.prior.bodies))
    message = f"prior standard deviation of URDF masses: factor {factor:.2g}"
    if solution.prior.bodies >= TUNING.max_width:
        message += (
            ", its upper bound: the masses of the URDF are wrong by more, or the torques are not in Nm (N); "
            "`spelgen logs` tests their units"
        )
    elif factor > TUNING.wrong_urdf:
        message += (
            "; check the masses and centres of mass of the URDF, `spelgen logs` names links that are far off"
        )
    severity: Severity = "warning" if factor > TUNING.wrong_urdf else "info"
    yield Diagnostic(severity, "urdf-prior", "bodies", None, message)
    if solution.prior.offset >= TUNING.max_width:
        message = (
            "the torque offsets exceed three times the friction that is expected of drives of this effort; check the "
            "effort limits of the URDF, the zeros of the torques and their unit"
        )
        yield Diagnostic("warning", "offset-prior", "logs", None, message)
    unsupported = solution.held_out_nmse > TUNING.unsupported
    if unsupported.any():
        yield _few_data(samples, solution, names[unsupported])
    if isinstance(model.inputs, MotorInputs) and len(model.inputs.gain_rows):
        yield _trained_gains(posterior)
    if solution.compensated.any():
        yield _compensation(model, solution, names)
    if residual_terms(model) is not None:
        message = _selected_terms(solution, names)
        if solution.selected_terms and not samples.recordings.any():
            message += "; all of them were selected in one recording: test them on another motion"
        yield Diagnostic("info", "residuals", "model", None, message)
    subset = samples.subsampled(TUNING.report_positions).columns
    inertia, std = posterior.uncertain(lambda other: _mean_inertia(other, subset.q))
    undetermined = std > TUNING.undetermined * inertia
    if undetermined.any():
        joints = ", ".join(names[undetermined])
        message = f"these logs do not determine the inertia at {joints}; its value is mostly the prior"
        yield Diagnostic("warning", "inertia-undetermined", "logs", None, message)
    weak = solution.rms_residual > TUNING.weak_acceleration * inertia * subset.qdd.std(dim=0).numpy()
    if weak.any():
        message = (
            f"the torque residual exceeds the inertial torque at {', '.join(names[weak])}: a simulation may be worse "
            "than constant velocity; record faster motion"
        )
        yield Diagnostic("warning", "acceleration-unseen", "logs", None, message)


def _few_data(samples: TorqueSamples, solution: TorqueSolution, joints: np.ndarray) -> Diagnostic:
    """Return the warning that the samples do not support the parameters of these joints."""
    nmse = float(np.nanmax(solution.held_out_nmse))
    seconds = samples.count * samples.interval
    # the error of the parameters is inversely proportional to the duration of the motion
    enough = math.ceil(seconds * nmse / TUNING.unsupported)
    message = (
        f"torques that were not fitted are predicted no better than by a constant at {', '.join(joints)} (nMSE "
        f"{nmse:.2g}): {seconds:.2g} s of this motion do not support a fit, the values of the URDF or of a ridge "
        f"regression may be as good; record about {enough} s in which all joints move"
    )
    return Diagnostic("warning", "few-data", "logs", None, message)


def _trained_gains(posterior: Posterior) -> Diagnostic:
    """Return the trained motor gains with 95 % intervals, as a warning if the logs do not determine one of them."""
    gains = posterior.drives["gain"]
    parts = [f"{x.name} {x.value:.4g} ({x.low:.4g} to {x.high:.4g})" for x in gains]
    message = f"joint torque per logged torque, with 95 % intervals: {', '.join(parts)}"
    undetermined = [x.name for x in gains if x.std > TUNING.undetermined_gain * x.value]
    if not undetermined:
        return Diagnostic("info", "trained-gains", "motors", None, message)
    message += (
        f"; the gain of {', '.join(undetermined)} is not determined: friction and inertia scale with it"
    )
    return Diagnostic("warning", "trained-gains", "motors", None, message)


def _compensation(model: ArmModel, solution: TorqueSolution, names: np.ndarray) -> Diagnostic:
    value = model.friction_compensation.detach().numpy()
    joints = ", ".join(
        f"{names[k]} {value[k]:.3g}" for k in np.flatnonzero(solution.compensated & (value > 0))
    )
    message = (
        "the measured torque decreases with velocity, as if the drive compensated friction: "
        f"{joints} Nm s/rad (N s/m) are added; check the torques' signs and what the controller subtracts"
    )
    return Diagnostic("warning", "friction-compensated", "logs", None, message)


def _selected_terms(solution: TorqueSolution, names: np.ndarray) -> str:
    """Return a sentence with the selected terms and their error reductions."""
    if not solution.selected_terms:
        return "no residual terms selected (cross-validation)"
    parts = []
    for term in solution.selected_terms:
        name = TERM_NAMES[term.name]
        if term.joint is not None:
            name += f" at {names[term.joint]}"
        parts.append(f"{name} ({term.error_reduction:.1%})")
    return (
        "residual terms selected by cross-validation, with the decrease of the mean squared torque residual: "
        + ", ".join(parts)
    )


def terms_in_use(model: ArmModel) -> list[str]:
    """Return the residual terms of a model that are not zero, with their joints."""
    names = model.joint_names
    residuals = residual_terms(model)
    if residuals is None:
        return []
    idle = idle_residuals(model)
    terms: list[str] = []
    for name, weights in residuals.named_parameters():
        if f"residuals.{name}" in idle:
            continue
        if name in TERM_NAMES:
            joints = compress(names, weights.any(dim=1).tolist())
            term = f"{TERM_NAMES[name]} at {', '.join(joints)}"
        elif name.startswith("potential."):
            term = TERM_NAMES["residual_potential"]
        else:
            term = TERM_NAMES["residual_mass"]
        if term not in terms:
            terms.append(term)
    return terms


def _mean_inertia(model: ArmModel, q: torch.Tensor) -> torch.Tensor:
    """Return the diagonal of M, (n,) [kg m^2, kg], averaged over positions q (T, n)."""
    mass: torch.Tensor = model.mass_matrix(q)
    return mass.diagonal(dim1=-2, dim2=-1).mean(dim=0)
