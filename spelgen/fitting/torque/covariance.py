"""Covariance of the parameters of a torque fit, and the torque error of held-out samples, from blocks of samples."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import torch

from spelgen.fitting.torque.jacobian import TorqueJacobian
from spelgen.fitting.torque.problem import TorqueEstimate
from spelgen.identification.intervals import (
    BLOCKS,
    MIN_BLOCK,
    jackknife_covariance,
    larger_covariance,
    student_scale,
)


class ParameterCovariance(NamedTuple):
    """Covariance of the parameters x (K, K), zero for fixed ones, and RMS torque residual of held-out samples (n,)."""

    covariance: torch.Tensor
    torque_std: torch.Tensor


def parameter_covariance(estimate: TorqueEstimate) -> ParameterCovariance:
    """Return the covariance of an estimate, which has been written into its model.

    The posterior covariance assumes correlation times, and errors that are the same in all motions. The jackknife over
    contiguous blocks of samples measures both, but from few blocks. The result is the larger one in every direction,
    scaled such that 1.96 standard deviations are the 95 % interval of Student's t with blocks - 1 degrees of freedom.

    95 % intervals of 47 arms of `benchmarks/truth.py` contain 97 % of base parameters and 95 % of g(q); intervals
    of the posterior covariance 93 and 89 %.
    """
    problem, x, free = estimate.problem, estimate.state.x, estimate.problem.free
    # a new Jacobian measures logged torques relative to the gains that were written
    noise, count = problem.noise / problem.jacobian.logged_scale(x), problem.jacobian.samples.count
    blocks = max(1, min(BLOCKS, count // MIN_BLOCK))
    equations = [jacobian.normal_equations(x, noise) for jacobian in _blocks(estimate, blocks)]
    curvature, descent = (torch.stack(terms) for terms in zip(*equations, strict=True))
    curvature, descent = curvature[:, free][:, :, free], descent[:, free]
    prior = problem.prior.precision[free][:, free]
    posterior = torch.linalg.inv(curvature.sum(dim=0) + prior)
    if blocks > 1:
        steps, jackknife = jackknife_covariance(curvature, descent, prior)
        posterior = larger_covariance(jackknife, posterior) * student_scale(blocks) ** 2
    else:
        steps = torch.zeros_like(descent)
    squares = torch.zeros_like(noise)
    for jacobian, step in zip(_blocks(estimate, blocks), steps, strict=True):
        held_out = jacobian.curved_step(x, torch.zeros_like(x).masked_scatter(free, step))
        squares += jacobian.squared_residual(held_out)
    return ParameterCovariance(problem.of_all_parameters(posterior), (squares / count).sqrt())


def _blocks(estimate: TorqueEstimate, blocks: int) -> Iterator[TorqueJacobian]:
    """Yield the Jacobian of each block of samples."""
    model, samples = estimate.problem.jacobian.model, estimate.problem.jacobian.samples
    for rows in np.array_split(np.arange(samples.count), blocks):
        yield TorqueJacobian(model, samples.select(slice(int(rows[0]), int(rows[-1]) + 1)))
