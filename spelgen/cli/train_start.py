"""What the command `train` fits, from its flags and the robot's settings, or the run that goes on."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from spelgen.cli.console import note
from spelgen.errors import RunError

if TYPE_CHECKING:
    from spelgen.emission.loading import EmittedModel
    from spelgen.logs.preprocessing import Preprocessing
    from spelgen.settings.fits import FitConfig
    from spelgen.settings.log_mapping import LogMapping


LIMIT = "max_minutes"


class NotApplicable(typer.BadParameter):
    """An option that belongs to something else than what is fitted."""

    def format_message(self) -> str:
        """The message as it is."""
        return self.message


@dataclass(frozen=True)
class Chosen:
    """What the command line says. fitted: the model that it begins with was fitted before."""

    objective: str | None
    flags: dict[str, Any]
    preprocessing: dict[str, Any]
    validation: float | None
    seed: int | None
    fitted: bool = False


@dataclass(frozen=True)
class Start:
    """What is fitted, and how: `config` makes it where the logs' sample rates are known."""

    module: Path
    config: Callable[[EmittedModel, Sequence[float] | None], FitConfig | None]
    preprocessing: Preprocessing
    validation: float
    seed: int
    mapping: LogMapping | None


def begun(module: Path, urdf: Path | None, chosen: Chosen) -> Start:
    """A new run: what the command line does not say, the robot's settings do."""
    from spelgen.fitting.stages import default_config, has_rigid_bodies
    from spelgen.logs.preprocessing import Preprocessing
    from spelgen.settings.fits import fit_config
    from spelgen.settings.settings import load_settings
    from spelgen.settings.training import TrainingSettings

    settings = TrainingSettings() if urdf is None else load_settings(urdf).training
    said = {name: value for name, value in chosen.preprocessing.items() if value is not None}
    objective = chosen.objective or settings.objective

    def config(model: EmittedModel, rates: Sequence[float] | None) -> FitConfig | None:
        rigid_bodies, defaults = has_rigid_bodies(model), settings.options
        if chosen.fitted and objective == "rollout" and rigid_bodies:
            defaults = {**defaults, "torque_first": False}  # which would begin anew
        if objective is not None:
            return fit_config(objective, rigid_bodies=rigid_bodies, options=chosen.flags, defaults=defaults)
        if rates is None and has_rigid_bodies(model):
            return None  # the logs decide
        flags, defaults = dict(chosen.flags), dict(defaults)
        if LIMIT in flags:  # whoever says it need not know what the logs will make of it
            defaults[LIMIT] = flags.pop(LIMIT)
        found = default_config(model, rates or [], flags, defaults)
        if LIMIT in chosen.flags and LIMIT not in type(found).model_fields:
            note(f"info: --max-minutes limits fits to windows; these logs are fitted by {found.objective}")
        return found

    return Start(
        module,
        config,
        Preprocessing(**(settings.preprocessing | said)),
        settings.validation_fraction if chosen.validation is None else chosen.validation,
        settings.seed if chosen.seed is None else chosen.seed,
        None,
    )


def resumed(folder: Path, chosen: Chosen) -> Start:
    """A run that goes on: what the command line does not say, the run does."""
    from spelgen.fitting.run_folder import RunFolder
    from spelgen.fitting.run_record import recorded_config
    from spelgen.fitting.stages import has_rigid_bodies
    from spelgen.logs.preprocessing import Preprocessing
    from spelgen.settings.fits import fit_config
    from spelgen.settings.log_mapping import LogMapping

    run = RunFolder(folder)
    before = run.read_config()
    said = {name: value for name, value in chosen.preprocessing.items() if value is not None}
    if before["validation_fraction"] is None and before["objective"] != "servo":  # which needs none
        raise RunError(
            "a run with validation logs that were given in memory", file=folder,
            do="go on with spelgen.fit(..., folder=..., resume=True)",
        )  # fmt: skip

    def config(model: EmittedModel, rates: Sequence[float] | None) -> FitConfig:
        if chosen.objective not in (None, before["objective"]):
            return fit_config(chosen.objective, rigid_bodies=has_rigid_bodies(model), options=chosen.flags)
        found = recorded_config(before, **chosen.flags)
        found.require(rigid_bodies=has_rigid_bodies(model))
        return found

    return Start(
        run.module,
        config,
        Preprocessing(**(before["preprocessing"] | said)),
        before["validation_fraction"] if chosen.validation is None else chosen.validation,
        before["seed"] if chosen.seed is None else chosen.seed,
        LogMapping(**before["mapping"]),
    )
