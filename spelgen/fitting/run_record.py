"""What the files of a run folder must hold to be read, for they may come from elsewhere, and to be resumed."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from spelgen.errors import RunError, SpelgenError
from spelgen.logs.preprocessing import Preprocessing
from spelgen.settings.fits import CONFIGS, FitConfig, Objective, Substeps
from spelgen.settings.log_mapping import LogMapping
from spelgen.settings.messages import validated
from spelgen.settings.values import Count, NonNegative, Positive, Whole

Content = dict[str, Any]
"""What a file of a run folder holds, by key: JSON, or what torch saves."""
ReadContent = Mapping[str, Any]
"""The same, only read."""

Schema = TypeVar("Schema", bound=BaseModel)
MAY_CHANGE = ("epochs", "patience", "max_minutes")  # between a run and its resumption


class Record(BaseModel):
    """config.json; the configuration itself is checked by its own class."""

    robot: str
    joints: list[str]
    objective: Objective
    config: dict[str, object]
    preprocessing: Preprocessing
    validation_fraction: float | None
    seed: Whole
    data_digest: str
    training: list[str]
    validation: list[str]
    mapping: LogMapping


class Checkpoint(BaseModel):
    """The plain numbers of checkpoint.pt; what else it holds are states that torch checks when it takes them."""

    epoch: Whole
    step: Whole
    best_epoch: Whole
    best_loss: float
    seconds: NonNegative
    substeps: Substeps
    best_weights: dict[str, object]
    # of fits to windows alone
    rollbacks: Whole = 0
    learning_rate_factor: Positive = 1.0
    momentum_done: bool = True


class Epoch(BaseModel):
    """A line of metrics.jsonl."""

    epoch: Count
    step: Count
    loss: float
    validation: float
    best: float
    seconds: NonNegative


def require(schema: type[Schema], content: object, file: Path, line: int | None = None) -> Schema:
    """Return the content as the schema has it. Raises RunError where a key is missing or not of its kind."""
    try:
        return schema.model_validate(content)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        key = ".".join(map(str, first["loc"]))
        message = f"{key}: {first['msg']}".removeprefix(": ")
        raise RunError(
            message, file=file, line=line, do="restore it from a copy, or start a new run"
        ) from error
    except SpelgenError as error:
        raise RunError(str(error), file=file, line=line) from error


def require_record(content: Content, file: Path) -> Content:
    """Return what config.json says. Raises RunError as `require`, and for a configuration that cannot be."""
    record = require(Record, content, file)
    try:
        validated(CONFIGS[record.objective], record.config)
    except SpelgenError as error:
        raise RunError(f"config: {error}", file=file) from error
    return content


def recorded_config(record: Content, **changed: object) -> FitConfig:
    """Return the configuration in config.json, with some options changed. Raises OptionError as `FitConfig`."""
    return validated(CONFIGS[record["objective"]], record["config"] | changed)


def require_same(started: Content, now: Content, folder: Path) -> None:
    """Raise RunError where a run would be resumed with other data or settings than it was started with."""
    if started["data_digest"] != now["data_digest"]:
        raise RunError(
            "other logs than the run was started with",
            file=folder,
            do="give the same --data or start a new run",
        )
    before, after = _settings(started), _settings(now)
    changed = []
    for name in before | after:
        if name not in MAY_CHANGE and before.get(name) != after.get(name):
            changed.append(f"{name} {after.get(name)} instead of {before.get(name)}")
    if changed:
        raise RunError(
            ", ".join(changed),
            file=folder,
            expected="the settings the run was started with",
            do="or start a new run",
        )


def _settings(record: Content) -> dict[str, object]:
    settings = {name: record.get(name) for name in ("objective", "validation_fraction", "seed")}
    return {**record["config"], **record["preprocessing"], **settings}
