"""What the files of a run folder must hold to be read: they may come from elsewhere, or from another version."""

from __future__ import annotations

from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from spelgen.errors import RunError, SpelgenError
from spelgen.logs.preprocessing import Preprocessing
from spelgen.settings.fits import CONFIGS, Objective, Substeps, made
from spelgen.settings.log_mapping import LogMapping
from spelgen.settings.values import Count, NonNegative, Positive, Whole

Schema = TypeVar("Schema", bound=BaseModel)


class Record(BaseModel):
    """config.json; the configuration itself is checked by its own class."""

    robot: str
    joints: list[str]
    objective: Objective
    config: dict[str, Any]
    preprocessing: Preprocessing
    validation_fraction: float | None
    seed: Whole
    data_digest: str
    training: list[str]
    validation: list[str]
    mapping: LogMapping


class Counters(BaseModel):
    """The plain numbers of checkpoint.pt; what else it holds are states that torch checks when it takes them."""

    epoch: Whole
    step: Whole
    best_epoch: Whole
    best_loss: float
    seconds: NonNegative
    substeps: Substeps
    best_weights: dict[str, Any]
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


def require_record(found: dict[str, Any], file: Path) -> dict[str, Any]:
    """What config.json says; RunError where a key is lost or not of its kind."""
    checked = _checked(Record, found, file)
    try:
        made(CONFIGS[checked.objective], checked.config)
    except SpelgenError as error:
        raise RunError(f"config: {error}", file=file) from error
    return found


def require_checkpoint(found: dict[str, Any], file: Path) -> dict[str, Any]:
    """What checkpoint.pt says; RunError where a number is lost or not of its kind."""
    _checked(Counters, found, file)
    return found


def require_epoch(found: Any, file: Path, line: int) -> dict[str, Any]:
    """What a line of metrics.jsonl says; RunError where it is none."""
    _checked(Epoch, found, file, line)
    return dict(found)


def _checked(schema: type[Schema], found: Any, file: Path, line: int | None = None) -> Schema:
    try:
        return schema.model_validate(found)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        told = f"{'.'.join(map(str, first['loc']))}: {first['msg']}".removeprefix(": ")
        raise RunError(told, file=file, line=line, do="restore it from a copy, or start a new run") from error
    except SpelgenError as error:
        raise RunError(str(error), file=file, line=line) from error
