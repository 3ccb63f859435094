"""Inputs of the runs of an arm: the URDF that models are built from, and training and test logs."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import yaml

from spelgen.comparison.arms import ComparedArm, Comparison
from spelgen.comparison.known_urdf import known_urdf
from spelgen.comparison.tuning import ComparisonTuning
from spelgen.errors import LogError, RunError, SettingsError, collect
from spelgen.files import read_json, write_bytes, write_json, write_text
from spelgen.logs.formats import log_files
from spelgen.logs.read import read_logs, write_logs
from spelgen.logs.trajectory import Trajectory, set_aside
from spelgen.logs.windows import split_validation
from spelgen.pipeline.loaded_arm import load_arm
from spelgen.settings.log_mapping import LogMapping
from spelgen.settings.settings import load_mapping
from spelgen.settings.values import Group

if TYPE_CHECKING:
    from spelgen.pipeline.loaded_arm import LoadedArm

TUNING = ComparisonTuning()
Progress = Callable[[int, int], None]


class ArmInputs(Group):
    """Files that the runs of an arm read.

    urdf: URDF that models are built from. truth: URDF of the simulated arm; None if the logs are the user's.
    data: logs; their columns and units are in `mapping`. digest: of the URDF, settings and logs.
    """

    urdf: Path
    truth: Path | None
    joints: tuple[str, ...] | None
    tip: str | None
    data: tuple[Path, ...]
    mapping: LogMapping
    digest: str

    def load(self) -> LoadedArm:
        """Return the arm that models are built from."""
        return load_arm(self.urdf, self.joints, self.tip)

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
    arm: ComparedArm, comparison: Comparison, folder: Path, progress: Progress | None = None
) -> ArmInputs:
    """Return the inputs of an arm's runs; the logs of an arm without logs are simulated into the folder.

    Raises what `load_arm`, `load_mapping`, `read_logs` and `simulate` raise.
    """
    loaded = load_arm(arm.urdf, arm.joints, arm.tip)
    if not arm.data:
        return _simulated(arm, loaded, comparison, folder, progress)
    mapping = loaded.settings.logs
    if arm.mapping is not None:
        mapping = load_mapping(arm.mapping, loaded.robot.joint)
    files, errors = log_files(arm.data)
    collect(errors)
    sources: list[object] = [_description(arm, loaded), mapping.model_dump_json(exclude_unset=True)]
    for file in files:
        sources.append((file, file.stat().st_size, file.stat().st_mtime_ns))
    inputs = ArmInputs(
        urdf=arm.urdf, truth=None, joints=arm.joints, tip=arm.tip, data=arm.data, mapping=mapping,
        digest=_digest(sources),
    )  # fmt: skip
    inputs.split(
        0, comparison.splits
    )  # logs that cannot be used are reported once, before anything is trained
    return inputs


def _simulated(
    arm: ComparedArm, loaded: LoadedArm, comparison: Comparison, folder: Path, progress: Progress | None
) -> ArmInputs:
    """Simulate logs by the protocol of the arm's settings, unless they are there.

    Models know only a copy of the URDF without drives and with wrong inertials or none, so that no model starts from
    the truth that it is compared with.
    """
    from spelgen.simulation.simulate import (
        simulate,
    )  # Pinocchio is an extra, not needed for the user's own logs

    if loaded.settings.input == "position":
        raise SettingsError(
            "position servos", file=arm.urdf.with_suffix(".yaml"), element="input",
            expected="torques: the simulated protocol has no commands",
            do="give logs of the arm with --data",
        )  # fmt: skip
    urdf, digest = folder / "known.urdf", _digest([_description(arm, loaded), comparison.urdf_error])
    inputs = ArmInputs(
        urdf=urdf, truth=arm.urdf, joints=loaded.joints, tip=loaded.tip, data=(folder / "logs",),
        mapping=LogMapping(), digest=digest,
    )  # fmt: skip
    # written last: without it the other files may be incomplete
    record = folder / "inputs.json"
    if record.exists() and read_json(record, RunError) == {"digest": digest}:
        return inputs
    record.unlink(missing_ok=True)
    logs = simulate(loaded, progress=progress)
    training, first = list(logs.train), loaded.settings.comparison.first
    if first is not None:
        training = [log[: int((log.t - log.t[0] < first - 1e-9).sum())] for log in training]
    write_logs(folder / "logs" / "train.parquet", training, loaded.arm.joint_names)
    write_logs(folder / "logs" / "test.parquet", logs.test, loaded.arm.joint_names)
    write_bytes(urdf, known_urdf(arm.urdf, comparison.urdf_error))
    write_text(urdf.with_suffix(".yaml"), yaml.safe_dump({"gravity": list(loaded.settings.gravity)}))
    write_json(record, {"digest": digest})
    return inputs


def _description(arm: ComparedArm, loaded: LoadedArm) -> tuple[object, ...]:
    # `seeds` only sets the number of runs, and `about` and `published` change no run
    settings = loaded.settings.model_dump_json(
        exclude_unset=True, exclude={"about": True, "comparison": {"seeds", "published"}}
    )
    return loaded.robot.digest, arm.joints, arm.tip, settings


def _digest(sources: Sequence[object]) -> str:
    return hashlib.sha256(json.dumps(sources, default=str).encode()).hexdigest()[:16]
