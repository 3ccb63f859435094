"""A constant velocity: what any model of short horizons must beat."""

from __future__ import annotations

from spelgen.baselines.baseline import Baseline, JudgedArm
from spelgen.baselines.names import CONSTANT_VELOCITY
from spelgen.baselines.predictor import Predictor, States
from spelgen.logs.windows import Windows


class ConstantVelocity(Baseline):
    """Predict that the velocity at a window's start stays."""

    def predictors(self, judged: JudgedArm) -> list[Predictor]:
        """Return the one predictor."""
        return [Predictor(CONSTANT_VELOCITY, hold_velocity)]


def hold_velocity(windows: Windows) -> States:
    """Return q and qd, (W, K-1, n)."""
    elapsed = windows.dt.cumsum(dim=1).unsqueeze(-1)  # (W, K-1, 1)
    qd = windows.qd[:, :1]
    return windows.q[:, :1] + qd * elapsed, qd.expand(-1, elapsed.shape[1], -1)
