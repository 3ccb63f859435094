"""Friction of drives: with constant coefficients, and as columns that are linear in the constants of each joint."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from spelgen.design import BREAKAWAY
from spelgen.settings.settings import JointSettings


class DampedJoint(Protocol):
    """A joint with the damping and friction of <dynamics> in a URDF."""

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
        """Return the joint friction torque, (..., n), at velocities qd (..., n): C^T times the drives' torque

            viscous v + s (forward - backward)/2 + s^2 (forward + backward)/2,    s = tanh(v / smoothing_velocity)

        The last two terms tend to `forward` and `backward` for large |v|. The torque is smooth, 0 at rest, and
        dissipative: its product with v = C qd is not negative.
        """
        v = qd if self.speeds is None else qd @ self.speeds.T
        return self.torque(qd, np.tanh(v / self.smoothing_velocity))

    def torque(self, qd: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Return the joint friction torque (..., n) at velocities qd (..., n) for a direction of dry friction.

        direction: (..., n) in [-1, 1] per drive: tanh(v / smoothing_velocity), or from the friction state.
        """
        v = qd if self.speeds is None else qd @ self.speeds.T
        # s (f - b) / 2 + s^2 (f + b) / 2 is f at s = 1, b at s = -1, and has no jump between them.
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

    joints: of a URDF, or the coordinates of an arm. speeds: C, (n, n), see ``DriveFriction``.
    """
    # settings replace <dynamics> as a whole: both describe the same losses
    losses = []
    for joint in joints:
        if joint.name in drives:
            drive = drives[joint.name]
            losses.append((drive.viscous, *drive.coulomb))
        else:
            losses.append((joint.damping, joint.friction, -joint.friction))
    # Drives that are not coupled have C = 1: without it each integration step saves two matrix products.
    if speeds is not None and np.array_equal(speeds, np.eye(len(speeds))):
        speeds = None
    viscous, forward, backward = np.array(losses).T
    return DriveFriction(viscous, forward, backward, smoothing_velocity, speeds)


BRISTLES = tuple(f"bristle {k + 1}, joint " for k in range(len(BREAKAWAY["revolute"])))


@dataclass(frozen=True)
class FrictionModel:
    """The effects that have a column, in addition to armature, viscous and Coulomb friction and offset.

    coulomb_smoothing_velocity [rad/s, m/s]: width of the tanh in place of the sign of the velocity. stribeck: dry
    friction at low velocity (Gaussian, Armstrong-Helouvry 1991). polynomial: qd |qd| and qd^3. memory: dry friction as
    a function of the deflection of bristles (see ``runtime.friction_laws``), one column per bristle, in place of the
    tanh.
    """

    coulomb_smoothing_velocity: float = 0.01
    stribeck: bool = False
    polynomial: bool = False
    memory: bool = False

    @property
    def effects(self) -> tuple[str, ...]:
        """Names of the effects, in the order of the columns."""
        names = ["armature", "viscous", *(BRISTLES if self.memory else ("coulomb",)), "offset"]
        if self.stribeck:
            names.append("stribeck")
        if self.polynomial:
            names += ["quadratic", "cubic"]
        return tuple(names)

    def columns(
        self,
        qd: np.ndarray,
        qdd: np.ndarray,
        bent: np.ndarray | None = None,
        motors: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return the columns, (T, n, effects n): effect e of drive j is column e n + j.

        Args:
            qd, qdd: motion of the joints, (T, n).
            bent: deflections of the bristles relative to their break-away displacements, (T, n, K); None: unknown.
            motors: C, (n, n), the drives rotate at C qd; None: each drive moves its own joint.
        """
        motors = np.eye(qd.shape[-1]) if motors is None else motors
        effects = self._effects(qd @ motors.T, qdd @ motors.T, bent)
        # The torque of drive j acts on joint i by C_ji, as power is equal on both sides of the gears.
        columns: np.ndarray = effects[..., None, :, :] * motors.T[:, None]
        return columns.reshape(*qd.shape, -1)

    def torque(
        self, constants: np.ndarray, qd: np.ndarray, bent: np.ndarray | None, motors: np.ndarray
    ) -> np.ndarray:
        """Return the torque without the armature's contribution, (..., n) [Nm, N], for ``constants`` (effects, n)."""
        speed = qd @ motors.T
        torque: np.ndarray = (self._effects(speed, np.zeros_like(speed), bent) * constants).sum(
            axis=-2
        ) @ motors
        return torque

    def _effects(self, speed: np.ndarray, rise: np.ndarray, bent: np.ndarray | None) -> np.ndarray:
        """Return the factor of each constant, (..., effects, n), from velocity and acceleration of the drives."""
        sign = np.tanh(speed / self.coulomb_smoothing_velocity)
        dry = [sign]
        if self.memory:
            # if the history is unknown: bristles of a joint that has moved in this direction for a long time
            dry = [sign] * len(BRISTLES) if bent is None else list(np.moveaxis(bent, -1, 0))
        effects = [rise, speed, *dry, np.ones_like(speed)]
        if self.stribeck:
            # falls to 1/e at 0.1 rad/s or m/s
            effects.append(sign * np.exp(-((speed / 0.1) ** 2)))
        if self.polynomial:
            effects += [speed * np.abs(speed), speed**3]
        # the order of `effects`
        return np.stack(effects, axis=-2)
