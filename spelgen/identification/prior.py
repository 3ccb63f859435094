"""Make the prior of an identification: the URDF's bodies, and the usual size of friction and armature."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from spelgen.arm.arm import Arm
from spelgen.dynamics.regressor import urdf_parameters
from spelgen.emission.plan import guessed_armature, guessed_friction
from spelgen.errors import ArmError
from spelgen.identification.friction import BRISTLES, FrictionModel
from spelgen.settings.tuning.identification import IdentificationTuning
from spelgen.structure.pseudo_inertia import parameters_of, reference_factor, sensitivity
from spelgen.structure.sampling import float_energies

TUNING = IdentificationTuning()


@dataclass(frozen=True, eq=False)
class GaussianPrior:
    """x = mean + basis z, with z ~ N(0, deviation^2): mean (K,), basis (K, K), deviation (K,)."""

    mean: np.ndarray
    basis: np.ndarray
    deviation: np.ndarray


def gaussian_prior(arm: Arm, friction: FrictionModel, torque: np.ndarray, deviation: float) -> GaussianPrior:
    """Return the prior of an arm with inertials, whose joint torques have the standard deviations ``torque`` (n,).

    ``deviation`` is how far a body may be from the URDF's, in the first-order affine-invariant metric of its
    pseudo-inertia (see ``pseudo_inertia``): 0.1 is about 20 % in mass. Raises ArmError without inertials.
    """
    if not arm.has_inertials:
        missing = [x.name for x in arm.bodies if x.inertia is None or x.inertia[0] <= 0]
        raise ArmError(
            f"no inertials behind the joints {', '.join(missing)}",
            expected="masses, for a prior",
            do="drop --prior",
        )
    urdf = urdf_parameters(arm).reshape(-1, 10)
    factors = [reference_factor(ten)[0] for ten in urdf]
    bodies = np.concatenate([parameters_of(factor @ factor.T) for factor in factors])
    means, sizes = _drives(arm, friction, torque)
    return GaussianPrior(
        mean=np.concatenate([bodies, means]),
        basis=block_diag(*(sensitivity(factor) for factor in factors), np.diag(sizes)),
        deviation=np.concatenate([np.full(len(bodies), deviation), np.ones(len(means))]),
    )


def _drives(arm: Arm, friction: FrictionModel, torque: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return means and standard deviations of the friction columns' coefficients."""
    n = len(arm.coordinates)
    inertia = _mean_inertia(arm)
    usual, armature, speed = np.zeros(n), np.zeros(n), np.zeros(n)
    for k, coordinate in enumerate(arm.coordinates):
        usual[k] = guessed_friction(coordinate) or TUNING.friction_of_torque * torque[k]
        armature[k] = guessed_armature(coordinate)
        speed[k] = coordinate.velocity or TUNING.usual_speed
    means = {"armature": armature, "viscous": usual / speed, "coulomb": usual}
    means |= dict.fromkeys(BRISTLES, usual / len(BRISTLES))
    sizes = {
        "armature": np.where(armature > 0, armature, inertia), "viscous": usual / speed, "coulomb": usual,
        "offset": usual, "stribeck": usual, "quadratic": usual / speed**2, "cubic": usual / speed**3,
        **dict.fromkeys(BRISTLES, usual),
    }  # fmt: skip
    # where there is no guess the best one is none
    zero = np.zeros(n)
    return (
        np.concatenate([means.get(effect, zero) for effect in friction.effects]),
        TUNING.friction_width * np.concatenate([sizes[effect] for effect in friction.effects]),
    )


def _mean_inertia(arm: Arm) -> np.ndarray:
    """Return the URDF's own M_ii (n,), the mean over a hundred positions."""
    n = len(arm.coordinates)
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (100, n))
    inertias = [list(map(float, body.inertia or ())) for body in arm.bodies]
    mass, _ = float_energies(arm, q, inertias)
    # the lower triangle comes row by row
    rows, columns = np.tril_indices(n)
    return np.asarray(mass.mean(axis=0)[rows == columns])
