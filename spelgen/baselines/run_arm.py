"""The arm and the logs of a run folder."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from spelgen.errors import RunError
from spelgen.fitting.run_folder import RunFolder
from spelgen.fitting.train import open_logs
from spelgen.logs.trajectory import Trajectory
from spelgen.arm.configured_arm import ConfiguredArm
from spelgen.emission.build import arm_of_spec
from spelgen.settings.log_mapping import LogMapping
from spelgen.spec import read_facts


def run_arm(run: RunFolder) -> ConfiguredArm:
    """Return the arm that a run's module was built from. Raises RunError where the run has no URDF."""
    if not run.urdf.exists():
        raise RunError("no robot.urdf", file=run.path, do="train with --robot")
    return arm_of_spec(read_facts(run.module), run.urdf)


def run_logs(run: RunFolder, paths: Iterable[Path | str]) -> Sequence[Trajectory]:
    """Return log files read as those that the run was trained on. Raises LogError."""
    return open_logs(run.load_module(), paths, LogMapping(**run.read_config()["mapping"])).trajectories
