"""All baselines, in the order in which tables show them: `fit` fits them, `evaluate` compares a model with them."""

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
"""The content of least_squares.json: fitted baselines, and the coverage of the training logs."""
LinearServoRecord = Mapping[str, Any]
"""Parameters of `LinearServos` in the record of a fit, by name."""


@dataclass(frozen=True)
class EvaluatedArm:
    """The information about an arm under torques that baselines may use.

    joints: names, in the order of q. urdf: None if unknown. fitted: the baselines fitted to the training logs.
    fitted_arm: the arm for which these were fitted; None if there are none. probe: windows for which the integrator's
    step is chosen. notes: a baseline appends, for example, why it is absent.
    """

    joints: Sequence[str]
    urdf: Path | None
    fitted: FittedBaselines
    fitted_arm: Arm | None
    probe: Windows
    notes: list[Diagnostic]


class Baseline:
    """Simple predictor of an arm under torques, under position commands, or under both.

    Each baseline is listed in `registry.py`. It overrides `predictors` or `followers`, and `fit` if it has parameters.
    """

    def fit(self, arm: Arm, logs: Sequence[Trajectory], preprocessing: Preprocessing) -> dict[str, object]:
        """Return the parameters fitted to the training logs, as JSON; {} if there is nothing to fit."""
        return {}

    def predictors(self, arm: EvaluatedArm) -> list[Predictor]:
        """Return the predictors under torques; [] if data or a package for them is absent."""
        return []

    def followers(
        self, linear_servos: LinearServoRecord | None, notes: list[Diagnostic]
    ) -> dict[str, CommandFollower]:
        """Return the predictors under position commands, by name.

        linear_servos: None for a model without a record.
        """
        return {}


def arm_of_model(model: object, urdf: Path) -> Arm:
    """Return the arm that a model was built from, read from its URDF. Raises UrdfError, ArmError or SettingsError."""
    spec = spec_of(model)
    options = Options() if spec is None else spec.options
    return load_arm(urdf, options.joints, options.tip, options.angle_tolerance)


class ConstantVelocity(Baseline):
    """The initial velocity of a window, kept constant."""

    def predictors(self, arm: EvaluatedArm) -> list[Predictor]:
        """Return the predictor."""
        return [Predictor(CONSTANT_VELOCITY, hold_velocity)]


def hold_velocity(windows: Windows) -> States:
    """Return q [rad, m] and qd [rad/s, m/s], (W, K-1, n), at samples 1..K-1 of the windows."""
    elapsed = windows.dt.cumsum(dim=1).unsqueeze(-1)  # (W, K-1, 1)
    qd = windows.qd[:, :1]
    return windows.q[:, :1] + qd * elapsed, qd.expand(-1, elapsed.shape[1], -1)


class UrdfValues(Baseline):
    """The dynamics that the URDF specifies."""

    def predictors(self, arm: EvaluatedArm) -> list[Predictor]:
        """Return one or two predictors; [] and a note if Pinocchio cannot read the file or is not installed."""
        if arm.urdf is None:
            arm.notes.append(_missing("robot.urdf", "no arm is known"))
            return []
        try:
            from spelgen.dynamics.pinocchio_dynamics import drives_known, urdf_dynamics  # an extra

            plain = urdf_dynamics(arm.urdf, arm.joints)
            predictors = [of_dynamics(URDF, plain, arm.probe)]
            # without drives in the URDF both predictors would be equal
            if drives_known(arm.urdf, arm.joints):
                driven = urdf_dynamics(arm.urdf, arm.joints, drives=True)
                predictors.append(of_dynamics(URDF_WITH_DRIVES, driven, arm.probe))
        # Pinocchio and its parser raise many kinds; the evaluation continues without it
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
"""By name of the predictor: the key of its parameters in least_squares.json, and its friction model."""


class IdentifiedArm(Baseline):
    """Rigid bodies, friction and armature with parameters identified by least squares."""

    def fit(self, arm: Arm, logs: Sequence[Trajectory], preprocessing: Preprocessing) -> dict[str, object]:
        """Return the identification with the parameters (K,) of each friction model; {} without accelerations."""
        methods = [LeastSquares(friction=friction) for _, friction in FRICTION.values()]
        try:
            require_torques(logs)
            identified = identify_by(arm, logs, methods, preprocessing)
        # a baseline that cannot be fitted must not stop the fit of the model
        except (LogError, np.linalg.LinAlgError):
            return {}
        fits = {key: fit for (key, _), fit in zip(FRICTION.values(), identified, strict=True)}
        # with Coulomb friction all results are kept, with bristles only the parameters
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
    """`LinearServos` and `DelayedCommand` with the parameters of a fit's record."""

    def followers(
        self, linear_servos: LinearServoRecord | None, notes: list[Diagnostic]
    ) -> dict[str, CommandFollower]:
        """Return both; {} and a note for a model without a record."""
        if linear_servos is None:
            message = "no linear servos to compare with: they are fitted by `train`"
            notes.append(Diagnostic("info", "no-linear-servos", "logs", None, message))
            return {}
        servos = LinearServos(**linear_servos)
        return {LINEAR_SERVOS: servos, DELAYED_COMMAND: DelayedCommand(servos.late)}


BASELINES: tuple[Baseline, ...] = (ConstantVelocity(), UrdfValues(), IdentifiedArm(), FittedServos())


def fit_baselines(arm: Arm, logs: Sequence[Trajectory], preprocessing: Preprocessing) -> FittedBaselines:
    """Return the baselines fitted to training logs, validation logs included, and the coverage of these logs.

    preprocessing: resolved by the fit of the model.
    """
    # the coverage of the training logs is needed for the assessment of test logs
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
