"""Identification of base parameters, friction and rotor inertias of an arm from logs, by linear least squares."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from spelgen.arm.actuation import Drives
from spelgen.arm.arm import Chain
from spelgen.arm.configured_arm import Arm, load_arm
from spelgen.dynamics.bristles import reach_of
from spelgen.dynamics.friction import FrictionModel
from spelgen.dynamics.regressor_dynamics import body_chain, regressor
from spelgen.errors import Diagnostic, LogError
from spelgen.identification.base_parameters import base_parameters
from spelgen.identification.drive_hints import friction_compensated
from spelgen.identification.identification import Identification, LeastSquares
from spelgen.identification.intervals import BLOCKS, jackknife_covariance, student_scale
from spelgen.identification.least_squares import Solution, deviations, solve
from spelgen.identification.torque_delay import TorqueDelay, find_torque_delay
from spelgen.identification.tuning import TUNING
from spelgen.logs.checks import check, joint_kinds
from spelgen.logs.dynamics_samples import NEEDED, DynamicsSamples, dynamics_samples
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.trajectory import Trajectory, recordings, require_torques
from spelgen.logs.tuning import SAMPLES


def identify(
    arm: Arm | Path | str,
    logs: Trajectory | Sequence[Trajectory],
    method: LeastSquares | None = None,
    *,
    preprocessing: Preprocessing | None = None,
) -> Identification:
    """Fit the base parameters, friction and rotor inertias (armatures) of an arm to the torques of logs.

    Args:
        arm: result of `load_arm`, or the path of a URDF. The arm's input matrix maps motor torques to joint torques.
        logs: one or several trajectories with torques.
        method: friction model and weights of the joints; None: the defaults.
        preprocessing: filter, gap and torque delay of the logs; None: the defaults.

    Raises:
        LogError: for logs without torques or without motion.
    """
    if not isinstance(arm, Arm):
        arm = load_arm(arm)
    logs = recordings(logs, arm.chain.joint_names)
    return identify_by(arm, logs, [method or LeastSquares()], preprocessing or Preprocessing())[0]


def identify_by(
    arm: Arm,
    logs: Sequence[Trajectory],
    methods: Sequence[LeastSquares],
    preprocessing: Preprocessing,
) -> list[Identification]:
    """Return one identification for each of `methods` (weights and friction model); see `identify`.

    All identifications use the same logs, which are filtered only once.
    """
    joints, joint_types = arm.chain.joint_names, arm.chain.joint_types
    require_torques(logs)
    notes = check(logs, joints, joint_kinds(arm.chain.coordinates))
    drives = arm.actuation.drives()
    delay = TorqueDelay(preprocessing.torque_delay or 0.0)
    if preprocessing.torque_delay is None:
        delay = find_torque_delay(logs, joint_types, drives, body_chain(arm.chain), preprocessing)
        preprocessing = replace(preprocessing, torque_delay=delay.delay)
        notes += delay.notes
    reach = None
    if any(method.friction.memory for method in methods):
        reach = reach_of(joint_types, drives.speeds)
    samples = dynamics_samples(logs, preprocessing=preprocessing, reach=reach)
    unused = sorted({x.name for x in logs} - {x.name for x in samples})
    if unused:
        message = f"sampled too slowly or too short for accelerations: {', '.join(unused)}"
        notes.append(Diagnostic("warning", "no-accelerations", "logs", None, message))
    # logged motor torques are converted to joint torques, which the regressor describes
    equations = _Equations(arm.chain, [replace(x, tau=x.tau @ drives.inputs.T) for x in samples], drives)
    solved = map(equations.solved, methods)
    return [replace(x, diagnostics=(*notes, *_negative_friction(x)), torque_delay=delay) for x in solved]


def _negative_friction(result: Identification) -> Iterator[Diagnostic]:
    """Yield a warning if viscous friction is negative, also at the upper bound of its 95 % interval.

    Negative friction indicates that friction decreases with speed, or that the drives compensate friction.
    """
    names = {f"viscous{k}": name for k, name in enumerate(result.arm.joint_names, start=1)}
    negative = [f"{names[x.name]} {x.text}" for x in result.intervals if x.name in names and x.high < 0]
    if negative:
        yield friction_compensated(f"viscous friction {', '.join(negative)} Nm s/rad (N s/m)")


def least_squares(
    arm: Chain,
    samples: Sequence[DynamicsSamples],
    method: LeastSquares | None = None,
    drives: Drives | None = None,
) -> Identification:
    """Fit base parameters, friction and rotor inertias of an arm to samples of joint torques.

    Args:
        arm: arm with n joints.
        samples: motion and joint torques (T, n) of each trajectory.
        method: friction model and weights of the joints; None: the defaults.
        drives: drives, in which friction and rotor inertias act; None: one drive per joint.

    Raises:
        LogError: if there are no samples.
    """
    identity = np.eye(len(arm.coordinates))
    return _Equations(arm, samples, drives or Drives(identity, identity)).solved(method or LeastSquares())


# [1] Smallest number of samples of a jackknife block, 2 s at 100 Hz. Without a prior, the fit to all other blocks fails
# if some parameter is excited only in the omitted block, which is likely for short blocks.
MIN_BLOCK = 200


class _Equations:
    """Linear equations of the joint torques: torque = regressor @ parameters at all samples.

    The regressor is computed for one block of samples at a time. Its columns for rigid bodies are common to all
    friction models, and are kept if they fit into memory.
    """

    def __init__(self, arm: Chain, samples: Sequence[DynamicsSamples], drives: Drives) -> None:
        self.arm, self.samples, self.drives = arm, samples, drives
        self._blocks: list[DynamicsSamples] = []
        for x in samples:
            self._blocks += [x[start : start + TUNING.block] for start in range(0, len(x.q), TUNING.block)]
        speeds = (
            np.concatenate([x.qd for x in samples] or [np.zeros((0, len(drives.speeds)))]) @ drives.speeds.T
        )
        self._is_moving = np.abs(speeds).max(axis=0, initial=0.0) > SAMPLES.moving
        self._regressors: list[np.ndarray] = []
        # regressors are kept if they are small enough, otherwise they are recomputed for each pass over the samples
        size = 8 * sum(x.q.size for x in samples) * 10 * len(arm.bodies)
        if size <= TUNING.regressor_bytes:
            self._regressors = list(map(self._regressor, self._blocks))

    def _regressor(self, block: DynamicsSamples) -> np.ndarray:
        """Return the regressor (T, n, 10 B) of the inertial parameters of B bodies, for a block of T samples."""
        return regressor(self.arm, block.q, block.qd, block.qdd)

    def _rows(self, friction: FrictionModel) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yield the regressor (T, n, K) of K parameters and the torques (T, n) [Nm, N] of each block of T samples."""
        reach = reach_of(self.arm.joint_types).values
        # Friction and rotor inertia of a drive at rest are omitted: noise of its velocity would determine them.
        is_seen = np.array([self._is_moving | (effect == "offset") for effect in friction.effects]).ravel()
        regressors = self._regressors or map(self._regressor, self._blocks)
        for block, bodies in zip(self._blocks, regressors, strict=True):
            deflection = None if block.z is None else block.z / reach
            columns = friction.columns(block.qd, block.qdd, deflection, self.drives.speeds)
            yield np.concatenate([bodies, columns * is_seen], axis=2), block.tau

    def _products(self, friction: FrictionModel, parameters: int) -> np.ndarray:
        """Return the Gram matrices (n, BLOCKS, K + 1, K + 1) of regressor and torque per joint and block of samples.

        parameters: number K of parameters.
        """
        count, first = sum(len(block.q) for block in self._blocks), 0
        # group: number of the contiguous block to which each sample belongs, (count,)
        group = np.arange(count) * BLOCKS // count
        products = np.zeros((len(self.drives.speeds), BLOCKS, parameters + 1, parameters + 1))
        for columns, tau in self._rows(friction):
            rows = np.concatenate([columns, tau[..., None]], axis=2).swapaxes(0, 1)
            numbers = group[first : first + len(tau)]
            for number in np.unique(numbers).tolist():
                block = rows[:, numbers == number]
                products[:, number] += block.swapaxes(1, 2) @ block
            first += len(tau)
        return products

    def solved(self, method: LeastSquares) -> Identification:
        """Return base parameters of bodies, friction and drives, fitted to the torques by weighted least squares.

        method: friction model, and the weights of the joints' torque residuals: equal, or 1 / range or 1 / noise of the
        torque. Raises LogError if there are no samples.
        """
        if not self._blocks:
            raise LogError("no samples to identify from", expected=NEEDED)
        base = base_parameters(self.arm, method.friction, self.drives.speeds)
        products = self._products(method.friction, len(base.parameters))
        torques = np.concatenate([block.tau for block in self._blocks])
        deviation = torques.std(axis=0)
        # The standard deviation of a torque, by which it is weighted, has a lower bound: a joint with a constant torque
        # would have an infinite weight otherwise.
        torque_range = np.maximum(deviation, 1e-3 * deviation.max())
        weights = np.ones_like(torque_range) if method.weights == "equal" else 1.0 / torque_range
        # with the weights "noise", each iteration weights the joints by their residuals in the previous fit
        for _ in range(1 + TUNING.rounds * (method.weights == "noise")):
            weighted = np.tensordot(np.square(weights), products, 1)
            # only the base columns are fitted; the other parameters remain zero
            solution = solve(weighted.sum(axis=0), base.columns)
            residuals = [rows @ solution.parameters - tau for rows, tau in self._rows(method.friction)]
            noise = np.maximum(deviations(residuals, solution.rank), TUNING.least_noise * torque_range)
            used, weights = weights, 1.0 / noise
        squares = np.square(np.concatenate(residuals)).mean(axis=0)
        combination = base.combination[:, base.columns]
        std = solution.deviations(products.sum(axis=1), used**2 * noise, combination)
        # the jackknife is omitted if some parameters are undetermined: fits without a block would be singular
        if solution.rank == len(base) and len(torques) >= BLOCKS * MIN_BLOCK:
            std = np.maximum(std, student_scale(BLOCKS) * _jackknife(weighted, solution, combination))
        return Identification(
            arm=self.arm,
            method=method,
            base=base,
            parameters=solution.parameters,
            values=base.combination @ solution.parameters,
            deviations=std,
            condition=solution.condition,
            unseen=len(base) - solution.rank,
            residual=np.sqrt(squares),
            nmse=squares / np.where(deviation > 0, deviation, np.nan) ** 2,
            trajectories=tuple(x.name for x in self.samples),
            samples=len(torques),
            drives=self.drives,
        )


def _jackknife(products: np.ndarray, solution: Solution, combination: np.ndarray) -> np.ndarray:
    """Return the standard deviations (r,) of base parameters from a jackknife over blocks of samples.

    See `jackknife_covariance`. solution: least-squares fit to all blocks. products: (B, K + 1, K + 1) weighted Gram
    matrices of regressor and torque per block of samples. combination: (r, k) coefficients of the k fitted parameters
    in each of the r base parameters.
    """
    columns = solution.columns
    curvature, target = products[:, columns[:, None], columns], products[:, columns, -1]
    descent = target - curvature @ solution.parameters[columns]
    # `length`: norms of the regressor's columns, by which they are divided, since they have different units
    length = np.sqrt(curvature.sum(axis=0).diagonal())
    curvature = curvature / np.outer(length, length)
    ridge = TUNING.negligible * np.eye(len(columns))
    _, covariance = jackknife_covariance(*map(torch.from_numpy, (curvature, descent / length, ridge)))
    root = combination / length
    return np.asarray(np.sqrt(np.einsum("rk,kl,rl->r", root, covariance.numpy(), root)))
