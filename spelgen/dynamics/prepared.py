"""A trained model for many calls, as in control loops: constant parameters, whose cache is computed only once.

The methods return torques, accelerations, rollouts and linearizations.
"""

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
    """State of an arm: positions q and velocities qd, (..., n), and friction state z, (..., n, K).

    z has the deflections [rad, m] of K bristles per joint.
    """

    q: Tensor
    qd: Tensor
    z: Tensor


class PreparedModel:
    """A copy of a trained model with constant parameters, for many calls of its dynamics.

    Arguments q, qd, qdd and tau of the methods are (..., n), in rad and Nm, or m and N. The friction state z has the
    deflections of K bristles per joint, (..., n, K); if it is omitted, it is the state after a long motion at qd.

    Args:
        model: trained model; residual terms that are zero are removed from the copy.
        tip: kinematics of the tip, see ``tip_kinematics``.
        dtype: type of the parameters and states.

    Attributes:
        model: the copy, without residual terms that are zero.
        n: number of joints.
        elements: number of bristles per joint, K.
        dtype: type of the parameters and states.
    """

    def __init__(
        self, model: PortHamiltonian, tip: TipKinematics | None = None, *, dtype: torch.dtype = torch.float64
    ) -> None:
        # Residual networks whose output is zero would take most of the time: they are removed.
        self.model = without_idle_residuals(model).to(dtype=dtype).requires_grad_(False)
        self._weights, self._tip, self.dtype = self.model.prepare(), tip, dtype
        self.n: int = self.model.n
        self.elements: int = self.model.elements

    def mass_matrix(self, q: Tensor) -> Tensor:
        """Return the mass matrix M(q), (..., n, n) [kg m^2, kg m, kg]."""
        return self.model.mass_matrix(self._at(q))

    def gravity(self, q: Tensor) -> Tensor:
        """Return the gravity torque dV/dq, (..., n) [Nm, N]."""
        return self.model.gravity(self._at(q))

    def bias(self, q: Tensor, qd: Tensor) -> Tensor:
        """Return Coriolis, centrifugal and gravity torque, (..., n) [Nm, N]."""
        return self.model.nonlinear_effects(self._at(q, qd), qd)

    def friction_torque(self, q: Tensor, qd: Tensor, z: Tensor | None = None) -> Tensor:
        """Return the friction torque, (..., n) [Nm, N]; z: friction state, (..., n, K) [rad, m]."""
        return self.model.friction_torque(self._at(q, qd), qd, *known_past(self.model, z))

    def memory(self, qd: Tensor) -> Tensor:
        """Return the friction state z, (..., n, K) [rad, m], after a long motion at qd, (..., n): zero at qd = 0."""
        return sliding_memory(self.model, qd)

    def memory_after(self, z: Tensor, displacement: Tensor) -> Tensor:
        """Return the friction state after a displacement of the joints without reversals, (..., n, K) [rad, m].

        z: friction state before the displacement, (..., n, K) [rad, m]. displacement: (..., n) [rad, m].
        """
        return memory_after(self.model, z, displacement)

    def forward_dynamics(self, q: Tensor, qd: Tensor, tau: Tensor, z: Tensor | None = None) -> Tensor:
        """Return the accelerations qdd, (..., n) [rad/s^2, m/s^2], under the inputs tau, (..., n)."""
        return self.model.forward_dynamics(self._at(q, qd, tau), qd, tau, *known_past(self.model, z))

    def inverse_dynamics(self, q: Tensor, qd: Tensor, qdd: Tensor, z: Tensor | None = None) -> Tensor:
        """Return the inputs tau, (..., n), that cause the accelerations qdd, (..., n) [rad/s^2, m/s^2].

        z: friction state, (..., n, K) [rad, m]; None: friction depends only on the velocity qd.
        """
        return self.model.inverse_dynamics(self._at(q, qd, qdd), qd, qdd, *known_past(self.model, z))

    def momentum(self, q: Tensor, qd: Tensor) -> Tensor:
        """Return the momenta p = M(q) qd, (..., n) [Nm s, N s]."""
        return self.model.momentum(self._at(q, qd), qd)

    def momentum_rate(self, q: Tensor, qd: Tensor, tau: Tensor, z: Tensor | None = None) -> Tensor:
        """Return dp/dt, (..., n) [Nm, N], of the momenta p = M(q) qd under the inputs tau, for momentum observers."""
        past = known_past(self.model, z)
        p = self.momentum(q, qd)
        return self.model.port_hamiltonian_rhs(q, p, tau, self._weights, *past)[1]

    def step(
        self, q: Tensor, qd: Tensor, tau: Tensor, dt: float, z: Tensor | None = None, *, substeps: int = 1
    ) -> State:
        """Return the state (q, qd, z) after a time step under constant inputs.

        The classical Runge-Kutta method integrates q and qd. z is computed from the displacement of the joints.

        Args:
            q: positions, (..., n) [rad, m].
            qd: velocities, (..., n) [rad/s, m/s].
            tau: inputs, (..., n) [Nm, N]: joint torques, or motor torques if the model has an input matrix G.
            dt: duration of the time step [s].
            z: friction state of K bristles per joint, (..., n, K) [rad, m]; None: the state after a long motion at qd.
            substeps: number of Runge-Kutta steps.
        """
        z = self.memory(qd) if z is None else z

        def rhs(q: Tensor, speed: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
            """Return qd and qdd, (..., n), at q, ``speed`` = qd and friction state z under the constant inputs tau."""
            return speed, self.forward_dynamics(q, speed, tau, z)

        for _ in range(substeps):
            # The integrated state has velocities, not momenta, since control loops measure velocities.
            q, qd, z, _ = runge_kutta(self.model, rhs, q, qd, z, dt / substeps)
        return State(q, qd, z)

    def rollout(
        self, q: Tensor, qd: Tensor, tau: Tensor, dt: float, z: Tensor | None = None, *, substeps: int = 1
    ) -> State:
        """Return the trajectory under a sequence of inputs: q and qd, (steps + 1, ..., n), z, (steps + 1, ..., n, K).

        The first row is the initial state.

        Args:
            q: initial positions, (..., n) [rad, m].
            qd: initial velocities, (..., n) [rad/s, m/s].
            tau: inputs, (steps, ..., n) [Nm, N], each constant for dt: torques as in `step`.
            dt: duration of a time step [s].
            z: initial friction state of K bristles per joint, (..., n, K) [rad, m]; None: the state after a long motion
                at qd.
            substeps: number of Runge-Kutta steps per time step.
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

        A is the derivative with respect to the state (q, qd), B with respect to the inputs tau. Without dt, A and B are
        derivatives of the rate (qd, qdd) at constant z (continuous time). With dt [s], A and B are derivatives of q and
        qd after ``step`` with ``substeps`` Runge-Kutta steps (discrete time). z: friction state, by default
        ``memory(qd)``.
        """
        n = self.n
        z = self.memory(qd) if z is None else z
        # torch.func cannot differentiate compiled functions: in the copy `plain`, forward dynamics is not compiled.
        plain = copy.copy(self)
        vars(plain).pop("forward_dynamics", None)

        def function(state: Tensor, tau: Tensor, z: Tensor) -> Tensor:
            """Return d/dt (q, qd), (2 n,), at inputs tau and friction state z; if dt is given, (q, qd) after dt."""
            position, speed = state.split(n)
            if dt is None:
                return torch.cat([speed, plain.forward_dynamics(position, speed, tau, z)])
            return torch.cat(plain.step(position, speed, tau, dt, z, substeps=substeps)[:2])

        batch, elements = q.shape[:-1], z.shape[-1]
        states = torch.cat([q, qd], dim=-1).reshape(-1, 2 * n)
        rows = states, tau.reshape(-1, n), z.reshape(len(states), n, elements)
        by_state, by_input = _state_and_input_jacobians(function, *rows)
        return by_state.reshape(*batch, 2 * n, 2 * n), by_input.reshape(*batch, 2 * n, n)

    def pose(self, q: Tensor) -> Tensor:
        """Return the pose of the tip in the frame of the root link, (..., 4, 4). Raises ValueError without a tip."""
        return self._kinematics().pose(q)

    def jacobian(self, q: Tensor) -> Tensor:
        """Return the Jacobian of the tip, (..., 6, n), in root axes: three rows of linear, three of angular velocity.

        Raises ValueError without a tip.
        """
        return self._kinematics().jacobian(q)

    def compile(self) -> PreparedModel:
        """Return a copy whose forward and inverse dynamics are compiled by ``torch.compile`` at their first calls."""
        result = copy.copy(self)
        for method in (self.forward_dynamics, self.inverse_dynamics):
            # size_asserts=False disables assertions between compiled kernels, which would take a tenth of the time.
            compiled = torch.compile(method, fullgraph=True, options={"size_asserts": False})
            vars(result)[method.__name__] = compiled
        return result

    def _at(self, q: Tensor, *others: Tensor) -> object:
        """Return the model's configuration cache at q, (..., n): the quantities that depend on q only.

        others: other vectors of the call, such as qd and tau, (..., n), whose dtypes and shapes are checked.
        """
        return self.model.at(q, *others, prepared=self._weights)

    def _kinematics(self) -> TipKinematics:
        if self._tip is None:
            raise ValueError("no tip: give model.prepared(tip=spelgen.tip_kinematics(arm))")
        return self._tip


def _state_and_input_jacobians(function: Callable[..., Tensor], *arguments: Tensor) -> tuple[Tensor, Tensor]:
    """Return the Jacobians, (batch, m, k), of a function of (state, input, ...) with respect to state and input.

    Args:
        function: function of (state, input, ...), without batch dimension. State and input are vectors, (k,) each. The
            function returns a vector, (m,).
        arguments: all arguments of the function, (batch, ...) each.
    """
    if not torch.is_grad_enabled():
        arguments = tuple(x.detach() for x in arguments)
    # In torch 2.13, vmap of a derivative of linalg.solve is wrong in forward mode and, if autograd is disabled, in
    # reverse mode. Reverse mode is therefore used, with autograd enabled.
    with torch.inference_mode(False), torch.enable_grad():
        jacobian = torch.func.vmap(torch.func.jacrev(function, argnums=(0, 1)))
        # Tensors of inference mode cannot be differentiated, so the arguments are cloned.
        by_state, by_input = jacobian(*(x.clone() for x in arguments))
    return by_state, by_input
