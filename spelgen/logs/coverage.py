"""Measure where logs have been: ranges of positions and velocities, and how often each part of them occurs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from spelgen.logs.trajectory import Trajectory
from spelgen.settings.tuning.logs import LogTuning

TUNING = LogTuning()


def coverage(logs: Sequence[Trajectory]) -> dict[str, object]:
    """Return `seconds` of all logs; by joint `q` and `qd`: their range, and the samples in equal bins of it."""
    result: dict[str, object] = {"seconds": _rounded(sum(log.duration for log in logs))}
    for name in ("q", "qd"):
        values = np.concatenate([getattr(log, name) for log in logs])
        joints = []
        for column in values.T:
            counts = np.histogram(column, TUNING.bins)[0].tolist()
            joints.append({"low": _rounded(column.min()), "high": _rounded(column.max()), "counts": counts})
        result[name] = joints
    return result


def _rounded(value: float) -> float:
    """Return a value to five significant digits."""
    return float(f"{value:.5g}")
