"""Roll out windows under their commands as a function of a model's parameters: residuals, cost and normal equations.

Each joint is rolled out by itself under the load of the bodies, so a parameter of every joint is moved at once;
parameters that all joints share, those of the bodies and the delay, are moved one after the other, all in one rollout.
The cost is

    sum over joints and samples of 2 log(1 + (error / scale)^2 / 4) / correlated + |(x - start) / deviation|^2 / 2,

Student's t with three degrees of freedom: a joint that is held by something unknown, a table maybe, counts little.
The scale of a joint is what its errors usually are, and correlated how many samples say the same.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from spelgen.dynamics.servo_rollout import Load, ServoDrives, advanced, balanced, servo_drives
from spelgen.fitting.functional_model import evaluate_with
from spelgen.fitting.levenberg_marquardt import NormalEquations
from spelgen.fitting.servo.parameters import (
    ParameterRows,
    ServoParameters,
    body_directions,
    body_parameters,
    inertial_parameters,
)
from spelgen.fitting.servo.tuning import ServoCostTuning
from spelgen.fitting.servo.windows import Path, ServoWindows, body_load

if TYPE_CHECKING:
    from spelgen.emission.assemble import ArmModel

TUNING = ServoCostTuning()
LONGEST_STEP = 1.0  # in any parameter: they are logarithms
GRAVITY_SAMPLES = 2000  # for the directions of the bodies


@dataclass(frozen=True, eq=False)
class Likelihood:
    """Weigh errors of positions: what they usually are, and how many samples say the same, both (n,)."""

    scale: torch.Tensor
    correlated: torch.Tensor

    @classmethod
    def of(cls, errors: torch.Tensor, noise: torch.Tensor, span: int) -> Likelihood:
        """Return that of errors (W, K', n) above the noise (n,), of which at most ``span`` samples say the same."""
        # a Gaussian deviates by 1.4826 times its median; a table under the arm is not in the median
        scale = torch.maximum(1.4826 * errors.abs().flatten(0, 1).median(dim=0).values, noise)
        robust = errors / (1 + (errors / scale).square() / 4)
        # errors that say the same add up: the variance of their sum is so many times that of a sample
        span = min(span, errors.shape[1])
        blocks = robust[:, : errors.shape[1] // span * span].unflatten(1, (-1, span))
        of_sums = blocks.sum(dim=2).square().mean(dim=(0, 1))
        of_samples = blocks.square().sum(dim=2).mean(dim=(0, 1))
        return cls(scale, (of_sums / of_samples.clamp(min=1e-300)).clamp(1.0, float(span)))

    def costs(self, errors: torch.Tensor) -> torch.Tensor:
        """Return minus the logarithm of the likelihood by joint, (n,)."""
        costs = 2 * torch.log1p((errors / self.scale).square() / 4) / self.correlated
        return costs.sum(dim=(0, 1))

    def weights(self, errors: torch.Tensor) -> torch.Tensor:
        """Return the weights of squared errors, (W, K', n), by which least squares has the same gradient."""
        robust = 1 / (1 + (errors / self.scale).square() / 4)
        return robust / self.scale**2 / self.correlated


class ServoProblem:
    """A `LeastSquaresProblem` of `ServoParameters`: windows, a model, and the errors that it makes on them.

    nudge: of finite differences.
    """

    def __init__(self, model: ArmModel, windows: ServoWindows, noise: torch.Tensor) -> None:
        self.model, self.windows, self._noise = model, windows, noise
        self.rows = ParameterRows(model)
        self.nudge = TUNING.nudge
        q = windows.q.flatten(0, 1)
        self.directions = body_directions(model, q[:: max(1, len(q) // GRAVITY_SAMPLES)])
        self._raw_bodies = body_parameters(model).detach().clone()
        bodies = torch.zeros(self.directions.shape[1]).double()
        self.start = ServoParameters(self.rows.read(), bodies, float(model.servo.delay), self.rows.active)
        self.linearise(self.start, windows.path())

    def linearise(self, x: ServoParameters, path: Path) -> None:
        """Take the bodies' load as it is at x, moving along this path."""
        self.write(x)
        self.along = path
        self._inertial = inertial_parameters(self.model, body_parameters(self.model).detach()).flatten()
        self.load = body_load(self.model, path)

    def weigh(self, errors: torch.Tensor) -> None:
        """Take the likelihood of errors like these, (W, K', n)."""
        span = max(1, round(TUNING.correlation_time * self.windows.rate))
        self.likelihood = Likelihood.of(errors, self._noise, span)

    def write(self, x: ServoParameters) -> None:
        """Give the model the parameters."""
        self.rows.write(x)
        with torch.no_grad():
            body_parameters(self.model).copy_(self._bodies_at(x.bodies))
            self.model.servo.delay.fill_(x.delay)

    def residual(self, x: ServoParameters) -> torch.Tensor:
        """Return predicted less measured positions (W, K', n), all samples after the windows' settling."""
        return self._errors(self._rollout_at(x)[0])[0]

    def predicted_path(self, x: ServoParameters) -> Path:
        """Return the measured motion, whose derivatives are the predicted ones and those of what prediction misses."""
        q, qd = self._rollout_at(x)
        return self.windows.path(q[0], qd[0])

    def joint_costs(self, x: ServoParameters, errors: torch.Tensor) -> torch.Tensor:
        """Return the cost by joint, (n,), without that of shared parameters."""
        prior = self._prior(x)[: x.joints.numel()].view_as(x.joints)
        return self.likelihood.costs(errors) + prior.sum(dim=0)

    def cost(self, x: ServoParameters, errors: torch.Tensor) -> float:
        """Return the cost, infinite where a rollout left all bounds."""
        if not errors.isfinite().all():
            return float("inf")
        return float(self.likelihood.costs(errors).sum() + self._prior(x).sum())

    def _prior(self, x: ServoParameters) -> torch.Tensor:
        return self.rows.precision(x) * (x.flat - self.start.flat).square() / 2

    def candidates(self, x: ServoParameters, step: torch.Tensor) -> Iterable[ServoParameters]:
        """Return where a step (k,) leads."""
        return [x.moved(step.clamp(-LONGEST_STEP, LONGEST_STEP))]

    def normal_equations(self, x: ServoParameters, errors: torch.Tensor) -> NormalEquations:
        """Return those of all windows and the prior, (k, k) and (k,)."""
        return self.with_prior(self.window_equations(x, errors), x)

    def with_prior(self, windows: NormalEquations, x: ServoParameters) -> NormalEquations:
        """Return the sum of windows' normal equations, and the prior's."""
        precision = self.rows.precision(x)
        descent = windows.descent.sum(dim=0) - precision * (x.flat - self.start.flat)
        return NormalEquations(windows.curvature.sum(dim=0) + torch.diag(precision), descent)

    def window_equations(self, x: ServoParameters, errors: torch.Tensor) -> NormalEquations:
        """Return those of each window without the prior, (W, k, k) and (W, k)."""
        joint_slopes, shared_slopes = self._slopes(x)
        weights = self.likelihood.weights(errors)
        (p, count, _, n), r = joint_slopes.shape, len(shared_slopes)
        curvature = torch.zeros(count, p * n + r, p * n + r).double()
        descent = torch.zeros(count, p * n + r).double()
        for joint in range(n):
            # rolled out by itself, a joint does not depend on the parameters of others
            slopes = torch.cat([joint_slopes[..., joint], shared_slopes[..., joint]]).transpose(0, 1)
            rows = torch.cat([torch.arange(p) * n + joint, p * n + torch.arange(r)])
            weighted = slopes * weights[:, None, :, joint]  # (W, p + r, K')
            curvature[:, rows[:, None], rows] += weighted @ slopes.mT
            descent[:, rows] -= (weighted @ errors[..., joint].unsqueeze(-1)).squeeze(-1)
        return NormalEquations(curvature, descent)

    def _slopes(self, x: ServoParameters) -> tuple[torch.Tensor, torch.Tensor]:
        """Return those of errors by joints' parameters (p, W, K', n), and by shared ones (r + 1, W, K', n).

        They are finite differences of one rollout, whose first row has the parameters as they are.
        """
        rows = x.active.any(dim=1).nonzero().squeeze(-1)  # which any joint has
        p, r, nudge = len(rows), len(x.bodies), self.nudge
        joints = x.joints.expand(p + r + 2, -1, -1).clone()
        joints[torch.arange(p) + 1, rows] += nudge
        bodies = x.bodies.expand(p + r + 2, -1).clone()
        bodies[torch.arange(r) + p + 1, torch.arange(r)] += nudge
        commands = self.windows.commands(x.delay).expand(p + r + 1, -1, -1, -1, -1)
        later = self.windows.commands(x.delay + nudge).unsqueeze(0)
        q, _ = self._rollout(joints, bodies, torch.cat([commands, later]))
        errors = self._errors(q)
        changes = (errors[1:] - errors[0]) / nudge
        slopes = torch.zeros(len(x.joints), *changes.shape[1:]).double()
        slopes[rows] = changes[:p]
        return slopes, changes[p:]

    def _errors(self, q: torch.Tensor) -> torch.Tensor:
        judged = self.windows.settling + 1
        return q[:, :, judged:] - self.windows.q[:, judged:]

    def _rollout_at(self, x: ServoParameters) -> tuple[torch.Tensor, torch.Tensor]:
        """Return q and qd (1, W, K, n)."""
        commands = self.windows.commands(x.delay)
        return self._rollout(x.joints.unsqueeze(0), x.bodies.unsqueeze(0), commands.unsqueeze(0))

    def _rollout(
        self, joints: torch.Tensor, bodies: torch.Tensor, commands: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return q and qd (P, W, K, n) of parameters (P, p, n), (P, r) under commands (P, W, K-1, S, n)."""
        named = self.rows.named(joints)
        tensors = {name: tensor.detach() for name, tensor in named.items()}
        with torch.inference_mode():  # small operations, of which each takes a tenth less so
            drives, armature = evaluate_with(self.model, tensors, _drives)
            change = torch.einsum("wkni,pi->pwkn", self.load.slopes, self._changed(bodies))
            return self._integrate(drives, armature, change, commands)

    def _changed(self, bodies: torch.Tensor) -> torch.Tensor:
        """Return by how much inertial parameters differ from those of the load, (P, 10 B), at bodies (P, r)."""
        changes = []
        for point in bodies:
            inertial = inertial_parameters(self.model, self._bodies_at(point))
            changes.append(inertial.flatten() - self._inertial)
        return torch.stack(changes)

    def _bodies_at(self, bodies: torch.Tensor) -> torch.Tensor:
        """Return the bodies' raw parameters, (B, 10), this far (r,) along their directions."""
        return self._raw_bodies + (self.directions @ bodies).view_as(self._raw_bodies)

    def _integrate(
        self, drives: ServoDrives, armature: torch.Tensor, change: torch.Tensor, commands: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        windows, load = self.windows, self.load
        h = windows.dt.unsqueeze(-1) / commands.shape[3]
        inertia, bias = load.inertia + armature.unsqueeze(-2), load.bias + change
        shape = (len(change), *windows.q[:, 0].shape)
        q, qd = windows.q[:, 0].expand(shape), windows.qd[:, 0].expand(shape)
        positions, velocities, state = [q], [qd], None
        for k in range(windows.q.shape[1] - 1):
            now = Load(inertia[:, :, k], bias[:, :, k], load.gravity[:, k], coupled=False)
            if state is None:  # friction's state at the start is unknown; the settling forgets it
                state = balanced(drives, q, qd, commands[:, :, k, 0], now)
            for u in commands[:, :, k].unbind(2):
                state = advanced(drives, state, u, now, h[:, k])
            positions.append(state.q)
            velocities.append(state.qd)
        return torch.stack(positions, dim=2), torch.stack(velocities, dim=2)


def _drives(model: ArmModel) -> tuple[ServoDrives, torch.Tensor]:
    return servo_drives(model), model.armature
