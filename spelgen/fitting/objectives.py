"""The registry of objectives, and which one is fitted where nobody says."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

from spelgen.dynamics.protocol import has_rigid_bodies, has_servos
from spelgen.errors import OptionError
from spelgen.fitting.objective import FitRequest, FitSummary, Objective
from spelgen.fitting.run_record import ReadContent
from spelgen.fitting.servo.objective import ServoObjective
from spelgen.fitting.servo.report import servo_summary
from spelgen.fitting.torque.objective import TorqueObjective
from spelgen.fitting.window.objectives import MomentumObjective, RolloutObjective
from spelgen.logs.rates import shows_accelerations
from spelgen.settings.fits import FitConfig, fit_config

if TYPE_CHECKING:
    from spelgen.emission.loading import EmittedModel

OBJECTIVES: dict[str, type[Objective]] = {
    TorqueObjective.name: TorqueObjective,
    MomentumObjective.name: MomentumObjective,
    RolloutObjective.name: RolloutObjective,
    ServoObjective.name: ServoObjective,
}


SUMMARIES: dict[str, Callable[[ReadContent], FitSummary | None]] = {ServoObjective.name: servo_summary}
"""What an objective says of a run's config.json, where it determines more than a model."""


def fit_summary(record: ReadContent) -> FitSummary | None:
    """Return what a fit determined, None where its objective has nothing to say, or is not over."""
    summary = SUMMARIES.get(record.get("objective", ""))
    return None if summary is None else summary(record)


def objective_of(request: FitRequest) -> Objective:
    """Return the objective of a request. Raises OptionError where it is not for this model."""
    name = request.config.objective
    objective = OBJECTIVES[name]
    if has_servos(request.model) and not objective.follows_commands:
        message = f"{name} belongs to logs of torques, this arm has position servos"
        raise OptionError("objective", message)
    if objective.follows_commands and not has_servos(request.model):
        raise OptionError("objective", f"{name} belongs to arms with 'input: position' in their settings")
    return objective(request)


def default_objective(model: EmittedModel, rates: Sequence[float]) -> str:
    """Return the objective that is fitted where nobody names one.

    It is "servo" for an arm under position servos, "torque" for a model of rigid bodies where logs are sampled densely
    enough for accelerations (rates [Hz]), and else "rollout".
    """
    if has_servos(model):
        return "servo"
    if has_rigid_bodies(model) and any(map(shows_accelerations, rates)):
        return "torque"
    return "rollout"


def default_config(
    model: EmittedModel,
    rates: Sequence[float],
    options: Mapping[str, object] | None = None,
    defaults: Mapping[str, object] | None = None,
) -> FitConfig:
    """Return the configuration of `default_objective`; options and defaults as for `fit_config`."""
    objective, rigid_bodies = default_objective(model, rates), has_rigid_bodies(model)
    if rigid_bodies and objective == "rollout":  # bodies need no regularizer where nobody asks for one
        defaults = {"urdf_weight": 0.0, **(defaults or {})}
    return fit_config(objective, rigid_bodies=rigid_bodies, options=options, defaults=defaults)
