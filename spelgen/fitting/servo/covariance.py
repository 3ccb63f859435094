"""Covariance of the parameters of a model after a servo fit, from which its posterior is made."""

import torch
from torch import Tensor

from spelgen.fitting.run_record import Content
from spelgen.fitting.servo.parameters import DELAY
from spelgen.fitting.servo.problem import ServoProblem
from spelgen.fitting.servo.report import ServoSolution
from spelgen.fitting.servo.tuning import TUNING
from spelgen.fitting.torque.parameters import ParameterVector
from spelgen.identification.intervals import QUANTILE


def posterior_content(problem: ServoProblem, solution: ServoSolution) -> Content:
    """Return the posterior of a servo fit for the checkpoint: `covariance` (K, K), and `delay_std` of the delay [s].

    K is the number of parameters of the model (`ParameterVector`). The fit estimates fewer parameters
    (`ServoParameters`), with coordinates of the bodies in place of the inertial parameters. The covariance of the fit
    is converted to the model's parameters by the Jacobian. It is scaled such that 1.96 standard deviations are half the
    width of the 95 % interval of the fit, which is wider than a normal one (`ServoSolution.quantile`). Three variances
    are increased, since the fit underestimates them:

    - kd, armature and friction: the variance due to errors of the friction model is added
      (`ServoTuning.model_deviation`).
    - bodies: the prior covariance is added for directions orthogonal to `ParameterMap.directions`, which are not
      fitted.
    - common factor of gains, masses, friction and offsets, if no kp is known: only effort limits [Nm, N] determine this
      factor, and the limits in URDFs are often wrong. The variance of the logarithm of the factor is therefore
      increased until the mean variance of log kp is at least `ServoTuning.bodies`^2, the prior variance of the
      logarithm of a mass.
    """
    parameters, model = problem.parameters, problem.rollouts.model
    vector, directions = ParameterVector(model), parameters.directions
    (p, n), count = parameters.prior_mean.joints.shape, len(solution.covariance)
    units = torch.eye(count).double()
    # `slopes` are the derivatives (k, K) of the K parameters of the model with respect to the k fitted parameters.
    slopes = {name: torch.zeros(count, x.numel()).double() for name, x in vector.initial.items()}
    of_joints = parameters.named(units[:, : p * n].view(count, p, n))
    slopes |= {name: x.reshape(count, -1) for name, x in of_joints.items()}
    slopes[vector.bodies] = units[:, p * n : -1] @ directions.mT
    slopes[DELAY] = units[:, -1:]
    slope = torch.cat(list(slopes.values()), dim=1)
    scale, bodies = solution.quantile / QUANTILE, vector.mask("bodies")
    forms = (scale * TUNING.model_deviation) ** 2 * vector.mask("damping", "armature", "sizes")
    covariance = scale**2 * slope.mT @ solution.covariance @ slope + forms.diag()
    unfitted = TUNING.bodies**2 * torch.eye(len(directions)).double() - directions @ directions.mT
    covariance[bodies[:, None] & bodies] += unfitted.flatten()
    if model.servo.trained.all():
        factor = _common_factor(vector)
        missing = TUNING.bodies**2 - covariance.diagonal()[vector.mask("stiffness")].mean()
        covariance += missing.clamp(min=0) * factor.outer(factor)
    return {"covariance": covariance, "delay_std": scale * float(solution.covariance[-1, -1].sqrt())}


def _common_factor(vector: ParameterVector) -> Tensor:
    """Return the derivative (K,) of the parameters with respect to the logarithm of a common factor of all torques.

    Positions under servos do not depend on this factor of gains, masses, friction and torque offsets. The
    parameters of gains, masses and friction are logarithms and have the derivative 1. The parameter of a torque offset
    is proportional to the factor: its derivative is its value.
    """
    logarithms = vector.mask("stiffness", "damping", "armature", "sizes", "effects").double()
    derivatives = vector.unflatten(logarithms)
    derivatives[vector.bodies][:, -1] = 1.0  # log(mass), with derivative 1 by log(factor)
    for name in vector.names("offset"):
        derivatives[name].copy_(vector.initial[name])
    return logarithms
