"""A generalised-momentum observer of the disturbance torque: causal, without accelerations.

    r(t) = K (p(t) - p(0) - integral from 0 to t of (G tau + C^T qd - g - friction + r)),    r(0) = 0

(De Luca and Mattone, ICRA 2003, eq. 9; ICRA 2005), so that r' = K (d - r), with d the residual of the momentum balance:
r is d after a first-order filter with time constant 1 / K. A prediction then keeps r constant, as offset-free control
does (Pannocchia and Rawlings, AIChE J. 49:426, 2003).

Two differences from the reference: d is constant between samples, so that the filter is solved exactly; and r is
divided by the response of the filter to d = 1, so that a constant disturbance is found at once instead of after some
time constants.
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
    """Return the number of steps of the observer before a prediction, at a sample rate [Hz]."""
    return max(1, round(TUNING.observed_past * rate))


def observe(dynamics: Any, windows: Windows, past: int) -> tuple[Windows, Tensor]:
    """Observe the disturbance in the first `past` steps of W windows.

    Args:
        dynamics: of `integrable`.
        windows: of more than `past` steps.
        past: number of steps of the observer.

    Returns:
        The windows without these steps, and the disturbance (W, n): a generalised force [Nm, N] if the state of the
        dynamics has momenta, an acceleration [rad/s^2, m/s^2] if it has velocities.
    """
    q = windows.q[:, : past + 1]
    qd = windows.qd[:, : past + 1]
    dt = windows.dt[:, :past].unsqueeze(-1)
    tau = windows.tau[:, :past]
    z = memory_along(dynamics, q, qd, windows.z)
    cache = dynamics.prepare()
    pose = dynamics.at(q, prepared=cache)
    p = dynamics.momentum(pose, qd)
    # the input is constant in each interval: at a sample, it has the values of the intervals after and before it
    inputs = torch.stack([torch.cat([tau, tau[:, -1:]], dim=1), torch.cat([tau[:, :1], tau], dim=1)])
    _, (at_start, at_end) = dynamics.port_hamiltonian_rhs(pose, p, inputs, cache, *known_past(dynamics, z))
    residual = p.diff(dim=1) / dt - (at_start[:, :-1] + at_end[:, 1:]) / 2  # d in each interval, (W, past, n)
    gain = 1 - torch.exp(-dt / TUNING.observer_time_constant)
    r = torch.zeros_like(residual[:, 0])
    response = torch.zeros_like(gain[:, 0])  # of the filter to d = 1
    for k in range(past):
        r = r + gain[:, k] * (residual[:, k] - r)
        response = response + gain[:, k] * (1 - response)
    ahead = replace(without_past(windows, past), z=z[:, -1])
    return ahead, r / response


def without_past(windows: Windows, past: int) -> Windows:
    """Return the windows without their first `past` steps; z stays that of the first sample."""
    return Windows(
        windows.dt[:, past:], windows.q[:, past:], windows.qd[:, past:], windows.tau[:, past:], windows.z
    )
