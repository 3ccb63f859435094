"""List of all baselines, in the order of tables, to which `evaluate` compares a model, and their fit to logs."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from spelgen.arm.configured_arm import Arm
from spelgen.baselines.predictor import CommandFollower, Predictors, Solver, States
from spelgen.dynamics.friction import FrictionModel
from spelgen.dynamics.regressor_dynamics import identified_dynamics
from spelgen.errors import Diagnostic, LogError, in_one_line
from spelgen.labels import (
    CONSTANT_VELOCITY,
    DELAYED_COMMAND,
    LEAST_SQUARES,
    LEAST_SQUARES_WITH_MEMORY,
    LINEAR_SERVOS,
    URDF,
    URDF_WITH_DRIVES,
)
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.trajectory import Trajectory, coverage, require_torques
from spelgen.logs.windows import Windows

FittedBaselines = dict[str, Any]
"""Content of least_squares.json: the fitted baselines, and the range of motion of the training logs."""
FRICTION = {
    LEAST_SQUARES: ("parameters", FrictionModel()),
    LEAST_SQUARES_WITH_MEMORY: ("parameters_with_memory", FrictionModel(memory=True)),
}
"""{name of a predictor: (key of its parameters in least_squares.json, its friction model)}."""


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


def fit_baselines(arm: Arm, logs: Sequence[Trajectory], preprocessing: Preprocessing) -> FittedBaselines:
    """Return the content of least_squares.json: the motion that the logs cover, and identified parameters.

    The motion is described by the duration, and by ranges and histograms of positions and velocities (see `coverage`).
    For each friction model, inertial and friction parameters are identified by linear least squares. The parameters are
    absent if the logs have no torques or no accelerations.

    preprocessing: resampling and filters of the logs, as in the fit of the model, with all default values resolved.
    """
    # The identification is imported here: an evaluation imports this file, too, but needs no identification.
    from spelgen.identification.identification import LeastSquares
    from spelgen.identification.identify import identify_by

    # The coverage of the training logs is stored, because an evaluation compares the motion in test logs with it.
    fitted: FittedBaselines = {"coverage": coverage(logs)}
    methods = [LeastSquares(friction=friction) for _, friction in FRICTION.values()]
    try:
        require_torques(logs)
        identified = identify_by(arm, logs, methods, preprocessing)
    # An error of the identification is ignored, because the model can be fitted without this baseline.
    except (LogError, np.linalg.LinAlgError):
        return fitted
    fits = {key: fit for (key, _), fit in zip(FRICTION.values(), identified, strict=True)}
    # Parameters are recorded for both friction models, because predictors are made from them. The statistics of the
    # identification are recorded only for the model without bristles.
    parameters = {key: fit.parameters.tolist() for key, fit in fits.items()}
    return {**fitted, **fits["parameters"].to_dict(), **parameters}


def torque_predictors(arm: EvaluatedArm) -> Predictors:
    """Return all baselines for an arm under torques."""
    predictors: Predictors = {}
    for baseline in BASELINES:
        predictors |= baseline(arm)
    return predictors


def command_followers(
    linear_servos: Mapping[str, Any] | None, notes: list[Diagnostic]
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
