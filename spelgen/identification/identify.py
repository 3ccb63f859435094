"""Identify an arm from logs: base parameters, friction and drives by least squares, and how sure they are."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from spelgen.arm.actuation import Drives
from spelgen.arm.arm import Arm
from spelgen.dynamics.bristles import reach_of
from spelgen.dynamics.regressor import regressor
from spelgen.dynamics.rigid_bodies import body_chain
from spelgen.errors import Diagnostic, LogError
from spelgen.identification.base_parameters import base_parameters
from spelgen.identification.friction import FrictionModel
from spelgen.identification.identification import Identification
from spelgen.identification.least_squares import Columns, Solution, deviations, reduce, solve
from spelgen.identification.method import LeastSquares
from spelgen.identification.torque_delay import TorqueDelay, find_torque_delay
from spelgen.loaded_arm import LoadedArm, load_arm
from spelgen.logs.checks import check
from spelgen.logs.dynamics_samples import SHORTEST, DynamicsSamples, dynamics_samples
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.rates import SLOWEST
from spelgen.logs.trajectory import Trajectory, require_joints, require_torques
from spelgen.settings.tuning.identification import IdentificationTuning

TUNING = IdentificationTuning()


def identify(
    arm: LoadedArm | Path | str,
    logs: Trajectory | Sequence[Trajectory],
    method: LeastSquares | None = None,
    *,
    preprocessing: Preprocessing | None = None,
) -> Identification:
    """Fit base parameters, friction and armature of ``arm`` to the torques in ``logs``.

    arm: of ``load_arm``, or the path of a URDF. Torques of motors are taken to the joints' by its input matrix.
    preprocessing: its filter and gap. Raises LogError for logs that cannot be used.
    """
    arm = arm if isinstance(arm, LoadedArm) else load_arm(arm)
    logs = [logs] if isinstance(logs, Trajectory) else logs
    return identify_by(arm, logs, [method or LeastSquares()], preprocessing or Preprocessing())[0]


def identify_by(
    arm: LoadedArm, logs: Sequence[Trajectory], methods: Sequence[LeastSquares], preprocessing: Preprocessing
) -> list[Identification]:
    """Return what each method makes of the same logs, which are filtered once; see `identify`."""
    joints = arm.arm.joint_names
    kinds = arm.arm.joint_types
    for trajectory in logs:
        require_joints(trajectory, joints)
    require_torques(logs)
    notes = check(logs, joints, kinds)
    drives = arm.actuation.drives()
    reach = None
    if any(method.friction.memory for method in methods):
        reach = reach_of(kinds, drives.speeds)
    late = TorqueDelay(preprocessing.torque_delay or 0.0)
    if preprocessing.torque_delay is None:
        late = find_torque_delay(logs, kinds, drives, body_chain(arm.arm), preprocessing)
        preprocessing = replace(preprocessing, torque_delay=late.delay)
        notes += late.notes
    samples = dynamics_samples(logs, preprocessing=preprocessing, reach=reach)
    unused = sorted({x.name for x in logs} - {x.name for x in samples})
    if unused:
        message = f"sampled too slowly or too short for accelerations: {', '.join(unused)}"
        notes.append(Diagnostic("warning", "no-accelerations", "logs", None, message))
    # samples of motors' torques: the regressor's rows are joints'
    at_joints = [replace(x, tau=x.tau @ drives.inputs.T) for x in samples]
    bodies = _BodyRows(arm.arm, at_joints)
    results = []
    for method in methods:
        found = _least_squares(bodies, method, drives)
        results.append(replace(found, diagnostics=tuple(notes), torque_delay=late))
    return results


def least_squares(
    arm: Arm,
    samples: Sequence[DynamicsSamples],
    method: LeastSquares | None = None,
    drives: Drives | None = None,
) -> Identification:
    """Fit ``arm`` to samples of joint torques; errors as for ``identify``.

    drives: those whose friction and armature are fitted; None: each moves its own joint alone.
    """
    return _least_squares(_BodyRows(arm, samples), method or LeastSquares(), drives)


def _least_squares(bodies: _BodyRows, method: LeastSquares, drives: Drives | None) -> Identification:
    if not any(len(x.q) for x in bodies.samples):
        raise LogError(
            "no samples to identify from",
            expected=f"motion sampled at {SLOWEST:g} Hz or faster, {SHORTEST:g} s without a gap at least",
        )
    rows = _Rows(bodies, method.friction, None if drives is None else drives.speeds)
    base = base_parameters(bodies.arm, method.friction, rows.motors)
    triangles = reduce(rows.blocks())
    # a joint whose torque never changes must not weigh everything
    torque_range = np.maximum(triangles.deviation, 1e-3 * triangles.deviation.max())
    weights = np.ones_like(torque_range) if method.weights == "equal" else 1.0 / torque_range
    # each base parameter stands for the parameter that it is named after
    solution = solve(triangles, weights, base.columns)
    noise = rows.noise(solution, torque_range)
    # with the weights "noise" again, by what was left of each joint's torque
    for _ in range(TUNING.rounds if method.weights == "noise" else 0):
        weights = 1.0 / noise
        solution = solve(triangles, weights, base.columns)
        noise = rows.noise(solution, torque_range)
    squares = triangles.squares(solution.parameters) / triangles.count
    return Identification(
        arm=bodies.arm,
        method=method,
        base=base,
        parameters=solution.parameters,
        values=base.combination @ solution.parameters,
        deviations=solution.deviations(triangles, weights**2 * noise, base.combination[:, base.columns]),
        condition=solution.condition,
        unseen=len(base) - solution.rank,
        residual=np.sqrt(squares),
        nmse=squares / np.where(triangles.deviation > 0, triangles.deviation, np.nan) ** 2,
        trajectories=tuple(x.name for x in bodies.samples),
        samples=triangles.count,
        drives=drives,
    )


@dataclass(frozen=True, eq=False)
class _BodyRows:
    """Give the bodies' regressor of samples, block by block: the same whatever the friction."""

    arm: Arm
    samples: Sequence[DynamicsSamples]

    def blocks(self) -> Iterator[tuple[DynamicsSamples, np.ndarray]]:
        """Yield blocks of samples with their regressor (T, n, 10 B), kept from pass to pass where memory allows."""
        return iter(self._few) if self._few is not None else self._computed()

    @cached_property
    def _few(self) -> list[tuple[DynamicsSamples, np.ndarray]] | None:
        count = sum(x.q.size for x in self.samples) * 10 * len(self.arm.bodies)
        return list(self._computed()) if 8 * count <= TUNING.regressor_bytes else None

    def _computed(self) -> Iterator[tuple[DynamicsSamples, np.ndarray]]:
        for x in self.samples:
            for start in range(0, len(x.q), TUNING.block):
                block = x[start : start + TUNING.block]
                yield block, regressor(self.arm, block.q, block.qd, block.qdd)


@dataclass(frozen=True, eq=False)
class _Rows:
    """Give the equations of samples, a block at a time. motors: joints' velocities to the drives', (n, n)."""

    bodies: _BodyRows
    friction: FrictionModel
    motors: np.ndarray | None

    def blocks(self) -> Iterator[Columns]:
        reach = reach_of(self.bodies.arm.joint_types).values
        for block, bodies in self.bodies.blocks():
            bent = None if block.z is None else block.z / reach
            drives = self.friction.columns(block.qd, block.qdd, bent, self.motors)
            yield np.concatenate([bodies, drives], axis=2), block.tau

    def noise(self, solution: Solution, torque_range: np.ndarray) -> np.ndarray:
        """Return the standard deviations (n,), as if independent, of the errors that a solution leaves."""
        residuals = [regressors @ solution.parameters - tau for regressors, tau in self.blocks()]
        noise = deviations(residuals, solution.rank)
        return np.asarray(np.maximum(noise, TUNING.least_noise * torque_range))
