"""Mass matrices, gravity torques and torque regressors of an arm at random configurations, computed by Pinocchio.

Random inertial parameters are physically consistent: their pseudo-inertia is positive definite (Wensing, Kim and
Slotine, RA-L 3(1), 2018).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
import pinocchio as pin

from spelgen.arm.arm import Chain
from spelgen.dynamics.pinocchio_arm import arm_dynamics
from spelgen.settings.settings import Settings
from spelgen.structure.pseudo_inertia import parameters_of

ENGINE = f"Pinocchio {pin.__version__}"


@dataclass(frozen=True)
class NumericSamples:
    """Samples of M and of the gravity torque.

    mass: lower triangles of M divided by ``scale``, (1 + n, S, n(n+1)/2); in block k only coordinate k differs from
    block 0. scale: geometric mean of the diagonal entries of row and column, (n(n+1)/2,). gravity: dV/dq divided by its
    largest value, (S, n).
    """

    mass: np.ndarray
    scale: np.ndarray
    gravity: np.ndarray

    @property
    def changes(self) -> np.ndarray:
        """Differences of M between block k and block 0, (n, S, n(n+1)/2)."""
        result: np.ndarray = self.mass[1:] - self.mass[0]
        return result


def draw(arm: Chain, count: int, rng: np.random.Generator, *, random_inertials: bool) -> NumericSamples:
    """Return samples at ``count`` configurations, with random inertial parameters or those from the URDF."""
    n = len(arm.coordinates)
    rows, columns = np.tril_indices(n)
    mass = np.zeros((1 + n, count, n, n))
    gravity = np.zeros((count, n))
    for sample in range(count):
        drawn = arm
        if random_inertials:
            drawn = with_random_inertias(arm, rng)
        dynamics = arm_dynamics(drawn, Settings())
        # Every further row differs from the base in one coordinate: a difference of M is an effect of this
        # coordinate.
        base, moved = _positions(arm, rng), _positions(arm, rng)
        q = np.where(np.eye(1 + n, n, -1) == 1, moved, base)  # (1 + n, n)
        mass[:, sample] = dynamics.mass_matrix(q)
        gravity[sample] = dynamics.gravity(base)
    # Entries have different units (kg, kg m, kg m2): each is relative to its own scale.
    diagonal = np.abs(np.diagonal(mass, axis1=2, axis2=3)).mean(axis=(0, 1))
    scale = np.sqrt(np.outer(diagonal, diagonal))[rows, columns]
    scale[scale == 0] = 1.0
    # An arm without gravity has zeros, which are compared without a unit.
    largest = np.abs(gravity).max() or 1.0
    return NumericSamples(mass[:, :, rows, columns] / scale, scale, gravity / largest)


def regressor(arm: Chain, rng: np.random.Generator) -> np.ndarray:
    """Return rows of the inverse-dynamics regressor at random q, qd, qdd, (m n, 10 B) for B bodies."""
    # The regressor does not depend on the inertial parameters.
    dynamics = arm_dynamics(with_random_inertias(arm, rng), Settings())
    n, bodies = len(arm.coordinates), len(arm.bodies)
    rows = []
    for _ in range(10 * bodies // n + 10):  # more rows than columns
        q = dynamics.configuration(_positions(arm, rng))
        qd = dynamics.jacobian @ rng.normal(size=n)
        qdd = dynamics.jacobian @ rng.normal(size=n)
        by_joint = pin.computeJointTorqueRegressor(dynamics.model, dynamics.data, q, qd, qdd)
        # Pinocchio returns a vector for a single joint.
        rows.append(dynamics.jacobian.T @ by_joint.reshape(bodies, -1))
    return np.concatenate(rows)


def _positions(arm: Chain, rng: np.random.Generator) -> np.ndarray:
    """Return random positions (n,) [rad, m]."""
    # The structure holds at every configuration, also outside the limits.
    half_range = np.where(np.array(arm.joint_types) == "revolute", np.pi, 1.0)
    return rng.uniform(-half_range, half_range)


def with_random_inertias(arm: Chain, rng: np.random.Generator) -> Chain:
    """Return the arm with random, physically consistent inertial parameters of all bodies."""
    translations = np.array([body.translation for body in arm.bodies], dtype=float)
    size = float(np.linalg.norm(translations, axis=1).mean()) or 1.0
    # A A^T is a positive definite pseudo-inertia; lengths have the magnitude of the arm's.
    factors = rng.normal(size=(len(arm.bodies), 4, 4)) * np.array([[size], [size], [size], [1.0]])
    bodies = []
    for body, inertia in zip(arm.bodies, parameters_of(factors @ factors.mT).tolist(), strict=True):
        bodies.append(replace(body, inertia=tuple(map(Fraction, inertia))))
    return replace(arm, bodies=tuple(bodies))
