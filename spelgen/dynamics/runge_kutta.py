"""The classical Runge-Kutta method for the state of an arm (Hairer et al., Solving ODEs I, II.1)."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor


def runge_kutta(
    rhs: Callable[[Tensor, Tensor], tuple[Tensor, Tensor]], p: Tensor, step: Tensor | float
) -> tuple[Tensor, Tensor, Tensor]:
    """How far joints move in one `step` [s], p at its end, and q' at its start; each (..., n).

    rhs: q' and p' where joints have moved so far since the step began, and at this p: the momenta, or the velocities.
    Friction's memory follows the displacement exactly, so it needs no stages of its own.
    """
    half = step / 2
    qd1, pd1 = rhs(torch.zeros_like(p), p)
    qd2, pd2 = rhs(half * qd1, p + half * pd1)
    qd3, pd3 = rhs(half * qd2, p + half * pd2)
    qd4, pd4 = rhs(step * qd3, p + step * pd3)
    sixth = step / 6
    moved = sixth * (qd1 + 2 * (qd2 + qd3) + qd4)
    return moved, p + sixth * (pd1 + 2 * (pd2 + pd3) + pd4), qd1
