"""What is missing from a model's forces, estimated from the past of a window and held on: offset-free prediction.

The mean generalised force over the past that the momentum balance lacks, as a momentum observer finds it (De Luca and
Mattone, ICRA 2003) and offset-free model predictive control holds it (Pannocchia and Rawlings, AIChE J. 49:426, 2003).
No accelerations are needed.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch

from spelgen.dynamics.protocol import memory_along
from spelgen.logs.windows import Windows

INTERVALS = 10  # of the past, at most, over which forces are integrated


class WithoutCompensation:
    """A model of rigid bodies whose drives add nothing by velocity that is not measured.

    What they add is held with the rest of the disturbance: a force that grows with velocity, in the drives of an arm
    whose controller is not part of the model, makes rollouts blow up within tenths of a second.
    """

    def __init__(self, model: Any) -> None:
        self.model = model

    def __getattr__(self, name: str) -> Any:
        return getattr(self.model, name)

    def prepare(self, definite: bool = True) -> Any:
        """What depends on the weights alone."""
        prepared = self.model.prepare(definite)
        return prepared._replace(compensation=torch.zeros_like(prepared.compensation))


def without_compensation(model: Any) -> Any:
    """The same model but for what its drives add by velocity."""
    own = getattr(model, "friction_compensation", None)
    return model if own is None or not own.any() else WithoutCompensation(model)


class Disturbed:
    """What is integrated (see ``integrable``) under a force, (W, n), that is added to p', and holds what drives add."""

    def __init__(self, form: Any, disturbance: torch.Tensor) -> None:
        self.form, self.disturbance = without_compensation(form), disturbance

    def __getattr__(self, name: str) -> Any:
        return getattr(self.form, name)

    def port_hamiltonian_rhs(
        self,
        q: torch.Tensor,
        p: torch.Tensor,
        tau: torch.Tensor,
        prepared: Any,
        z: torch.Tensor | None = None,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """q' and p'."""
        qd, force = self.form.port_hamiltonian_rhs(q, p, tau, prepared, z)
        return qd, force + self.disturbance


def without_past(windows: Windows, past: int) -> Windows:
    """Windows without their first `past` steps; z stays as it is, for what has no use for it."""
    dt, q, qd, tau = (x[:, past:] for x in windows.columns()[:4])
    return Windows(dt, q, qd, tau, windows.z)


def after_past(form: Any, windows: Windows, past: int) -> tuple[Windows, torch.Tensor]:
    """Windows without their first `past` steps, and the disturbance (W, n) that was missing in these.

    That is what p' lacks: a generalised force where the form's p is momentum, an acceleration where it is velocity.
    """
    form = without_compensation(form)
    q, qd = windows.q[:, : past + 1], windows.qd[:, : past + 1]
    along = memory_along(form, q, qd, windows.z)
    ahead = replace(without_past(windows, past), z=along[:, -1])
    chosen = torch.linspace(0, past, min(past, INTERVALS) + 1, dtype=torch.float64).round().long()
    q, qd, z = (x[:, chosen] for x in (q, qd, along))
    steps = windows.dt[:, :past].unsqueeze(-1)
    dt, impulse = (_between(x, chosen) for x in (steps, steps * windows.tau[:, :past]))
    prepared = form.prepare()
    p = form.momentum(q, qd, prepared)
    ends = [
        form.port_hamiltonian_rhs(q[:, at], p[:, at], impulse / dt, prepared, z[:, at])[1]
        for at in (slice(None, -1), slice(1, None))
    ]
    told = (dt * (ends[0] + ends[1]) / 2).sum(dim=1)  # the trapezium rule
    return ahead, (p[:, -1] - p[:, 0] - told) / dt.sum(dim=1)


def _between(values: torch.Tensor, chosen: torch.Tensor) -> torch.Tensor:
    """Sums of (W, past, n) between chosen samples."""
    summed = torch.cat([torch.zeros_like(values[:, :1]), values.cumsum(dim=1)], dim=1)
    return summed[:, chosen].diff(dim=1)
