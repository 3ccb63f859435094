"""The arm of a run folder."""

from __future__ import annotations

from spelgen.errors import RunError
from spelgen.fitting.run_folder import RunFolder
from spelgen.loaded_arm import LoadedArm, arm_of_module
from spelgen.spec import read_facts


def run_arm(run: RunFolder) -> LoadedArm:
    """Return the arm that a run's module was built from. Raises RunError where the run has no URDF."""
    if not run.urdf.exists():
        raise RunError("no robot.urdf", file=run.path, do="train with --robot")
    return arm_of_module(read_facts(run.module), run.urdf)
