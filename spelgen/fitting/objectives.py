"""The registry of objectives, and the choice of the objective and its configuration."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from spelgen.dynamics.protocol import input_of
from spelgen.emission.assemble import ArmModel
from spelgen.errors import OptionError, SettingsError
from spelgen.fitting.objective import FitRequest, Objective
from spelgen.fitting.servo.objective import ServoObjective
from spelgen.fitting.torque.objective import TorqueObjective
from spelgen.fitting.window.momentum import MomentumObjective
from spelgen.fitting.window.rollout import RolloutObjective
from spelgen.logs.tuning import shows_accelerations
from spelgen.runtime.rigid_body_dynamics import RigidBodyDynamics
from spelgen.settings.fits import FitConfig, fit_config

ALL: tuple[type[Objective], ...] = (TorqueObjective, MomentumObjective, RolloutObjective, ServoObjective)
OBJECTIVES = {objective.name: objective for objective in ALL}
Rates = Callable[[], Sequence[float]]
"""Return the sample rates of the logs [Hz]; called only if the choice depends on them, since it may read the logs."""


@dataclass(frozen=True)
class FitOptions:
    """Options of a fit whose objective may not be known yet.

    objective: None: chosen by `default_objective`. options: by name; an option that does not apply is an error.
    defaults: by name, for options that are not given; inapplicable ones are omitted.
    """

    objective: str | None = None
    options: Mapping[str, object] = field(default_factory=dict)
    defaults: Mapping[str, object] = field(default_factory=dict)


def objective_of(request: FitRequest) -> Objective:
    """Return the objective of a request. Raises OptionError if it does not apply to the model."""
    name = request.config.objective
    objective = OBJECTIVES[name]
    under = input_of(request.model)
    if objective.input != under:
        message = (
            f"{name} belongs to arms with 'input: {objective.input}' in their settings, this has '{under}'"
        )
        raise OptionError("objective", message)
    return objective(request)


def default_objective(model: ArmModel, rates: Rates) -> str:
    """Return the objective for a model and its logs.

    "servo" for an arm under position servos; "torque" for rigid bodies if a log is sampled densely enough for
    accelerations; else "rollout".
    """
    if input_of(model) == ServoObjective.input:
        return ServoObjective.name
    if isinstance(model, RigidBodyDynamics) and any(map(shows_accelerations, rates())):
        return "torque"
    return "rollout"


def choose_config(model: ArmModel, requested: FitConfig | FitOptions | None, rates: Rates) -> FitConfig:
    """Return the configuration of a fit. Raises OptionError for an option that does not apply to the model."""
    rigid_bodies = isinstance(model, RigidBodyDynamics)
    if isinstance(requested, FitConfig):
        requested.require(rigid_bodies=rigid_bodies)
        return requested
    if not isinstance(requested, FitOptions | None):
        raise SettingsError(
            f"{requested!r} as the configuration of a fit",
            expected="spelgen.TorqueFit(), MomentumFit(), Rollout() or ServoFit()",
        )
    chosen = requested or FitOptions()
    objective, defaults = chosen.objective, chosen.defaults
    if objective is None:
        objective = default_objective(model, rates)
        if rigid_bodies and objective == "rollout":  # rigid bodies need no regularizer unless it is requested
            defaults = {"urdf_weight": 0.0, **defaults}
    return fit_config(objective, rigid_bodies=rigid_bodies, options=chosen.options, defaults=defaults)
