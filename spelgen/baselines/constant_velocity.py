"""Baseline of short horizons: the velocity stays constant."""

from __future__ import annotations

from spelgen.baselines.baseline import Baseline, EvaluatedArm
from spelgen.baselines.names import CONSTANT_VELOCITY
from spelgen.baselines.predictor import Predictor, States
from spelgen.logs.windows import Windows


class ConstantVelocity(Baseline):
    """The initial velocity of a window, kept constant."""

    def predictors(self, arm: EvaluatedArm) -> list[Predictor]:
        """Return the predictor."""
        return [Predictor(CONSTANT_VELOCITY, hold_velocity)]


def hold_velocity(windows: Windows) -> States:
    """Return q [rad, m] and qd [rad/s, m/s], (W, K-1, n), at samples 1..K-1 of the windows."""
    elapsed = windows.dt.cumsum(dim=1).unsqueeze(-1)  # (W, K-1, 1)
    qd = windows.qd[:, :1]
    return windows.q[:, :1] + qd * elapsed, qd.expand(-1, elapsed.shape[1], -1)
