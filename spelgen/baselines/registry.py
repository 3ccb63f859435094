"""All baselines, in the order in which tables show them: `fit` fits them, `evaluate` compares a model with them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from spelgen.arm.configured_arm import ConfiguredArm
from spelgen.baselines.baseline import Baseline, EvaluatedArm, FittedBaselines
from spelgen.baselines.constant_velocity import ConstantVelocity
from spelgen.baselines.fitted_servos import FittedServos
from spelgen.baselines.least_squares import IdentifiedArm
from spelgen.baselines.predictor import CommandFollower, Predictor
from spelgen.baselines.urdf import UrdfValues
from spelgen.errors import Diagnostic
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.trajectory import Trajectory, coverage

BASELINES: tuple[Baseline, ...] = (ConstantVelocity(), UrdfValues(), IdentifiedArm(), FittedServos())


def fit_baselines(
    arm: ConfiguredArm, logs: Sequence[Trajectory], preprocessing: Preprocessing
) -> FittedBaselines:
    """Return the baselines fitted to training logs, validation logs included, and the coverage of these logs.

    preprocessing: resolved by the fit of the model.
    """
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
    linear_servos: Mapping[str, Any] | None, notes: list[Diagnostic]
) -> dict[str, CommandFollower]:
    """Return all baselines for an arm under position commands, by name; see `Baseline.followers`."""
    followers: dict[str, CommandFollower] = {}
    for baseline in BASELINES:
        followers |= baseline.followers(linear_servos, notes)
    return followers
