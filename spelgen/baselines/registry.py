"""List of all baselines, in the order of tables. `fit` fits the baselines, `evaluate` compares a model with them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from spelgen.arm.configured_arm import Arm, load_arm
from spelgen.baselines.linear_servos import DelayedCommand, LinearServos
from spelgen.baselines.predictor import CommandFollower, Predictor, States, of_dynamics
from spelgen.dynamics.friction import FrictionModel
from spelgen.emission.assemble import spec_of
from spelgen.errors import Diagnostic, LogError, in_one_line
from spelgen.identification.identification import LeastSquares, identified_dynamics
from spelgen.identification.identify import identify_by
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
from spelgen.spec import Options

FittedBaselines = dict[str, Any]
"""Content of least_squares.json: the fitted baselines, and the coverage of the training logs."""
LinearServoRecord = Mapping[str, Any]
"""Parameters of `LinearServos` in the record of a fit, by name."""


@dataclass(frozen=True)
class EvaluatedArm:
    """The information about an arm under torques that baselines may use.

    joints: names of the joints in the order of q. urdf: path of the URDF, None if unknown. fitted: baselines fitted to
    the training logs. fitted_arm: arm for which these baselines were fitted; None without fitted baselines. probe:
    windows from which the number of integrator steps is chosen. notes: list to which a baseline appends diagnostics,
    for example the reason of its absence.
    """

    joints: Sequence[str]
    urdf: Path | None
    fitted: FittedBaselines
    fitted_arm: Arm | None
    probe: Windows
    notes: list[Diagnostic]


class Baseline:
    """Base class of simple predictors of an arm under torques, under position commands, or under both.

    Subclasses are listed in `registry.py`. A subclass overrides `predictors` or `followers`, and `fit` if it has
    parameters.
    """

    def fit(self, arm: Arm, logs: Sequence[Trajectory], preprocessing: Preprocessing) -> dict[str, object]:
        """Return the parameters fitted to the training logs, as a JSON object; {} if the baseline has no parameters."""
        return {}

    def predictors(self, arm: EvaluatedArm) -> list[Predictor]:
        """Return the predictors under torques; [] if data or a package that they need is absent."""
        return []

    def followers(
        self, linear_servos: LinearServoRecord | None, notes: list[Diagnostic]
    ) -> dict[str, CommandFollower]:
        """Return the predictors under position commands, by name.

        linear_servos: parameters of linear servos in the record of the fit; None for a model without a record.
        """
        return {}


def arm_of_model(model: object, urdf: Path) -> Arm:
    """Return the arm that a model was built from, read from its URDF. Raises UrdfError, ArmError or SettingsError."""
    spec = spec_of(model)
    options = Options() if spec is None else spec.options
    return load_arm(urdf, options.joints, options.tip, options.angle_tolerance)


class ConstantVelocity(Baseline):
    """Prediction that the initial velocity of a window remains constant."""

    def predictors(self, arm: EvaluatedArm) -> list[Predictor]:
        """Return the predictor of constant velocity."""
        return [Predictor(CONSTANT_VELOCITY, hold_velocity)]


def hold_velocity(windows: Windows) -> States:
    """Return q [rad, m] and qd [rad/s, m/s], (W, K-1, n), at samples 1..K-1, for constant velocity from sample 0."""
    elapsed = windows.dt.cumsum(dim=1).unsqueeze(-1)  # (W, K-1, 1)
    qd = windows.qd[:, :1]
    return windows.q[:, :1] + qd * elapsed, qd.expand(-1, elapsed.shape[1], -1)


class UrdfValues(Baseline):
    """Dynamics with the parameters of the URDF, without and with its drives."""

    def predictors(self, arm: EvaluatedArm) -> list[Predictor]:
        """Return one or two predictors. If Pinocchio is absent or cannot read the URDF, return [] and add a note."""
        if arm.urdf is None:
            arm.notes.append(_missing("robot.urdf", "no arm is known"))
            return []
        try:
            from spelgen.dynamics.pinocchio_dynamics import drives_known, urdf_dynamics  # needs an extra

            plain = urdf_dynamics(arm.urdf, arm.joints)
            predictors = [of_dynamics(URDF, plain, arm.probe)]
            # Without drives in the URDF both predictors would be equal.
            if drives_known(arm.urdf, arm.joints):
                driven = urdf_dynamics(arm.urdf, arm.joints, drives=True)
                predictors.append(of_dynamics(URDF_WITH_DRIVES, driven, arm.probe))
        # Pinocchio and its URDF parser raise exceptions of many types. The evaluation continues without this baseline.
        except Exception as error:
            arm.notes.append(_missing(arm.urdf.name, in_one_line(error)))
            return []
        return predictors


def _missing(where: str, reason: str) -> Diagnostic:
    return Diagnostic("info", "no-urdf-baseline", where, None, f"no comparison with the URDF: {reason}")


FRICTION = {
    LEAST_SQUARES: ("parameters", FrictionModel()),
    LEAST_SQUARES_WITH_MEMORY: ("parameters_with_memory", FrictionModel(memory=True)),
}
"""Name of a predictor -> key of its parameters in least_squares.json, and its friction model."""


class IdentifiedArm(Baseline):
    """Rigid bodies, friction and armature with parameters identified by least squares."""

    def fit(self, arm: Arm, logs: Sequence[Trajectory], preprocessing: Preprocessing) -> dict[str, object]:
        """Return the identification, and the parameters (K,) per friction model; {} for logs without accelerations."""
        methods = [LeastSquares(friction=friction) for _, friction in FRICTION.values()]
        try:
            require_torques(logs)
            identified = identify_by(arm, logs, methods, preprocessing)
        # An error in a baseline is ignored, so that it does not stop the fit of the model.
        except (LogError, np.linalg.LinAlgError):
            return {}
        fits = {key: fit for (key, _), fit in zip(FRICTION.values(), identified, strict=True)}
        # All results are kept for Coulomb friction, and only the parameters for bristles.
        parameters = {key: fit.parameters.tolist() for key, fit in fits.items()}
        return {**fits["parameters"].to_dict(), **parameters}

    def predictors(self, arm: EvaluatedArm) -> list[Predictor]:
        """Return a predictor for each friction model."""
        if arm.fitted_arm is None or "parameters" not in arm.fitted:
            return []
        chain, drives = arm.fitted_arm.chain, arm.fitted_arm.actuation.drives()
        predictors = []
        for name, (key, friction) in FRICTION.items():
            dynamics = identified_dynamics(chain, friction, np.array(arm.fitted[key]), drives)
            predictors.append(of_dynamics(name, dynamics, arm.probe))
        return predictors


class FittedServos(Baseline):
    """`LinearServos` and `DelayedCommand`, with parameters from the record of the fit."""

    def followers(
        self, linear_servos: LinearServoRecord | None, notes: list[Diagnostic]
    ) -> dict[str, CommandFollower]:
        """Return both predictors, by name. For a model without a record, return {} and add a note."""
        if linear_servos is None:
            message = "no linear servos to compare with: they are fitted by `train`"
            notes.append(Diagnostic("info", "no-linear-servos", "logs", None, message))
            return {}
        servos = LinearServos(**linear_servos)
        return {LINEAR_SERVOS: servos, DELAYED_COMMAND: DelayedCommand(servos.late)}


BASELINES: tuple[Baseline, ...] = (ConstantVelocity(), UrdfValues(), IdentifiedArm(), FittedServos())


def fit_baselines(arm: Arm, logs: Sequence[Trajectory], preprocessing: Preprocessing) -> FittedBaselines:
    """Return the baselines fitted to the training and validation logs, and the coverage of these logs.

    preprocessing: preprocessing of the fit, in which all default values are resolved.
    """
    # The assessment compares the range of motion in test logs with the coverage of the training logs.
    fitted: FittedBaselines = {"coverage": coverage(logs)}
    for baseline in BASELINES:
        fitted |= baseline.fit(arm, logs, preprocessing)
    return fitted


def torque_predictors(arm: EvaluatedArm) -> list[Predictor]:
    """Return all baselines for an arm under torques."""
    predictors = []
    for baseline in BASELINES:
        predictors += baseline.predictors(arm)
    return predictors


def command_followers(
    linear_servos: LinearServoRecord | None, notes: list[Diagnostic]
) -> dict[str, CommandFollower]:
    """Return all baselines for an arm under position commands, by name; see `Baseline.followers`."""
    followers: dict[str, CommandFollower] = {}
    for baseline in BASELINES:
        followers |= baseline.followers(linear_servos, notes)
    return followers
