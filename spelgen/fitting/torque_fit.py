"""Fit a closed-form model to torques: its most probable weights, by Gauss-Newton steps (Levenberg-Marquardt).

The torque is linear in the bodies' parameters, which the log-Cholesky weights make possible ones, and smooth in the
few constants of each joint: seconds are enough, and no step size is to be chosen. What is minimised is

    sum over joints and samples of (missing torque / noise)^2 + (weights - start)^T covariance^-1 (weights - start),

with the covariance of a Gaussian prior (see ``covariance``). The noise of a joint is what is left of its torque, found
in rounds. Sums over samples are made block by block, so that memory does not grow with the logs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from spelgen.fitting.config import GaussianPrior
from spelgen.fitting.gaussian_prior import covariance
from spelgen.fitting.torque_jacobian import TorqueJacobian
from spelgen.fitting.torque_samples import TorqueSamples
from spelgen.identification.samples import DynamicsSamples

if TYPE_CHECKING:
    from spelgen.emission.loading import EmittedModel

DECIMATION = (
    2  # samples taken of so many: filtered at 8 Hz and sampled at 100 Hz they say all that is to be said
)
ALIKE = 20.0  # of those: so many in a row, 0.4 s, err alike and count once
ROUNDS = 6  # of weighing joints by what is left of their torque
STEPS = 8  # at most in a round
LARGE = 2**15  # samples; of more, FEW of them are fitted first
FEW, LAST_ROUNDS = 2**14, 2
GAIN = 1e-4  # relative: a step that gains less ends a round
NO_GAIN = 1e-10  # likewise: a step that promises less is not tried
FIRST_NOISE = 0.1  # of a joint's torque range
LEAST_NOISE = 1e-4  # likewise: noise-free samples are fitted to four digits of their torque's range
DAMPING = (1e-9, 1e-3, 1e6)  # of the steps, relative to the curvature: least, first, most
PAYLOAD = GaussianPrior(bodies=10.0)
"""Of a load at the tip nothing is known before."""


@dataclass(frozen=True, eq=False)
class TorqueSolution:
    """How a fit ended. residual: (n,) root mean square of the torque that is missed [Nm, N]."""

    residual: np.ndarray
    steps: int
    cost: float


@dataclass(frozen=True, eq=False)
class _Step:
    """Weights, the sums of squares of the torque that they miss (n,), their cost, the damping of the next step."""

    x: torch.Tensor
    squares: torch.Tensor
    cost: float
    damping: float


def last_body(model: EmittedModel) -> int:
    """The body that holds the tip, and what the tip holds."""
    return len(model.dynamics.inertial_parameters()) - 1


def fit_torque(
    model: EmittedModel,
    samples: TorqueSamples | Sequence[DynamicsSamples],
    prior: GaussianPrior | None = None,
    only_bodies: Sequence[int] | None = None,
) -> TorqueSolution:
    """Set the weights of a closed-form ``model`` to the most probable ones after ``samples`` (torques as logged).

    The prior is centred on the weights as they are. ``only_bodies``: nothing moves but these bodies' parameters.
    """
    if not isinstance(samples, TorqueSamples):
        samples = TorqueSamples.held(samples, DECIMATION)
    prior = prior or GaussianPrior()
    problem = _Problem(TorqueJacobian(model, samples), prior, only_bodies)
    if samples.count <= LARGE:
        at, steps = problem.solve(problem.start, ALIKE**0.5 * FIRST_NOISE * problem.range, ROUNDS)
    else:  # few of many samples come near, all of them finish
        few = _Problem(TorqueJacobian(model, samples.thinned(FEW)), prior, only_bodies)
        near, first = few.solve(few.start, ALIKE**0.5 * FIRST_NOISE * few.range, ROUNDS)
        at, steps = problem.solve(near.x, few.noise(near.squares), LAST_ROUNDS, near.damping)
        steps += first
    problem.jacobian.write(at.x)
    return TorqueSolution((at.squares / samples.count).sqrt().numpy(), steps, at.cost)


class _Problem:
    def __init__(
        self, jacobian: TorqueJacobian, prior: GaussianPrior, only_bodies: Sequence[int] | None
    ) -> None:
        self.jacobian, self.count = jacobian, jacobian.samples.count
        self.start = jacobian.start
        self.precision = torch.linalg.inv(covariance(prior, jacobian.weights))
        self.free = jacobian.free(only_bodies)
        deviation = jacobian.torque_deviation()
        self.range = torch.maximum(deviation, 1e-3 * deviation.max())

    def solve(
        self, x: torch.Tensor, noise: torch.Tensor, rounds: int, damping: float = DAMPING[1]
    ) -> tuple[_Step, int]:
        """Steps down from x, and how many; the noise (n,) is found anew after each round."""
        at, steps = _Step(x, self.jacobian.squares(x), float("inf"), damping), 0
        for _ in range(rounds):
            at = _Step(at.x, at.squares, self.cost(at.x, at.squares, noise), at.damping)
            for _ in range(STEPS):
                after = self.step(at, noise)
                if after is None:
                    break
                gained, at, steps = at.cost - after.cost, after, steps + 1
                if gained < GAIN * at.cost:
                    break
            noise = self.noise(at.squares)
        return at, steps

    def noise(self, squares: torch.Tensor) -> torch.Tensor:
        """Standard deviations (n,) of errors as if they were independent from sample to sample."""
        return ALIKE**0.5 * torch.maximum((squares / self.count).sqrt(), LEAST_NOISE * self.range)

    def cost(self, x: torch.Tensor, squares: torch.Tensor, noise: torch.Tensor) -> float:
        away = x - self.start
        return float(((squares / noise.square()).sum() + away @ self.precision @ away) / 2)

    def step(self, at: _Step, noise: torch.Tensor) -> _Step | None:
        """A step that lowers the cost; None: there is none."""
        curvature, target = self.jacobian.normal_equations(at.x, noise, self.free)
        curvature = curvature + self.precision[self.free][:, self.free]
        target = target - (self.precision @ (at.x - self.start))[self.free]
        damping = at.damping
        while damping < DAMPING[2]:
            damped = curvature + damping * torch.diag(curvature.diagonal())
            moved = at.x.clone()
            step = torch.linalg.solve(damped, target)
            if step @ (target - curvature @ step / 2) < NO_GAIN * at.cost:
                return None
            moved[self.free] += step
            squares = self.jacobian.squares(moved)
            lower = self.cost(moved, squares, noise)
            if lower < at.cost:
                return _Step(moved, squares, lower, max(damping / 10, DAMPING[0]))
            damping *= 10
        return None
