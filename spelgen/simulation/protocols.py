"""Settings -> logs, by the protocol that they name."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from spelgen.arm.arm import Arm
from spelgen.settings.settings import Settings
from spelgen.simulation.simulate import SimulationResult, simulate
from spelgen.simulation.tracking import track

PROTOCOLS = {"random-inputs": simulate, "tracking": track}


def make_logs(
    arm: Arm,
    settings: Settings,
    input_matrix: np.ndarray | None = None,
    *,
    progress: Callable[[int, int], None] | None = None,
) -> SimulationResult:
    """Return the logs of `settings.simulation.protocol`; arguments and errors as for `simulate`."""
    return PROTOCOLS[settings.simulation.protocol](arm, settings, input_matrix, progress=progress)
