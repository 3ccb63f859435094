"""Draw mass matrices, torques of gravity and torque regressors of an arm by Pinocchio, at random configurations.

With random inertials every sample has its own, each that of a possible rigid body: the pseudo-inertia is
positive definite (Wensing, Kim and Slotine, RA-L 3(1), 2018).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
import pinocchio as pin

from spelgen.arm.arm import Arm
from spelgen.dynamics.pinocchio_arm import arm_dynamics
from spelgen.settings.settings import Settings
from spelgen.structure.pseudo_inertia import parameters_of

ENGINE = f"Pinocchio {pin.__version__}"


@dataclass(frozen=True)
class NumericSamples:
    """Hold samples: of M in blocks, every one but the first with one coordinate moved.

    ``mass`` (1 + n, samples, n(n+1)/2), each entry in units of ``scale`` (n(n+1)/2,), the geometric mean of
    its row's and column's diagonal entries; ``gravity`` dV/dq (samples, n), in units of its largest value.
    """

    mass: np.ndarray
    scale: np.ndarray
    gravity: np.ndarray

    @property
    def changes(self) -> np.ndarray:
        """How M changes when one coordinate moves, (n, samples, n(n+1)/2)."""
        result: np.ndarray = self.mass[1:] - self.mass[0]
        return result


def draw(arm: Arm, count: int, rng: np.random.Generator, *, random_inertials: bool) -> NumericSamples:
    """Return ``count`` samples of ``arm``, with random inertials or those it has."""
    n = len(arm.coordinates)
    rows, columns = np.tril_indices(n)
    mass = np.zeros((1 + n, count, n, n))
    gravity = np.zeros((count, n))
    for sample in range(count):
        drawn = arm
        if random_inertials:
            drawn = with_random_inertias(arm, rng)
        dynamics = arm_dynamics(drawn, Settings())
        base, moved = _positions(arm, rng), _positions(arm, rng)
        q = np.where(np.eye(1 + n, n, -1) == 1, moved, base)  # (1 + n, n)
        mass[:, sample] = dynamics.mass_matrix(q)
        gravity[sample] = dynamics.gravity(base)
    # entries mix kilograms and kilogram square metres: each is judged in its own unit
    diagonal = np.abs(np.diagonal(mass, axis1=2, axis2=3)).mean(axis=(0, 1))
    scale = np.sqrt(np.outer(diagonal, diagonal))[rows, columns]
    scale[scale == 0] = 1.0
    largest = np.abs(gravity).max() or 1.0
    return NumericSamples(mass[:, :, rows, columns] / scale, scale, gravity / largest)


def regressor(arm: Arm, rng: np.random.Generator) -> np.ndarray:
    """Return rows of the inverse-dynamics regressor at random q, qd, qdd, (rows, 10 bodies)."""
    # a regressor does not depend on inertials: any possible ones will do
    dynamics = arm_dynamics(with_random_inertias(arm, rng), Settings())
    n, bodies = len(arm.coordinates), len(arm.bodies)
    rows = []
    for _ in range(10 * bodies // n + 10):  # more rows than columns
        q = dynamics.configuration(_positions(arm, rng))
        qd = dynamics.jacobian @ rng.normal(size=n)
        qdd = dynamics.jacobian @ rng.normal(size=n)
        by_joint = pin.computeJointTorqueRegressor(dynamics.model, dynamics.data, q, qd, qdd)
        # of a single joint Pinocchio gives a vector
        rows.append(dynamics.jacobian.T @ by_joint.reshape(bodies, -1))
    return np.concatenate(rows)


def _positions(arm: Arm, rng: np.random.Generator) -> np.ndarray:
    turns = np.array(arm.joint_types) == "revolute"
    # beyond limits, too: the structure holds at every configuration
    reach = np.where(turns, np.pi, 1.0)
    return rng.uniform(-reach, reach)


def with_random_inertias(arm: Arm, rng: np.random.Generator) -> Arm:
    """Return the arm with the inertia of a possible rigid body, drawn anew, on every joint."""
    translations = np.array([body.translation for body in arm.bodies], dtype=float)
    size = float(np.linalg.norm(translations, axis=1).mean()) or 1.0
    # any positive definite pseudo-inertia is that of a possible body; lengths are of the arm's size
    factors = rng.normal(size=(len(arm.bodies), 4, 4)) * np.array([[size], [size], [size], [1.0]])
    bodies = []
    for body, inertia in zip(arm.bodies, parameters_of(factors @ factors.mT).tolist(), strict=True):
        bodies.append(replace(body, inertia=tuple(map(Fraction, inertia))))
    return replace(arm, bodies=tuple(bodies))
