"""FLEET.yaml: which arms, models, seeds and splits; checked key by key, as settings are."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

from pydantic import Field, StringConstraints

from spelgen.design import PRESET_NAMES
from spelgen.errors import SettingsError, collect, suggestion
from spelgen.settings.messages import dotted, validated
from spelgen.settings.training import TrainingSettings
from spelgen.settings.values import Count, Group
from spelgen.settings.yaml_document import Document, Location, read_document

Name = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,60}$")]


class FleetRobot(Group):
    """An arm: its URDF, and its logs; none: they are simulated, as `spelgen simulate` does.

    data: log files and folders. mapping: how these are named and measured; by default as the settings beside the URDF
    say. joints, tip: as for `spelgen build`.
    """

    urdf: Path
    data: tuple[Path, ...] = ()
    mapping: Path | None = None
    joints: tuple[str, ...] | None = None
    tip: str | None = None


class Fleet(Group):
    """Every arm with every preset, seed and split.

    splits: 1 takes train.* and test.* of the logs, or a quarter of the trajectories for the test where there are none;
    k: k-fold cross-validation over whole trajectories. training: options as in a robot's settings, for all.
    """

    robots: Annotated[dict[Name, FleetRobot], Field(min_length=1)]
    presets: Annotated[tuple[str, ...], Field(min_length=1)] = ("closed-form", "hybrid")
    seeds: Count = 1
    splits: Count = 1
    width: Count = 64
    depth: Count = 2
    training: TrainingSettings = Field(default_factory=TrainingSettings)


def load_fleet(path: Path) -> Fleet:
    """Return the fleet that a file describes; its paths are relative to its folder.

    Raises SettingsError, or SpelgenErrors with all that is wrong.
    """
    # YAML that knows its lines, for messages
    document = read_document(path)
    fleet = validated(Fleet, document.value(), document)
    collect([*_preset_errors(fleet, document), *_path_errors(fleet, document)])
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
