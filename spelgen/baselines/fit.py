"""Fit of the baselines to the logs of a fit; `baselines.registry` makes predictors from them."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from spelgen.arm.configured_arm import Arm
from spelgen.dynamics.friction import FrictionModel
from spelgen.errors import LogError
from spelgen.labels import LEAST_SQUARES, LEAST_SQUARES_WITH_MEMORY
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.trajectory import Trajectory, coverage, require_torques

FittedBaselines = dict[str, Any]
"""Content of least_squares.json: the fitted baselines, and the range of motion of the training logs."""
FRICTION = {
    LEAST_SQUARES: ("parameters", FrictionModel()),
    LEAST_SQUARES_WITH_MEMORY: ("parameters_with_memory", FrictionModel(memory=True)),
}
"""{name of a predictor: (key of its parameters in least_squares.json, its friction model)}."""


def fit_baselines(arm: Arm, logs: Sequence[Trajectory], preprocessing: Preprocessing) -> FittedBaselines:
    """Return the content of least_squares.json: the motion that the logs cover, and identified parameters.

    The motion is described by the duration, and by ranges and histograms of positions and velocities (see `coverage`).
    For each friction model, inertial and friction parameters are identified by linear least squares. The parameters are
    absent if the logs have no torques or no accelerations.

    preprocessing: resampling and filters of the logs, as in the fit of the model, with all default values resolved.
    """
    # The identification is imported here: an evaluation imports this file, too, and needs no identification.
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
