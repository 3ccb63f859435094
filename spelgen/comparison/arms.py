"""The arms, models and logs of a comparison, which is specified by a URDF with options, or by a YAML file."""

import hashlib
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Self

import numpy as np
import yaml
from lxml import etree
from pydantic import Field, StringConstraints

from spelgen.arm.configured_arm import Arm, load_arm
from spelgen.design import PRESET_NAMES
from spelgen.errors import LogError, RunError, SettingsError, collect, suggestion
from spelgen.files import read_json, remove, write_bytes, write_json, write_text
from spelgen.logs.arm_mapping import log_source
from spelgen.logs.formats import log_files
from spelgen.logs.read import read_logs, write_logs
from spelgen.logs.trajectory import Trajectory, set_aside
from spelgen.logs.windows import split_validation
from spelgen.settings.log_mapping import LogMapping
from spelgen.settings.training import TrainingSettings
from spelgen.settings.yaml_document import Count, Group, Location, dotted, read_document, validated

YAML = (".yaml", ".yml")
Name = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,60}$")]


class ComparedArm(Group):
    """An arm of a comparison. Without logs the arm is simulated by the protocol of its settings.

    data: log files and folders. mapping: YAML file with columns and units of the logs; by default the mapping in the
    settings of the URDF. joints, tip: selection of the arm in the URDF, as for `spelgen build`.
    """

    urdf: Path
    data: tuple[Path, ...] = ()
    mapping: Path | None = None
    joints: tuple[str, ...] | None = None
    tip: str | None = None

    def in_folder(self, folder: Path) -> Self:
        """Return the arm with its relative paths resolved against a folder."""
        mapping = None if self.mapping is None else folder / self.mapping
        data = tuple(folder / path for path in self.data)
        return self.model_copy(update={"urdf": folder / self.urdf, "data": data, "mapping": mapping})


class Comparison(Group):
    """A comparison: every preset is trained on every arm, with every seed and split.

    Attributes:
        arms: {name: arm}.
        presets: Names of presets, or YAML files of designs. Default: closed-form and hybrid for an arm with logs, and
            all presets for a simulated arm.
        seeds: Number of seeds 0, 1, ... Default: 1 for an arm with logs, and `comparison.seeds` in the settings of a
            simulated arm.
        splits: Number of folds of a cross-validation over whole trajectories. 1: no cross-validation; the logs test.*
            are for testing, all others for training. If there is no test.*, a random quarter of the trajectories is for
            testing.
        width: Number of units of a hidden layer.
        depth: Number of hidden layers.
        training: Training settings for all arms, with the keys of a robot's settings.
        steps: Number of training steps on a simulated arm.
    """

    arms: Annotated[dict[Name, ComparedArm], Field(min_length=1)]
    presets: Annotated[tuple[str, ...], Field(min_length=1)] | None = None
    seeds: Count | None = None
    splits: Count = 1
    width: Count | None = None
    depth: Count | None = None
    training: TrainingSettings = Field(default_factory=TrainingSettings)
    steps: Count | None = None


def load_comparison(path: Path) -> Comparison:
    """Return the comparison that a YAML file specifies. Paths in the file are relative to the folder of the file.

    Raises SettingsError for an error in the file, or SpelgenErrors for several.
    """
    document = read_document(path)
    comparison = validated(Comparison, document.value(), document)
    errors = []
    for location, got, do in _contradictions(comparison, path.parent):
        element, line = dotted(location), document.line(location)
        errors.append(SettingsError(got, file=path, line=line, element=element, do=do))
    collect(errors)
    arms = {name: arm.in_folder(path.parent) for name, arm in comparison.arms.items()}
    # A preset is a name or the path of a YAML file. A path is relative to the folder of the comparison's file; a name
    # is not changed.
    presets = comparison.presets
    if presets is not None:
        presets = tuple(str(path.parent / name) if _is_file(name) else name for name in presets)
    return comparison.model_copy(update={"arms": arms, "presets": presets})


def _is_file(preset: str) -> bool:
    return Path(preset).suffix in YAML


def _contradictions(comparison: Comparison, folder: Path) -> Iterator[tuple[Location, str, str]]:
    """Yield (location, error, advice) for each unknown preset and for each file of an arm that does not exist.

    The location is the sequence of keys from the root of the YAML file, such as ("arms", "iiwa", "urdf").
    """
    for number, preset in enumerate(comparison.presets or ()):
        if preset not in PRESET_NAMES and not _is_file(preset):
            yield ("presets", number), f"unknown preset {preset!r}", suggestion(preset, PRESET_NAMES)
    for name, arm in comparison.arms.items():
        paths = {"urdf": [arm.urdf], "data": arm.data, "mapping": [arm.mapping] if arm.mapping else []}
        for key, files in paths.items():
            for file in files:
                if not (folder / file).exists():
                    yield ("arms", name, key), f"no such file: {file}", "check the path"


Progress = Callable[[int, int], None]


class ArmInputs(ComparedArm):
    """The files that all runs on one arm read.

    urdf: URDF from which models are built. truth: URDF with the true parameters of a simulated arm; None for logs of
    the user. digest: hash of the URDF, the settings and the logs.
    """

    truth: Path | None = None
    digest: str

    def load(self) -> Arm:
        """Return the arm from which models are built."""
        return load_arm(self.urdf, self.joints, self.tip)

    def log_mapping(self) -> LogMapping:
        """Return the columns and units of the arm's logs."""
        return log_source(self.load(), self.mapping).mapping

    def split(self, number: int, splits: int) -> tuple[list[Trajectory], list[Trajectory]]:
        """Return the training and test trajectories of split `number` of `splits`. Raises LogError.

        For ``splits`` = 1, the test trajectories are the logs test.* or, without such logs, a random quarter of all
        trajectories. Otherwise they are fold ``number`` of a cross-validation with random folds. The seed is fixed: all
        models are tested on the same trajectories.
        """
        # Arm and logs are loaded here and not by the caller: a worker process calls this method for a job, and a job
        # has only the paths of the URDF and the logs.
        arm = self.load()
        train = read_logs(self.data, arm, self.mapping, "train")
        test = []
        if log_files(self.data, "train") != log_files(self.data):
            test = read_logs(self.data, arm, self.mapping, "test")
        if splits == 1 and test:
            return train, test
        logs = [*train, *test]
        if splits == 1:
            # Without test.* files a quarter of the trajectories is held out for testing.
            held_out = split_validation(logs, 0.25, 0)
            return list(held_out.training), list(held_out.validation)
        if len(logs) < splits:
            expected = f"{splits} or more, for as many splits"
            raise LogError(f"{len(logs)} trajectories", element="data", expected=expected)
        # Folds consist of whole trajectories: the samples of a trajectory are correlated, so a split within a
        # trajectory would leak training data into the test.
        folds = np.array_split(np.random.default_rng(0).permutation(len(logs)), splits)
        return set_aside(logs, folds[number])


def arm_inputs(
    arm: ComparedArm, folder: Path, splits: int = 1, progress: Progress | None = None
) -> ArmInputs:
    """Return the input files of the runs on an arm: URDF, mapping and logs.

    If the arm has no logs, logs are simulated and written to ``folder``. Models of a simulated arm are built from a
    copy of the URDF in this folder, without inertials, drives and friction. splits: number of folds; LogError if there
    are too few trajectories. progress: callback of the simulation, see `simulate`.

    Raises the errors of `load_arm`, `load_mapping`, `read_logs` and `simulate`.
    """
    loaded = load_arm(arm.urdf, arm.joints, arm.tip)
    mapping = log_source(loaded, arm.mapping).mapping
    files, errors = log_files(arm.data)
    collect(errors)
    # The digest omits keys of the settings that do not affect the result of a run.
    apart: dict[str, bool | set[str]] = {"about": True, "comparison": {"seeds", "published"}}
    settings = [loaded.settings.model_dump(mode="json", exclude_unset=True, exclude=apart)]
    settings.append(mapping.model_dump(mode="json", exclude_unset=True))
    # The digest uses size and modification time instead of the content, since logs may have gigabytes.
    versions = [(file, file.stat().st_size, file.stat().st_mtime_ns) for file in files]
    sources = json.dumps((loaded.robot.digest, arm.joints, arm.tip, settings, versions), default=str)
    inputs = ArmInputs(**dict(arm), digest=hashlib.sha256(sources.encode()).hexdigest()[:16])
    if not arm.data:
        changes = {"urdf": folder / "known.urdf", "truth": arm.urdf, "data": (folder,)}
        inputs = inputs.model_copy(update=changes | {"joints": loaded.joints, "tip": loaded.tip})
        _simulate(inputs, loaded, folder, progress)
    # The first split is made here only to raise its error, for example about too few logs, before hours of training.
    inputs.split(0, splits)
    return inputs


def _simulate(inputs: ArmInputs, loaded: Arm, folder: Path, progress: Progress | None) -> None:
    """Simulate logs by the protocol of the arm's settings; write them to ``folder``, if it does not contain them yet.

    A copy of the URDF without inertials, drives and friction is written, too. Models are built from this copy, so that
    no model starts from the true parameters.
    """
    # The simulation needs Pinocchio, an optional dependency. A comparison on logs of the user does not need it, so the
    # imports are in this function.
    from spelgen.simulation.as_built import urdf_without
    from spelgen.simulation.simulate import simulate

    if loaded.settings.input == "position":
        raise SettingsError(
            "position servos", file=loaded.robot.path.with_suffix(".yaml"), element="input",
            expected="torques: the simulated protocol has no commands",
            do="give logs of the arm with --data",
        )  # fmt: skip
    # inputs.json is written last: if it is absent, the other files may be incomplete.
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
    kinematics = urdf_without(loaded.robot.path, "dynamics", "visual", "collision", "inertial")
    write_bytes(inputs.urdf, etree.tostring(kinematics, xml_declaration=True, encoding="utf-8"))
    write_text(inputs.urdf.with_suffix(".yaml"), yaml.safe_dump({"gravity": list(loaded.settings.gravity)}))
    write_json(complete, {"digest": inputs.digest})
