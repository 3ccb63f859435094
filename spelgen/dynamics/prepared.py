"""A trained model for many calls: quantities that depend on the parameters only are computed once."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from spelgen.dynamics.equations import runge_kutta
from spelgen.dynamics.parameters import without_idle_residuals
from spelgen.dynamics.protocol import known_past, memory_after, sliding_memory
from spelgen.runtime.port_hamiltonian import PortHamiltonian

if TYPE_CHECKING:
    from spelgen.dynamics.tip import TipKinematics


class State(NamedTuple):
    """State of an arm: q and qd, (..., n), and the friction state z, (..., n, K), of K bristles per joint."""

    q: Tensor
    qd: Tensor
    z: Tensor


class PreparedModel:
    """A copy of a model with constant parameters.

    Arguments q, qd, qdd and tau of the methods are (..., n), in rad and Nm, or m and N. The friction state z is (...,
    n, K); its default is the steady state of motion at the velocity qd.

    Attributes:
        tip: kinematics of the tip, see ``tip_kinematics``.
        elements: number of bristles per joint, K.
        dtype: type of the parameters and states.
    """

    def __init__(
        self, model: PortHamiltonian, tip: TipKinematics | None = None, *, dtype: torch.dtype = torch.float64
    ) -> None:
        # Networks whose output is zero would take most of the time: remove them.
        reduced = without_idle_residuals(model)
        reduced.to(dtype=dtype).requires_grad_(False)
        self._model = reduced
        self._weights, self._tip, self.dtype = reduced.prepare(), tip, dtype
        self.n: int = reduced.n
        self.elements: int = reduced.elements

    def mass_matrix(self, q: Tensor) -> Tensor:
        """Return the mass matrix M(q), (..., n, n) [kg m^2, kg m, kg]."""
        return self._model.mass_matrix(self._at(q))

    def gravity(self, q: Tensor) -> Tensor:
        """Return the gravity torque dV/dq, (..., n) [Nm, N]."""
        return self._model.gravity(self._at(q))

    def bias(self, q: Tensor, qd: Tensor) -> Tensor:
        """Return Coriolis, centrifugal and gravity torque, (..., n) [Nm, N]."""
        return self._model.nonlinear_effects(self._at(q, qd), qd)

    def friction_torque(self, q: Tensor, qd: Tensor, z: Tensor | None = None) -> Tensor:
        """Return the friction torque, (..., n) [Nm, N]."""
        return self._model.friction_torque(self._at(q, qd), qd, *known_past(self._model, z))

    def memory(self, qd: Tensor) -> Tensor:
        """Return the friction state z, (..., n, K), of joints that have moved at qd for a long time: zero at rest."""
        return sliding_memory(self._model, qd)

    def memory_after(self, z: Tensor, displacement: Tensor) -> Tensor:
        """Return the friction state z, (..., n, K), after a monotonic displacement of the joints, (..., n) [rad, m]."""
        return memory_after(self._model, z, displacement)

    def forward_dynamics(self, q: Tensor, qd: Tensor, tau: Tensor, z: Tensor | None = None) -> Tensor:
        """Return the accelerations qdd, (..., n), under the input tau."""
        return self._model.forward_dynamics(self._at(q, qd, tau), qd, tau, *known_past(self._model, z))

    def inverse_dynamics(self, q: Tensor, qd: Tensor, qdd: Tensor, z: Tensor | None = None) -> Tensor:
        """Return the input tau, (..., n), that causes the accelerations qdd."""
        return self._model.inverse_dynamics(self._at(q, qd, qdd), qd, qdd, *known_past(self._model, z))

    def momentum(self, q: Tensor, qd: Tensor) -> Tensor:
        """Return the momenta p = M(q) qd, (..., n) [Nm s, N s]."""
        return self._model.momentum(self._at(q, qd), qd)

    def momentum_rate(self, q: Tensor, qd: Tensor, tau: Tensor, z: Tensor | None = None) -> Tensor:
        """Return the rate dp/dt of the momenta, (..., n) [Nm, N], under the input tau, for a momentum observer."""
        past = known_past(self._model, z)
        p = self.momentum(q, qd)
        return self._model.port_hamiltonian_rhs(q, p, tau, self._weights, *past)[1]

    def step(
        self, q: Tensor, qd: Tensor, tau: Tensor, dt: float, z: Tensor | None = None, *, substeps: int = 1
    ) -> State:
        """Return q, qd and z after dt [s] under a constant input tau.

        Integration by ``substeps`` steps of the classical Runge-Kutta method. q, qd, tau: (..., n). z: friction state,
        (..., n, K), by default ``memory(qd)``; it is not integrated, but computed from the displacement of the joints.
        """
        z = self.memory(qd) if z is None else z

        def rhs(q: Tensor, speed: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
            """Return qd and qdd, (..., n) each."""
            return speed, self.forward_dynamics(q, speed, tau, z)

        for _ in range(substeps):
            # The state has velocities, not momenta, since control loops measure velocities.
            q, qd, z, _ = runge_kutta(self._model, rhs, q, qd, z, dt / substeps)
        return State(q, qd, z)

    def rollout(
        self, q: Tensor, qd: Tensor, tau: Tensor, dt: float, z: Tensor | None = None, *, substeps: int = 1
    ) -> State:
        """Return q and qd, (steps + 1, ..., n), and z, (steps + 1, ..., n, K), from the initial state on.

        tau: inputs, (steps, ..., n), each constant for dt [s]. substeps: Runge-Kutta steps for each input.
        """
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
        """Return the linearization of the dynamics: A, (..., 2 n, 2 n), and B, (..., 2 n, n).

        A is the derivative with respect to (q, qd), B with respect to tau. Without dt, they are derivatives of the rate
        (qd, qdd) at constant z. With dt [s], they are derivatives of q and qd after ``step``.
        """
        n = self.n
        z = self.memory(qd) if z is None else z
        # torch.func cannot differentiate compiled functions: in this copy, forward dynamics is not compiled.
        plain = copy.copy(self)
        vars(plain).pop("forward_dynamics", None)

        def function(state: Tensor, tau: Tensor, z: Tensor) -> Tensor:
            """Return the rate of the state (q, qd), or the state after dt if dt is given, (2 n,)."""
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
        """Return the pose of the tip in the root frame, (..., 4, 4). Raises ValueError without a tip."""
        return self._kinematics().pose(q)

    def jacobian(self, q: Tensor) -> Tensor:
        """Return the Jacobian of the tip, (..., 6, n), linear velocity first. Raises ValueError without a tip."""
        return self._kinematics().jacobian(q)

    def compile(self) -> PreparedModel:
        """Return a copy whose forward and inverse dynamics are compiled by ``torch.compile`` at their first calls."""
        result = copy.copy(self)
        for method in (self.forward_dynamics, self.inverse_dynamics):
            # Assertions between the compiled kernels would take a tenth of the time: disable them.
            compiled = torch.compile(method, fullgraph=True, options={"size_asserts": False})
            vars(result)[method.__name__] = compiled
        return result

    def _at(self, q: Tensor, *others: Tensor) -> object:
        """Return the model's configuration cache at q, (..., n): the quantities that depend on q only.

        others: further vectors (..., n), whose dtypes and shapes are checked.
        """
        return self._model.at(q, *others, prepared=self._weights)

    def _kinematics(self) -> TipKinematics:
        if self._tip is None:
            raise ValueError("no tip: give model.prepared(tip=spelgen.tip_kinematics(arm))")
        return self._tip


def batched_jacobians(function: Callable[..., Tensor], variables: int, *states: Tensor) -> tuple[Tensor, ...]:
    """Return the Jacobians, (batch, m, n), of a function with respect to each of its first ``variables`` inputs.

    Args:
        function: function of the states without batch dimension, (n,) each, that returns a vector (m,).
        states: (batch, n) each.
    """
    if not torch.is_grad_enabled():
        states = tuple(x.detach() for x in states)
    # In torch 2.13, vmap of a derivative of linalg.solve is wrong in forward mode, and if autograd is disabled:
    # autograd is therefore enabled, and reverse mode is used.
    with torch.inference_mode(False), torch.enable_grad():
        jacobian = torch.func.vmap(torch.func.jacrev(function, argnums=tuple(range(variables))))
        # Tensors of inference mode cannot be differentiated, so the inputs are cloned.
        derivatives: tuple[Tensor, ...] = jacobian(*(x.clone() for x in states))
    return derivatives
