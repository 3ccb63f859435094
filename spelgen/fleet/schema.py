"""FLEET.yaml: which arms, models, seeds and splits; checked key by key, as settings are."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import Field, StringConstraints

from spelgen.design import PRESET_NAMES
from spelgen.errors import SettingsError, collect, suggestion
from spelgen.settings.messages import dotted, validated
from spelgen.settings.training import TrainingSettings
from spelgen.settings.values import Count, Group
from spelgen.settings.yaml_document import Location, read_document

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

    def paths(self) -> list[tuple[str, Path]]:
        """Return its files, each with its key."""
        paths = [("urdf", self.urdf), *(("data", path) for path in self.data)]
        if self.mapping is not None:
            paths.append(("mapping", self.mapping))
        return paths

    def in_folder(self, folder: Path) -> FleetRobot:
        """Return it with paths that are relative to the folder."""
        mapping = self.mapping and folder / self.mapping
        data = tuple(folder / path for path in self.data)
        return self.model_copy(update={"urdf": folder / self.urdf, "data": data, "mapping": mapping})


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
    problems: list[tuple[Location, str, str]] = []
    for number, preset in enumerate(fleet.presets):
        if preset not in PRESET_NAMES and Path(preset).suffix not in (".yaml", ".yml"):
            hint = suggestion(preset, PRESET_NAMES)
            problems.append((("presets", number), f"unknown preset {preset!r}", hint))
    for name, robot in fleet.robots.items():
        for key, file in robot.paths():
            if not (path.parent / file).exists():
                problems.append((("robots", name, key), f"no such file: {file}", "check the path"))
    errors = []
    for place, got, do in problems:
        line = document.line(place)
        errors.append(SettingsError(got, file=path, line=line, element=dotted(place), do=do))
    collect(errors)
    presets = tuple(name if name in PRESET_NAMES else str(path.parent / name) for name in fleet.presets)
    robots = {name: robot.in_folder(path.parent) for name, robot in fleet.robots.items()}
    return fleet.model_copy(update={"robots": robots, "presets": presets})
