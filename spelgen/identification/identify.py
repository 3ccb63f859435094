"""Identify an arm from logs: base parameters, friction and drives by least squares, and how sure they are."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from spelgen.arm.actuation import Drives
from spelgen.arm.arm import Arm
from spelgen.arm.configured_arm import ConfiguredArm, load_arm
from spelgen.dynamics.bristles import reach_of
from spelgen.dynamics.linear_friction import FrictionModel
from spelgen.dynamics.regressor import body_chain, regressor
from spelgen.errors import Diagnostic, LogError
from spelgen.identification.base_parameters import base_parameters
from spelgen.identification.identification import Identification, LeastSquares
from spelgen.identification.least_squares import Columns, Solution, deviations, reduce, solve
from spelgen.identification.torque_delay import TorqueDelay, find_torque_delay
from spelgen.identification.tuning import TUNING
from spelgen.logs.checks import check
from spelgen.logs.dynamics_samples import SHORTEST, DynamicsSamples, dynamics_samples
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.rates import SLOWEST
from spelgen.logs.trajectory import Trajectory, require_joints, require_torques


def identify(
    arm: ConfiguredArm | Path | str,
    logs: Trajectory | Sequence[Trajectory],
    method: LeastSquares | None = None,
    *,
    preprocessing: Preprocessing | None = None,
) -> Identification:
    """Fit base parameters, friction and armature of ``arm`` to the torques in ``logs``.

    arm: of ``load_arm``, or the path of a URDF. Torques of motors are taken to the joints' by its input matrix.
    preprocessing: its filter and gap. Raises LogError for logs that cannot be used.
    """
    if not isinstance(arm, ConfiguredArm):
        arm = load_arm(arm)
    logs = [logs] if isinstance(logs, Trajectory) else logs
    return identify_by(arm, logs, [method or LeastSquares()], preprocessing or Preprocessing())[0]


def identify_by(
    arm: ConfiguredArm,
    logs: Sequence[Trajectory],
    methods: Sequence[LeastSquares],
    preprocessing: Preprocessing,
) -> list[Identification]:
    """Return what each method makes of the same logs, which are filtered once; see `identify`."""
    joints, kinds = arm.arm.joint_names, arm.arm.joint_types
    for trajectory in logs:
        require_joints(trajectory, joints)
    require_torques(logs)
    notes = check(logs, joints, kinds)
    drives = arm.actuation.drives()
    late = TorqueDelay(preprocessing.torque_delay or 0.0)
    if preprocessing.torque_delay is None:
        late = find_torque_delay(logs, kinds, drives, body_chain(arm.arm), preprocessing)
        preprocessing = replace(preprocessing, torque_delay=late.delay)
        notes += late.notes
    reach = None
    if any(method.friction.memory for method in methods):
        reach = reach_of(kinds, drives.speeds)
    samples = dynamics_samples(logs, preprocessing=preprocessing, reach=reach)
    unused = sorted({x.name for x in logs} - {x.name for x in samples})
    if unused:
        message = f"sampled too slowly or too short for accelerations: {', '.join(unused)}"
        notes.append(Diagnostic("warning", "no-accelerations", "logs", None, message))
    # samples of motors' torques: the regressor's rows are joints'
    equations = _Equations(arm.arm, [replace(x, tau=x.tau @ drives.inputs.T) for x in samples], drives)
    return [replace(equations.solved(x), diagnostics=tuple(notes), torque_delay=late) for x in methods]


def least_squares(
    arm: Arm,
    samples: Sequence[DynamicsSamples],
    method: LeastSquares | None = None,
    drives: Drives | None = None,
) -> Identification:
    """Fit ``arm`` to samples of joint torques; errors as for ``identify``.

    drives: those whose friction and armature are fitted; None: each moves its own joint alone.
    """
    alone = np.eye(len(arm.coordinates))
    return _Equations(arm, samples, drives or Drives(alone, alone)).solved(method or LeastSquares())


class _Equations:
    """Give the equations of samples, a block at a time: the bodies' part is the same whatever the friction."""

    def __init__(self, arm: Arm, samples: Sequence[DynamicsSamples], drives: Drives) -> None:
        self.arm, self.samples, self.drives = arm, samples, drives
        self._blocks: list[DynamicsSamples] = []
        for x in samples:
            self._blocks += [x[start : start + TUNING.block] for start in range(0, len(x.q), TUNING.block)]
        self._regressors: list[np.ndarray] = []
        # kept from pass to pass where memory allows
        size = 8 * sum(x.q.size for x in samples) * 10 * len(arm.bodies)
        if size <= TUNING.regressor_bytes:
            self._regressors = list(map(self._regressor, self._blocks))

    def _regressor(self, block: DynamicsSamples) -> np.ndarray:
        return regressor(self.arm, block.q, block.qd, block.qdd)

    def _rows(self, friction: FrictionModel) -> Iterator[Columns]:
        reach = reach_of(self.arm.joint_types).values
        regressors = self._regressors or map(self._regressor, self._blocks)
        for block, bodies in zip(self._blocks, regressors, strict=True):
            bent = None if block.z is None else block.z / reach
            columns = friction.columns(block.qd, block.qdd, bent, self.drives.speeds)
            yield np.concatenate([bodies, columns], axis=2), block.tau

    def _noise(self, friction: FrictionModel, solution: Solution) -> np.ndarray:
        """Return the standard deviations (n,), as if independent, of the errors that a solution leaves."""
        residuals = [rows @ solution.parameters - tau for rows, tau in self._rows(friction)]
        return deviations(residuals, solution.rank)

    def solved(self, method: LeastSquares) -> Identification:
        """Return the least squares of a method. Raises LogError without any samples."""
        if not self._blocks:
            raise LogError(
                "no samples to identify from",
                expected=f"motion sampled at {SLOWEST:g} Hz or faster, {SHORTEST:g} s without a gap at least",
            )
        base = base_parameters(self.arm, method.friction, self.drives.speeds)
        triangles = reduce(self._rows(method.friction))
        # a joint whose torque never changes must not weigh everything
        torque_range = np.maximum(triangles.deviation, 1e-3 * triangles.deviation.max())
        weights = np.ones_like(torque_range) if method.weights == "equal" else 1.0 / torque_range
        # with the weights "noise" again, by what was left of each joint's torque
        for _ in range(1 + TUNING.rounds * (method.weights == "noise")):
            # each base parameter stands for the parameter that it is named after
            solution = solve(triangles, weights, base.columns)
            noise = np.maximum(self._noise(method.friction, solution), TUNING.least_noise * torque_range)
            used, weights = weights, (1.0 / noise)
        squares = triangles.squares(solution.parameters) / triangles.count
        return Identification(
            arm=self.arm,
            method=method,
            base=base,
            parameters=solution.parameters,
            values=base.combination @ solution.parameters,
            deviations=solution.deviations(triangles, used**2 * noise, base.combination[:, base.columns]),
            condition=solution.condition,
            unseen=len(base) - solution.rank,
            residual=np.sqrt(squares),
            nmse=squares / np.where(triangles.deviation > 0, triangles.deviation, np.nan) ** 2,
            trajectories=tuple(x.name for x in self.samples),
            samples=triangles.count,
            drives=self.drives,
        )
