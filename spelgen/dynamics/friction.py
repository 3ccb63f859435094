"""Friction of drives with constant coefficients: its torque, and its regressor for the fit of coefficients."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from spelgen.design import BREAKAWAY
from spelgen.settings.settings import JointSettings


class DampedJoint(Protocol):
    """Joint of a URDF with the damping and the friction of its <dynamics> element."""

    @property
    def name(self) -> str: ...
    @property
    def damping(self) -> float: ...
    @property
    def friction(self) -> float: ...


@dataclass(frozen=True, eq=False)
class DriveFriction:
    """Viscous friction and Coulomb friction of n drives, with different Coulomb torques for both directions.

    Attributes:
        viscous: viscous coefficients, (n,) [Nm s/rad, N s/m].
        forward: Coulomb torques for velocities > 0, not negative, (n,) [Nm, N].
        backward: Coulomb torques for velocities < 0, not positive, (n,) [Nm, N].
        smoothing_velocity: width of the tanh that replaces the sign of the velocity [rad/s, m/s].
        speeds: matrix C, (n, n): the velocities of the drives are C qd (see `motor_speeds`); None: each drive moves its
            own joint.
    """

    viscous: np.ndarray
    forward: np.ndarray
    backward: np.ndarray
    smoothing_velocity: float
    speeds: np.ndarray | None = None

    def __call__(self, qd: np.ndarray, direction: np.ndarray | None = None) -> np.ndarray:
        """Return the friction torque of the joints, (..., n) [Nm, N], at joint velocities qd, (..., n) [rad/s, m/s].

        The torque is C^T times the torque of the drives, which depends on their velocities v = C qd:

            viscous v + s (forward - backward)/2 + s^2 (forward + backward)/2,    s = tanh(v / smoothing_velocity)

        The sum of the last two terms, Coulomb friction, tends to `forward` > 0 for v >> 0 and to `backward` < 0 for v
        << 0. The torque is smooth, 0 at rest, and dissipative: the torque of a drive times its velocity is not
        negative.

        direction: factor s of the dry friction of each drive, from -1 to 1, (..., n), computed from the friction state;
        None: the tanh above.
        """
        v = qd if self.speeds is None else qd @ self.speeds.T
        if direction is None:
            direction = np.tanh(v / self.smoothing_velocity)
        # With the direction s, forward f and backward b: s (f - b)/2 + s^2 (f + b)/2 is f at s = 1 and b at s = -1.
        odd, even = self.forward - self.backward, self.forward + self.backward
        torque: np.ndarray = self.viscous * v + 0.5 * direction * (odd + direction * even)
        return torque if self.speeds is None else torque @ self.speeds


def joint_friction(
    joints: Iterable[DampedJoint],
    drives: Mapping[str, JointSettings],
    smoothing_velocity: float,
    speeds: np.ndarray | None,
) -> DriveFriction:
    """Return the friction of joints, from the settings of their drives or from the URDF.

    Args:
        joints: joints of a URDF, or coordinates of an arm.
        drives: {name of a joint: settings of its drive}; for other joints, <dynamics> of the URDF is used.
        smoothing_velocity, speeds: see ``DriveFriction``.
    """
    # The friction of a joint is taken from the settings of its drive, if there are any, otherwise from the <dynamics>
    # element of the URDF. The two are not added: both describe the same friction, which would be counted twice.
    losses = []
    for joint in joints:
        if joint.name in drives:
            drive = drives[joint.name]
            losses.append((drive.viscous, *drive.coulomb))
        else:
            losses.append((joint.damping, joint.friction, -joint.friction))
    # C is the identity for drives that are not coupled: omitting C saves two matrix products per integration step.
    if speeds is not None and np.array_equal(speeds, np.eye(len(speeds))):
        speeds = None
    viscous, forward, backward = np.array(losses).T
    return DriveFriction(viscous, forward, backward, smoothing_velocity, speeds)


BRISTLES = tuple(f"bristle {k + 1}, joint " for k in range(len(BREAKAWAY["revolute"])))


@dataclass(frozen=True)
class FrictionModel:
    """Torques of drives that are linear in coefficients, as columns of the regressor of a least-squares fit.

    Each effect is a torque per drive: armature, viscous and Coulomb friction, torque offset, and the effects that
    ``stribeck`` and ``polynomial`` add.

    Attributes:
        coulomb_smoothing_velocity: width of the tanh that replaces the sign of the velocity [rad/s, m/s].
        stribeck: True: add dry friction at low velocity (Gaussian, Armstrong-Helouvry 1991).
        polynomial: True: add the effects qd |qd| and qd^3.
        memory: True: Coulomb friction depends on the deflections of bristles (see ``runtime.friction_laws``), and each
            bristle is an effect with its own coefficient. False: Coulomb friction depends on the tanh of the velocity.
    """

    coulomb_smoothing_velocity: float = 0.01
    stribeck: bool = False
    polynomial: bool = False
    memory: bool = False

    @property
    def effects(self) -> tuple[str, ...]:
        """Names of all effects, in the order of the regressor's columns."""
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
        """Return the regressor of E effects, (T, n, E n): column e n + j is effect e of drive j per unit coefficient.

        The order of the effects is the order of the property `effects`: armature, viscous friction, Coulomb friction
        (with ``memory``: one effect per bristle), torque offset and, if enabled, Stribeck and polynomial friction.

        Args:
            qd, qdd: velocities [rad/s, m/s] and accelerations [rad/s^2, m/s^2] of the joints, (T, n).
            bent: deflections of K bristles per drive, divided by the break-away displacements, (T, n, K). None, if
                unknown: Coulomb friction of each bristle then depends on the tanh of the velocity.
            motors: matrix C, (n, n): the velocities of the drives are C qd; None: each drive moves its own joint.
        """
        motors = np.eye(qd.shape[-1]) if motors is None else motors
        effects = self._effects(qd @ motors.T, qdd @ motors.T, bent)
        # C is `motors`. The velocities of the drives are C qd, and power is equal on both sides of the gears: the
        # torque of drive j acts on joint i with the factor C_ji.
        columns: np.ndarray = effects[..., None, :, :] * motors.T[:, None]
        return columns.reshape(*qd.shape, -1)

    def torque(
        self, constants: np.ndarray, qd: np.ndarray, bent: np.ndarray | None, motors: np.ndarray
    ) -> np.ndarray:
        """Return the joint torque of friction and offset: all effects except for the armature, (..., n) [Nm, N].

        Args:
            constants: coefficients of the E effects in `effects`, (E, n).
            qd: joint velocities, (..., n) [rad/s, m/s].
            bent: deflections of K bristles per drive, divided by the break-away displacements, (..., n, K); None:
                unknown.
            motors: matrix C, (n, n): the velocities of the drives are C qd.
        """
        speed = qd @ motors.T
        effects = self._effects(speed, np.zeros_like(speed), bent)
        return np.asarray((effects * constants).sum(axis=-2) @ motors)

    def _effects(self, speed: np.ndarray, rise: np.ndarray, bent: np.ndarray | None) -> np.ndarray:
        """Return the torque at the drives of each effect in `effects` per unit of its coefficient, (..., effects, n).

        For example, the effect "viscous" has the torque `speed`, and "armature" has the torque `rise`.

        Args:
            speed: velocities of the drives, (..., n) [rad/s, m/s].
            rise: accelerations of the drives, (..., n) [rad/s^2, m/s^2].
            bent: deflections of K bristles per drive, divided by the break-away displacements, (..., n, K); None:
                unknown.
        """
        sign = np.tanh(speed / self.coulomb_smoothing_velocity)
        dry = [sign]
        if self.memory:
            # If the bristle deflections are unknown, the drive is assumed to have moved in the direction of its
            # velocity for a long time.
            dry = [sign] * len(BRISTLES) if bent is None else list(np.moveaxis(bent, -1, 0))
        effects = [rise, speed, *dry, np.ones_like(speed)]
        if self.stribeck:
            # The Stribeck effect is exp(-(v / 0.1)^2): it falls to 1/e at a velocity v of 0.1 rad/s or m/s.
            effects.append(sign * np.exp(-((speed / 0.1) ** 2)))
        if self.polynomial:
            effects += [speed * np.abs(speed), speed**3]
        # The rows of the result, (..., effects, n), have the order of the property `effects`.
        return np.stack(effects, axis=-2)
