"""An arm's logs for its runs: simulated or as given, in one form, split into what is trained on and what tests."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from spelgen.errors import LogError, SpelgenError, collect
from spelgen.files import write_json
from spelgen.fleet.schema import FleetRobot
from spelgen.loaded_arm import LoadedArm, load_arm
from spelgen.logs.chunks import large_files
from spelgen.logs.log_files import log_files
from spelgen.logs.read import read_logs, write_logs
from spelgen.logs.trajectory import Trajectory
from spelgen.logs.windows import split_validation
from spelgen.settings.log_mapping import LogMapping
from spelgen.settings.settings import load_mapping

HELD_OUT = 0.25  # of logs that do not say which are for the test


@dataclass(frozen=True)
class Preparation:
    """What is to be done for one arm: its logs go to ``folder``."""

    name: str
    robot: FleetRobot
    splits: int
    folder: Path


@dataclass(frozen=True)
class Prepared:
    """An arm whose logs are ready. key: of all that they were made from. group: of its URDF and choice of joints: equal
    for units of the same arm. data: for each split the paths of training and of test logs, which `mapping` reads.
    """

    name: str
    key: str
    group: str
    data: tuple[tuple[tuple[Path, ...], tuple[Path, ...]], ...]
    mapping: LogMapping


def prepare(preparation: Preparation) -> Prepared:
    """Write the logs of every split, unless they are there already. Raises what reading and simulating raise."""
    robot, folder = preparation.robot, preparation.folder
    arm = load_arm(robot.urdf, robot.joints, robot.tip)
    mapping = _mapping(robot, arm)
    group = _digest(arm.robot.digest, robot.joints, robot.tip)
    key = _digest(
        group,
        arm.settings.model_dump_json(exclude_unset=True),
        mapping.model_dump_json(exclude_unset=True),
        _stamps(robot),
        preparation.splits,
    )
    names = [coordinate.name for coordinate in arm.arm.coordinates]
    if robot.data and large_files(robot.data, names):
        if preparation.splits > 1:
            raise LogError(
                "logs larger than memory",
                element=f"robots.{preparation.name}.data",
                expected="splits: 1 of them",
            )
        return Prepared(preparation.name, key, group, ((robot.data, robot.data),), mapping)
    places = [folder / f"split{k}" for k in range(preparation.splits)]
    done = folder / "prepared.json"
    if not done.exists() or json.loads(done.read_text(encoding="utf-8")) != {"key": key}:
        done.unlink(missing_ok=True)
        train, test = _logs(robot, arm, mapping)
        parts = [(train, test)] if preparation.splits == 1 and test else _folds([*train, *test], preparation)
        for place, (training, testing) in zip(places, parts, strict=True):
            write_logs(place / "train.parquet", training, names)
            write_logs(place / "test.parquet", testing, names)
        write_json(done, {"key": key})
    data = tuple(((place / "train.parquet",), (place / "test.parquet",)) for place in places)
    return Prepared(preparation.name, key, group, data, LogMapping())


def _mapping(robot: FleetRobot, arm: LoadedArm) -> LogMapping:
    if robot.mapping is None:
        return arm.settings.logs
    return load_mapping(robot.mapping, [joint.name for joint in arm.robot.joints])


def _logs(
    robot: FleetRobot, arm: LoadedArm, mapping: LogMapping
) -> tuple[Sequence[Trajectory], Sequence[Trajectory]]:
    """Training and test trajectories; none of the latter where the logs do not tell."""
    if not robot.data:
        from spelgen.simulation.simulate import simulate

        simulated = simulate(arm)
        return simulated.train, simulated.test
    train, every = (read_logs(robot.data, arm, mapping, role) for role in ("train", None))
    files = {x.file for x in train}
    if {x.file for x in every} == files:
        return train, []
    return train, read_logs(robot.data, arm, mapping, "test")


def _folds(
    logs: Sequence[Trajectory], preparation: Preparation
) -> list[tuple[Sequence[Trajectory], Sequence[Trajectory]]]:
    """Training and test logs of each split, whole trajectories drawn by a fixed seed."""
    if preparation.splits == 1:
        split = split_validation(logs, HELD_OUT, 0)
        return [(split.training, split.validation)]
    if len(logs) < preparation.splits:
        raise LogError(
            f"{len(logs)} trajectories", element=f"robots.{preparation.name}.data",
            expected=f"{preparation.splits} or more, for as many splits",
        )  # fmt: skip
    folds = np.array_split(np.random.default_rng(0).permutation(len(logs)), preparation.splits)
    tests = [set(fold.tolist()) for fold in folds]
    return [
        ([x for k, x in enumerate(logs) if k not in test], [x for k, x in enumerate(logs) if k in test])
        for test in tests
    ]


def _stamps(robot: FleetRobot) -> list[Any]:
    """Of each log file its path, size and last change."""
    errors: list[SpelgenError] = []
    files = log_files(robot.data, None, errors)
    collect(errors)
    return [(str(x), x.stat().st_size, x.stat().st_mtime_ns) for x in files]


def _digest(*parts: Any) -> str:
    return hashlib.sha256(json.dumps(parts, default=str).encode()).hexdigest()[:16]
