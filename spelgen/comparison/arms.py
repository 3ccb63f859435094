"""The arms and models of a comparison: one URDF with options, or a YAML file that lists arms."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Annotated

from pydantic import Field, StringConstraints

from spelgen.design import PRESET_NAMES, Design, load_design
from spelgen.errors import SettingsError, collect, suggestion
from spelgen.settings.training import TrainingSettings
from spelgen.settings.values import Count, Group
from spelgen.settings.yaml_document import Location, YamlDocument, dotted, read_document, validated

YAML = (".yaml", ".yml")
Name = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,60}$")]


class ComparedArm(Group):
    """An arm: its URDF and logs. Without logs the arm is simulated by the protocol of its settings.

    data: log files and folders. mapping: YAML file with columns and units of the logs; default: the settings of
    the URDF. joints, tip: as for `spelgen build`.
    """

    urdf: Path
    data: tuple[Path, ...] = ()
    mapping: Path | None = None
    joints: tuple[str, ...] | None = None
    tip: str | None = None

    def files(self) -> Iterator[tuple[str, Path]]:
        """Yield each path with its key."""
        yield "urdf", self.urdf
        for path in self.data:
            yield "data", path
        if self.mapping is not None:
            yield "mapping", self.mapping

    def in_folder(self, folder: Path) -> ComparedArm:
        """Return the arm with its relative paths resolved against a folder."""
        mapping = None if self.mapping is None else folder / self.mapping
        data = tuple(folder / path for path in self.data)
        return self.model_copy(update={"urdf": folder / self.urdf, "data": data, "mapping": mapping})


class Comparison(Group):
    """Every preset on every arm, with every seed and split.

    presets: names or YAML files of designs; default: closed-form and hybrid on logs, all presets on a simulated arm.
    seeds: runs with the seeds 0, 1, ...; default: 1 on logs, `comparison.seeds` of the arm's settings if simulated.
    splits: 1 uses train.* and test.* of the logs, or holds out a quarter of the trajectories; k: k-fold
    cross-validation over whole trajectories. width, depth: of hidden layers. training: options as in a robot's
    settings, for all arms. steps: training steps on simulated arms.
    """

    arms: Annotated[dict[Name, ComparedArm], Field(min_length=1)]
    presets: Annotated[tuple[str, ...], Field(min_length=1)] | None = None
    seeds: Count | None = None
    splits: Count = 1
    width: Count | None = None
    depth: Count | None = None
    training: TrainingSettings = Field(default_factory=TrainingSettings)
    steps: Count | None = None


def ablation_designs() -> dict[str, str | Design]:
    """Return designs from phnode to hybrid that differ by one change each, by name."""
    friction = replace(load_design("phnode"), dissipation="per-joint")
    inputs = replace(friction, input="derived")
    return {
        "phnode": "phnode",
        "per-joint-friction": friction,
        "known-inputs": inputs,
        "fewest-outputs": replace(inputs, mass="derived"),
        "minimal": "minimal",
        "hybrid": "hybrid",
    }


def load_comparison(path: Path) -> Comparison:
    """Return the comparison in a YAML file; its paths are relative to the file's folder.

    Raises SettingsError, or SpelgenErrors with all errors of the file.
    """
    document = read_document(path)
    comparison = validated(Comparison, document.value(), document)
    collect([*_unknown_presets(comparison, document), *_missing_files(comparison, document)])
    arms = {name: arm.in_folder(path.parent) for name, arm in comparison.arms.items()}
    presets = comparison.presets
    if presets is not None:
        presets = tuple(str(path.parent / name) if _is_file(name) else name for name in presets)
    return comparison.model_copy(update={"arms": arms, "presets": presets})


def _is_file(preset: str) -> bool:
    return Path(preset).suffix in YAML


def _unknown_presets(comparison: Comparison, document: YamlDocument) -> Iterator[SettingsError]:
    for number, preset in enumerate(comparison.presets or ()):
        if preset not in (*PRESET_NAMES, *ablation_designs()) and not _is_file(preset):
            hint = suggestion(preset, PRESET_NAMES)
            yield _error(document, ("presets", number), f"unknown preset {preset!r}", hint)


def _missing_files(comparison: Comparison, document: YamlDocument) -> Iterator[SettingsError]:
    for name, arm in comparison.arms.items():
        for key, file in arm.files():
            if not (document.path.parent / file).exists():
                yield _error(document, ("arms", name, key), f"no such file: {file}", "check the path")


def _error(document: YamlDocument, place: Location, got: str, do: str) -> SettingsError:
    return SettingsError(got, file=document.path, line=document.line(place), element=dotted(place), do=do)
