"""What is believed before any log is read: the URDF's bodies, and the usual size of friction and rotors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from spelgen.arm.arm import Arm
from spelgen.dynamics.regressor import urdf_parameters
from spelgen.emission.plan import guessed_friction, guessed_rotor
from spelgen.errors import ArmError
from spelgen.identification.friction import FrictionModel
from spelgen.structure.pseudo_inertia import parameters_of, reference_factor, sensitivity
from spelgen.structure.sampling import float_energies

_FRICTION_OF_TORQUE = 0.1  # where the URDF names no effort
_WIDE = 10.0  # times the guessed size: how far friction and rotors may be from the guess
_SPEED = 2.0  # [rad/s, m/s] likewise


@dataclass(frozen=True, eq=False)
class GaussianPrior:
    """x = start + outlay z, with z ~ N(0, deviation^2): start (K,), outlay (K, K), deviation (K,)."""

    start: np.ndarray
    outlay: np.ndarray
    deviation: np.ndarray


def gaussian_prior(arm: Arm, friction: FrictionModel, spread: np.ndarray, deviation: float) -> GaussianPrior:
    """The prior of an arm with usable inertials, whose joint torques have the standard deviations ``spread`` (n,).

    ``deviation`` is how far a body may be from the URDF's, in the first-order affine-invariant metric of its
    pseudo-inertia (see ``pseudo_inertia``): 0.1 is about 20 % in mass. Raises ArmError without inertials.
    """
    if not arm.has_inertials:
        missing = [body.name for body in arm.bodies if body.inertia is None or body.inertia[0] <= 0]
        raise ArmError(
            f"no inertials behind the joints {', '.join(missing)}",
            expected="masses, for a prior",
            do="drop --prior",
        )
    urdf = urdf_parameters(arm).reshape(-1, 10)
    factors = [reference_factor(ten)[0] for ten in urdf]
    bodies = np.concatenate([parameters_of(factor @ factor.T) for factor in factors])
    means, sizes = _drives(arm, friction, spread)
    return GaussianPrior(
        start=np.concatenate([bodies, means]),
        outlay=block_diag(*(sensitivity(factor) for factor in factors), np.diag(sizes)),
        deviation=np.concatenate([np.full(len(bodies), deviation), np.ones(len(means))]),
    )


def _drives(arm: Arm, friction: FrictionModel, spread: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Means and standard deviations of the friction columns' coefficients."""
    n = len(arm.coordinates)
    inertia = _mean_inertia(arm)
    rub, rotor, speed = np.zeros(n), np.zeros(n), np.zeros(n)
    for k, coordinate in enumerate(arm.coordinates):
        rub[k] = guessed_friction(coordinate) or _FRICTION_OF_TORQUE * spread[k]
        rotor[k] = guessed_rotor(coordinate)
        speed[k] = coordinate.velocity or _SPEED
    means = {"rotor": rotor, "viscous": rub / speed, "coulomb": rub}
    sizes = {
        "rotor": np.where(rotor > 0, rotor, inertia), "viscous": rub / speed, "coulomb": rub, "offset": rub,
        "stribeck": rub, "quadratic": rub / speed**2, "cubic": rub / speed**3,
    }  # fmt: skip
    zero = np.zeros(n)
    return (
        np.concatenate([means.get(effect, zero) for effect in friction.effects]),
        _WIDE * np.concatenate([sizes[effect] for effect in friction.effects]),
    )


def _mean_inertia(arm: Arm) -> np.ndarray:
    """The URDF's own M_ii (n,), at a hundred positions."""
    n = len(arm.coordinates)
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (100, n))
    mass, _ = float_energies(arm, q, [[float(x) for x in body.inertia or ()] for body in arm.bodies])
    return mass.mean(axis=0)[[k * (k + 3) // 2 for k in range(n)]]
