"""List of all baselines, in the order of tables. `evaluate` compares a model with them; `baselines.fit` fits them."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from spelgen.arm.configured_arm import Arm
from spelgen.baselines.fit import FRICTION, FittedBaselines
from spelgen.baselines.predictor import CommandFollower, Predictors, Solver, States
from spelgen.dynamics.regressor_dynamics import identified_dynamics
from spelgen.errors import Diagnostic, in_one_line
from spelgen.labels import (
    CONSTANT_VELOCITY,
    DELAYED_COMMAND,
    LINEAR_SERVOS,
    URDF,
    URDF_WITH_DRIVES,
)
from spelgen.logs.windows import Windows

LinearServoRecord = Mapping[str, Any]
"""Parameters of `LinearServos` in the record of a fit, by name."""


@dataclass(frozen=True)
class EvaluatedArm:
    """The information that baselines may use about an arm whose inputs are torques.

    Attributes:
        joints: Names of the joints in the order of q.
        urdf: Path of the URDF; None if unknown.
        fitted: Content of least_squares.json: baselines that were fitted to the training logs.
        fitted_arm: Arm of the fitted baselines; None if there are none.
        probe: Windows from which the number of integrator steps is chosen.
        notes: List to which a baseline appends diagnostics, for example the reason why it is absent.
    """

    joints: Sequence[str]
    urdf: Path | None
    fitted: FittedBaselines
    fitted_arm: Arm | None
    probe: Windows
    notes: list[Diagnostic]


def constant_velocity(arm: EvaluatedArm) -> Predictors:
    """Return one predictor, for which all joints keep the velocity of the first sample of a window."""
    return {CONSTANT_VELOCITY: hold_velocity}


def hold_velocity(windows: Windows) -> States:
    """Return q [rad, m] and qd [rad/s, m/s] of W windows of K samples for constant velocity from sample 0.

    q and qd are (W, K-1, n), at samples 1 to K-1.
    """
    elapsed = windows.dt.cumsum(dim=1).unsqueeze(-1)  # elapsed: time since sample 0, (W, K-1, 1) [s]
    qd = windows.qd[:, :1]
    return windows.q[:, :1] + qd * elapsed, qd.expand(-1, elapsed.shape[1], -1)


def urdf_values(arm: EvaluatedArm) -> Predictors:
    """Return one or two baselines with the inertial parameters of the URDF.

    The first baseline has only rigid bodies. The second baseline also has rotors and friction; it is omitted if the
    settings of the URDF specify neither of them. If Pinocchio is absent or cannot read the URDF, the result is empty
    and a note is added to ``arm.notes``.
    """
    if arm.urdf is None:
        arm.notes.append(_missing("robot.urdf", "no arm is known"))
        return {}
    try:
        # Pinocchio is an optional dependency, so the import is in this function.
        from spelgen.dynamics.pinocchio_dynamics import drives_known, urdf_dynamics

        plain = urdf_dynamics(arm.urdf, arm.joints)
        predictors: Predictors = {URDF: Solver(plain, arm.probe)}
        # The baseline with rotors and friction is omitted if the settings specify neither: it would equal `plain`.
        if drives_known(arm.urdf, arm.joints):
            driven = urdf_dynamics(arm.urdf, arm.joints, drives=True)
            predictors[URDF_WITH_DRIVES] = Solver(driven, arm.probe)
    # Pinocchio and its URDF parser raise exceptions of many types. The evaluation continues without this baseline.
    except Exception as error:
        arm.notes.append(_missing(arm.urdf.name, in_one_line(error)))
        return {}
    return predictors


def _missing(where: str, reason: str) -> Diagnostic:
    return Diagnostic("info", "no-urdf-baseline", where, None, f"no comparison with the URDF: {reason}")


def least_squares(arm: EvaluatedArm) -> Predictors:
    """Return one predictor per friction model, with the parameters that `fit_baselines` has identified.

    The result is empty if these parameters are unknown.
    """
    if arm.fitted_arm is None or "parameters" not in arm.fitted:
        return {}
    drives = arm.fitted_arm.actuation.drives()
    predictors: Predictors = {}
    for name, (key, friction) in FRICTION.items():
        dynamics = identified_dynamics(arm.fitted_arm.chain, friction, np.array(arm.fitted[key]), drives)
        predictors[name] = Solver(dynamics, arm.probe)
    return predictors


BASELINES: tuple[Callable[[EvaluatedArm], Predictors], ...] = (
    constant_velocity,
    urdf_values,
    least_squares,
)
"""Functions that return predictors under torques, or {} if data or a package that they need is absent."""


def torque_predictors(arm: EvaluatedArm) -> Predictors:
    """Return all baselines for an arm under torques."""
    predictors: Predictors = {}
    for baseline in BASELINES:
        predictors |= baseline(arm)
    return predictors


def command_followers(
    linear_servos: LinearServoRecord | None, notes: list[Diagnostic]
) -> dict[str, CommandFollower]:
    """Return {name: baseline} for an arm under position commands.

    linear_servos: parameters of linear servos in the record of the fit. For a model without a record it is None; the
    result is then empty, and a note with the reason is appended to ``notes``.
    """
    if linear_servos is None:
        message = "no linear servos to compare with: they are fitted by `train`"
        notes.append(Diagnostic("info", "no-linear-servos", "logs", None, message))
        return {}
    from spelgen.baselines.linear_servos import DelayedCommand, LinearServos

    servos = LinearServos(**linear_servos)
    return {LINEAR_SERVOS: servos, DELAYED_COMMAND: DelayedCommand(servos.late)}
