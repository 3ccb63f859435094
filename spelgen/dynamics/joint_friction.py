"""Friction of drives by constants: viscous, and Coulomb's with its jump at rest smoothed."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np


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
        s = np.tanh(v / self.smoothing_velocity)
        torque: np.ndarray = self.viscous * v + s * (self._odd + s * self._even)
        return torque if self.speeds is None else torque @ self.speeds

    @cached_property
    def _odd(self) -> np.ndarray:
        return np.asarray(0.5 * (self.forward - self.backward))

    @cached_property
    def _even(self) -> np.ndarray:
        return np.asarray(0.5 * (self.forward + self.backward))
