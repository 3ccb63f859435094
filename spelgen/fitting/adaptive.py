"""Integrate with torchdiffeq's adaptive dopri5, where a fixed step is not trusted or horizons are long."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from spelgen.dynamics.protocol import memory_after
from spelgen.settings.tuning.fitting import AdaptiveTuning

TUNING = AdaptiveTuning()
SOLVER: dict[str, Any] = {"method": "dopri5", "rtol": TUNING.relative, "atol": TUNING.absolute}


def adaptive_step(
    dynamics: object,
    rhs: Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor]],
    q: Tensor,
    p: Tensor,
    z: Tensor,
    step: Tensor,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """As `runge_kutta`, in as many steps as the tolerance asks for; gradients go through the solver.

    Dormand and Prince, J. Comput. Appl. Math. 6 (1980). Windows are solved together, in units of their own steps.
    """
    from torchdiffeq import odeint  # half a second, for those who ask for dopri5 alone

    def slope(t: Tensor, state: Tensor) -> Tensor:
        q_now, p_now = state.chunk(2, dim=-1)
        return step * torch.cat(rhs(q_now, p_now, memory_after(dynamics, z, q_now - q)), dim=-1)

    unit = torch.tensor([0.0, 1.0], dtype=q.dtype, device=q.device)
    q_end, p_end = odeint(slope, torch.cat([q, p], dim=-1), unit, **SOLVER)[-1].chunk(2, dim=-1)
    return q_end, p_end, memory_after(dynamics, z, q_end - q), rhs(q, p, z)[0]
