"""Block jackknife of a torque fit: covariance of the parameters, and torque residual of held-out blocks."""

from typing import NamedTuple

import numpy as np
import torch

from spelgen.fitting.torque.jacobian import TorqueJacobian
from spelgen.fitting.torque.linearization import append_target, concatenate_blocks
from spelgen.fitting.torque.problem import TorqueEstimate
from spelgen.fitting.torque.samples import TorqueSamples
from spelgen.identification.intervals import (
    BLOCKS,
    MIN_BLOCK,
    jackknife_covariance,
    larger_covariance,
    student_scale,
)


class Jackknife(NamedTuple):
    """Covariance of the parameters of a torque fit, and its held-out residual, from a block jackknife.

    covariance: (K, K), covariance of the K parameters x of bodies, drives and friction; zero for fixed parameters.
    held_out: (blocks, n) [Nm^2, N^2], sum of the squared torque residual of each block of samples and each joint after
    a fit to all other blocks.
    """

    covariance: torch.Tensor
    held_out: torch.Tensor


def contiguous_blocks(samples: TorqueSamples) -> list[TorqueSamples]:
    """Return the samples in at most ten contiguous blocks, which a jackknife omits one at a time.

    The blocks have at least `MIN_BLOCK` samples, so that the correlation between neighbouring blocks is negligible.
    """
    count = max(1, min(BLOCKS, samples.count // MIN_BLOCK))
    rows = np.array_split(np.arange(samples.count), count)
    return [samples.select(slice(int(block[0]), int(block[-1]) + 1)) for block in rows]


def jackknife(estimate: TorqueEstimate) -> Jackknife:
    """Return covariance and held-out residual of an estimate, whose parameters have been written to the model.

    The posterior covariance assumes that the correlation times are right, and that errors have the same distribution in
    all motions. The jackknife over contiguous blocks of samples does not need these assumptions, but has few blocks. In
    every direction of the parameter space, the result is the larger one of the posterior and the jackknife covariance.
    The covariance is scaled such that 1.96 standard deviations are half the 95 % interval of Student's t with (number
    of blocks - 1) degrees of freedom.

    For 47 arms of `benchmarks/truth.py`, the 95 % intervals contain 97 % of the base parameters and 95 % of g(q). The
    intervals of the posterior covariance contain only 93 % and 89 %.

    The held-out residual of a block is computed without another fit: it is residual - J step, with the Jacobian J of
    the block. The step is the change of the parameters if the block is omitted, by one Newton step.
    """
    problem, x, free = estimate.problem, estimate.state.x, estimate.problem.free
    model, change = problem.jacobian.model, problem.jacobian.theta_jacobian(x)
    # `problem.noise` is the noise of torques at the initial motor gains. The Jacobians below are of torques at the
    # fitted gains, so the noise is converted to the fitted gains.
    noise = problem.noise / problem.jacobian.logged_scale(x)
    blocks = contiguous_blocks(problem.jacobian.samples)
    products = torch.stack([_products(TorqueJacobian(model, block), x) for block in blocks])
    weighted = (products / noise.square()[:, None, None]).sum(dim=1)  # Gram matrices, (blocks, K + 1, K + 1)
    curvature = (change.mT @ weighted[:, :-1, :-1] @ change)[:, free][:, :, free]
    descent, prior = (weighted[:, :-1, -1] @ change)[:, free], problem.prior.precision[free][:, free]
    covariance = torch.linalg.inv(curvature.sum(dim=0) + prior)
    steps, of_blocks = jackknife_covariance(curvature, descent, prior)
    if len(blocks) > 1:
        # In each direction, the larger one of the posterior and the jackknife covariance is used, since each is too
        # small in some directions: few blocks may agree by chance, and the posterior covariance neglects differences
        # between motions.
        covariance = larger_covariance(of_blocks, covariance) * student_scale(len(blocks)) ** 2
    without_block = torch.zeros(len(blocks), len(x)).double().masked_scatter(free, steps) @ change.mT
    # The residual after a step is [J, residual] @ [-step, 1]; its square is computed from the Gram matrices of [J,
    # residual].
    combination = append_target(-without_block, torch.ones(len(blocks)).double())
    held_out = torch.einsum("bk,bjkl,bl->bj", combination, products, combination)
    return Jackknife(problem.of_all_parameters(covariance), held_out)


def _products(jacobian: TorqueJacobian, x: torch.Tensor) -> torch.Tensor:
    """Return the Gram matrix of the columns of [J, residual] for each joint, (n, K + 1, K + 1), at parameters x (K,).

    J (T, K) is the Jacobian of the modelled torque with respect to theta, which is x with inertial parameters in place
    of log-Cholesky parameters (see `TorqueJacobian.joint_rows`). residual: torque residual (T,) of the joint.
    """
    products = torch.zeros(jacobian.model.n, len(x) + 1, len(x) + 1).double()
    for joint, columns, of_joint, residual in concatenate_blocks(jacobian.joint_rows(x), len(products)):
        rows, places = append_target(of_joint, residual), torch.cat([columns, torch.tensor([len(x)])])
        products[joint, places[:, None], places] = rows.mT @ rows
    return products
