"""Decide what the command `train` fits: the command line first, then the robot's settings or the run that goes on."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from pydantic import ValidationError

from spelgen.cli.console import note
from spelgen.errors import RunError, suggestion
from spelgen.settings.fits import OWNERS, Adaptation, FitConfig
from spelgen.settings.messages import explain
from spelgen.settings.training import TrainingSettings
from spelgen.settings.values import Count

if TYPE_CHECKING:
    from spelgen.emission.assemble import ArmModel
    from spelgen.settings.log_mapping import LogMapping

TIME_LIMIT = "max_minutes"
OF_LOGS = {"cutoff", "decimation", "gap", "torque_delay", "validation_fraction", "seed"}
FIELD_SEPARATOR = "."


class UsageError(typer.BadParameter):
    """An option that does not apply to what is fitted; the message names the option itself."""

    def format_message(self) -> str:
        """Return the message without the name of a parameter before it."""
        return self.message


class Assignments(TrainingSettings):
    """What `--set` assigns: a robot's settings, what of a fitted model moves, and where and how a fit runs.

    device: of torch. threads: that it uses. progress: whether it is shown.
    """

    adapt: Adaptation | None = None
    device: str = "cpu"
    threads: Count = 1
    progress: bool = True


@dataclass(frozen=True)
class Request:
    """Hold what the command line asks for. values: of `--set`, by key. warm_start: the model was fitted before."""

    objective: str | None
    values: Mapping[str, Any]
    warm_start: bool = False

    def values_of(self, keys: Iterable[str]) -> dict[str, Any]:
        """Return the values of these keys."""
        return {name: self.values[name] for name in keys if name in self.values}

    def settings(self, defaults: TrainingSettings) -> TrainingSettings:
        """Return how logs are prepared and split: as the command line says, else as these settings do."""
        return defaults.model_copy(update=self.values_of(OF_LOGS))


@dataclass(frozen=True)
class Start:
    """Hold what is fitted and how. config: makes the configuration once the logs' sample rates [Hz] are known."""

    module: Path
    config: Callable[[ArmModel, Sequence[float] | None], FitConfig | None]
    settings: TrainingSettings
    mapping: LogMapping | None = None


def read_assignments(assignments: Sequence[str]) -> dict[str, object]:
    """Return the checked values of `KEY=VALUE`; `prior.bodies=0.1` sets one field of a group.

    Raises a usage error for an unknown key, with the nearest known one, and for a value that cannot be.
    """
    keys = Assignments.model_fields.keys() - {"objective"}  # an option of its own
    # first gathered: fields of one group are checked together
    texts: dict[str, Any] = {}
    for assignment in assignments:
        key, equals, text = assignment.partition("=")
        name, _, field = key.strip().replace("-", "_").partition(FIELD_SEPARATOR)
        if not equals:
            raise UsageError(f"--set: got {assignment!r}, expected KEY=VALUE")
        if name not in keys:
            raise UsageError(f"--set: unknown key {name!r}; {suggestion(name, sorted(keys))}")
        if not field:
            texts[name] = text
        elif isinstance(texts.setdefault(name, {}), dict):
            texts[name][field] = text
    try:
        checked = Assignments.model_validate(texts)
    except ValidationError as error:
        wrong = explain(error.errors(include_url=False)[0], None, Assignments)
        raise UsageError(f"--set {wrong}") from error
    return {name: getattr(checked, name) for name in texts}


def new_run(module: Path, urdf: Path | None, request: Request) -> Start:
    """Return the start of a new run: what the command line does not say, the robot's settings do."""
    from spelgen.settings.settings import load_settings

    # without a URDF there is no sidecar that could hold defaults
    settings = TrainingSettings() if urdf is None else load_settings(urdf).training
    return Start(
        module, lambda model, rates: _new_config(settings, request, model, rates), request.settings(settings)
    )


def _new_config(
    settings: TrainingSettings, request: Request, model: ArmModel, rates: Sequence[float] | None
) -> FitConfig | None:
    """Return the configuration for a model; None where the logs' rates decide and are not known yet."""
    from spelgen.dynamics.protocol import has_rigid_bodies
    from spelgen.fitting.objectives import chosen_config

    options, defaults = request.values_of(OWNERS), dict(settings.options)
    objective = request.objective or settings.objective
    if request.warm_start and objective == "rollout" and has_rigid_bodies(model):
        defaults["torque_first"] = False  # it would start the bodies anew
    if objective is None and TIME_LIMIT in options:
        # whoever sets it cannot know which objective the logs will lead to
        defaults[TIME_LIMIT] = options.pop(TIME_LIMIT)
    config = chosen_config(model, rates, objective, options, defaults)
    if config is None:
        return None
    if TIME_LIMIT in request.values and TIME_LIMIT not in type(config).model_fields:
        note(f"info: max_minutes limits fits to windows; these logs are fitted by {config.objective}")
    return config


def resumed_run(folder: Path, request: Request) -> Start:
    """Return the start of a run that goes on: what the command line does not say, the run does."""
    from spelgen.dynamics.protocol import has_rigid_bodies
    from spelgen.fitting.run_folder import RunFolder
    from spelgen.fitting.run_record import recorded_config
    from spelgen.settings.fits import fit_config
    from spelgen.settings.log_mapping import LogMapping

    run = RunFolder(folder)
    record = run.read_config()
    fraction = record["validation_fraction"]
    # those logs were in memory of another program
    if fraction is None and record["validation"]:
        raise RunError(
            "a run whose validation logs were passed from Python",
            file=folder,
            do="resume it by spelgen.fit(..., folder=..., options=spelgen.RunOptions(resume=True))",
        )
    # not validated again: Python allows more than files of settings do
    recorded = {"seed": record["seed"], **record["preprocessing"]}
    if fraction is not None:
        recorded["validation_fraction"] = fraction
    settings = TrainingSettings().model_copy(update=recorded)

    def config(model: ArmModel, rates: Sequence[float] | None) -> FitConfig:
        rigid_bodies = has_rigid_bodies(model)
        if request.objective not in (None, record["objective"]):
            return fit_config(request.objective, rigid_bodies=rigid_bodies, options=request.values_of(OWNERS))
        same = recorded_config(record, **request.values_of(OWNERS))
        same.require(rigid_bodies=rigid_bodies)
        return same

    return Start(run.module, config, request.settings(settings), LogMapping(**record["mapping"]))
