"""Least squares on the very training logs of a run, with friction of two kinds: a jump, and bristles with memory."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from spelgen.baselines.baseline import Baseline, JudgedArm
from spelgen.baselines.names import LEAST_SQUARES, LEAST_SQUARES_WITH_MEMORY
from spelgen.baselines.predictor import Predictor, of_dynamics
from spelgen.baselines.run_arm import run_arm
from spelgen.dynamics.linear_friction import FrictionModel
from spelgen.errors import LogError
from spelgen.fitting.run_folder import RunFolder
from spelgen.identification.identification import LeastSquares, identified_dynamics
from spelgen.identification.identify import identify_by
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.trajectory import Trajectory, require_torques

FRICTION = {
    LEAST_SQUARES: ("parameters", FrictionModel()),
    LEAST_SQUARES_WITH_MEMORY: ("parameters_with_memory", FrictionModel(memory=True)),
}
"""By name, under which key parameters are kept, and the friction that they are of."""


class IdentifiedArm(Baseline):
    """Take an arm for what least squares makes of the training logs."""

    def fit(self, run: RunFolder, logs: Sequence[Trajectory], files: Sequence[str]) -> dict[str, object]:
        """Return the parameters with what is known of them; {} where logs show no torques or no accelerations."""
        preprocessing = Preprocessing(**run.read_config()["preprocessing"])
        methods = [LeastSquares(friction=friction) for _, friction in FRICTION.values()]
        try:
            require_torques(logs)
            found = identify_by(run_arm(run), logs, methods, preprocessing)
        except (LogError, np.linalg.LinAlgError):
            return {}
        fits = {key: fit for (key, _), fit in zip(FRICTION.values(), found, strict=True)}
        # numbers and their intervals are those of the usual friction; with memory only the parameters are kept
        parameters = {key: fit.parameters.tolist() for key, fit in fits.items()}
        return {**fits["parameters"].to_dict(), **parameters}

    def predictors(self, judged: JudgedArm) -> list[Predictor]:
        """Return a predictor for each kind of friction."""
        if judged.run is None or not judged.run.baseline.exists():
            return []
        record = judged.run.read_json(judged.run.baseline)
        if "parameters" not in record:
            return []
        arm = run_arm(judged.run)
        predictors = []
        for name, (key, friction) in FRICTION.items():
            dynamics = identified_dynamics(arm.arm, friction, np.array(record[key]), arm.actuation.drives())
            predictors.append(of_dynamics(name, dynamics, judged.probe))
        return predictors
