"""The time that a fit may take."""

from __future__ import annotations

import math
import time


class Clock:
    """The time of a fit. max_minutes: allowed; None: any. spent: before [s]."""

    def __init__(self, max_minutes: float | None, spent: float) -> None:
        self.allowed = math.inf if max_minutes is None else 60 * max_minutes
        self._start = time.monotonic() - spent

    @property
    def seconds(self) -> float:
        """Time of the fit so far [s]."""
        return time.monotonic() - self._start

    def fraction(self, seconds: float) -> float:
        """Return how much of the allowed time these seconds are; 0 where any time is allowed."""
        if math.isinf(self.allowed):
            return 0.0
        return math.inf if not self.allowed else seconds / self.allowed
