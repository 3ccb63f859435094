"""Typed contents of a run folder's files, checked when they are read, since the folder may come from another person."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal, TypeVar

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    InstanceOf,
    ValidationError,
    ValidationInfo,
    field_serializer,
    field_validator,
)

from spelgen.errors import RunError, SettingsError, SpelgenError
from spelgen.labels import LAST_PART
from spelgen.logs.preprocessing import Preprocessing
from spelgen.settings.fits import CONFIGS, FitConfig, Objective, Substeps
from spelgen.settings.log_mapping import LogMapping
from spelgen.settings.yaml_document import Count, NonNegative, Positive, Whole, validated

Content = dict[str, Any]
"""Content of a file of a run folder, key -> value: a JSON object, or a dictionary that torch saved."""

Schema = TypeVar("Schema", bound=BaseModel)
MAY_CHANGE = ("epochs", "patience", "max_minutes")  # options that may differ when a run is resumed


class Record(BaseModel):
    """The record of a fit in config.json: the data, the settings with all defaults resolved, and the results.

    Attributes:
        config: the options that apply to the model; the type depends on the objective.
        joints: names in the order of q.
        validation_fraction: fraction of the logs for validation; None if validation logs were given.
        data_digest: SHA-256 of all numbers of the logs.
        training, validation: names of the trajectories.
        fingerprints: {name of a recording: hashes of its samples}; the hashes show whether a test log was also fitted.
        scales: divisors of the errors in the validation loss.
        mapping: names and units of the columns of the logs.
        servo: parameters of position servos with intervals; None unless a fit of servos has finished.
        notes: messages of the torque fit for the user.
        warnings: warnings about the logs and the links of the URDF.
    """

    model_config = ConfigDict(frozen=True)

    version: Literal[2] = Field(default=2, alias="schema")
    robot: str
    preset: str | None = None
    joints: list[str]
    objective: Objective
    config: FitConfig
    preprocessing: Preprocessing
    validation_fraction: float | None
    seed: Whole
    data_digest: str
    training: list[str]
    validation: list[str]
    fingerprints: dict[str, list[int]] = {}
    training_windows: Whole = 0
    validation_windows: Whole = 0
    scales: Content | None = None
    mapping: LogMapping
    device: str = "cpu"
    threads: int = 1
    servo: Content | None = None
    notes: list[str] = []
    warnings: list[str] = []

    @field_validator("config", mode="before")
    @classmethod
    def _of_the_objective(cls, options: object, info: ValidationInfo) -> object:
        """Return the options of a fit as an object of the class of the fit's objective, for example `TorqueFit`."""
        # `info.data` has no objective if the objective is invalid. pydantic reports the invalid objective, so the
        # options need no check.
        if "objective" not in info.data:
            return FitConfig()
        try:
            return validated(CONFIGS[info.data["objective"]], options)
        except SpelgenError as error:
            raise SettingsError(f"config: {error}") from error

    @field_serializer("config")
    def _options(self, config: FitConfig) -> Content:
        return config.model_dump(mode="json", exclude_unset=True)

    @field_serializer("mapping")
    def _mapping(self, mapping: LogMapping) -> Content:
        return mapping.model_dump(mode="json", exclude_defaults=True)

    @property
    def options(self) -> Content:
        """The options of the recorded fit by name, as JSON."""
        return self._options(self.config)

    @property
    def trajectories(self) -> int:
        """Number of trajectories; a trajectory that was cut into training and validation counts once."""
        return len(self.training) + sum(not name.endswith(LAST_PART) for name in self.validation)

    def to_dict(self) -> Content:
        """Return the content of config.json."""
        return self.model_dump(mode="json", by_alias=True, exclude_unset=True)

    def require_same_run(self, resumed: Record, folder: Path) -> None:
        """Raise RunError if ``resumed``, the record of a resumed fit, has other logs or options than this record.

        The options in `MAY_CHANGE` may differ.
        """
        if self.data_digest != resumed.data_digest:
            do = "give the same --data or start a new run"
            raise RunError("other logs than the run was started with", file=folder, do=do)
        original, changed_settings = self._settings(), resumed._settings()
        changed = []
        for name in original | changed_settings:
            if name not in MAY_CHANGE and original.get(name) != changed_settings.get(name):
                changed.append(f"{name} {changed_settings.get(name)} instead of {original.get(name)}")
        if changed:
            expected, do = "the settings the run was started with", "or start a new run"
            raise RunError(", ".join(changed), file=folder, expected=expected, do=do)

    def _settings(self) -> Content:
        settings = self.model_dump(include={"objective", "validation_fraction", "seed"})
        return {**self.options, **asdict(self.preprocessing), **settings}


class Checkpoint(BaseModel):
    """The content of checkpoint.pt: the progress of a fit, and the state from which its objective resumes.

    Attributes:
        seconds: duration of the fit [s].
        substeps: integrator steps per sample interval.
        torque_nmse: mean squared torque error divided by the variance of the torque, per joint.
        posterior: covariance of the parameters and RMS torque residual (see `posterior_of`), only for rigid bodies
            fitted to torques, or to positions under position servos.
        rollbacks: number of repeated epochs of a fit to windows.
        learning_rate_factor: factor on the learning rate after these repetitions.
        momentum_done: whether the first stage, the minimization of `momentum_loss`, has ended.

    Further keys are states of an objective; torch checks their content when `resume` loads them.
    """

    model_config = ConfigDict(frozen=True, extra="allow")

    epoch: Whole
    step: Whole
    best_epoch: Whole
    best_loss: float
    seconds: NonNegative
    substeps: Substeps
    best_weights: InstanceOf[dict]  # type: ignore[type-arg]
    torque_nmse: list[float] = []
    posterior: InstanceOf[dict] | None = None  # type: ignore[type-arg]
    rollbacks: Whole = 0
    learning_rate_factor: Positive = 1.0
    momentum_done: bool = True

    @property
    def content(self) -> Content:
        """All keys and values of the file; tensors are not copied."""
        return {name: value for name, value in self if name in self.model_fields_set}


class Epoch(BaseModel):
    """A line of metrics.jsonl: the state of a fit after an epoch.

    Attributes:
        step: number of optimizer steps so far.
        loss: mean training loss.
        validation: validation loss.
        best: lowest validation loss so far.
        seconds: duration of the fit so far [s].
    """

    epoch: Count
    step: Count
    loss: float
    validation: float
    best: float
    seconds: NonNegative


def require(schema: type[Schema], content: object, file: Path, line: int | None = None) -> Schema:
    """Return the content of a file as an object of the schema.

    line: line of the content in the file, for the error. Raises RunError if a key is absent or has another type.
    """
    try:
        return schema.model_validate(content)
    except ValidationError as error:
        # only the first error is reported: a file that a fit wrote has no error
        first = error.errors(include_url=False)[0]
        key = ".".join(map(str, first["loc"]))
        message = f"{key}: {first['msg']}".removeprefix(": ")
        raise RunError(
            message, file=file, line=line, do="restore it from a copy, or start a new run"
        ) from error
    except SpelgenError as error:
        raise RunError(str(error), file=file, line=line) from error
