"""What friction and drives add to the torque, linear in unknown constants: one column a joint and effect."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

STRIBECK_VELOCITY = 0.1  # [rad/s, m/s] at which the extra dry friction of slow motion has fallen to 1/e


@dataclass(frozen=True)
class FrictionModel:
    """Which effects have a column: armature, viscous, Coulomb and offset always.

    coulomb_smoothing_velocity [rad/s, m/s]: width of the tanh in place of Coulomb friction's jump. stribeck: dry
    friction of slow motion (Gaussian, Armstrong-Helouvry 1991). polynomial: qd |qd| and qd^3.
    """

    coulomb_smoothing_velocity: float = 0.01
    stribeck: bool = False
    polynomial: bool = False

    @property
    def effects(self) -> tuple[str, ...]:
        """Their names, in the columns' order."""
        more = ("stribeck",) * self.stribeck + ("quadratic", "cubic") * self.polynomial
        return ("armature", "viscous", "coulomb", "offset", *more)

    def columns(self, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
        """(T, n, effects n): effect e of joint j is column e n + j, which no other joint's torque reads."""
        parts = np.stack([qdd, *self._velocity_parts(qd)], axis=-2)  # (T, effects, n)
        columns: np.ndarray = parts[:, None] * np.eye(qd.shape[1])[:, None]
        return columns.reshape(*qd.shape, -1)

    def torque(self, constants: np.ndarray, qd: np.ndarray) -> np.ndarray:
        """All but the armature's part, (T, n), of ``constants`` by effect and joint, (effects, n)."""
        parts = zip(constants[1:], self._velocity_parts(qd), strict=True)
        return np.sum([by_joint * part for by_joint, part in parts], axis=0)

    def _velocity_parts(self, qd: np.ndarray) -> list[np.ndarray]:
        sign = np.tanh(qd / self.coulomb_smoothing_velocity)
        parts = [qd, sign, np.ones_like(qd)]
        if self.stribeck:
            parts.append(sign * np.exp(-((qd / STRIBECK_VELOCITY) ** 2)))
        if self.polynomial:
            parts += [qd * np.abs(qd), qd**3]
        return parts
