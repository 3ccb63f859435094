"""config.json of a run folder: what was fitted to what, and how; what a resumed run must agree with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from spelgen.dynamics.protocol import has_rigid_bodies
from spelgen.errors import RunError
from spelgen.fitting.dataset import TrainingData
from spelgen.fitting.run_folder import RunFolder
from spelgen.logs.trajectory import Trajectory
from spelgen.settings.fits import CONFIGS, FitConfig, WindowConfig, made
from spelgen.settings.log_mapping import LogMapping
from spelgen.spec import logged_joints

if TYPE_CHECKING:
    from spelgen.emission.loading import EmittedModel

MAY_CHANGE = ("epochs", "patience", "max_minutes", "compile")  # between a run and its resumption


def describe(
    model: EmittedModel,
    config: WindowConfig,
    data: TrainingData,
    *,
    seed: int,
    validation: float | Sequence[Trajectory],
    mapping: LogMapping | None,
) -> dict[str, Any]:
    """What goes into config.json: options that were used, resolved, and nothing that does not apply."""
    facts = getattr(model, "facts", None)
    return {
        "schema": 2,
        "robot": facts.robot if facts else type(model).__name__,
        "preset": facts.options.preset if facts else None,
        "joints": list(logged_joints(model)),
        "objective": config.objective,
        "config": config.record(rigid_bodies=has_rigid_bodies(model)),
        "preprocessing": asdict(data.preprocessing),
        "validation_fraction": validation if isinstance(validation, float) else None,
        "seed": seed,
        "data_digest": data.digest,
        "training": list(data.training_names),
        "validation": list(data.validation_names),
        "training_windows": data.size,
        "validation_windows": len(data.validation),
        "scales": {name: getattr(data.scales, name).tolist() for name in ("q", "qd", "tau")},
        "mapping": (mapping or LogMapping()).model_dump(exclude_defaults=True),
    }


def recorded_config(record: dict[str, Any], **changed: Any) -> FitConfig:
    """The configuration in config.json, with some options changed. Raises OptionError where these do not apply."""
    return made(CONFIGS[record["objective"]], record["config"] | changed)


def require_same(run: RunFolder, now: dict[str, Any]) -> None:
    """Refuse to resume with other data or settings than the run was started with."""
    started = run.read_config()
    if started["data_digest"] != now["data_digest"]:
        raise RunError(
            "other logs than the run was started with",
            file=run.path,
            do="give the same --data or start a new run",
        )
    before, after = _settings(started), _settings(now)
    changed = [
        name for name in before | after if name not in MAY_CHANGE and before.get(name) != after.get(name)
    ]
    if changed:
        told = ", ".join(f"{name} {after.get(name)} instead of {before.get(name)}" for name in changed)
        raise RunError(
            told, file=run.path, expected="the settings the run was started with", do="or start a new run"
        )


def _settings(record: dict[str, Any]) -> dict[str, Any]:
    own = {name: record.get(name) for name in ("objective", "validation_fraction", "seed")}
    return record["config"] | record["preprocessing"] | own
