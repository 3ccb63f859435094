"""Ridge regression of the torque on the regressors of bodies and friction, a simple method compared with the fit."""

from collections.abc import Callable, Sequence
from dataclasses import replace
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

# [1] Penalties for columns scaled to unit length. With the smallest penalty, ridge regression is least squares.
PENALTIES = np.logspace(-10, 2, 13)
# Inertial parameters (see `pseudo_inertia`) of a sphere of 1 kg with a radius of gyration of 0.1 m. Its centre is at
# (0.1, 0, 0.1) m in the body frame; the inertia is about the origin of this frame.
DEFAULT_BODY = (1.0, 0.1, 0.0, 0.1, 0.02, 0.0, -0.01, 0.03, 0.0, 0.02)


class Regression(NamedTuple):
    """Result of ridge regression with the penalty that has the smallest held-out error.

    held_out: (blocks, n) [1], sum over samples of the squared torque residual of each block after a fit to all other
    blocks, divided by the variance of the joint's torque. torque: function that predicts the joint torques (T, n)
    [Nm, N] of samples.
    """

    held_out: np.ndarray
    torque: Callable[[SampleBlock], np.ndarray]


def best_regression(model: ArmModel, blocks: Sequence[TorqueSamples], torque_std: np.ndarray) -> Regression:
    """Return the ridge regression with the smaller held-out error of two.

    In one regression, Coulomb friction depends on the velocity; in the other, on the friction state z.

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
    """Return the ridge regression of the joint torques on inertial parameters, armatures, friction and offsets.

    friction: friction model, with or without a friction state. model, blocks, torque_std: see `best_regression`.
    """
    motors, reach = motors_of(model).numpy(), bristle_reach(model).values

    def columns(x: SampleBlock) -> np.ndarray:
        """Return the regressor of K inertial parameters, armatures, friction coefficients and offsets, (T, n, K)."""
        bent = x.z.numpy() / reach if friction.memory and x.z is not None else None
        drives = friction.columns(x.qd.numpy(), x.qdd.numpy(), bent, motors)
        return np.concatenate([regressor_of(model.chain, x.q, x.qd, x.qdd).numpy(), drives], axis=2)

    def products(x: SampleBlock) -> np.ndarray:
        """Return the Gram matrix of the K columns of the regressor and the torque per joint, (n, K + 1, K + 1).

        Columns and torque are first divided by `torque_std` per joint.
        """
        rows = np.concatenate([columns(x), joint_torque(model, x).numpy()[..., None]], axis=2)
        rows = (rows / torque_std[:, None]).swapaxes(0, 1)
        return np.asarray(rows.swapaxes(1, 2) @ rows)

    grams = np.stack([products(block.columns) for block in blocks])
    total = grams.sum(axis=(0, 1))
    length = np.sqrt(np.diagonal(total)[:-1])
    scale = np.append(np.where(length > 0, length, 1.0), 1.0)
    grams, total = (gram / np.outer(scale, scale) for gram in (grams, total))

    def solution(gram: np.ndarray, penalty: float) -> np.ndarray:
        """Return the vector (w, -1), (..., K + 1), with the ridge solution w of the K scaled columns of the regressor.

        gram: (..., K + 1, K + 1), G = A^T A of A = [scaled columns, torque]. A (w, -1) is the residual, so the squared
        residual is (w, -1)^T G (w, -1). penalty: factor of |w|^2 in the cost.
        """
        normal = gram[..., :-1, :-1] + penalty * np.eye(len(length))
        weights = np.linalg.solve(normal, gram[..., :-1, -1:])[..., 0]
        return np.concatenate([weights, np.full((*weights.shape[:-1], 1), -1.0)], axis=-1)

    def held_out(penalty: float) -> np.ndarray:
        """Return the sums of (residual / `torque_std`)^2 over each block, (blocks, n), after a ridge fit to the others.

        penalty: factor of |w|^2 in the cost, with the weights w of columns of unit length.
        """
        weights = solution(total - grams.sum(axis=1), penalty)[:, None, :, None]
        return np.asarray((weights * (grams @ weights)).sum(axis=(2, 3)))

    penalty = min(PENALTIES, key=lambda penalty: float(held_out(penalty).sum()))
    parameters = (solution(total, penalty) / scale)[:-1]  # weights of unscaled columns, without the last -1
    return Regression(held_out(penalty), lambda x: columns(x) @ parameters)


def start_at(model: ArmModel, samples: TorqueSamples, regression: Regression) -> None:
    """Set the bodies of a model to physically consistent bodies that approximate a regression.

    The bodies are a fit to the torques that the regression predicts, with a wide prior about bodies of 1 kg. The
    inertias of the URDF are not used as the prior mean: this function is called if a fit with this prior mean has a
    larger held-out error than the regression, and the probable reason is a wrong URDF, for example with centres of mass
    in mm. The friction and the drives of this fit are discarded: friction coefficients of a regression may be negative,
    which the fit would explain by drives that compensate friction.
    """
    with torch.no_grad():
        body = pseudo_inertia(torch.tensor([DEFAULT_BODY]).double())
        # The pseudo-inertia of a body is C S C^T with the constant factor C, and its log-Cholesky parameters are the
        # Cholesky factor of S. `body` is the pseudo-inertia P of `DEFAULT_BODY`. The first line computes C^-1 P, the
        # second line S = C^-1 P C^-T.
        relative = torch.linalg.solve(model.bodies.factors, body)
        relative = torch.linalg.solve(model.bodies.factors, relative.mT)
        model.bodies.raw.copy_(log_cholesky_parameters(upper_cholesky((relative + relative.mT) / 2)))
        inputs = torch.linalg.pinv(model.input_matrix(samples.columns.q[:1])[0])
    torque = torch.from_numpy(regression.torque(samples.columns)) @ inputs.mT
    predicted = replace(samples, columns=samples.columns._replace(tau=torque))
    prior = GaussianPrior(bodies=TUNING.max_width)
    estimate = initial_fit(TorqueProblem.of(TorqueJacobian(model, predicted), prior))
    rigid = estimate.problem.jacobian.rigid
    with torch.no_grad():
        model.bodies.raw.copy_(rigid.unflatten(estimate.state.x)[rigid.bodies])
