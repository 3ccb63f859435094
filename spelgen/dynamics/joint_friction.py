"""Friction of drives by constants: viscous, and Coulomb's with its jump at rest smoothed."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from spelgen.settings.joint import JointSettings


@dataclass(frozen=True, eq=False)
class Friction:
    """Friction of n drives, each array (n,), in Nm and rad/s, N and m/s for prismatic joints.

    forward, backward: Coulomb torque for speeds > 0 (not negative) and for speeds < 0 (not positive).
    smoothing_velocity: width of the tanh in place of Coulomb friction's jump. speeds: C, (n, n), the drives' speeds are
    C qd (see `motor_speeds`); None: each moves its own joint alone.
    """

    viscous: np.ndarray
    forward: np.ndarray
    backward: np.ndarray
    smoothing_velocity: float
    speeds: np.ndarray | None = None

    def __call__(self, qd: np.ndarray) -> np.ndarray:
        """Return the torque (..., n) at the joints that friction takes at velocity qd (..., n), C^T of the drives':

            viscous v + s (forward - backward)/2 + s^2 (forward + backward)/2,    s = tanh(v / smoothing_velocity)

        The last two terms tend to `forward` and `backward` on the two sides. All is smooth, 0 at rest, and
        never drives: its product with the speed v = C qd is not negative.
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
    joints: Iterable[Any],
    drives: Mapping[str, JointSettings],
    smoothing_velocity: float,
    speeds: np.ndarray | None,
) -> Friction:
    """Return the friction of joints: that of a joint's drive where this is known, else its URDF's <dynamics>.

    joints: of a URDF, or an arm's coordinates.
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
    return Friction(viscous, forward, backward, smoothing_velocity, speeds)
