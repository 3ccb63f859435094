"""FLEET.yaml: which arms, models, seeds and splits; checked key by key, as settings are."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import date
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, StringConstraints, ValidationError, model_validator

from spelgen.design import PRESET_NAMES
from spelgen.errors import SettingsError, collect, suggestion
from spelgen.settings.messages import dotted, expected_text, explain
from spelgen.settings.training import TrainingSettings
from spelgen.settings.values import Count, Group, NonNegative, Number, Whole
from spelgen.settings.yaml_document import Document, Location, read_document

Name = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,60}$")]
SIZES = ("width", "depth")  # options of a module, beside those of its training
NOT_SEARCHED = ("prior", "seed", "objective")


class SearchedOptions(TrainingSettings):
    """Options that a search may vary."""

    width: Count = 64
    depth: Count = 2


class FleetRobot(Group):
    """An arm: its URDF, and its logs; none: they are simulated, as `spelgen simulate` does.

    data: log files and folders. mapping: how these are named and measured; by default as the settings beside the URDF
    say. joints, tip: as for `spelgen build`. day: of the logs, to tell how an arm's friction drifts.
    """

    urdf: Path
    data: tuple[Path, ...] = ()
    mapping: Path | None = None
    joints: tuple[str, ...] | None = None
    tip: str | None = None
    day: date | None = None


class Range(Group):
    """Numbers from low to high, whole ones between whole ones; log: as many between 1 and 10 as between 10 and 100."""

    low: Whole | Number
    high: Whole | Number
    log: bool = False

    @model_validator(mode="after")
    def _in_order(self) -> Range:
        if not self.low < self.high or (self.log and self.low <= 0):
            raise ValueError("low below high, and above 0 where log is true")
        return self


Choices = Annotated[tuple[Any, ...], Field(min_length=1)]


class Search(Group):
    """A search by Optuna (TPE) over options of training, and `width` and `depth`, for each arm and preset.

    over: a range, or a list of choices. trials: in all. at_once: that are chosen together, knowing of those before.
    """

    over: Annotated[dict[str, Range | Choices], Field(min_length=1)]
    trials: Count = 20
    at_once: Count = 4


class Fleet(Group):
    """Every arm with every preset, seed and split.

    splits: 1 takes train.* and test.* of the logs, or a quarter of the trajectories for the test where there are none;
    k: k-fold cross-validation over whole trajectories. training: options as in a robot's settings, for all. shared:
    arms of the same URDF are units of one: see `units.py`. gpus: what each run needs of one, 0: none.
    """

    robots: Annotated[dict[Name, FleetRobot], Field(min_length=1)]
    presets: Annotated[tuple[str, ...], Field(min_length=1)] = ("closed-form", "hybrid")
    seeds: Count = 1
    splits: Count = 1
    width: Count = 64
    depth: Count = 2
    training: TrainingSettings = Field(default_factory=TrainingSettings)
    search: Search | None = None
    shared: bool = False
    gpus: NonNegative = 0.0


def load_fleet(path: Path) -> Fleet:
    """Return the fleet that a file describes; its paths are relative to its folder.

    Raises SettingsError, or SpelgenErrors with all that is wrong.
    """
    # YAML that knows its lines, for messages
    document = read_document(path)
    content = document.value()
    try:
        fleet = Fleet.model_validate({} if content is None else content)
    except ValidationError as error:
        collect([explain(detail, document, Fleet) for detail in error.errors(include_url=False)])
        raise
    collect(
        [*_preset_errors(fleet, document), *_search_errors(fleet, document), *_path_errors(fleet, document)]
    )
    folder = path.parent
    presets = tuple(name if name in PRESET_NAMES else str(folder / name) for name in fleet.presets)
    robots = {name: _resolved(robot, folder) for name, robot in fleet.robots.items()}
    return fleet.model_copy(update={"robots": robots, "presets": presets})


def _resolved(robot: FleetRobot, folder: Path) -> FleetRobot:
    paths: dict[str, object] = {
        "urdf": folder / robot.urdf,
        "data": tuple(folder / path for path in robot.data),
    }
    if robot.mapping is not None:
        paths["mapping"] = folder / robot.mapping
    return robot.model_copy(update=paths)


def _preset_errors(fleet: Fleet, document: Document) -> Iterator[SettingsError]:
    for number, preset in enumerate(fleet.presets):
        if preset not in PRESET_NAMES and Path(preset).suffix not in (".yaml", ".yml"):
            yield _error(
                document, ("presets", number), f"unknown preset {preset!r}", suggestion(preset, PRESET_NAMES)
            )


def _search_errors(fleet: Fleet, document: Document) -> Iterator[SettingsError]:
    if fleet.search is None:
        return
    searchable = [name for name in SearchedOptions.model_fields if name not in NOT_SEARCHED]
    for name, candidates in fleet.search.over.items():
        location = ("search", "over", name)
        if name not in searchable:
            yield _error(document, location, f"unknown option {name!r}", suggestion(name, searchable))
            continue
        if isinstance(candidates, Range):
            candidates = (candidates.low, candidates.high)
        for value in candidates:
            try:
                SearchedOptions.model_validate({name: value})
            except ValidationError as error:
                expected = expected_text(error.errors()[0]["msg"])
                yield _error(document, location, repr(value), f"expected {expected}")


def _path_errors(fleet: Fleet, document: Document) -> Iterator[SettingsError]:
    for name, robot in fleet.robots.items():
        paths = [("urdf", robot.urdf), *(("data", path) for path in robot.data)]
        if robot.mapping is not None:
            paths.append(("mapping", robot.mapping))
        for key, path in paths:
            if not (document.path.parent / path).exists():
                yield _error(document, ("robots", name, key), f"no such file: {path}", "check the path")


def _error(document: Document, location: Location, got: str, do: str) -> SettingsError:
    return SettingsError(
        got, file=document.path, line=document.line(location), element=dotted(location), do=do
    )
