"""Predict windows with torchdiffeq's adaptive dopri5, where a fixed step is not trusted or horizons are long."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

from spelgen.dynamics.protocol import has_friction_state, known_past, memory_after, sliding_memory
from spelgen.logs.windows import Windows
from spelgen.settings.tuning.fitting import AdaptiveTuning

TUNING = AdaptiveTuning()
SOLVER: dict[str, Any] = {"method": "dopri5", "rtol": TUNING.relative, "atol": TUNING.absolute}


def roll_out_adaptive(model: Any, windows: Windows) -> tuple[torch.Tensor, torch.Tensor]:
    """As `roll_out` gives them: positions and velocities (W, K-1, n).

    Intervals between samples are solved one after the other, each over [0, 1] in units of the window's own step.
    Gradients go through the solver (Dormand and Prince, J. Comput. Appl. Math. 6, 1980), over long horizons by the
    adjoint equation (Chen et al., Neural Ordinary Differential Equations, NeurIPS 2018). Friction's memory follows the
    displacement since the last sample, as in `roll_out`; of it the adjoint equation knows nothing.
    """
    from torchdiffeq import odeint, odeint_adjoint  # half a second, for those who ask for dopri5 alone

    long = (
        windows.dt.shape[1] >= TUNING.adjoint_samples
        and isinstance(model, torch.nn.Module)
        and torch.is_grad_enabled()
    )
    adjoint = long and not has_friction_state(model)
    # the adjoint equation sees weights alone, so what is made of them cannot be prepared once for it
    prepared = None if adjoint else model.prepare()
    q = windows.q[:, 0]
    z = sliding_memory(model, windows.qd[:, 0]) if windows.z is None else windows.z
    state = torch.cat([q, model.momentum(q, windows.qd[:, 0])], dim=-1)  # (W, 2n)
    unit = torch.tensor([0.0, 1.0], dtype=q.dtype, device=q.device)
    states = []
    for dt, tau in zip(windows.dt.unbind(1), windows.tau.unbind(1), strict=True):
        interval = _Interval(model, dt.unsqueeze(-1), tau, prepared, q, z)
        if adjoint:
            weights = tuple(x for x in model.parameters() if x.requires_grad)
            solved = odeint_adjoint(interval, state, unit, **SOLVER, adjoint_params=weights)
        else:
            solved = odeint(interval, state, unit, **SOLVER)
        state, start = solved[-1], q
        q = state.chunk(2, dim=-1)[0]
        z = memory_after(model, z, q - start)
        states.append(state)
    positions, momenta = torch.stack(states, dim=1).chunk(2, dim=-1)
    return positions, model.velocity(positions, momenta)


class _Interval(torch.nn.Module):
    """The equations of motion under a held input (W, n), in time relative to the step (W, 1).

    start, z: q (W, n) and friction's memory (W, n, K) at its beginning.
    """

    def __init__(
        self,
        model: Any,
        step: torch.Tensor,
        tau: torch.Tensor,
        prepared: Any,
        start: torch.Tensor,
        z: torch.Tensor,
    ) -> None:
        super().__init__()
        self.past: Callable[[torch.Tensor], tuple[torch.Tensor, ...]] = lambda moved: known_past(
            model, memory_after(model, z, moved)
        )
        # functions, not parts of this module: the weights are the model's own
        self.rhs, self.prepare, self.prepared = model.port_hamiltonian_rhs, model.prepare, prepared
        self.step, self.tau, self.start = step, tau, start

    def forward(self, t: torch.Tensor, state: torch.Tensor) -> torch.Tensor:
        q, p = state.chunk(2, dim=-1)
        prepared = self.prepare() if self.prepared is None else self.prepared
        return self.step * torch.cat(self.rhs(q, p, self.tau, prepared, *self.past(q - self.start)), dim=-1)
