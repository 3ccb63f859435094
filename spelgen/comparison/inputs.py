"""Inputs of the runs of an arm: the URDF that models are built from, and training and test logs."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import yaml
from lxml import etree

from spelgen.arm.configured_arm import load_arm
from spelgen.comparison.arms import ComparedArm
from spelgen.comparison.tuning import ComparisonTuning
from spelgen.errors import LogError, RunError, SettingsError, collect
from spelgen.files import read_json, remove, write_bytes, write_json, write_text
from spelgen.logs.arm_mapping import log_source
from spelgen.logs.formats import log_files
from spelgen.logs.read import read_logs, write_logs
from spelgen.logs.trajectory import Trajectory, set_aside
from spelgen.logs.windows import split_validation
from spelgen.settings.log_mapping import LogMapping

if TYPE_CHECKING:
    from spelgen.arm.configured_arm import Arm

TUNING = ComparisonTuning()
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
        arm = self.load()
        train = read_logs(self.data, arm, self.mapping, "train")
        test = []
        if log_files(self.data, "train") != log_files(self.data):
            test = read_logs(self.data, arm, self.mapping, "test")
        if splits == 1 and test:
            return train, test
        logs = [*train, *test]
        if splits == 1:
            held_out = split_validation(logs, TUNING.held_out, 0)
            return list(held_out.training), list(held_out.validation)
        if len(logs) < splits:
            expected = f"{splits} or more, for as many splits"
            raise LogError(f"{len(logs)} trajectories", element="data", expected=expected)
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
    versions = [(file, file.stat().st_size, file.stat().st_mtime_ns) for file in files]
    sources = json.dumps((loaded.robot.digest, arm.joints, arm.tip, settings, versions), default=str)
    inputs = ArmInputs(**dict(arm), digest=hashlib.sha256(sources.encode()).hexdigest()[:16])
    if not arm.data:
        changes = {"urdf": folder / "known.urdf", "truth": arm.urdf, "data": (folder,)}
        inputs = inputs.model_copy(update=changes | {"joints": loaded.joints, "tip": loaded.tip})
        _simulate(inputs, loaded, folder, progress)
    inputs.split(0, splits)
    return inputs


def _simulate(inputs: ArmInputs, loaded: Arm, folder: Path, progress: Progress | None) -> None:
    """Simulate logs by the protocol of the arm's settings, unless they are in the folder.

    Models know only a copy of the URDF without inertials, drives and friction, so that no model starts from the truth.
    """
    from spelgen.simulation.simulate import (
        simulate,  # Pinocchio is an extra, not needed for the user's own logs
    )

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
    text: bytes = etree.tostring(tree, xml_declaration=True, encoding="utf-8")
    return text
