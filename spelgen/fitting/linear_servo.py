"""What any model of an arm under position servos has to beat: commands that come late, and linear servos."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy.linalg import expm
from scipy.optimize import least_squares, minimize_scalar

from spelgen.fitting.servo_windows import ServoWindows

LATEST = 0.4  # s
START = (20.0, 1.0, 0.02, 0.0)  # frequency [rad/s], damping ratio, delay [s], offset [rad, m]
LEAST, MOST = (1.0, 0.05, 0.0, -1.0), (200.0, 20.0, LATEST, 1.0)


@dataclass(frozen=True)
class LinearServos:
    """Of each joint by itself qdd = w^2 (u + offset - q) - 2 damping w qd, u commanded `delay` [s] ago.

    late: the one delay [s] by which commands themselves are nearest to positions.
    """

    frequency: tuple[float, ...]
    damping: tuple[float, ...]
    delay: tuple[float, ...]
    offset: tuple[float, ...]
    late: float

    def to_dict(self) -> dict[str, Any]:
        """As JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, record: Mapping[str, Any]) -> LinearServos:
        """What `to_dict` gave."""
        columns: dict[str, Any] = {name: tuple(x) if isinstance(x, list) else x for name, x in record.items()}
        return cls(**columns)

    def positions(
        self, joint: int, q: np.ndarray, qd: np.ndarray, commands: np.ndarray, dt: float
    ) -> np.ndarray:
        """Of one joint after each step (W, K), from q and qd (W,), under mean delayed commands (W, K)."""
        return _linear(q, qd, commands + self.offset[joint], dt, self.frequency[joint], self.damping[joint])


def fit_linear_servos(windows: ServoWindows) -> LinearServos:
    """Fitted to windows: commands to all samples, linear servos to what follows each window's settling."""
    q, qd = windows.q.numpy(), windows.qd.numpy()
    dt, keep = float(windows.dt.mean()), windows.settling
    measured = q[:, 1:]

    def commands(delay: float) -> np.ndarray:
        return windows.commands(delay).mean(dim=2).numpy()

    late = minimize_scalar(
        lambda x: float(np.square(commands(x) - measured).mean()), bounds=(0, LATEST), method="bounded"
    )
    found = []
    for joint in range(q.shape[2]):

        def errors(x: np.ndarray, joint: int = joint) -> np.ndarray:
            u = commands(x[2])[..., joint] + x[3]
            predicted = _linear(q[:, 0, joint], qd[:, 0, joint], u, dt, x[0], x[1])
            wrong: np.ndarray = (predicted - measured[..., joint])[:, keep:].ravel()
            return wrong

        scale = (10.0, 1.0, 0.02, 0.02)
        found.append(
            least_squares(errors, START, bounds=(LEAST, MOST), x_scale=scale, diff_step=1e-4, max_nfev=30).x
        )
    frequency, damping, delay, offset = (tuple(x) for x in np.transpose(found).tolist())
    return LinearServos(frequency, damping, delay, offset, float(late.x))


def _linear(
    q: np.ndarray, qd: np.ndarray, u: np.ndarray, dt: float, frequency: float, damping: float
) -> np.ndarray:
    """Exactly, of a command that is held over each step."""
    system = np.array([[0, 1, 0], [-(frequency**2), -2 * damping * frequency, frequency**2], [0, 0, 0]])
    step = expm(system * dt)[:2]
    state, found = np.stack([q, qd]), np.empty_like(u)
    for k in range(u.shape[1]):
        state = step[:, :2] @ state + step[:, 2:] * u[:, k]
        found[:, k] = state[0]
    return found
