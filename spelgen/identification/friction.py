"""What friction and drives add to the torque, linear in unknown constants: one column a joint and effect."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

STRIBECK_VELOCITY = 0.1  # [rad/s, m/s] at which the extra dry friction of slow motion has fallen to 1/e


@dataclass(frozen=True)
class FrictionModel:
    """Which effects have a column: viscous, Coulomb, offset and rotor inertia always.

    dry_velocity [rad/s, m/s]: width of the tanh in place of Coulomb friction's jump. stribeck: dry friction that
    fades with speed (Gaussian, Armstrong-Helouvry 1991). polynomial: qd |qd| and qd^3.
    """

    dry_velocity: float = 0.01
    stribeck: bool = False
    polynomial: bool = False

    @property
    def effects(self) -> tuple[str, ...]:
        """Their names, in the columns' order."""
        more = ("stribeck",) * self.stribeck + ("quadratic", "cubic") * self.polynomial
        return ("rotor", "viscous", "coulomb", "offset", *more)

    def columns(self, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
        """(T, n, effects n): effect e of joint j is column e n + j, which no other joint's torque reads."""
        dry = np.tanh(qd / self.dry_velocity)
        parts = [qdd, qd, dry, np.ones_like(qd)]
        if self.stribeck:
            parts.append(dry * np.exp(-((qd / STRIBECK_VELOCITY) ** 2)))
        if self.polynomial:
            parts += [qd * np.abs(qd), qd**3]
        return np.concatenate([x[:, :, None] * np.eye(qd.shape[1]) for x in parts], axis=-1)
