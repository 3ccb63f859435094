"""Where logs have been: ranges of positions and velocities, and how often each part of them occurs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from spelgen.logs.trajectory import Trajectory

BINS = 24


def coverage(logs: Sequence[Trajectory]) -> dict[str, Any]:
    """`seconds` of all logs; by joint `q` and `qd`: their range, and how many samples fall into equal bins of it."""
    found: dict[str, Any] = {"seconds": _told(sum(log.duration for log in logs))}
    for name in ("q", "qd"):
        values = np.concatenate([getattr(log, name) for log in logs]).T
        found[name] = [
            {"low": _told(x.min()), "high": _told(x.max()), "counts": np.histogram(x, BINS)[0].tolist()}
            for x in values
        ]
    return found


def _told(value: float) -> float:
    """To five digits."""
    return float(f"{value:.5g}")
