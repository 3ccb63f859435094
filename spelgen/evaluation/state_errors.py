"""Errors of predicted states at the end of a horizon."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from torch import Tensor, cat

from spelgen.baselines.solver import States
from spelgen.evaluation.plain import finite
from spelgen.fitting.rollout import position_difference
from spelgen.logs.windows import Windows

TipPosition = Callable[[Tensor], Tensor]
"""q (..., n) -> the tip's position (..., 3) [m]."""


@dataclass(frozen=True)
class StateErrors:
    """Errors at the end of a horizon, root mean square (RMS) over windows, per joint where a tuple.

    q, qd: [rad, rad/s; m, m/s], revolute positions as angles on the circle. q_relative_rms, qd_relative_rms:
    relative to how much q and qd change over the horizon. mean_relative_rms: mean of all of these. tip_mm: distance
    of the tip [mm]. None: not finite, or not known.
    """

    q: tuple[float | None, ...]
    qd: tuple[float | None, ...]
    q_relative_rms: tuple[float | None, ...]
    qd_relative_rms: tuple[float | None, ...]
    mean_relative_rms: float | None
    tip_mm: float | None


def end_errors(
    states: States, windows: Windows, joint_types: Sequence[str], tip: TipPosition | None
) -> StateErrors:
    """Return errors of predicted q and qd (W, K-1, n) of these windows at their ends."""
    q, qd = (predicted[:, -1] for predicted in states)  # (W, n)
    measured_q, measured_qd = windows.q[:, -1], windows.qd[:, -1]
    # a revolute joint may have gone a turn farther: the angle between counts
    q_error = _rms(position_difference(q, measured_q, joint_types))
    qd_error = _rms(qd - measured_qd)
    q_relative = q_error / _rms(position_difference(measured_q, windows.q[:, 0], joint_types))
    qd_relative = qd_error / _rms(measured_qd - windows.qd[:, 0])
    mean = cat([q_relative, qd_relative]).mean(dim=0, keepdim=True)
    tip_mm = None
    if tip is not None:
        distance = 1000 * _rms((tip(q) - tip(measured_q)).norm(dim=-1)).item()
        tip_mm = distance if math.isfinite(distance) else None
    return StateErrors(
        finite(q_error), finite(qd_error), finite(q_relative), finite(qd_relative), finite(mean)[0], tip_mm
    )


def _rms(values: Tensor) -> Tensor:
    """(W, ...) -> (...)."""
    return values.square().mean(dim=0).sqrt()
