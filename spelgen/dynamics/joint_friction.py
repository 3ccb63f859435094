"""Friction of drives with constant coefficients: viscous, and Coulomb friction that is smooth at rest."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from spelgen.settings.joint import JointSettings


class DampedJoint(Protocol):
    """A joint with <dynamics> of a URDF."""

    @property
    def name(self) -> str: ...
    @property
    def damping(self) -> float: ...
    @property
    def friction(self) -> float: ...


@dataclass(frozen=True, eq=False)
class DriveFriction:
    """Friction of n drives, each array (n,), in Nm and rad/s, N and m/s for prismatic joints.

    forward, backward: Coulomb torque for speeds > 0 (not negative) and for speeds < 0 (not positive).
    smoothing_velocity: width of the tanh in place of the sign of the velocity. speeds: C, (n, n), the drives rotate at
    C qd (see `motor_speeds`); None: each drive moves its own joint.
    """

    viscous: np.ndarray
    forward: np.ndarray
    backward: np.ndarray
    smoothing_velocity: float
    speeds: np.ndarray | None = None

    def __call__(self, qd: np.ndarray) -> np.ndarray:
        """Return the friction torque at the joints, (..., n), at velocities qd (..., n): C^T times that of the drives,

            viscous v + s (forward - backward)/2 + s^2 (forward + backward)/2,    s = tanh(v / smoothing_velocity)

        The last two terms tend to `forward` and `backward` for large |v|. The torque is smooth, 0 at rest, and
        dissipative: its product with v = C qd is not negative.
        """
        v = qd if self.speeds is None else qd @ self.speeds.T
        return self.torque(qd, np.tanh(v / self.smoothing_velocity))

    def torque(self, qd: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Return the joint torque (..., n) at velocity qd (..., n), with the direction of dry friction given.

        direction: (..., n) in [-1, 1], of the drives: s in the formula of `__call__`, or that of a friction state.
        """
        v = qd if self.speeds is None else qd @ self.speeds.T
        odd, even = self.forward - self.backward, self.forward + self.backward
        torque: np.ndarray = self.viscous * v + 0.5 * direction * (odd + direction * even)
        return torque if self.speeds is None else torque @ self.speeds


def joint_friction(
    joints: Iterable[DampedJoint],
    drives: Mapping[str, JointSettings],
    smoothing_velocity: float,
    speeds: np.ndarray | None,
) -> DriveFriction:
    """Return the friction of joints: from the settings of a drive, or from <dynamics> of the URDF if there are none.

    joints: of a URDF, or the coordinates of an arm. speeds: see ``DriveFriction``.
    """
    losses = []
    for joint in joints:
        if joint.name in drives:
            drive = drives[joint.name]
            losses.append((drive.viscous, *drive.coulomb))
        else:
            losses.append((joint.damping, joint.friction, -joint.friction))
    if speeds is not None and np.array_equal(speeds, np.eye(len(speeds))):
        speeds = None
    viscous, forward, backward = np.array(losses).T
    return DriveFriction(viscous, forward, backward, smoothing_velocity, speeds)
