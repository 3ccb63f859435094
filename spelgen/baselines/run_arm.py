"""The arm of a run folder."""

from __future__ import annotations

from spelgen.errors import RunError
from spelgen.fitting.run_folder import RunFolder
from spelgen.loaded_arm import LoadedArm, load_arm
from spelgen.spec import read_facts


def run_arm(run: RunFolder) -> LoadedArm:
    """Return the arm that a run's module was built from. Raises RunError where the run has no URDF."""
    if not run.urdf.exists():
        raise RunError("no robot.urdf", file=run.path, do="train with --robot")
    facts = read_facts(run.module)
    return load_arm(run.urdf, facts.joints, facts.options.tip, facts.options.angle_tolerance)
