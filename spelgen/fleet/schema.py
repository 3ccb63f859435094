"""FLEET.yaml: which arms, models, seeds and splits; checked key by key, as settings are."""

from __future__ import annotations

from datetime import date
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, StringConstraints, ValidationError, model_validator

from spelgen.design import PRESET_NAMES
from spelgen.errors import SettingsError, SpelgenError, collect, suggestion
from spelgen.settings.messages import explain
from spelgen.settings.training import TrainingSettings
from spelgen.settings.values import Count, Group, NonNegative, Number, Whole
from spelgen.settings.yaml_document import Document, read_document

Name = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,60}$")]


class _Searched(TrainingSettings):
    """What a search may vary."""

    width: Count = 64
    depth: Count = 2


SEARCHED = tuple(x for x in _Searched.model_fields if x not in ("prior", "seed", "objective"))


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
    """What is run: every arm with every preset, seed and split.

    splits: 1 takes train.* and test.* of the logs, or a quarter of the trajectories for the test where there are none;
    k: k-fold cross-validation over whole trajectories. training: options as in a robot's settings, for all. shared:
    arms of the same URDF are units of one: see `shared.py`. gpus: what each run needs of one, 0: none.
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
    """The fleet that a file describes; its paths are relative to its folder. Raises SettingsError, or SpelgenErrors."""
    document = read_document(path)
    content = document.value()
    try:
        fleet = Fleet.model_validate({} if content is None else content)
    except ValidationError as error:
        collect([explain(each, document, Fleet) for each in error.errors(include_url=False)])
        raise
    collect([*_unknown(fleet, document)])
    folder = path.parent
    robots = {name: _within(robot, folder) for name, robot in fleet.robots.items()}
    presets = tuple(x if x in PRESET_NAMES else str(folder / x) for x in fleet.presets)
    return fleet.model_copy(update={"robots": robots, "presets": presets})


def _within(robot: FleetRobot, folder: Path) -> FleetRobot:
    return robot.model_copy(
        update={
            "urdf": folder / robot.urdf,
            "data": tuple(folder / each for each in robot.data),
            "mapping": None if robot.mapping is None else folder / robot.mapping,
        }
    )


def _unknown(fleet: Fleet, document: Document) -> list[SpelgenError]:
    """Names that the file speaks of and nothing has."""
    errors: list[SpelgenError] = []

    def wrong(location: tuple[Any, ...], got: str, known: tuple[str, ...], do: str | None = None) -> None:
        errors.append(
            SettingsError(
                got, file=document.path, line=document.line(location), element=".".join(map(str, location)),
                do=do or suggestion(str(location[-1]), known),
            )
        )  # fmt: skip

    for number, preset in enumerate(fleet.presets):
        if preset not in PRESET_NAMES and Path(preset).suffix not in (".yaml", ".yml"):
            wrong(
                ("presets", number),
                f"unknown preset {preset!r}",
                PRESET_NAMES,
                suggestion(preset, PRESET_NAMES),
            )
    for name, among in () if fleet.search is None else fleet.search.over.items():
        if name not in SEARCHED:
            wrong(("search", "over", name), f"unknown option {name!r}", SEARCHED)
            continue
        for value in (among.low, among.high) if isinstance(among, Range) else among:
            try:
                _Searched.model_validate({name: value})
            except ValidationError as error:
                expected = error.errors()[0]["msg"].removeprefix("Input should be ")
                wrong(("search", "over", name), repr(value), (), f"expected {expected}")
    for name, robot in fleet.robots.items():
        for key, paths in (("urdf", [robot.urdf]), ("data", robot.data), ("mapping", [robot.mapping])):
            for each in paths:
                if each is not None and not (document.path.parent / each).exists():
                    wrong(("robots", name, key), f"no such file: {each}", (), "check the path")
    return errors
