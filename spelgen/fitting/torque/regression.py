"""Ridge regression of the torque on the samples of a fit: the simple method that a fit may not be worse than."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch

from spelgen.dynamics.body_regressor import pseudo_inertia, regressor_of
from spelgen.dynamics.bristles import bristle_reach
from spelgen.dynamics.friction import FrictionModel
from spelgen.dynamics.protocol import motors_of
from spelgen.emission.assemble import ArmModel
from spelgen.fitting.torque.jacobian import TorqueJacobian
from spelgen.fitting.torque.parameters import joint_torque, log_cholesky_parameters, upper_cholesky
from spelgen.fitting.torque.problem import TorqueProblem
from spelgen.fitting.torque.samples import SampleBlock, TorqueSamples
from spelgen.fitting.torque.stages import initial_fit
from spelgen.fitting.torque.tuning import TUNING
from spelgen.settings.fits import GaussianPrior

# Penalties on columns of length one; the smallest one is least squares.
PENALTIES = np.logspace(-10, 2, 13)
# m, h, I of a sphere of 1 kg with a radius of gyration of 0.1 m, whose centre is 0.1 m from the joint's axis.
DEFAULT_BODY = (1.0, 0.1, 0.0, 0.1, 0.02, 0.0, -0.01, 0.03, 0.0, 0.02)


class Regression(NamedTuple):
    """Ridge regression with the penalty of the smallest held-out error.

    held_out: sum over joints of the squared torque residual of each block by the fit to all other blocks, divided by
    the variances of the torques, (blocks,). torque: function that returns the joint torques (T, n) [Nm, N] of samples.
    """

    held_out: np.ndarray
    torque: Callable[[SampleBlock], np.ndarray]


def best_regression(model: ArmModel, blocks: Sequence[TorqueSamples], torque_std: np.ndarray) -> Regression:
    """Return the better one of two ridge regressions, with Coulomb friction from the velocity or the friction state.

    Args:
        model: model whose arm, drives and gains are used.
        blocks: contiguous blocks of samples, held out one at a time to choose the penalty.
        torque_std: (n,) standard deviation of the joint torques [Nm, N].
    """
    states = [False, True] if model.elements and blocks[0].columns.z is not None else [False]
    regressions = [_regression(model, blocks, torque_std, FrictionModel(memory=state)) for state in states]
    return min(regressions, key=lambda regression: float(regression.held_out.sum()))


def _regression(
    model: ArmModel, blocks: Sequence[TorqueSamples], torque_std: np.ndarray, friction: FrictionModel
) -> Regression:
    """Return the regression with the columns of `identify`; other arguments: see `best_regression`."""
    motors, reach = motors_of(model).numpy(), bristle_reach(model).values

    def columns(x: SampleBlock) -> np.ndarray:
        """Return the columns of bodies, armature, friction and offset, (T, n, K)."""
        bent = x.z.numpy() / reach if friction.memory and x.z is not None else None
        drives = friction.columns(x.qd.numpy(), x.qdd.numpy(), bent, motors)
        return np.concatenate([regressor_of(model.chain, x.q, x.qd, x.qdd).numpy(), drives], axis=2)

    def products(x: SampleBlock) -> np.ndarray:
        """Return the Gram matrix (K + 1, K + 1) of columns and torque, each joint divided by `torque_std`."""
        rows = np.concatenate([columns(x), joint_torque(model, x).numpy()[..., None]], axis=2)
        rows = (rows / torque_std[:, None]).reshape(-1, rows.shape[2])
        return np.asarray(rows.T @ rows)

    grams = np.stack([products(block.columns) for block in blocks])
    total = grams.sum(axis=0)
    length = np.sqrt(np.diagonal(total)[:-1])
    scale = np.append(np.where(length > 0, length, 1.0), 1.0)
    grams, total = (gram / np.outer(scale, scale) for gram in (grams, total))

    def solution(gram: np.ndarray, penalty: float) -> np.ndarray:
        """Return the weights (..., K + 1) of scaled columns, and -1 for the torque."""
        normal = gram[..., :-1, :-1] + penalty * np.eye(len(length))
        weights = np.linalg.solve(normal, gram[..., :-1, -1:])[..., 0]
        return np.concatenate([weights, np.full((*weights.shape[:-1], 1), -1.0)], axis=-1)

    def held_out(penalty: float) -> np.ndarray:
        """Return the sum of the squared residual of each block by the solution for all others, (blocks,)."""
        weights = solution(total - grams, penalty)
        return np.asarray(np.einsum("bk,bkl,bl->b", weights, grams, weights))

    penalty = min(PENALTIES, key=lambda penalty: float(held_out(penalty).sum()))
    parameters = (solution(total, penalty) / scale)[:-1]  # of columns in their units
    return Regression(held_out(penalty), lambda x: columns(x) @ parameters)


def start_at(model: ArmModel, samples: TorqueSamples, regression: Regression) -> None:
    """Set the bodies of a model to the physically consistent projection of a regression.

    The projection is a fit to the torques of the regression, with a wide prior about bodies of 1 kg: the prior at the
    URDF is the reason why a fit is worse than a regression, for example if its centres of mass are in mm. Friction and
    drives of the projection are discarded: a regression may have negative friction, which the projection would explain
    by drives that compensate friction.
    """
    with torch.no_grad():
        body = pseudo_inertia(torch.tensor([DEFAULT_BODY]).double())
        relative = torch.linalg.solve(model.bodies.factors, body)  # C^-1 J
        relative = torch.linalg.solve(model.bodies.factors, relative.mT)  # C^-1 J C^-T
        model.bodies.raw.copy_(log_cholesky_parameters(upper_cholesky((relative + relative.mT) / 2)))
        inputs = torch.linalg.pinv(model.input_matrix(samples.columns.q[:1])[0])
    torque = torch.from_numpy(regression.torque(samples.columns)) @ inputs.mT
    predicted = TorqueSamples(
        samples.columns._replace(tau=torque), samples.original_count, samples.interval, samples.recordings
    )
    prior = GaussianPrior(bodies=TUNING.max_width)
    estimate = initial_fit(TorqueProblem.of(TorqueJacobian(model, predicted), prior))
    rigid = estimate.problem.jacobian.rigid
    with torch.no_grad():
        model.bodies.raw.copy_(rigid.unflatten(estimate.state.x)[rigid.bodies])
