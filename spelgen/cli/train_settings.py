"""The options of the command `train`.

A value given by `--set KEY=VALUE` takes precedence over the value in the settings of the robot.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import typer
from pydantic import ValidationError

from spelgen.errors import suggestion
from spelgen.settings.fits import OWNERS, Adaptation, Objective
from spelgen.settings.training import TrainingSettings
from spelgen.settings.yaml_document import Count, explain

if TYPE_CHECKING:
    from spelgen.fitting.fit import FitOptions

TIME_LIMIT = "max_minutes"


class UsageError(typer.BadParameter):
    """Usage error about an option that does not apply; the message names the option."""

    def format_message(self) -> str:
        """Return the message without the prefix that typer adds, which names a parameter."""
        return self.message


class Assignments(TrainingSettings):
    """The keys of the option `--set`: the training settings of a robot, and options of a single fit.

    adapt: change to which a fitted model is adapted: "load" (a payload), "friction" (another day), or "unit" (another
    arm of the same type). device, threads: device and number of threads of torch. progress: whether a progress bar is
    shown.
    """

    adapt: Adaptation | None = None
    device: str = "cpu"
    threads: Count = 1
    progress: bool = True


def read_assignments(assignments: Sequence[str]) -> dict[str, object]:
    """Return {key: checked value} for texts `KEY=VALUE`.

    A key such as `prior.bodies` sets one field of a group. Raises a usage error for an invalid value and for an unknown
    key; the message suggests the most similar known key.
    """
    keys = Assignments.model_fields.keys() - {"objective"}  # The option --objective sets it: no key of --set.
    # All assignments of --set are collected before they are checked, since the fields of a group are checked together.
    texts: dict[str, str | dict[str, str]] = {}
    for assignment in assignments:
        key, equals, text = assignment.partition("=")
        name, _, field = key.strip().replace("-", "_").partition(".")
        # A missing `=` in --set is reported before an unknown key, because the user may have typed a blank in place of
        # `=`.
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


def selected(values: Mapping[str, Any], keys: Iterable[str]) -> dict[str, Any]:
    """Return {key: value} for each of `keys` that is in `values`, the values of `--set`."""
    return {name: values[name] for name in keys if name in values}


def adaptation(objective: Objective | None, values: dict[str, Any]) -> Objective:
    """Return the objective of a fit that starts from a fitted model, by default "torque".

    For this objective only, the default of `adapt` in `values`, the values of `--set`, is set to "load". Raises
    UsageError if `adapt` is set with another objective.
    """
    objective = objective or "torque"
    if objective == "torque":
        values.setdefault("adapt", "load")
    elif "adapt" in values:
        raise UsageError(f"--set adapt: belongs to the objective torque, this fits {objective}")
    return objective


def fit_options(
    objective: str | None,
    values: Mapping[str, Any],
    defaults: TrainingSettings | None,
    *,
    warm_start: bool,
) -> FitOptions:
    """Return the options of a fit; the command line takes precedence over the robot's settings.

    Args:
        objective: value of `--objective`; None: the settings or the logs determine the objective.
        values: {key of `--set`: value}.
        defaults: the robot's settings; None for a resumed run, whose record has all options.
        warm_start: whether the fit starts from the parameters of an earlier run.
    """
    from spelgen.fitting.fit import FitOptions

    options = selected(values, OWNERS)
    if defaults is None:
        return FitOptions(objective, options)
    settings = dict(defaults.options)
    objective = objective or defaults.objective
    if warm_start and objective == "rollout":
        # In a warm start no torque fit precedes the rollout fit: a torque fit would discard the source run's
        # parameters.
        settings["torque_first"] = False
    if objective is None and TIME_LIMIT in options:
        # No objective is given: the logs determine the objective after this point, and some objectives have no time
        # limit. Among `options`, a time limit would then be an error; among `settings`, which are only default values,
        # it is ignored.
        settings[TIME_LIMIT] = options.pop(TIME_LIMIT)
    return FitOptions(objective, options, settings)
