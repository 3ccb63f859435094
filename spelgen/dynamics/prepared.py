"""A trained model ready to be asked many times: nothing that depends on the weights alone is worked out again."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from spelgen.dynamics.equations import runge_kutta
from spelgen.dynamics.protocol import known_past, sliding_memory
from spelgen.dynamics.residuals import without_idle_residuals
from spelgen.runtime.port_hamiltonian import PortHamiltonian

if TYPE_CHECKING:
    from spelgen.dynamics.tip import TipKinematics


class State(NamedTuple):
    """q and qd, (..., n), and friction's memory z, (..., n, K)."""

    q: Tensor
    qd: Tensor
    z: Tensor


class PreparedModel:
    """An emitted model with its weights as they were, without gradients by them.

    q, qd, qdd and tau are (..., n); units are rad and Nm, or m and N. z, (..., n, K), is friction's memory; without it
    friction is that of joints which have long gone the way of qd. tip: what gives ``pose(q)`` and ``jacobian(q)``, as
    ``tip_kinematics`` does. elements: K, of friction's memory at a joint.
    """

    def __init__(
        self,
        model: PortHamiltonian,
        tip: TipKinematics | None = None,
        *,
        dtype: torch.dtype = torch.float64,
    ) -> None:
        # networks that give nothing would take most of the time
        reduced = without_idle_residuals(model)
        reduced.to(dtype=dtype).requires_grad_(False)
        self._model = reduced
        self._weights, self._tip = reduced.prepare(), tip
        self.n: int = reduced.n
        self.elements: int = getattr(reduced, "elements", 0)

    def mass_matrix(self, q: Tensor) -> Tensor:
        """M(q), (..., n, n) [kg m^2, kg m, kg]."""
        return self._model.mass_matrix(self._at(q))

    def gravity(self, q: Tensor) -> Tensor:
        """dV/dq, (..., n) [Nm, N]."""
        return self._model.gravity(self._at(q))

    def bias(self, q: Tensor, qd: Tensor) -> Tensor:
        """Coriolis, centrifugal and gravity torque, (..., n) [Nm, N]."""
        return self._model.nonlinear_effects(self._at(q, qd), qd)

    def friction_torque(self, q: Tensor, qd: Tensor, z: Tensor | None = None) -> Tensor:
        """What friction takes, (..., n) [Nm, N]."""
        return self._model.friction_torque(self._at(q, qd), qd, *known_past(self._model, z))

    def memory(self, qd: Tensor) -> Tensor:
        """Friction's memory z, (..., n, K), of joints that have long gone the way of qd: zero at rest."""
        return sliding_memory(self._model, qd)

    def forward_dynamics(self, q: Tensor, qd: Tensor, tau: Tensor, z: Tensor | None = None) -> Tensor:
        """qdd, (..., n), under the input tau."""
        return self._model.forward_dynamics(self._at(q, qd, tau), qd, tau, *known_past(self._model, z))

    def inverse_dynamics(self, q: Tensor, qd: Tensor, qdd: Tensor, z: Tensor | None = None) -> Tensor:
        """The input, (..., n), that gives qdd."""
        return self._model.inverse_dynamics(self._at(q, qd, qdd), qd, qdd, *known_past(self._model, z))

    def momentum(self, q: Tensor, qd: Tensor) -> Tensor:
        """p = M(q) qd, (..., n) [Nm s, N s]."""
        return self._model.momentum(self._at(q, qd), qd)

    def momentum_rate(self, q: Tensor, qd: Tensor, tau: Tensor, z: Tensor | None = None) -> Tensor:
        """p', (..., n) [Nm, N], under the input tau: what a momentum observer compares with."""
        past = known_past(self._model, z)
        p = self.momentum(q, qd)
        return self._model.port_hamiltonian_rhs(q, p, tau, self._weights, *past)[1]

    def step(
        self, q: Tensor, qd: Tensor, tau: Tensor, dt: float, z: Tensor | None = None, *, substeps: int = 1
    ) -> State:
        """q, qd and z after dt [s] under a tau that is held, by so many steps of the classical Runge-Kutta method.

        z follows the displacements exactly; by default it starts as ``memory`` says.
        """
        z = self.memory(qd) if z is None else z

        def rhs(q: Tensor, speed: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
            return speed, self.forward_dynamics(q, speed, tau, z)

        for _ in range(substeps):
            q, qd, z, _ = runge_kutta(self._model, rhs, q, qd, z, dt / substeps)
        return State(q, qd, z)

    def rollout(
        self, q: Tensor, qd: Tensor, tau: Tensor, dt: float, z: Tensor | None = None, *, substeps: int = 1
    ) -> State:
        """q and qd, (steps + 1, ..., n), and z from a state on; tau, (steps, ..., n), is held for dt [s] each."""
        states = [State(q, qd, self.memory(qd) if z is None else z)]
        for held_tau in tau:
            q, qd, z = states[-1]
            states.append(self.step(q, qd, held_tau, dt, z, substeps=substeps))
        return State(*(torch.stack(values) for values in zip(*states, strict=True)))

    def linearize(
        self,
        q: Tensor,
        qd: Tensor,
        tau: Tensor,
        dt: float | None = None,
        z: Tensor | None = None,
        *,
        substeps: int = 1,
    ) -> tuple[Tensor, Tensor]:
        """A, (..., 2 n, 2 n), and B, (..., 2 n, n), of the state (q, qd) and the input tau.

        Of its rate, (qd, qdd), with z held; with dt [s], of what ``step`` makes of it.
        """
        n = self.n
        z = self.memory(qd) if z is None else z
        # compiled functions take no derivative from outside
        plain = copy.copy(self)
        vars(plain).pop("forward_dynamics", None)

        def function(state: Tensor, tau: Tensor, z: Tensor) -> Tensor:
            position, speed = state.split(n)
            if dt is None:
                return torch.cat([speed, plain.forward_dynamics(position, speed, tau, z)])
            return torch.cat(plain.step(position, speed, tau, dt, z, substeps=substeps)[:2])

        batch, elements = q.shape[:-1], z.shape[-1]
        states = torch.cat([q, qd], dim=-1).reshape(-1, 2 * n)
        rows = states, tau.reshape(-1, n), z.reshape(len(states), n, elements)
        by_state, by_input = batched_jacobians(function, 2, *rows)
        return by_state.reshape(*batch, 2 * n, 2 * n), by_input.reshape(*batch, 2 * n, n)

    def pose(self, q: Tensor) -> Tensor:
        """The tip's homogeneous transform in the root link's frame, (..., 4, 4). Raises ValueError without a tip."""
        return self._kinematics().pose(q)

    def jacobian(self, q: Tensor) -> Tensor:
        """The tip's linear, then angular velocity by qd, (..., 6, n). Raises ValueError without a tip."""
        return self._kinematics().jacobian(q)

    def compile(self) -> PreparedModel:
        """Itself, its forward and inverse dynamics compiled by ``torch.compile`` at their first calls."""
        result = copy.copy(self)
        for name in ("forward_dynamics", "inverse_dynamics"):
            # asserts between the kernels would take a tenth of the time
            compiled = torch.compile(getattr(self, name), fullgraph=True, options={"size_asserts": False})
            setattr(result, name, compiled)
        return result

    def _at(self, q: Tensor, *others: Tensor) -> object:
        """Return the model's pose at q, vectors of the state checked."""
        return self._model.at(q, *others, prepared=self._weights)

    def _kinematics(self) -> TipKinematics:
        if self._tip is None:
            raise ValueError("no tip: give model.prepared(tip=spelgen.tip_kinematics(arm))")
        return self._tip


def batched_jacobians(function: Callable[..., Tensor], variables: int, *states: Tensor) -> tuple[Tensor, ...]:
    """Return a state's function's derivatives by its first inputs, for a batch of states."""
    if not torch.is_grad_enabled():
        states = tuple(x.detach() for x in states)
    # vmap of a derivative of linalg.solve is wrong in torch 2.13 if it is forward, or without autograd
    with torch.inference_mode(False), torch.enable_grad():
        jacobian = torch.func.vmap(torch.func.jacrev(function, argnums=tuple(range(variables))))
        derivatives: tuple[Tensor, ...] = jacobian(*(x.clone() for x in states))
    return derivatives
