"""Judge how good an excitation trajectory is, with its gradient.

The criterion is the logarithm of the condition number of the base regressor (Swevers et al., IEEE T-RA 13:730, 1997;
columns of length one), with penalties on efforts overrun and on amplitudes given away: columns of length one know no
amplitude, but the noise of a torque sensor does.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from spelgen.arm.arm import Arm
from spelgen.dynamics.body_regressor import regressor_of
from spelgen.dynamics.linear_friction import FrictionModel
from spelgen.dynamics.regressor import body_chain, urdf_parameters
from spelgen.excitation.trajectory import ExcitationTrajectory
from spelgen.excitation.tuning import TUNING
from spelgen.identification.base_parameters import base_parameters

FRICTION = FrictionModel()


class Criterion:
    """Judge motions of an arm: the less, the better."""

    def __init__(self, arm: Arm, trajectory: ExcitationTrajectory) -> None:
        self.trajectory, self.chain = trajectory, body_chain(arm)
        self.columns = torch.from_numpy(base_parameters(arm, FRICTION).columns)
        count = TUNING.samples_per_harmonic * trajectory.harmonics + 1
        self.times = torch.linspace(0.0, trajectory.duration, count, dtype=torch.float64)
        self.inertial = torch.from_numpy(urdf_parameters(arm))
        # without inertials the torque is not known, and no limit can be kept
        is_known = all(body.inertia for body in arm.bodies)
        efforts = [(is_known and coordinate.effort) or torch.inf for coordinate in arm.coordinates]
        self.limits = torch.tensor(efforts, dtype=torch.float64)

    def states(self, parameters: np.ndarray) -> Tensor:
        """Return q, qd and qdd at the samples that are judged, (3, T, n)."""
        return self.trajectory.states(torch.from_numpy(parameters), self.times)

    def condition(self, states: Tensor) -> float:
        """Return the condition number of the base regressor, its columns of length one; infinite where one is zero."""
        return float(self._log_condition(self._rows(states)).exp())

    def efforts(self, states: Tensor) -> np.ndarray:
        """Return torques of the rigid bodies, as part of the limits, (T, n); NaN where these are not known."""
        efforts = torch.where(self.limits.isinf(), torch.nan, self._efforts(self._rows(states)))
        return np.asarray(efforts.numpy())

    def value(self, parameters: np.ndarray) -> float:
        """Return the criterion."""
        return float(self._value(torch.from_numpy(parameters)))

    def value_and_gradient(self, parameters: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the criterion and its derivatives by the parameters, where the condition number is finite."""
        variables = torch.from_numpy(parameters).requires_grad_()
        value = self._value(variables)
        (gradient,) = torch.autograd.grad(value, variables)
        return value.item(), gradient.numpy()

    def _value(self, parameters: Tensor) -> Tensor:
        rows = self._rows(self.trajectory.states(parameters, self.times))
        overrun = (self._efforts(rows).abs() - TUNING.effort).clamp(min=0.0)
        penalties = TUNING.penalty * overrun.square().sum() + self.trajectory.given_away(parameters).sum()
        return self._log_condition(rows) + penalties

    def _rows(self, states: Tensor) -> Tensor:
        """Return the regressor (T, n, K) of bodies, and of friction and drives as `FRICTION.columns` has them."""
        q, qd, qdd = states
        direction = (qd / FRICTION.coulomb_smoothing_velocity).tanh()
        effects = torch.stack([qdd, qd, direction, torch.ones_like(qd)])
        drives = torch.diag_embed(effects).permute(1, 2, 0, 3).flatten(2)
        return torch.cat([regressor_of(self.chain, q, qd, qdd), drives], dim=2)

    def _efforts(self, rows: Tensor) -> Tensor:
        return rows[:, :, : len(self.inertial)] @ self.inertial / self.limits

    def _log_condition(self, rows: Tensor) -> Tensor:
        columns = rows[:, :, self.columns].flatten(0, 1)
        length = columns.norm(dim=0)
        # a parameter that the motion does not show at all
        if not length.all():
            return torch.tensor(torch.inf, dtype=torch.float64)
        condition: Tensor = torch.linalg.cond(columns / length)
        return condition.log()
