"""Criterion that the parameters of an exciting motion minimize.

The criterion is the logarithm of the condition number of the base regressor (Gautier and Khalil, IJRR 11:362, 1992)
with columns of unit length, plus penalties. There are penalties on violated effort limits, on distances between objects
below a margin, and on small amplitudes. The penalty on small amplitudes is needed, because scaling the columns to unit
length removes the effect of the amplitude: without it, a small motion, with a low signal-to-noise ratio of the torques,
would be as good as a large motion.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from spelgen.arm.arm import Chain
from spelgen.dynamics.body_regressor import regressor_of
from spelgen.dynamics.friction import FrictionModel
from spelgen.dynamics.regressor_dynamics import body_chain, urdf_parameters
from spelgen.excitation.trajectory import ExcitationTrajectory
from spelgen.excitation.tuning import TUNING
from spelgen.identification.base_parameters import base_parameters

if TYPE_CHECKING:
    from spelgen.excitation.collisions import Collisions

FRICTION = FrictionModel()


class Criterion:
    """Criterion to be minimized over the parameters (size,) of a motion: log condition number plus penalties.

    The parameters are explained in `ExcitationTrajectory`, and the criterion in the docstring of the module.
    """

    def __init__(
        self, arm: Chain, trajectory: ExcitationTrajectory, collisions: Collisions | None = None
    ) -> None:
        self.trajectory, self.chain, self.collisions = trajectory, body_chain(arm), collisions
        self.columns = torch.from_numpy(base_parameters(arm, FRICTION).columns)
        count = TUNING.samples_per_harmonic * trajectory.harmonics + 1
        self.times = torch.linspace(0.0, trajectory.duration, count, dtype=torch.float64)
        self.inertial = torch.from_numpy(urdf_parameters(arm))
        # If a body has no <inertial>, the torques are unknown, so effort limits are ignored.
        is_known = all(body.inertia for body in arm.bodies)
        efforts = [(is_known and coordinate.effort) or torch.inf for coordinate in arm.coordinates]
        self.limits = torch.tensor(efforts, dtype=torch.float64)

    def states(self, parameters: np.ndarray) -> Tensor:
        """Return q, qd and qdd, (3, T, n), at T equidistant times; parameters: see `ExcitationTrajectory`."""
        return self.trajectory.states(torch.from_numpy(parameters), self.times)

    def condition(self, states: Tensor) -> float:
        """Return the condition number of the base regressor with columns of unit length; infinite for a zero column.

        states: q, qd and qdd, (3, T, n) [rad, m, s].
        """
        return float(self._log_condition(self._rows(states)).exp())

    def largest_efforts(self, states: Tensor) -> np.ndarray:
        """Return the largest magnitudes of the rigid-body torques divided by the effort limits, (n,).

        The result is NaN for a joint without an effort limit. states: q, qd and qdd, (3, T, n) [rad, m, s].
        """
        largest = self._efforts(self._rows(states)).abs().amax(dim=0)
        return torch.where(self.limits.isinf(), torch.nan, largest).numpy()

    def value(self, parameters: np.ndarray) -> float:
        """Return the criterion for the parameters (size,) of a motion; smaller values are better."""
        return float(self._value(torch.from_numpy(parameters)))

    def value_and_gradient(self, parameters: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the criterion and its gradient (size,) for parameters (size,). Infinite values are not excluded."""
        variables = torch.from_numpy(parameters).requires_grad_()
        value = self._value(variables)
        (gradient,) = torch.autograd.grad(value, variables)
        return value.item(), gradient.numpy()

    def _value(self, parameters: Tensor) -> Tensor:
        """Return the criterion as a differentiable scalar for parameters (size,)."""
        states = self.trajectory.states(parameters, self.times)
        rows = self._rows(states)
        overrun = (self._efforts(rows).abs() - TUNING.effort).clamp(min=0.0)
        reduction = self.trajectory.amplitude_reduction(parameters).sum()
        penalties = TUNING.penalty * overrun.square().sum() + reduction
        if self.collisions is not None:
            value, gradient = self.collisions.penalty(states[0].detach().numpy())
            # Torch cannot differentiate the penalty on distances. A linear function of q with the same value and the
            # same gradient, from `Collisions.penalty`, is used.
            change = torch.from_numpy(gradient) * (states[0] - states[0].detach())
            penalties = penalties + TUNING.collision_penalty * (value + change.sum())
        return self._log_condition(rows) + penalties

    def _rows(self, states: Tensor) -> Tensor:
        """Return the regressor of the torques, (T, n, K) for K parameters; ``states``: q, qd and qdd, (3, T, n).

        The parameters are the inertial parameters of the bodies, then armature and friction (`FRICTION.columns`).
        """
        q, qd, qdd = states
        direction = (qd / FRICTION.coulomb_smoothing_velocity).tanh()
        effects = torch.stack([qdd, qd, direction, torch.ones_like(qd)])
        drives = torch.diag_embed(effects).permute(1, 2, 0, 3).flatten(2)
        return torch.cat([regressor_of(self.chain, q, qd, qdd), drives], dim=2)

    def _efforts(self, rows: Tensor) -> Tensor:
        """Return rigid-body torques divided by the effort limits, (T, n), from the regressor of `_rows`."""
        return rows[:, :, : len(self.inertial)] @ self.inertial / self.limits

    def _log_condition(self, rows: Tensor) -> Tensor:
        """Return the logarithm of the condition number, (), of the base regressor, from the regressor of `_rows`."""
        columns = rows[:, :, self.columns].flatten(0, 1)
        length = columns.norm(dim=0)
        # The column of a parameter that the motion does not excite is zero: the condition number is then infinite.
        if not length.all():
            return torch.tensor(torch.inf, dtype=torch.float64)
        condition: Tensor = torch.linalg.cond(columns / length)
        return condition.log()
