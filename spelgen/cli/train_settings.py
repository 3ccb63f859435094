"""The settings of `train`: from the command line, else from the robot's settings or the record of a resumed run."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from pydantic import ValidationError

from spelgen.errors import RunError, suggestion
from spelgen.settings.fits import OWNERS, Adaptation
from spelgen.settings.training import PREPROCESSING, TrainingSettings
from spelgen.settings.values import Count
from spelgen.settings.yaml_document import explain

if TYPE_CHECKING:
    from spelgen.fitting.fit import FitOptions
    from spelgen.settings.log_mapping import LogMapping

TIME_LIMIT = "max_minutes"
OF_LOGS = PREPROCESSING | {"validation_fraction", "seed"}


class UsageError(typer.BadParameter):
    """Usage error about an option that does not apply; the message names the option."""

    def format_message(self) -> str:
        """Return the message without the prefix that names a parameter."""
        return self.message


class Assignments(TrainingSettings):
    """The keys of the option `--set`: the training settings of a robot, and options of a single fit.

    adapt: see `TorqueFit`. device, threads: device and number of threads of torch. progress: whether a progress bar is
    shown.
    """

    adapt: Adaptation | None = None
    device: str = "cpu"
    threads: Count = 1
    progress: bool = True


@dataclass(frozen=True)
class Request:
    """The options of the command `train`.

    values: key of `--set` -> value. warm_start: whether the model was fitted before.
    """

    objective: str | None
    values: Mapping[str, Any]
    warm_start: bool = False

    def values_of(self, keys: Iterable[str]) -> dict[str, Any]:
        """Return key -> value, without keys that `--set` has not set."""
        return {name: self.values[name] for name in keys if name in self.values}

    def settings(self, defaults: TrainingSettings) -> TrainingSettings:
        """Return `defaults` in which preprocessing, split and seed are replaced by values of the command line."""
        return defaults.model_copy(update=self.values_of(OF_LOGS))


@dataclass(frozen=True)
class Start:
    """The settings at the start of a run: of the fit and of its logs."""

    options: FitOptions
    settings: TrainingSettings
    mapping: LogMapping | None = None


def read_assignments(assignments: Sequence[str]) -> dict[str, object]:
    """Return key -> checked value for texts `KEY=VALUE`; `prior.bodies=0.1` sets one field of a group.

    Raises a usage error for an unknown key, with the nearest known one, and for an invalid value.
    """
    keys = Assignments.model_fields.keys() - {"objective"}  # has its own option
    # All assignments are collected before they are checked, since the fields of a group are checked together.
    texts: dict[str, str | dict[str, str]] = {}
    for assignment in assignments:
        key, equals, text = assignment.partition("=")
        name, _, field = key.strip().replace("-", "_").partition(".")
        # The sign `=` is checked before the key: the user may have typed a blank in its place.
        if not equals:
            raise UsageError(f"--set: got {assignment!r}, expected KEY=VALUE")
        if name not in keys:
            raise UsageError(f"--set: unknown key {name!r}; {suggestion(name, sorted(keys))}")
        if not field:
            texts[name] = text
            continue
        group = texts.setdefault(name, {})
        if isinstance(group, dict):
            group[field] = text
    try:
        checked = Assignments.model_validate(texts)
    except ValidationError as error:
        wrong = explain(error.errors(include_url=False)[0], None, Assignments)
        raise UsageError(f"--set {wrong}") from error
    values = dict(checked)
    return {name: values[name] for name in texts}


def new_run(urdf: Path | None, request: Request) -> Start:
    """Return the settings of a new run; the command line takes precedence over the robot's settings."""
    from spelgen.fitting.fit import FitOptions
    from spelgen.settings.settings import load_settings

    # The robot's settings are found by the URDF; without a URDF, general defaults are used.
    settings = TrainingSettings() if urdf is None else load_settings(urdf).training
    options, defaults = request.values_of(OWNERS), dict(settings.options)
    objective = request.objective or settings.objective
    if request.warm_start and objective == "rollout":
        defaults["torque_first"] = False  # a torque fit would discard the weights of the run
    if objective is None and TIME_LIMIT in options:
        # The objective is chosen later from the logs, so this option must not be an error for any objective.
        defaults[TIME_LIMIT] = options.pop(TIME_LIMIT)
    return Start(FitOptions(objective, options, defaults), request.settings(settings))


def resumed_run(folder: Path, request: Request) -> Start:
    """Return the settings of a resumed run; the command line takes precedence over the record of the run."""
    from spelgen.fitting.fit import FitOptions
    from spelgen.fitting.run_folder import RunFolder

    run = RunFolder(folder)
    record = run.read_record()
    # Validation logs that were passed from Python are not stored in a file, so the run cannot be resumed here.
    if record.validation_fraction is None and record.validation:
        raise RunError(
            "a run whose validation logs were passed from Python",
            file=folder,
            do="resume it by spelgen.fit(..., folder=..., options=spelgen.RunOptions(resume=True))",
        )
    # Recorded values are not validated: runs from Python may have values that settings files do not accept.
    recorded = {"seed": record.seed, **asdict(record.preprocessing)}
    if record.validation_fraction is not None:
        recorded["validation_fraction"] = record.validation_fraction
    settings = TrainingSettings().model_copy(update=recorded)
    options = request.values_of(OWNERS)
    objective = request.objective or record.objective
    if objective == record.objective:
        options = record.options | options
    return Start(FitOptions(objective, options), request.settings(settings), record.mapping)
