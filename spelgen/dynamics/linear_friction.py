"""Describe what friction and drives add to the torque: linear in constants, one column a joint and effect."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spelgen.design import BRISTLE_REACH

BRISTLES = tuple(f"bristle {k + 1}, joint " for k in range(len(BRISTLE_REACH["revolute"])))

# [rad/s, m/s] Velocity at which the additional dry friction of slow motion has fallen to 1/e.
STRIBECK_VELOCITY = 0.1


@dataclass(frozen=True)
class FrictionModel:
    """Say which effects have a column: armature, viscous, Coulomb and offset always.

    coulomb_smoothing_velocity [rad/s, m/s]: width of the tanh in place of Coulomb friction's jump. stribeck: dry
    friction of slow motion (Gaussian, Armstrong-Helouvry 1991). polynomial: qd |qd| and qd^3. memory: dry friction by
    how far each bristle is bent (see ``runtime.friction_laws``), one column each, in place of the tanh.
    """

    coulomb_smoothing_velocity: float = 0.01
    stribeck: bool = False
    polynomial: bool = False
    memory: bool = False

    @property
    def effects(self) -> tuple[str, ...]:
        """Names, in the columns' order."""
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
        """Return (T, n, effects n): effect e of drive j is column e n + j, which only the joints that it moves read.

        bent: (T, n, K), how far the bristles are bent, relative to their reach; None: not known. motors: (n, n), takes
        joints' velocities to the drives' (see ``motor_speeds``); None: each drive moves its own joint alone.
        """
        motors = np.eye(qd.shape[-1]) if motors is None else motors
        effects = self._effects(qd @ motors.T, qdd @ motors.T, bent)
        columns: np.ndarray = effects[..., None, :, :] * motors.T[:, None]
        return columns.reshape(*qd.shape, -1)

    def torque(
        self, constants: np.ndarray, qd: np.ndarray, bent: np.ndarray | None, motors: np.ndarray
    ) -> np.ndarray:
        """Return all but the armature's part, (..., n), of ``constants`` by effect and drive, (effects, n)."""
        speed = qd @ motors.T
        torque: np.ndarray = (self._effects(speed, np.zeros_like(speed), bent) * constants).sum(
            axis=-2
        ) @ motors
        return torque

    def _effects(self, speed: np.ndarray, rise: np.ndarray, bent: np.ndarray | None) -> np.ndarray:
        """Return what each constant is multiplied with, (..., effects, n), by the drives' motion."""
        sign = np.tanh(speed / self.coulomb_smoothing_velocity)
        dry = [sign]
        if self.memory:
            # where the motion before is not known: as of a joint that has long moved the way it does
            dry = [sign] * len(BRISTLES) if bent is None else list(np.moveaxis(bent, -1, 0))
        effects = [rise, speed, *dry, np.ones_like(speed)]
        if self.stribeck:
            effects.append(sign * np.exp(-((speed / STRIBECK_VELOCITY) ** 2)))
        if self.polynomial:
            effects += [speed * np.abs(speed), speed**3]
        return np.stack(effects, axis=-2)
