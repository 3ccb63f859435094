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
    """Return the covariance (K, K), zero for fixed parameters, of an estimate, which has been written into its model.

    The posterior covariance assumes correlation times, and errors that are the same in all motions. The jackknife over
    contiguous blocks of samples measures both, but from few blocks. The result is the larger one in every direction,
    scaled such that 1.96 standard deviations are the 95 % interval of Student's t with blocks - 1 degrees of freedom.

    95 % intervals of 47 arms of `benchmarks/truth.py` contain 97 % of base parameters and 95 % of g(q); intervals
    of the posterior covariance 93 and 89 %.
    """
    problem, x, free = estimate.problem, estimate.state.x, estimate.problem.free
    model, samples = problem.jacobian.model, problem.jacobian.samples
    # a new Jacobian measures logged torques relative to the gains that were written
    noise = problem.noise / problem.jacobian.logged_scale(x)
    # shorter blocks than these would be as correlated with their neighbours as within
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
        # each of both is too small in some directions: of ten blocks some agree by chance, and the posterior covariance
        # does not know of differences between motions
        covariance = larger_covariance(jackknife, covariance) * student_scale(blocks) ** 2
    return problem.of_all_parameters(covariance)


def held_out_nmse(estimate: TorqueEstimate, samples: TorqueSamples) -> torch.Tensor:
    """Return the mean squared error (n,) of held-out segments, divided by the variance of the torque.

    To first order in the parameters, a fit without a segment has the residual (1 - H)^-1 r on this segment: r is the
    residual of the fit to all segments, and H the block of the hat matrix of the segment, of all joints together.
    """
    segments, size = estimate.on_segments(samples), samples.segment_length(TUNING.segment)
    jacobian, x, noise = segments.problem.jacobian, segments.state.x, segments.problem.noise
    # rows of all joints together: parameters of a body change the torques of all joints before it
    weighted = torch.zeros(len(noise), jacobian.samples.count, len(x)).double()
    for joint, columns, of_joint, _ in concatenate_blocks(jacobian.joint_rows(x), len(noise)):
        weighted[joint, :, columns] = of_joint / noise[joint]
    weighted = weighted @ jacobian.theta_jacobian(x)
    residual = (jacobian.residual_samples(x).torque_residual * jacobian.logged_scale(x) / noise).mT
    error = torch.zeros_like(residual)
    for start in range(0, residual.shape[1], size):
        rows = slice(start, start + size)
        block = weighted[:, rows].flatten(0, 1)
        # solved, not inverted: a joint that only this segment moves has an eigenvalue near zero
        kept = torch.eye(len(block)).double() - block @ segments.covariance @ block.mT
        error[:, rows] = torch.linalg.solve(kept, residual[:, rows].flatten()).view(len(noise), -1)
    return error.square().mean(dim=1) * (noise / estimate.problem.noise_estimator.torque_std).square()
