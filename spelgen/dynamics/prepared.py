"""A trained model ready to be asked many times: nothing that depends on the weights alone is worked out again."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor


class PreparedModel:
    """An emitted model with its weights as they were, without gradients by them.

    q, qd, qdd and tau are (..., n); units are rad and Nm, or m and N. Calls keep to ``torch.inference_mode`` rules of
    their caller, and take derivatives by q, qd and tau. tip: what gives ``pose(q)`` and ``jacobian(q)``, as
    ``tip_kinematics`` does.
    """

    def __init__(self, model: Any, tip: Any = None, *, dtype: torch.dtype = torch.float64) -> None:
        model = copy.deepcopy(model).to(dtype=dtype).requires_grad_(False)
        self.n: int = model.n
        self._dynamics, self._weights, self._tip = model.dynamics, model.prepare(), tip

    def mass_matrix(self, q: Tensor) -> Tensor:
        """M(q), (..., n, n) [kg m^2, kg m, kg]."""
        mass: Tensor = self._dynamics.mass_at(self._at(q), self._weights)[0]
        return mass

    def gravity(self, q: Tensor) -> Tensor:
        """dV/dq, (..., n) [Nm, N]."""
        torque: Tensor = self._dynamics.gravity_at(self._at(q), self._weights)
        return torque

    def bias(self, q: Tensor, qd: Tensor) -> Tensor:
        """Coriolis, centrifugal and gravity torque, (..., n) [Nm, N]."""
        return self._mass_and_bias(self._at(q), qd)[1]

    def friction_torque(self, q: Tensor, qd: Tensor) -> Tensor:
        """What friction takes, (..., n) [Nm, N]."""
        torque: Tensor = self._dynamics.friction_at(self._at(q), qd, self._weights)
        return torque

    def forward_dynamics(self, q: Tensor, qd: Tensor, tau: Tensor) -> Tensor:
        """qdd, (..., n), under the input tau."""
        mass, force = self._mass_and_force(q, qd, tau)
        found: Tensor = torch.linalg.solve(mass, force.unsqueeze(-1))
        return found.squeeze(-1)

    def inverse_dynamics(self, q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
        """The input, (..., n), that gives qdd."""
        at = self._at(q)
        mass, bias = self._mass_and_bias(at, qd)
        force = (mass @ qdd.unsqueeze(-1)).squeeze(-1) + bias
        force = force + self._dynamics.friction_at(at, qd, self._weights)
        tau: Tensor = self._dynamics.input_torque(at, force, self._weights)
        return tau

    def step(self, q: Tensor, qd: Tensor, tau: Tensor, dt: float, substeps: int = 1) -> tuple[Tensor, Tensor]:
        """q and qd after dt [s] under a tau that is held, by so many steps of the classical Runge-Kutta method."""
        return _stepped(self.forward_dynamics, q, qd, tau, dt, substeps)

    def rollout(
        self, q: Tensor, qd: Tensor, tau: Tensor, dt: float, substeps: int = 1
    ) -> tuple[Tensor, Tensor]:
        """q and qd, (steps + 1, ..., n), from a state on; tau, (steps, ..., n), is held for dt [s] each."""
        states = [(q, qd)]
        for held in tau:
            states.append(self.step(*states[-1], held, dt, substeps))
        positions, velocities = zip(*states, strict=True)
        return torch.stack(positions), torch.stack(velocities)

    def linearize(
        self, q: Tensor, qd: Tensor, tau: Tensor, dt: float | None = None, substeps: int = 1
    ) -> tuple[Tensor, Tensor]:
        """A, (..., 2 n, 2 n), and B, (..., 2 n, n), of the state (q, qd) and the input tau.

        Of its rate, (qd, qdd); with dt [s], of what ``step`` makes of it.
        """

        def function(state: Tensor, held: Tensor) -> Tensor:
            place, speed = state.split(self.n)
            if dt is None:
                return torch.cat([speed, self._differentiable(place, speed, held)])
            return torch.cat(_stepped(self._differentiable, place, speed, held, dt, substeps))

        states = torch.cat([q, qd], dim=-1)
        rows = (states.reshape(-1, 2 * self.n), tau.reshape(-1, self.n))
        jacobian = torch.func.vmap(torch.func.jacfwd(function, argnums=(0, 1)))
        by_state, by_input = jacobian(*rows)
        return (
            by_state.reshape(*q.shape[:-1], 2 * self.n, 2 * self.n),
            by_input.reshape(*q.shape[:-1], 2 * self.n, self.n),
        )

    def pose(self, q: Tensor) -> Tensor:
        """The tip's homogeneous transform in the root link's frame, (..., 4, 4). Raises ValueError without a tip."""
        found: Tensor = self._kinematics().pose(q)
        return found

    def jacobian(self, q: Tensor) -> Tensor:
        """The tip's linear, then angular velocity by qd, (..., 6, n). Raises ValueError without a tip."""
        found: Tensor = self._kinematics().jacobian(q)
        return found

    def compile(self) -> PreparedModel:
        """Itself, its forward and inverse dynamics compiled by ``torch.compile`` at their first calls."""
        found = copy.copy(self)
        for name in ("forward_dynamics", "inverse_dynamics"):
            setattr(found, name, torch.compile(getattr(self, name), fullgraph=True))
        return found

    def _kinematics(self) -> Any:
        if self._tip is None:
            raise ValueError("no tip: give model.prepared(tip=spelgen.tip_kinematics(arm))")
        return self._tip

    def _at(self, q: Tensor) -> Any:
        return self._dynamics.configuration(q, self._weights)

    def _mass_and_bias(self, at: Any, qd: Tensor) -> tuple[Tensor, Tensor]:
        mass, residuals = self._dynamics.mass_at(at, self._weights)
        return mass, self._dynamics.nonlinear_at(at, qd, residuals, self._weights)

    def _mass_and_force(self, q: Tensor, qd: Tensor, tau: Tensor) -> tuple[Tensor, Tensor]:
        at = self._at(q)
        mass, bias = self._mass_and_bias(at, qd)
        force = self._dynamics.input_force(at, tau, self._weights) - bias
        return mass, force - self._dynamics.friction_at(at, qd, self._weights)

    def _differentiable(self, q: Tensor, qd: Tensor, tau: Tensor) -> Tensor:
        """``forward_dynamics`` by the inverse: vmap of a forward derivative of linalg.solve is wrong in torch 2.13."""
        mass, force = self._mass_and_force(q, qd, tau)
        found: Tensor = torch.linalg.inv(mass) @ force
        return found


def _stepped(
    accelerations: Callable[[Tensor, Tensor, Tensor], Tensor],
    q: Tensor,
    qd: Tensor,
    tau: Tensor,
    dt: float,
    substeps: int,
) -> tuple[Tensor, Tensor]:
    h = dt / substeps
    for _ in range(substeps):
        a1 = accelerations(q, qd, tau)
        v2 = qd + 0.5 * h * a1
        a2 = accelerations(q + 0.5 * h * qd, v2, tau)
        v3 = qd + 0.5 * h * a2
        a3 = accelerations(q + 0.5 * h * v2, v3, tau)
        v4 = qd + h * a3
        a4 = accelerations(q + h * v3, v4, tau)
        q = q + h / 6 * (qd + 2 * v2 + 2 * v3 + v4)
        qd = qd + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
    return q, qd
