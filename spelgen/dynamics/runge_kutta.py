"""The classical Runge-Kutta method for the state of an arm (Hairer et al., Solving ODEs I, II.1)."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from spelgen.dynamics.protocol import memory_after


def runge_kutta(
    dynamics: object,
    rhs: Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor]],
    q: Tensor,
    p: Tensor,
    z: Tensor,
    step: Tensor | float,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return q, p and z after one `step` [s], and q' at its start.

    rhs: q' and p' of these dynamics by q, p and z. p: momenta, or velocities. Friction's memory z, (..., n, K), follows
    the displacement exactly, so it needs no stages of its own.
    """

    def slopes(moved: Tensor, p: Tensor) -> tuple[Tensor, Tensor]:
        return rhs(q + moved, p, memory_after(dynamics, z, moved))

    half = step / 2
    qd1, pd1 = slopes(torch.zeros_like(p), p)
    qd2, pd2 = slopes(half * qd1, p + half * pd1)
    qd3, pd3 = slopes(half * qd2, p + half * pd2)
    qd4, pd4 = slopes(step * qd3, p + step * pd3)
    sixth = step / 6
    moved = sixth * (qd1 + 2 * (qd2 + qd3) + qd4)
    p = p + sixth * (pd1 + 2 * (pd2 + pd3) + pd4)
    return q + moved, p, memory_after(dynamics, z, moved), qd1
