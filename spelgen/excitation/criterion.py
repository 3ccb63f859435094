"""Judge how good an excitation trajectory is, with its gradient.

The criterion is the logarithm of the condition number of the base regressor (Swevers et al., IEEE T-RA 13:730, 1997;
columns of length one), with penalties on efforts overrun and on amplitudes given away: columns of length one know no
amplitude, but the noise of a torque sensor does.
"""

from __future__ import annotations

from math import inf, log

import numpy as np

from spelgen.arm.arm import Arm
from spelgen.dynamics.regressor import regressor, urdf_parameters
from spelgen.excitation.trajectory import ExcitationTrajectory, Motion
from spelgen.identification.base_parameters import base_parameters
from spelgen.identification.friction import FrictionModel
from spelgen.settings.tuning.simulation import ExcitationTuning

TUNING = ExcitationTuning()
STEP = 1e-6  # of forward differences [rad, m, per s, per s^2]


class Criterion:
    """Judge motions of an arm: the less, the better."""

    def __init__(self, arm: Arm, trajectory: ExcitationTrajectory) -> None:
        self.arm, self.trajectory = arm, trajectory
        self.friction = FrictionModel()
        self.columns = base_parameters(arm, self.friction).columns
        self.times = np.linspace(
            0.0, trajectory.duration, TUNING.samples_per_harmonic * trajectory.harmonics + 1
        )
        self.inertial = urdf_parameters(arm)
        self.limits = np.full(len(arm.coordinates), np.nan)
        # without inertials the torque is not known, and no limit can be kept
        if all(body.inertia for body in arm.bodies):
            for k, coordinate in enumerate(arm.coordinates):
                self.limits[k] = coordinate.effort or np.nan

    def motion(self, parameters: np.ndarray) -> Motion:
        """Return the motion at the samples that are judged."""
        return self.trajectory.motion(parameters, self.times)

    def condition(self, motion: Motion) -> float:
        """Return the condition number of the base regressor, its columns of length one; infinite where one is zero."""
        columns = self._base(self._rows(motion.q, motion.qd, motion.qdd))
        length = np.linalg.norm(columns, axis=0)
        # a parameter that the motion does not show at all
        if not length.all():
            return inf
        values = np.linalg.svd(columns / length, compute_uv=False)
        return float(values[0] / values[-1]) if values[-1] > 0 else inf

    def efforts(self, motion: Motion) -> np.ndarray:
        """Return torques of the rigid bodies, as part of the limits, (T, n); NaN where these are not known."""
        return np.asarray(regressor(self.arm, motion.q, motion.qd, motion.qdd) @ self.inertial / self.limits)

    def value(self, parameters: np.ndarray) -> float:
        """Return the criterion."""
        motion = self.motion(parameters)
        return log(self.condition(motion)) + self._penalties(parameters, self._overrun(self.efforts(motion)))

    def value_and_gradient(self, parameters: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the criterion and its derivatives by the parameters, where the condition number is finite."""
        motion = self.motion(parameters)
        rows = self._rows(motion.q, motion.qd, motion.qdd)
        efforts = rows[:, :, : len(self.inertial)] @ self.inertial / self.limits
        overrun = self._overrun(efforts)
        logarithm, by_base = _log_condition(self._base(rows))
        by_rows = np.zeros_like(rows)  # (T, n, K)
        by_rows[:, :, self.columns] = by_base.reshape(*rows.shape[:2], -1)
        by_torque = np.nan_to_num(2 * TUNING.penalty * overrun * np.sign(efforts) / self.limits)
        by_rows[:, :, : len(self.inertial)] += by_torque[:, :, None] * self.inertial
        slope = self._by_parameters(parameters, motion, self._by_motion(motion, by_rows))
        slope[:, -1] += parameters.reshape(slope.shape)[:, -1] / 2  # of the amplitudes given away
        return logarithm + self._penalties(parameters, overrun), slope.ravel()

    def _penalties(self, parameters: np.ndarray, overrun: np.ndarray) -> float:
        given_away = -np.log(self.trajectory.amplitude_fractions(parameters)).sum()
        return float(TUNING.penalty * np.square(overrun).sum() + given_away)

    @staticmethod
    def _overrun(efforts: np.ndarray) -> np.ndarray:
        return np.asarray(np.nan_to_num(np.abs(efforts) - TUNING.effort).clip(min=0.0))

    def _rows(self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
        """Return the regressor (T, n, K) of bodies, friction and drives."""
        return np.concatenate([regressor(self.arm, q, qd, qdd), self.friction.columns(qd, qdd)], axis=2)

    def _base(self, rows: np.ndarray) -> np.ndarray:
        return rows[:, :, self.columns].reshape(-1, len(self.columns))

    def _by_motion(self, motion: Motion, weights: np.ndarray) -> np.ndarray:
        """Return derivatives by q, qd and qdd, (3, T, n), of the sum of weights (T, n, K) times the regressor.

        A row depends on its own sample alone: one difference by each of the 3 n numbers gives all samples'.
        """
        states = np.stack([motion.q, motion.qd, motion.qdd])
        value = (self._rows(*states) * weights).sum(axis=(1, 2))
        slope = np.empty_like(states)
        for joint in range(states.shape[2]):
            moved = np.repeat(states[:, None], 3, axis=1)  # of each of the three, one is moved
            moved[range(3), range(3), :, joint] += STEP
            rows = self._rows(*moved.reshape(3, -1, states.shape[2])).reshape(3, *weights.shape)
            slope[:, :, joint] = ((rows * weights).sum(axis=(2, 3)) - value) / STEP
        return slope

    def _by_parameters(self, parameters: np.ndarray, motion: Motion, slope: np.ndarray) -> np.ndarray:
        """Turn derivatives by the motion (3, T, n) into those by the parameters, (n, parameters of a joint).

        A joint's motion depends on its own parameters alone: all joints are moved at once.
        """
        states = np.stack([motion.q, motion.qd, motion.qdd])
        by_joint = parameters.reshape(states.shape[2], -1)
        by_parameters = np.empty_like(by_joint)
        for k in range(by_joint.shape[1]):
            moved = by_joint.copy()
            moved[:, k] += STEP
            neighbour = self.motion(moved.ravel())
            change = np.stack([neighbour.q, neighbour.qd, neighbour.qdd]) - states
            by_parameters[:, k] = (change * slope).sum(axis=(0, 1)) / STEP
        return by_parameters


def _log_condition(columns: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the logarithm of the condition number of columns (R, r) scaled to length one, and its gradient."""
    length = np.linalg.norm(columns, axis=0)
    unit = columns / length
    u, values, vt = np.linalg.svd(unit, full_matrices=False)
    by_unit = np.outer(u[:, 0], vt[0]) / values[0] - np.outer(u[:, -1], vt[-1]) / values[-1]
    return log(values[0] / values[-1]), (by_unit - unit * (by_unit * unit).sum(axis=0)) / length
