"""The arms and models of a comparison: one URDF with options, or a YAML file that lists arms; and their logs."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import yaml
from lxml import etree
from pydantic import Field, StringConstraints

from spelgen.arm.configured_arm import load_arm
from spelgen.design import PRESET_NAMES, Design, load_design
from spelgen.errors import LogError, RunError, SettingsError, collect, suggestion
from spelgen.files import read_json, remove, write_bytes, write_json, write_text
from spelgen.logs.arm_mapping import log_source
from spelgen.logs.formats import log_files
from spelgen.logs.read import read_logs, write_logs
from spelgen.logs.trajectory import Trajectory, set_aside
from spelgen.logs.windows import split_validation
from spelgen.settings.log_mapping import LogMapping
from spelgen.settings.training import TrainingSettings
from spelgen.settings.values import Count, Group
from spelgen.settings.yaml_document import Location, dotted, read_document, validated

if TYPE_CHECKING:
    from spelgen.arm.configured_arm import Arm


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
        yield from (("data", path) for path in self.data)
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
    errors = []
    for location, got, do in _contradictions(comparison, path.parent):
        element, line = dotted(location), document.line(location)
        errors.append(SettingsError(got, file=path, line=line, element=element, do=do))
    collect(errors)
    arms = {name: arm.in_folder(path.parent) for name, arm in comparison.arms.items()}
    # names of presets are no paths
    presets = comparison.presets
    if presets is not None:
        presets = tuple(str(path.parent / name) if _is_file(name) else name for name in presets)
    return comparison.model_copy(update={"arms": arms, "presets": presets})


def _is_file(preset: str) -> bool:
    return Path(preset).suffix in YAML


def _contradictions(comparison: Comparison, folder: Path) -> Iterator[tuple[Location, str, str]]:
    """Yield location, error and advice for each unknown preset and for each file that the folder does not have."""
    for number, preset in enumerate(comparison.presets or ()):
        if preset not in (*PRESET_NAMES, *ablation_designs()) and not _is_file(preset):
            yield ("presets", number), f"unknown preset {preset!r}", suggestion(preset, PRESET_NAMES)
    for name, arm in comparison.arms.items():
        for key, file in arm.files():
            if not (folder / file).exists():
                yield ("arms", name, key), f"no such file: {file}", "check the path"


Progress = Callable[[int, int], None]


class ArmInputs(ComparedArm):
    """Files that the runs of an arm read.

    urdf: URDF that models are built from. truth: URDF of the simulated arm; None if the logs are the user's. digest: of
    the URDF, settings and logs.
    """

    truth: Path | None = None
    digest: str

    def load(self) -> Arm:
        """Return the arm that models are built from."""
        return load_arm(self.urdf, self.joints, self.tip)

    def log_mapping(self) -> LogMapping:
        """Return the columns and units of the logs."""
        return log_source(self.load(), self.mapping).mapping

    def split(self, number: int, splits: int) -> tuple[list[Trajectory], list[Trajectory]]:
        """Return training and test trajectories of one of `splits` splits. Raises LogError.

        The test trajectories are test.* of the logs or a quarter of all; of several splits, one fold of a k-fold
        cross-validation. They are chosen by a fixed seed, so all models have the same.
        """
        # loaded again in each worker: paths are sent to it instead of arms
        arm = self.load()
        train = read_logs(self.data, arm, self.mapping, "train")
        test = []
        if log_files(self.data, "train") != log_files(self.data):
            test = read_logs(self.data, arm, self.mapping, "test")
        if splits == 1 and test:
            return train, test
        logs = [*train, *test]
        if splits == 1:
            # a quarter for testing, as the logs have no test.* files
            held_out = split_validation(logs, 0.25, 0)
            return list(held_out.training), list(held_out.validation)
        if len(logs) < splits:
            expected = f"{splits} or more, for as many splits"
            raise LogError(f"{len(logs)} trajectories", element="data", expected=expected)
        # whole trajectories: samples of one trajectory are correlated, and a split within it would leak
        folds = np.array_split(np.random.default_rng(0).permutation(len(logs)), splits)
        return set_aside(logs, folds[number])


def arm_inputs(
    arm: ComparedArm, folder: Path, splits: int = 1, progress: Progress | None = None
) -> ArmInputs:
    """Return the inputs of an arm's runs; the logs of an arm without logs are simulated into the folder.

    Raises the errors of `load_arm`, `load_mapping`, `read_logs` and `simulate`, before anything is trained.
    """
    loaded = load_arm(arm.urdf, arm.joints, arm.tip)
    mapping = log_source(loaded, arm.mapping).mapping
    files, errors = log_files(arm.data)
    collect(errors)
    # these keys of the settings change no run
    apart: dict[str, bool | set[str]] = {"about": True, "comparison": {"seeds", "published"}}
    settings = [loaded.settings.model_dump_json(exclude_unset=True, exclude=apart)]
    settings.append(mapping.model_dump_json(exclude_unset=True))
    # size and time in place of the content: logs may have gigabytes
    versions = [(file, file.stat().st_size, file.stat().st_mtime_ns) for file in files]
    sources = json.dumps((loaded.robot.digest, arm.joints, arm.tip, settings, versions), default=str)
    inputs = ArmInputs(**dict(arm), digest=hashlib.sha256(sources.encode()).hexdigest()[:16])
    if not arm.data:
        changes = {"urdf": folder / "known.urdf", "truth": arm.urdf, "data": (folder,)}
        inputs = inputs.model_copy(update=changes | {"joints": loaded.joints, "tip": loaded.tip})
        _simulate(inputs, loaded, folder, progress)
    # too few logs are an error now and not after hours of training
    inputs.split(0, splits)
    return inputs


def _simulate(inputs: ArmInputs, loaded: Arm, folder: Path, progress: Progress | None) -> None:
    """Simulate logs by the protocol of the arm's settings, unless they are in the folder.

    Models know only a copy of the URDF without inertials, drives and friction, so that no model starts from the truth.
    """
    # Pinocchio is an extra, not needed for the user's own logs
    from spelgen.simulation.simulate import simulate

    if loaded.settings.input == "position":
        raise SettingsError(
            "position servos", file=loaded.robot.path.with_suffix(".yaml"), element="input",
            expected="torques: the simulated protocol has no commands",
            do="give logs of the arm with --data",
        )  # fmt: skip
    # written last: without it the other files may be incomplete
    complete = folder / "inputs.json"
    if complete.exists() and read_json(complete, RunError) == {"digest": inputs.digest}:
        return
    remove(complete)
    logs = simulate(loaded, progress=progress)
    training, first = list(logs.train), loaded.settings.comparison.first
    if first is not None:
        training = [log[: int((log.t - log.t[0] < first - 1e-9).sum())] for log in training]
    write_logs(folder / "train.parquet", training, loaded.chain.joint_names)
    write_logs(folder / "test.parquet", logs.test, loaded.chain.joint_names)
    write_bytes(inputs.urdf, _kinematics(loaded.robot.path))
    write_text(inputs.urdf.with_suffix(".yaml"), yaml.safe_dump({"gravity": list(loaded.settings.gravity)}))
    write_json(complete, {"digest": inputs.digest})


def _kinematics(urdf: Path) -> bytes:
    """Return a URDF without inertials, friction, visuals and collision bodies."""
    # `load_arm` has read this file, so its size and entities have been checked
    parser = etree.XMLParser(resolve_entities=False, no_network=True, remove_comments=True)
    tree = etree.ElementTree(etree.fromstring(urdf.read_bytes(), parser))
    for element in list(tree.iter("dynamics", "visual", "collision", "inertial")):
        element.getparent().remove(element)
    return bytes(etree.tostring(tree, xml_declaration=True, encoding="utf-8"))
