"""The disturbance that a model lacks, as a generalised-momentum observer finds it: causal, without accelerations.

    r(t) = K (p(t) - p(0) - integral from 0 to t of (G tau + C^T qd - g - friction + r)),    r(0) = 0

(De Luca and Mattone, ICRA 2003, eq. 9; ICRA 2005), so that r' = K (d - r): r follows what the momentum balance lacks,
d, as a first-order filter of the time constant 1 / K. Offset-free prediction holds it on (Pannocchia and Rawlings,
AIChE J. 49:426, 2003).

Two deviations: between samples d is a constant, so that the filter is solved exactly; and r is divided by its own
response to d = 1 since it began, so that a constant disturbance is found at once and not after some time constants.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from spelgen.dynamics.protocol import known_past, memory_along
from spelgen.evaluation.tuning import TUNING
from spelgen.logs.windows import Windows


def past_steps(rate: float) -> int:
    """Return how many steps at this sample rate [Hz] the observer runs for before a prediction starts."""
    return max(1, round(TUNING.observed_past * rate))


def observe(dynamics: Any, windows: Windows, past: int) -> tuple[Windows, Tensor]:
    """Return the windows without their first `past` steps, and the disturbance (W, n) that was observed in these.

    dynamics: what a rollout integrates, see ``integrable``. The disturbance is a generalised force [Nm, N] where the
    state has momenta, an acceleration where it has velocities.
    """
    q = windows.q[:, : past + 1]
    qd = windows.qd[:, : past + 1]
    dt = windows.dt[:, :past].unsqueeze(-1)
    tau = windows.tau[:, :past]
    z = memory_along(dynamics, q, qd, windows.z)
    cache = dynamics.prepare()
    pose = dynamics.at(q, prepared=cache)
    p = dynamics.momentum(pose, qd)
    # the input jumps at samples: that of the interval after each sample, and that of the interval before
    inputs = torch.stack([torch.cat([tau, tau[:, -1:]], dim=1), torch.cat([tau[:, :1], tau], dim=1)])
    _, (at_start, at_end) = dynamics.port_hamiltonian_rhs(pose, p, inputs, cache, *known_past(dynamics, z))
    lacking = p.diff(dim=1) / dt - (at_start[:, :-1] + at_end[:, 1:]) / 2  # d of each interval, (W, past, n)
    gain = 1 - torch.exp(-dt / TUNING.observer_time_constant)
    r = torch.zeros_like(lacking[:, 0])
    response = torch.zeros_like(gain[:, 0])  # of the filter to d = 1
    for k in range(past):
        r = r + gain[:, k] * (lacking[:, k] - r)
        response = response + gain[:, k] * (1 - response)
    ahead = replace(without_past(windows, past), z=z[:, -1])
    return ahead, r / response


def without_past(windows: Windows, past: int) -> Windows:
    """Return the windows without their first `past` steps; z stays that of the first sample."""
    return Windows(
        windows.dt[:, past:], windows.q[:, past:], windows.qd[:, past:], windows.tau[:, past:], windows.z
    )
