"""MAP estimation of servo, friction and body parameters x from positions of windows.

The cost is the negative log posterior of x, except for a constant,

    sum over joints and samples of 2 log(1 + (error / scale)^2 / 4) / samples_per_error + (x - m)^T P (x - m) / 2,

with the density of Student's t for three degrees of freedom, and a Gaussian prior of mean m and precision P. Student's
t bounds the influence of windows in which the arm is blocked, for example by a table. Each joint has one scale. Errors
of neighbouring samples are correlated: samples_per_error samples count as one independent error. Shapes: W windows,
K' samples after the burn-in, n joints, k parameters.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from spelgen.fitting.levenberg_marquardt import NormalEquations
from spelgen.fitting.servo.parameters import ParameterMap, ServoParameters
from spelgen.fitting.servo.rollouts import ServoRollouts
from spelgen.fitting.servo.tuning import TUNING


@dataclass(frozen=True, eq=False)
class Likelihood:
    """Student-t likelihood of position errors.

    scale: (n,), scale of the errors [rad, m]. samples_per_error: (n,), number of samples per independent error.
    """

    scale: Tensor
    samples_per_error: Tensor

    @classmethod
    def of(cls, errors: Tensor, noise: Tensor, max_samples: int) -> Likelihood:
        """Return the likelihood with the scale and the correlation estimated from errors.

        Args:
            errors: (W, K', n), position errors [rad, m].
            noise: (n,), lower bound of the scale [rad, m].
            max_samples: largest number of samples per independent error.
        """
        # 1.4826 times the median of |error| is the standard deviation of a Gaussian; outliers do not change the median
        scale = torch.maximum(1.4826 * errors.abs().flatten(0, 1).median(dim=0).values, noise)
        robust = errors / (1 + (errors / scale).square() / 4)
        # The variance of the sum of m errors is m times the variance of an error if the errors are independent, and m^2
        # times this variance if they are equal. The ratio of the sum's variance to m variances is therefore the number
        # of samples per independent error.
        size = min(max_samples, errors.shape[1])
        blocks = robust[:, : errors.shape[1] // size * size].unflatten(1, (-1, size))
        of_sums = blocks.sum(dim=2).square().mean(dim=(0, 1))
        of_samples = blocks.square().sum(dim=2).mean(dim=(0, 1))
        return cls(scale, (of_sums / of_samples.clamp(min=1e-300)).clamp(1.0, float(size)))

    def costs(self, errors: Tensor) -> Tensor:
        """Return the negative log likelihood per joint, (n,), of errors (W, K', n)."""
        costs = 2 * torch.log1p((errors / self.scale).square() / 4) / self.samples_per_error
        return costs.sum(dim=(0, 1))

    def weights(self, errors: Tensor) -> Tensor:
        """Return the weights (W, K', n) with which weighted least squares has the gradient of `costs` at the errors."""
        robust = 1 / (1 + (errors / self.scale).square() / 4)
        return robust / self.scale**2 / self.samples_per_error


@dataclass(frozen=True, eq=False)
class ServoProblem:
    """A `LeastSquaresProblem`: negative log posterior of `ServoParameters` for a given load and likelihood.

    noise: (n,), lower bound of the scale of the position errors [rad, m].
    """

    rollouts: ServoRollouts
    noise: Tensor
    likelihood: Likelihood

    @classmethod
    def of(cls, rollouts: ServoRollouts, noise: Tensor, errors: Tensor) -> ServoProblem:
        """Return the problem with the likelihood estimated from errors (W, K', n) [rad, m]."""
        max_samples = max(1, round(TUNING.correlation_time * rollouts.windows.rate))
        return cls(rollouts, noise, Likelihood.of(errors, noise, max_samples))

    def reweighted(self, x: ServoParameters) -> ServoProblem:
        """Return the problem with the likelihood estimated from the errors at parameters x."""
        return self.of(self.rollouts, self.noise, self.residual(x))

    def refined(self, steps: int, difference_step: float) -> ServoProblem:
        """Return the problem with a new number of integration steps per sample interval and finite-difference step."""
        windows = replace(self.rollouts.windows, steps=steps)
        return replace(
            self, rollouts=replace(self.rollouts, windows=windows, difference_step=difference_step)
        )

    @property
    def parameters(self) -> ParameterMap:
        """The map of the parameters to the model, and their prior."""
        return self.rollouts.parameters

    def residual(self, x: ServoParameters) -> Tensor:
        """Return predicted minus measured positions after the burn-in, (W, K', n) [rad, m]."""
        return self.rollouts.residual(x)

    def joint_costs(self, x: ServoParameters, errors: Tensor) -> Tensor:
        """Return the cost per joint (n,) for errors (W, K', n), without the prior of parameters that joints share."""
        prior = self._prior(x)[: x.joints.numel()].view_as(x.joints)
        return self.likelihood.costs(errors) + prior.sum(dim=0)

    def cost(self, x: ServoParameters, errors: Tensor) -> float:
        """Return the cost for errors (W, K', n); infinite if a rollout diverged."""
        if not errors.isfinite().all():
            return float("inf")
        return float(self.likelihood.costs(errors).sum() + self._prior(x).sum())

    def _prior(self, x: ServoParameters) -> Tensor:
        """Return the negative log prior of each parameter, (k,)."""
        return self.parameters.precision(x) * (x.flat - self.parameters.prior_mean.flat).square() / 2

    def candidates(self, x: ServoParameters, step: Tensor) -> Iterable[ServoParameters]:
        """Return the parameters after a step (k,), whose components are clamped to at most `TUNING.max_step`."""
        return [x.after(step.clamp(-TUNING.max_step, TUNING.max_step))]

    def normal_equations(self, x: ServoParameters, errors: Tensor) -> NormalEquations:
        """Return Gauss-Newton Hessian (k, k) and negative gradient (k,) at x, of errors (W, K', n) and the prior."""
        return self.with_prior(self.window_equations(x, errors), x)

    def with_prior(self, windows: NormalEquations, x: ServoParameters) -> NormalEquations:
        """Return the normal equations of the whole cost at x: Hessian (k, k) and negative gradient (k,).

        windows: normal equations of W windows, (W, k, k) and (W, k), without the prior.
        """
        precision = self.parameters.precision(x)
        descent = windows.descent.sum(dim=0) - precision * (x.flat - self.parameters.prior_mean.flat)
        return NormalEquations(windows.curvature.sum(dim=0) + torch.diag(precision), descent)

    def window_equations(self, x: ServoParameters, errors: Tensor) -> NormalEquations:
        """Return the normal equations of each window, (W, k, k) and (W, k), without the prior; errors: (W, K', n)."""
        of_joints, of_shared = self.rollouts.jacobian(x)
        weights = self.likelihood.weights(errors)
        (p, count, _, n), r = of_joints.shape, len(of_shared)
        curvature = torch.zeros(count, p * n + r, p * n + r).double()
        descent = torch.zeros(count, p * n + r).double()
        for joint in range(n):
            # the errors of a joint depend only on the parameters of this joint and on shared parameters
            jacobian = torch.cat([of_joints[..., joint], of_shared[..., joint]]).transpose(0, 1)
            rows = torch.cat([torch.arange(p) * n + joint, p * n + torch.arange(r)])
            weighted = (
                jacobian * weights[:, None, :, joint]
            )  # (W, p + r, K'): p parameters of the joint, r shared ones
            curvature[:, rows[:, None], rows] += weighted @ jacobian.mT
            descent[:, rows] -= (weighted @ errors[..., joint].unsqueeze(-1)).squeeze(-1)
        return NormalEquations(curvature, descent)
