"""The estimator in C: a header and a source in addition to the model, with the noise levels of the run."""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterable

import numpy as np

from spelgen.exporting.c_source import CFunction, c_function
from spelgen.exporting.description import TrainedModel
from spelgen.exporting.estimator_expressions import ENTRIES, estimator_functions
from spelgen.live.noise import NoiseLevels
from spelgen.live.tuning import TUNING
from spelgen.templates import render

CALLED = ("inverse_dynamics", "friction", "gravity")
"""Functions of the model that the estimator calls, in addition to its own."""


def estimator_c_functions(model: TrainedModel, levels: NoiseLevels) -> list[CFunction]:
    """Return the functions of the model that only the estimator calls."""
    functions = estimator_functions(model, levels.point)
    return [c_function(model, entry, functions[entry.name]) for entry in ENTRIES]


def estimator_texts(model: TrainedModel, levels: NoiseLevels) -> dict[str, str]:
    """Return header and source of the estimator, by name of the file."""
    tables: dict[str, Iterable[float]] = {
        "load_prior": TUNING.load_prior,
        "load_white": levels.load.white,
        "load_disturbance": levels.load.disturbance,
        "load_time_constant": levels.load.time_constant,
        "drift_white": levels.drift.white,
        "drift_disturbance": levels.drift.disturbance,
        "drift_time_constant": levels.drift.time_constant,
        "observer": levels.observer,
        "peak_start": levels.peak_start,
        "peak_scale": levels.peak_scale,
        "load_variance": [levels.load_variance],
        "resting_torque": levels.resting,
        "resting_speed": levels.resting_speed,
        "speed": levels.speed,
        "rest_speed": levels.rest_speed,
        "encoder": levels.encoder,
        "effort": levels.effort,
        "scales": TUNING.scales,
        # C has no empty arrays
        "breakaway": model.breakaway.ravel() if model.memory else [0.0],
    }
    values = {
        "name": model.name,
        "upper": model.name.upper(),
        "n": model.n,
        "tuning": TUNING,
        "supported": f"{levels.supported_alarms:.2g} per minute",
        "windows": repr(levels.tail_peaks),
        "evidence": repr(TUNING.evidence),
        "quantile": repr(levels.load_quantile),
        "iterations": TUNING.iterations,
        "weights": TUNING.weights,
        "tables": {name: _numbers(row) for name, row in tables.items()},
        "motors": list(map(_numbers, model.motors)),
        "inverse_inputs": list(map(_numbers, np.linalg.inv(model.inputs + np.diag(1 - model.actuated)))),
    }
    # a saved state belongs to one estimator
    identity = zlib.crc32(repr(sorted((name, str(value)) for name, value in values.items())).encode())
    files: dict[str, str] = {}
    for suffix in (".h", ".c"):
        files[f"{model.name}_estimator{suffix}"] = render(
            f"estimator{suffix}.jinja", **values, identity=identity
        )
    return files


def _numbers(values: Iterable[float]) -> list[str]:
    """Return numbers as C constants, all digits."""
    return ["INFINITY" if math.isinf(value) else repr(float(value)) for value in values]
