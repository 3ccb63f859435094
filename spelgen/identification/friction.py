"""Describe what friction and drives add to the torque: linear in constants, one column a joint and effect."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spelgen.design import BRISTLE_REACH
from spelgen.settings.tuning.identification import IdentificationTuning

BRISTLES = tuple(f"bristle {k + 1}, joint " for k in range(len(BRISTLE_REACH["revolute"])))
STRIBECK_VELOCITY = IdentificationTuning().stribeck_velocity


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
        motors = np.eye(qd.shape[1]) if motors is None else motors
        qd, qdd = qd @ motors.T, qdd @ motors.T
        effects = np.stack([qdd, *self._velocity_effects(qd, bent)], axis=-2)  # (T, effects, n)
        columns: np.ndarray = effects[:, None] * motors.T[:, None]
        return columns.reshape(*qd.shape, -1)

    def torque(
        self,
        constants: np.ndarray,
        qd: np.ndarray,
        bent: np.ndarray | None = None,
        motors: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return all but the armature's part, (T, n), of ``constants`` by effect and drive, (effects, n)."""
        motors = np.eye(qd.shape[1]) if motors is None else motors
        effects = np.stack(self._velocity_effects(qd @ motors.T, bent))
        torque: np.ndarray = np.einsum("en,e...n->...n", constants[1:], effects) @ motors
        return torque

    def _velocity_effects(self, qd: np.ndarray, bent: np.ndarray | None) -> list[np.ndarray]:
        """Return what each constant but the armature is multiplied with, each (T, n)."""
        sign = np.tanh(qd / self.coulomb_smoothing_velocity)
        dry = [sign]
        if self.memory:
            # where the motion before is not known: as of a joint that has long moved the way it does
            dry = [sign] * len(BRISTLES) if bent is None else list(np.moveaxis(bent, -1, 0))
        effects = [qd, *dry, np.ones_like(qd)]
        if self.stribeck:
            effects.append(sign * np.exp(-((qd / STRIBECK_VELOCITY) ** 2)))
        if self.polynomial:
            effects += [qd * np.abs(qd), qd**3]
        return effects
