"""Mass matrices, potential energies and torque regressors of an arm by Pinocchio, at random configurations.

With random inertials every sample has its own, each that of a possible rigid body: the pseudo-inertia is
positive definite (Wensing, Kim and Slotine, RA-L 3(1), 2018).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
import pinocchio as pin

from spelgen.arm.arm import Arm, Body
from spelgen.dynamics.pinocchio_arm import arm_dynamics
from spelgen.dynamics.pinocchio_dynamics import PinocchioDynamics
from spelgen.settings.settings import Settings
from spelgen.structure.basis import Weights
from spelgen.structure.recursion import triangle

ENGINE = f"Pinocchio {pin.__version__}"


@dataclass(frozen=True)
class NumericSamples:
    """Every block but the first has one coordinate moved.

    ``mass`` (1 + n, samples, n(n+1)/2), each entry in units of ``scale`` (n(n+1)/2,), the geometric mean of
    its row's and column's diagonal entries; ``potential`` (1 + n, samples), in units of its largest value.
    """

    mass: np.ndarray
    scale: np.ndarray
    potential: np.ndarray

    @property
    def changes(self) -> np.ndarray:
        """What moving one coordinate changes, (n, samples, n(n+1)/2)."""
        return self.mass[1:] - self.mass[0]

    def combined(self, weights: Weights) -> tuple[np.ndarray, float]:
        """A weighted sum of entries (1 + n, samples), and the size it would have if nothing cancelled."""
        keys = {key: index for index, key in enumerate(triangle(len(self.mass) - 1))}
        row = np.zeros(len(self.scale))
        for i, j, value in weights:
            row[keys[i, j]] = float(value)
        return self.mass @ (row * self.scale), float(np.abs(row) @ self.scale)


def draw(arm: Arm, count: int, rng: np.random.Generator, *, random_inertials: bool) -> NumericSamples:
    """``count`` samples of ``arm``, with random inertials or those it has."""
    n = len(arm.coordinates)
    rows, columns = np.tril_indices(n)
    mass, potential = np.zeros((1 + n, count, n, n)), np.zeros((1 + n, count))
    own = None if random_inertials else arm_dynamics(arm, Settings())
    for sample in range(count):
        drawn = own or arm_dynamics(with_random_inertias(arm, rng), Settings())
        base, other = _positions(arm, rng), _positions(arm, rng)
        for block in range(1 + n):
            q = base.copy()
            if block:
                q[block - 1] = other[block - 1]
            mass[block, sample] = drawn.mass_matrix(q)
            potential[block, sample] = _potential_energy(drawn, q)
    typical = np.sqrt(np.abs(np.diagonal(mass, axis1=2, axis2=3)).mean(axis=(0, 1)))
    scale = np.outer(typical, typical)[rows, columns]
    scale[scale == 0] = 1.0
    return NumericSamples(
        mass[:, :, rows, columns] / scale, scale, potential / (np.abs(potential).max() or 1.0)
    )


def regressor(arm: Arm, rng: np.random.Generator) -> np.ndarray:
    """Rows of the inverse-dynamics regressor at random q, qd, qdd, (rows, 10 bodies)."""
    drawn = arm_dynamics(with_random_inertias(arm, rng), Settings())
    n = len(arm.coordinates)
    rows = []
    for _ in range(10 * len(arm.bodies) // n + 10):
        q = drawn.configuration(_positions(arm, rng))
        v, a = (drawn.jacobian @ rng.normal(size=n) for _ in range(2))
        by_joint = pin.computeJointTorqueRegressor(drawn.model, drawn.data, q, v, a)
        # of a single joint Pinocchio gives a vector
        rows.append(drawn.jacobian.T @ by_joint.reshape(len(arm.bodies), -1))
    return np.concatenate(rows)


def _positions(arm: Arm, rng: np.random.Generator) -> np.ndarray:
    reach = np.array([np.pi if coordinate.kind == "revolute" else 1.0 for coordinate in arm.coordinates])
    return rng.uniform(-reach, reach)


def _potential_energy(drawn: PinocchioDynamics, q: np.ndarray) -> float:
    return float(pin.computePotentialEnergy(drawn.model, drawn.data, drawn.configuration(q)))


def with_random_inertias(arm: Arm, rng: np.random.Generator) -> Arm:
    """The arm with the inertia of a possible rigid body, drawn anew, on every joint."""
    lengths = [float(np.linalg.norm(np.array(body.translation, dtype=float))) for body in arm.bodies]
    size = float(np.mean(lengths)) or 1.0
    return replace(arm, bodies=tuple(_random_body(body, size, rng) for body in arm.bodies))


def _random_body(body: Body, size: float, rng: np.random.Generator) -> Body:
    factor = rng.normal(size=(4, 4)) * np.array([[size], [size], [size], [1.0]])
    pseudo = factor @ factor.T
    tensor = np.trace(pseudo[:3, :3]) * np.eye(3) - pseudo[:3, :3]
    ten = (pseudo[3, 3], *pseudo[3, :3], *tensor[np.triu_indices(3)])
    return replace(body, inertia=tuple(Fraction(float(x)) for x in ten))
