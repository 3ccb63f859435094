"""Errors of a torque fit: covariance of its parameters, and torque residual of samples that were not fitted."""

import numpy as np
import torch

from spelgen.fitting.torque.jacobian import TorqueJacobian
from spelgen.fitting.torque.linearization import concatenate_blocks
from spelgen.fitting.torque.problem import TorqueEstimate
from spelgen.fitting.torque.samples import TorqueSamples
from spelgen.fitting.torque.tuning import TUNING
from spelgen.identification.intervals import (
    BLOCKS,
    MIN_BLOCK,
    jackknife_covariance,
    larger_covariance,
    student_scale,
)


def parameter_covariance(estimate: TorqueEstimate) -> torch.Tensor:
    """Return the covariance (K, K) of an estimate, zero for fixed parameters.

    The model must have the parameters of the estimate. The posterior covariance assumes that the correlation times are
    right, and that errors have the same distribution in all motions. The jackknife over contiguous blocks of samples
    does not need these assumptions, but has few blocks. The result is the larger of both covariances in every
    direction, scaled such that 1.96 standard deviations are the 95 % interval of Student's t with blocks - 1 degrees of
    freedom.

    For 47 arms of `benchmarks/truth.py`, the 95 % intervals contain 97 % of the base parameters and 95 % of g(q). The
    intervals of the posterior covariance contain only 93 % and 89 %.
    """
    problem, x, free = estimate.problem, estimate.state.x, estimate.problem.free
    model, samples = problem.jacobian.model, problem.jacobian.samples
    # The noise is converted from the initial to the current motor gains: the Jacobians below are made from the fitted
    # model, so that its current gains are their initial gains, and their factor `logged_scale` is 1.
    noise = problem.noise / problem.jacobian.logged_scale(x)
    # The jackknife needs independent blocks: shorter ones would be strongly correlated with their neighbours.
    blocks = max(1, min(BLOCKS, samples.count // MIN_BLOCK))
    equations = []
    for rows in np.array_split(np.arange(samples.count), blocks):
        block = samples.select(slice(int(rows[0]), int(rows[-1]) + 1))
        equations.append(TorqueJacobian(model, block).normal_equations(x, noise))
    curvature, descent = (torch.stack(terms) for terms in zip(*equations, strict=True))
    curvature, prior = curvature[:, free][:, :, free], problem.prior.precision[free][:, free]
    covariance = torch.linalg.inv(curvature.sum(dim=0) + prior)
    if blocks > 1:
        jackknife = jackknife_covariance(curvature, descent[:, free], prior)[1]
        # Each covariance is too small in some directions: few blocks may agree by chance, and the posterior
        # covariance neglects differences between motions.
        covariance = larger_covariance(jackknife, covariance) * student_scale(blocks) ** 2
    return problem.of_all_parameters(covariance)


def held_out_nmse(estimate: TorqueEstimate, samples: TorqueSamples) -> torch.Tensor:
    """Return the mean squared error (n,) of held-out segments, divided by the variance of the torque.

    The segments are held out one at a time, without refits: to first order in the parameters, a fit to all other
    segments has the residual (1 - H)^-1 r on the held-out segment. Here r is the residual of the fit to all segments,
    and H is the segment's block of the hat matrix, for all joints together.
    """
    segments, size = estimate.on_segments(samples), samples.segment_length(TUNING.segment)
    jacobian, x, noise = segments.problem.jacobian, segments.state.x, segments.problem.noise
    # Joints cannot be treated separately: the parameters of a body affect the torques of all joints that carry it.
    weighted = torch.zeros(len(noise), jacobian.samples.count, len(x)).double()
    for joint, columns, of_joint, _ in concatenate_blocks(jacobian.joint_rows(x), len(noise)):
        weighted[joint, :, columns] = of_joint / noise[joint]
    weighted = weighted @ jacobian.theta_jacobian(x)
    residual = (jacobian.residual_samples(x).torque_residual * jacobian.logged_scale(x) / noise).mT
    error = torch.zeros_like(residual)
    for start in range(0, residual.shape[1], size):
        rows = slice(start, start + size)
        block = weighted[:, rows].flatten(0, 1)
        # `kept` is 1 - H. It has an eigenvalue near zero if a joint moves in this segment only; solving a linear system
        # with it is more accurate than inverting it.
        kept = torch.eye(len(block)).double() - block @ segments.covariance @ block.mT
        error[:, rows] = torch.linalg.solve(kept, residual[:, rows].flatten()).view(len(noise), -1)
    return error.square().mean(dim=1) * (noise / estimate.problem.noise_estimator.torque_std).square()
