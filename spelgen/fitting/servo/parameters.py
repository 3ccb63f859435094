"""The parameters of a servo fit: their values, the map from values to a model, and their Gaussian prior."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import chain

import numpy as np
import torch
from torch import Tensor
from torch.autograd.functional import jacobian

from spelgen.dynamics.body_regressor import regressor_of
from spelgen.dynamics.parameters import evaluate_with, parameters_of_kind
from spelgen.emission.assemble import ArmModel
from spelgen.fitting.servo.tuning import TUNING

DEAD_ZONE = "servo.dead_zone"
DELAY = "servo.delay"
COULOMB = "friction.raw_coulomb"
STRIBECK_VELOCITY = "friction.raw_stribeck_velocity"


@dataclass(frozen=True, eq=False)
class ServoParameters:
    """Values of the k = p n + r + 1 parameters of a servo fit.

    Attributes:
        joints: (p, n), p parameters of each joint.
        bodies: (r,), r coordinates of the body parameters along `ParameterMap.directions`, in prior standard
            deviations.
        delay: delay of the commands [s].
        active: (p, n), True for joint parameters that are fitted; a dead zone is fitted only at joints that have one.
    """

    joints: Tensor
    bodies: Tensor
    delay: float
    active: Tensor

    def after(self, step: Tensor) -> ServoParameters:
        """Return the k parameters of a servo fit after a step (k,); the delay remains at least zero."""
        joints, bodies, delay = step.split([self.joints.numel(), len(self.bodies), 1])
        return replace(
            self,
            joints=self.joints + joints.view_as(self.joints) * self.active,
            bodies=self.bodies + bodies,
            delay=max(0.0, self.delay + float(delay)),
        )

    @property
    def flat(self) -> Tensor:
        """All k parameters of a servo fit as one vector, (k,): joints, bodies, delay."""
        delay = torch.tensor([self.delay], dtype=torch.float64)
        return torch.cat([self.joints.flatten(), self.bodies, delay])


class ParameterMap:
    """The map between `ServoParameters` and the tensors of a model, and the prior of the k = p n + r + 1 parameters.

    There are p parameters for each of n joints, r coordinates of the body parameters, and the delay.

    Attributes:
        names: names of the p rows of `ServoParameters.joints`; a parameter with K values per joint has K rows of the
            same name.
        tensors: {name: joint parameter of the model}.
        directions: (10 B, r), r directions in the space of the log-Cholesky parameters of B bodies; only steps along
            these directions are fitted.
        prior_mean: parameters of the model when the map is made.

    Args:
        model: the model, which `write` changes.
        q: (M, n), M positions of the logs [rad, m], from which the directions are computed.
    """

    def __init__(self, model: ArmModel, q: Tensor) -> None:
        self._model, self._n = model, model.n
        tensors = dict(model.named_parameters()) | dict(model.named_buffers())
        # The parameter friction.raw_viscous is not fitted: logs of positions determine only the sum of viscous friction
        # and kd, which is fitted as kd.
        rows = [
            *(parameters_of_kind(model, group) for group in ("stiffness", "damping", "armature", "offset")),
            (COULOMB, "friction.raw_stribeck", STRIBECK_VELOCITY),
            *(parameters_of_kind(model, group) for group in ("load_dependence", "fractions", "dead_zone")),
        ]
        self.tensors = {name: tensors[name] for name in chain(*rows)}
        self._widths = [x[:1].numel() for x in self.tensors.values()]
        self.names = np.repeat(list(self.tensors), self._widths).tolist()
        self._deviations = torch.full((len(self.names), 1), TUNING.logarithm).double()
        self._deviations[self.row(STRIBECK_VELOCITY)] = TUNING.stribeck_velocity
        self._deviations[self.row(DEAD_ZONE)] = TUNING.dead_zone
        (self._bodies,) = parameters_of_kind(model, "bodies")
        self._mean_bodies = model.get_parameter(self._bodies).detach().clone()
        self.directions = self._body_directions(q)
        joints = torch.cat([x.detach().reshape(self._n, -1).mT for x in self.tensors.values()])
        always = torch.from_numpy(np.array(self.names) != DEAD_ZONE)
        bodies = torch.zeros(self.directions.shape[1]).double()
        active = always.unsqueeze(-1).expand(-1, model.n)
        self.prior_mean = ServoParameters(joints, bodies, float(model.servo.delay), active)

    def row(self, name: str) -> int:
        """Return the index of the row of `ServoParameters.joints` for a parameter name; of several rows, the first."""
        return self.names.index(name)

    def named(self, joints: Tensor) -> dict[str, Tensor]:
        """Return {name: tensor} for P sets of joint parameters (P, p, n): p parameters for each of n joints.

        A tensor is (P, 1, n), or (P, 1, n, K) for a parameter with K values per joint. In rollouts, the axis of length
        1 is broadcast over the windows.
        """
        # `columns` has a tensor (P, 1, n, K) for each parameter name: P sets, n joints, K values per joint
        columns = joints.unsqueeze(1).mT.split(self._widths, dim=-1)
        named = {}
        for (name, tensor), column in zip(self.tensors.items(), columns, strict=True):
            named[name] = column.reshape(*column.shape[:2], *tensor.shape)
        return named

    def write(self, x: ServoParameters) -> None:
        """Set the parameters of the model to the values of `ServoParameters` x."""
        with torch.no_grad():
            for name, rows in self.named(x.joints.unsqueeze(0)).items():
                self.tensors[name].copy_(rows[0, 0])
            self._model.get_parameter(self._bodies).copy_(self._log_cholesky(x.bodies))
            self._model.servo.delay.fill_(x.delay)

    def precision(self, x: ServoParameters) -> Tensor:
        """Return the inverse prior variances of all parameters, (k,); the parameters are independent in the prior.

        A parameter that is not fitted according to ``x.active`` has a variance of practically zero.
        """
        joints = torch.where(x.active, self._deviations, TUNING.fixed)
        shared = torch.tensor([1.0] * len(x.bodies) + [TUNING.delay]).double()
        return torch.cat([joints.flatten(), shared]) ** -2

    def inertial(self, bodies: Tensor) -> Tensor:
        """Return the inertial parameters of B bodies, (10 B,), for the coordinates `ServoParameters.bodies`, (r,)."""
        return self._inertial(self._log_cholesky(bodies)).flatten()

    def _log_cholesky(self, bodies: Tensor) -> Tensor:
        """Return log-Cholesky parameters, (B, 10), of B bodies: prior mean plus `directions` times coordinates (r,)."""
        return self._mean_bodies + (self.directions @ bodies).view_as(self._mean_bodies)

    def _inertial(self, log_cholesky: Tensor) -> Tensor:
        """Return inertial parameters, (B, 10), for log-Cholesky parameters (B, 10)."""
        parameters: Tensor = evaluate_with(
            self._model, {self._bodies: log_cholesky}, lambda model: model.inertial_parameters
        )
        return parameters

    def _body_directions(self, q: Tensor) -> Tensor:
        """Return the r directions of log-Cholesky parameters of B bodies with the largest effect on gravity, (10 B, r).

        Let A (M n, 10 B) be the derivative of the gravity torques at M positions with respect to the log-Cholesky
        parameters. A direction is a right singular vector of A, multiplied by the prior standard deviation
        `ServoTuning.bodies`. The vectors of the largest singular values are used, at most
        `ServoTuning.body_directions`; vectors of negligible effect are omitted. q: (M, n), the positions [rad, m].
        """
        zero = torch.zeros_like(q)
        # torch.func is not used, since its Jacobians import torch's compiler, which takes more than a second.
        slopes = jacobian(self._inertial, self._mean_bodies)
        with torch.no_grad():
            gravity = regressor_of(self._model.chain, q, zero, zero) @ slopes.reshape(
                self._mean_bodies.numel(), -1
            )
        _, effects, directions = torch.linalg.svd(gravity.flatten(0, 1), full_matrices=False)
        strong = effects[: TUNING.body_directions] > TUNING.min_effect * effects[:1].clamp(min=1e-12)
        result: Tensor = TUNING.bodies * directions[: len(strong)][strong].mT
        return result
