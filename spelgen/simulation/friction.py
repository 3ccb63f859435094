"""Describe friction of simulated joints: viscous, and Coulomb's with its jump at rest smoothed."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from spelgen.arm.arm import Arm, Coordinate
from spelgen.settings.joint import JointSettings
from spelgen.settings.settings import Settings


@dataclass(frozen=True, eq=False)
class Friction:
    """Friction of n joints, each array (n,), in Nm and rad/s, N and m/s for prismatic joints.

    forward, backward: Coulomb torque for qd > 0 (not negative) and for qd < 0 (not positive).
    smoothing_velocity: width of the tanh in place of Coulomb friction's jump.
    """

    viscous: np.ndarray
    forward: np.ndarray
    backward: np.ndarray
    smoothing_velocity: float

    def __call__(self, qd: np.ndarray) -> np.ndarray:
        """Return the torque (..., n) that friction takes at velocity qd (..., n):

            viscous qd + s (forward - backward)/2 + s^2 (forward + backward)/2,    s = tanh(qd / smoothing_velocity)

        The last two terms tend to `forward` and `backward` on the two sides. All is smooth, 0 at rest, and
        never drives: its product with qd is not negative.
        """
        s = np.tanh(qd / self.smoothing_velocity)
        torque: np.ndarray = self.viscous * qd + s * (self._odd + s * self._even)
        return torque

    @cached_property
    def _odd(self) -> np.ndarray:
        return np.asarray(0.5 * (self.forward - self.backward))

    @cached_property
    def _even(self) -> np.ndarray:
        return np.asarray(0.5 * (self.forward + self.backward))

    @cached_property
    def widths(self) -> np.ndarray:
        """Velocity (n,) within which the friction of each joint jumps, infinite where it does not."""
        return np.where(self.forward > self.backward, self.smoothing_velocity, np.inf)


def make_friction(arm: Arm, settings: Settings) -> Friction:
    """Return the friction of the arm: a joint's settings where it has some, else its URDF's <dynamics>."""
    joints = [_losses(coordinate, settings) for coordinate in arm.coordinates]
    return Friction(
        viscous=np.array([joint.viscous for joint in joints]),
        forward=np.array([joint.coulomb[0] for joint in joints]),
        backward=np.array([joint.coulomb[1] for joint in joints]),
        smoothing_velocity=settings.simulation.coulomb_smoothing_velocity,
    )


def _losses(coordinate: Coordinate, settings: Settings) -> JointSettings:
    urdf = JointSettings(viscous=coordinate.damping, coulomb=(coordinate.friction, -coordinate.friction))
    return settings.joints.get(coordinate.name, urdf)
