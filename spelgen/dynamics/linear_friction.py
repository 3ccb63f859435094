"""Friction and drive torque that is linear in its constants: a column per joint and effect."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spelgen.design import BRISTLE_REACH

BRISTLES = tuple(f"bristle {k + 1}, joint " for k in range(len(BRISTLE_REACH["revolute"])))

# [rad/s, m/s] Velocity at which the additional dry friction of slow motion has fallen to 1/e.
STRIBECK_VELOCITY = 0.1


@dataclass(frozen=True)
class FrictionModel:
    """The effects that have a column, in addition to armature, viscous and Coulomb friction and offset.

    coulomb_smoothing_velocity [rad/s, m/s]: width of the tanh in place of the sign of the velocity. stribeck: dry
    friction at low velocity (Gaussian, Armstrong-Helouvry 1991). polynomial: qd |qd| and qd^3. memory: dry friction as
    a function of the deflection of bristles (see ``runtime.friction_laws``), a column each, in place of the tanh.
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
        columns: np.ndarray = effects[..., None, :, :] * motors.T[:, None]
        return columns.reshape(*qd.shape, -1)

    def torque(
        self, constants: np.ndarray, qd: np.ndarray, bent: np.ndarray | None, motors: np.ndarray
    ) -> np.ndarray:
        """Return the torque without that of the armature, (..., n) [Nm, N], for ``constants`` (effects, n)."""
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
            effects.append(sign * np.exp(-((speed / STRIBECK_VELOCITY) ** 2)))
        if self.polynomial:
            effects += [speed * np.abs(speed), speed**3]
        return np.stack(effects, axis=-2)
