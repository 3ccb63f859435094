"""config.json of a run folder: what was fitted to what, and how; what a resumed run must agree with."""

from __future__ import annotations

from typing import Any

from spelgen.errors import RunError
from spelgen.fitting.run_folder import RunFolder
from spelgen.settings.fits import CONFIGS, FitConfig, made

MAY_CHANGE = ("epochs", "patience", "max_minutes", "compile")  # between a run and its resumption


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
