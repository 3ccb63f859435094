"""MAP estimation of servo, friction and body parameters x from positions of windows.

The cost is the negative log posterior of x, except for a constant,

    sum over joints and samples of 2 log(1 + (error / scale)^2 / 4) / samples_per_error + (x - m)^T P (x - m) / 2.

The first term is a Student-t likelihood with three degrees of freedom, which bounds the influence of windows in which
the arm is blocked, for example by a table. Each joint has one scale, the standard deviation of the Gaussian that
approximates the likelihood for small errors: sqrt(3) / 2 times the scale in the standard form of the t distribution.
Errors of neighbouring samples are correlated: samples_per_error samples count as one independent error. The second term
is a Gaussian prior with mean m and precision P.
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
from spelgen.runtime.parts import applied


@dataclass(frozen=True, eq=False)
class Likelihood:
    """Student-t likelihood of the position errors (W, K', n) of n joints: W windows, K' samples after the burn-in.

    scale: (n,), scale of the errors [rad, m]: the standard deviation of the Gaussian that approximates the likelihood
    for small errors. samples_per_error: (n,), number of correlated samples that count as one independent error.
    """

    scale: Tensor
    samples_per_error: Tensor

    @classmethod
    def of(cls, errors: Tensor, noise: Tensor, max_samples: int) -> Likelihood:
        """Return the likelihood with ``scale`` and ``samples_per_error`` estimated from position errors.

        Args:
            errors: (W, K', n), position errors [rad, m] of n joints at the K' samples of each of W windows after the
                burn-in.
            noise: (n,), lower bound of the scale [rad, m].
            max_samples: upper bound of ``samples_per_error``, the number of samples per independent error.
        """
        # 1.4826 times the median of |error| is the standard deviation of a Gaussian. Unlike the RMS, the median is
        # insensitive to outliers.
        scale = torch.maximum(1.4826 * errors.abs().flatten(0, 1).median(dim=0).values, noise)
        robust = errors / (1 + (errors / scale).square() / 4)
        # Let v be the variance of an error. The sum of m errors has the variance m v if the errors are independent, and
        # m^2 v if they are equal. The variance of the sum divided by m v is therefore between 1 and m: the number of
        # samples per independent error.
        size = min(max_samples, errors.shape[1])
        blocks = robust[:, : errors.shape[1] // size * size].unflatten(1, (-1, size))
        of_sums = blocks.sum(dim=2).square().mean(dim=(0, 1))
        of_samples = blocks.square().sum(dim=2).mean(dim=(0, 1))
        return cls(scale, (of_sums / of_samples.clamp(min=1e-300)).clamp(1.0, float(size)))

    def costs(self, errors: Tensor) -> Tensor:
        """Return the negative log likelihood of each joint's position errors, (n,), up to a constant.

        errors: (W, K', n) [rad, m], at K' samples of W windows.
        """
        costs = 2 * torch.log1p((errors / self.scale).square() / 4) / self.samples_per_error
        return costs.sum(dim=(0, 1))

    def weights(self, errors: Tensor) -> Tensor:
        """Return weights w (W, K', n) of iteratively reweighted least squares: w error^2/2 has the gradient of `costs`.

        The gradient is with respect to the errors (W, K', n) [rad, m] at K' samples of W windows, with constant w.
        """
        robust = 1 / (1 + (errors / self.scale).square() / 4)
        return robust / self.scale**2 / self.samples_per_error


@dataclass(frozen=True, eq=False)
class ServoProblem:
    """A `LeastSquaresProblem`: negative log posterior of `ServoParameters` for a given load and likelihood.

    Shapes: W windows, K' samples of a window after the burn-in, n joints, k parameters.

    noise: (n,), standard deviation of encoder rounding, the lower bound of `Likelihood.scale` [rad, m].
    """

    rollouts: ServoRollouts
    noise: Tensor
    likelihood: Likelihood

    @classmethod
    def of(cls, rollouts: ServoRollouts, noise: Tensor, errors: Tensor) -> ServoProblem:
        """Return the problem whose residual is computed by `rollouts`, with a likelihood estimated from `errors`.

        noise: (n,), standard deviation of encoder rounding [rad, m]. errors: (W, K', n), position errors [rad, m].
        """
        max_samples = max(1, round(TUNING.correlation_time * rollouts.windows.rate))
        return cls(rollouts, noise, Likelihood.of(errors, noise, max_samples))

    def reweighted(self, x: ServoParameters) -> ServoProblem:
        """Return the problem with the likelihood re-estimated from the position errors at parameters x."""
        return self.of(self.rollouts, self.noise, self.residual(x))

    def refined(self, steps: int, difference_step: float) -> ServoProblem:
        """Return the same problem with shorter or longer integration steps and another step of the finite differences.

        steps: number of integration steps per sample interval. difference_step: step of each parameter in the finite
        differences [1].
        """
        windows = replace(self.rollouts.windows, steps=steps)
        return replace(
            self, rollouts=replace(self.rollouts, windows=windows, difference_step=difference_step)
        )

    @property
    def parameters(self) -> ParameterMap:
        """Map from the fitted parameters to the model, with the prior of the parameters."""
        return self.rollouts.parameters

    def residual(self, x: ServoParameters) -> Tensor:
        """Return predicted minus measured positions for parameters x, (W, K', n) [rad, m].

        Each of the W windows has K' samples after the burn-in.
        """
        return self.rollouts.residual(x)

    def joint_costs(self, x: ServoParameters, errors: Tensor) -> Tensor:
        """Return the negative log posterior of each joint, (n,), as a function of the joint's p parameters in x.

        It is the negative log likelihood of the joint's errors plus the negative log prior of the p parameters. The
        prior of shared parameters is not included. errors: position errors at x, at K' samples of W windows after the
        burn-in, (W, K', n) [rad, m].
        """
        prior = self._prior(x)[: x.joints.numel()].view_as(x.joints)
        return self.likelihood.costs(errors) + prior.sum(dim=0)

    def cost(self, x: ServoParameters, errors: Tensor) -> float:
        """Return the negative log posterior at x; infinite if a rollout diverged. errors: position errors at x."""
        if not errors.isfinite().all():
            return float("inf")
        return float(self.likelihood.costs(errors).sum() + self._prior(x).sum())

    def _prior(self, x: ServoParameters) -> Tensor:
        """Return the negative log prior of each of the k parameters, (k,): (x - mean)^2 * precision / 2."""
        return self.parameters.precision(x) * (x.flat - self.parameters.prior_mean.flat).square() / 2

    def candidates(self, x: ServoParameters, step: Tensor) -> Iterable[ServoParameters]:
        """Return the only candidate: parameters after a step (k,) with components clipped to +-`TUNING.max_step`."""
        return [x.after(step.clamp(-TUNING.max_step, TUNING.max_step))]

    def normal_equations(self, x: ServoParameters, errors: Tensor) -> NormalEquations:
        """Return the Gauss-Newton Hessian (k, k) and the negative gradient (k,) of the cost at x.

        errors: position errors of W windows at x, at the K' samples after the burn-in, (W, K', n) [rad, m].
        """
        return self.with_prior(self.window_equations(x, errors), x)

    def with_prior(self, windows: NormalEquations, x: ServoParameters) -> NormalEquations:
        """Return the Hessian (k, k) and the negative gradient (k,) of the cost: sums over windows, plus the prior.

        windows: normal equations of each window at x, (W, k, k) and (W, k), without the prior.
        """
        precision = self.parameters.precision(x)
        descent = windows.descent.sum(dim=0) - precision * (x.flat - self.parameters.prior_mean.flat)
        return NormalEquations(windows.curvature.sum(dim=0) + torch.diag(precision), descent)

    def window_equations(self, x: ServoParameters, errors: Tensor) -> NormalEquations:
        """Return the normal equations of each of W windows for k parameters, (W, k, k) and (W, k), without prior.

        errors: position errors at x, at K' samples of each window after the burn-in, (W, K', n) [rad, m].
        """
        of_joints, of_shared = self.rollouts.jacobian(x)
        weights = self.likelihood.weights(errors)
        (p, count, _, n), r = of_joints.shape, len(of_shared)
        curvature = torch.zeros(count, p * n + r, p * n + r).double()
        descent = torch.zeros(count, p * n + r).double()
        for joint in range(n):
            # The errors of a joint depend only on p parameters of the joint and on r parameters that all joints share:
            # here r includes the coordinates of the bodies and the delay. `jacobian`, (W, p + r, K'), has the
            # derivatives of the joint's K' errors in each window with respect to these p + r parameters.
            jacobian = torch.cat([of_joints[..., joint], of_shared[..., joint]]).transpose(0, 1)
            rows = torch.cat([torch.arange(p) * n + joint, p * n + torch.arange(r)])
            weighted = jacobian * weights[:, None, :, joint]
            curvature[:, rows[:, None], rows] += weighted @ jacobian.mT
            descent[:, rows] -= applied(weighted, errors[..., joint])
        return NormalEquations(curvature, descent)
