"""Prepare an arm's logs for its runs: simulated or as given, in one form, split into training and test."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from spelgen.arm.configured_arm import ConfiguredArm, load_arm
from spelgen.errors import LogError, RunError, collect
from spelgen.files import read_json, write_json
from spelgen.fleet.schema import FleetRobot
from spelgen.logs.formats import log_files
from spelgen.logs.read import read_logs, write_logs
from spelgen.logs.trajectory import Trajectory, set_aside
from spelgen.logs.windows import split_validation
from spelgen.settings.log_mapping import LogMapping
from spelgen.settings.settings import load_mapping
from spelgen.settings.values import Group

HELD_OUT = 0.25  # of logs that do not say which are for the test
Split = tuple[Sequence[Trajectory], Sequence[Trajectory]]
"""Training and test trajectories."""


@dataclass(frozen=True)
class Preparation:
    """Name an arm whose logs go to ``folder``, in so many splits."""

    name: str
    robot: FleetRobot
    splits: int
    folder: Path


class SplitLogs(Group):
    """Hold the logs of one split, which `mapping` reads. digest: of all that they were made from."""

    train: tuple[Path, ...] = ()
    test: tuple[Path, ...] = ()
    digest: str
    mapping: LogMapping = LogMapping()


def prepare(preparation: Preparation) -> list[SplitLogs]:
    """Write the logs of every split, unless they are there already. Raises what reading and simulating raise."""
    robot, folder, count = preparation.robot, preparation.folder, preparation.splits
    arm = load_arm(robot.urdf, robot.joints, robot.tip)
    mapping = arm.settings.logs
    if robot.mapping is not None:
        mapping = load_mapping(robot.mapping, arm.robot.joint)
    # reading logs takes longer than asking for their times of change
    files, errors = log_files(robot.data)
    collect(errors)
    sources: list[object] = [arm.robot.digest, robot.joints, robot.tip, count]
    for settings in (arm.settings, mapping):
        sources.append(settings.model_dump_json(exclude_unset=True))
    for file in files:
        sources.append((file, file.stat().st_size, file.stat().st_mtime_ns))
    digest = hashlib.sha256(json.dumps(sources, default=str).encode()).hexdigest()[:16]
    names = arm.arm.joint_names
    element = f"robots.{preparation.name}.data"
    splits = []
    for number in range(count):
        train, test = (folder / f"split{number}" / f"{role}.parquet" for role in ("train", "test"))
        splits.append(SplitLogs(train=(train,), test=(test,), digest=digest))
    # written last: a folder without it holds logs that were cut off
    record = folder / "prepared.json"
    if not record.exists() or read_json(record, RunError) != {"key": digest}:
        record.unlink(missing_ok=True)
        trajectories = _splits(robot, arm, mapping, count, element)
        for files_of_split, (training, testing) in zip(splits, trajectories, strict=True):
            write_logs(files_of_split.train[0], training, names)
            write_logs(files_of_split.test[0], testing, names)
        write_json(record, {"key": digest})
    return splits


def _splits(
    robot: FleetRobot, arm: ConfiguredArm, mapping: LogMapping, count: int, element: str
) -> list[Split]:
    """Return the trajectories of each split; whole ones are drawn by a fixed seed where the logs do not say."""
    train, test = _roles(robot, arm, mapping)
    if count == 1 and test:
        return [(train, test)]
    logs = [*train, *test]
    if count == 1:
        split = split_validation(logs, HELD_OUT, 0)
        return [(split.training, split.validation)]
    if len(logs) < count:
        expected = f"{count} or more, for as many splits"
        raise LogError(f"{len(logs)} trajectories", element=element, expected=expected)
    splits: list[Split] = []
    for fold in np.array_split(np.random.default_rng(0).permutation(len(logs)), count):
        # the order of the logs is kept, so that equal files give equal fits
        splits.append(set_aside(logs, fold))
    return splits


def _roles(robot: FleetRobot, arm: ConfiguredArm, mapping: LogMapping) -> Split:
    """Return training and test trajectories; none of the latter where the logs do not say which they are."""
    if not robot.data:
        from spelgen.simulation.simulate import simulate

        simulated = simulate(arm)
        return simulated.train, simulated.test
    train = read_logs(robot.data, arm, mapping, "train")
    if log_files(robot.data, "train") == log_files(robot.data):
        return train, []
    return train, read_logs(robot.data, arm, mapping, "test")
