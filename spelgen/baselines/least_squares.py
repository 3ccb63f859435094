"""Least squares on the training logs of a model, with two friction models: Coulomb friction, and bristles."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from spelgen.arm.configured_arm import ConfiguredArm
from spelgen.baselines.baseline import Baseline, EvaluatedArm
from spelgen.baselines.names import LEAST_SQUARES, LEAST_SQUARES_WITH_MEMORY
from spelgen.baselines.predictor import Predictor, of_dynamics
from spelgen.dynamics.linear_friction import FrictionModel
from spelgen.errors import LogError
from spelgen.identification.identification import LeastSquares, identified_dynamics
from spelgen.identification.identify import identify_by
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.trajectory import Trajectory, require_torques

FRICTION = {
    LEAST_SQUARES: ("parameters", FrictionModel()),
    LEAST_SQUARES_WITH_MEMORY: ("parameters_with_memory", FrictionModel(memory=True)),
}
"""By name of the predictor: the key of its parameters in least_squares.json, and its friction model."""


class IdentifiedArm(Baseline):
    """Rigid bodies, friction and armature with parameters identified by least squares."""

    def fit(
        self, arm: ConfiguredArm, logs: Sequence[Trajectory], preprocessing: Preprocessing
    ) -> dict[str, object]:
        """Return the identification with the parameters (K,) of each friction model; {} without accelerations."""
        methods = [LeastSquares(friction=friction) for _, friction in FRICTION.values()]
        try:
            require_torques(logs)
            found = identify_by(arm, logs, methods, preprocessing)
        except (LogError, np.linalg.LinAlgError):
            return {}
        fits = {key: fit for (key, _), fit in zip(FRICTION.values(), found, strict=True)}
        # base parameters and intervals are those of Coulomb friction; of bristles only the parameters are kept
        parameters = {key: fit.parameters.tolist() for key, fit in fits.items()}
        return {**fits["parameters"].to_dict(), **parameters}

    def predictors(self, arm: EvaluatedArm) -> list[Predictor]:
        """Return a predictor for each friction model."""
        if arm.fitted_arm is None or "parameters" not in arm.fitted:
            return []
        chain, drives = arm.fitted_arm.arm, arm.fitted_arm.actuation.drives()
        predictors = []
        for name, (key, friction) in FRICTION.items():
            dynamics = identified_dynamics(chain, friction, np.array(arm.fitted[key]), drives)
            predictors.append(of_dynamics(name, dynamics, arm.probe))
        return predictors
