"""The interface of a baseline: a simple predictor that a fitted model is compared with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from spelgen.arm.configured_arm import Arm, load_arm
from spelgen.baselines.predictor import CommandFollower, Predictor
from spelgen.emission.assemble import spec_of
from spelgen.errors import Diagnostic
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.trajectory import Trajectory
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
