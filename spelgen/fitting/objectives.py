"""The registry of objectives, and which one is fitted where nobody says."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from spelgen.dynamics.protocol import has_rigid_bodies, input_of
from spelgen.errors import OptionError
from spelgen.fitting.objective import FitRequest, Objective
from spelgen.fitting.servo.objective import ServoObjective
from spelgen.fitting.torque.objective import TorqueObjective
from spelgen.fitting.window.momentum import MomentumObjective
from spelgen.fitting.window.rollout import RolloutObjective
from spelgen.logs.rates import shows_accelerations
from spelgen.settings.fits import FitConfig, fit_config

if TYPE_CHECKING:
    from spelgen.emission.assemble import ArmModel

ALL: tuple[type[Objective], ...] = (TorqueObjective, MomentumObjective, RolloutObjective, ServoObjective)
OBJECTIVES = {objective.name: objective for objective in ALL}


def objective_of(request: FitRequest) -> Objective:
    """Return the objective of a request. Raises OptionError where it is not for this model."""
    name = request.config.objective
    objective = OBJECTIVES[name]
    under = input_of(request.model)
    if objective.input != under:
        message = (
            f"{name} belongs to arms with 'input: {objective.input}' in their settings, this has '{under}'"
        )
        raise OptionError("objective", message)
    return objective(request)


def default_objective(model: ArmModel, rates: Sequence[float]) -> str:
    """Return the objective that is fitted where nobody names one.

    It is that of position servos for an arm under these, "torque" for a model of rigid bodies where logs are sampled
    densely enough for accelerations (rates [Hz]), and else "rollout".
    """
    if input_of(model) == ServoObjective.input:
        return ServoObjective.name
    if has_rigid_bodies(model) and any(map(shows_accelerations, rates)):
        return "torque"
    return "rollout"


def chosen_config(
    model: ArmModel,
    rates: Sequence[float] | None,
    objective: str | None = None,
    options: Mapping[str, object] | None = None,
    defaults: Mapping[str, object] | None = None,
) -> FitConfig | None:
    """Return the configuration of an objective, by default of `default_objective`.

    options, defaults: as for `fit_config`. rates: None before logs are read; None is returned where these decide.
    """
    rigid_bodies = has_rigid_bodies(model)
    if objective is None:
        if rates is None and rigid_bodies:
            return None
        objective = default_objective(model, rates or [])
        if rigid_bodies and objective == "rollout":  # bodies need no regularizer where nobody asks for one
            defaults = {"urdf_weight": 0.0, **(defaults or {})}
    return fit_config(objective, rigid_bodies=rigid_bodies, options=options, defaults=defaults)
