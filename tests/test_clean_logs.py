"""Logs that agree with the URDF and the settings get no advice, although the URDF's inertials are 30 % wrong."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.truth import Case, Truth, record_log, wrong_urdf
from spelgen.arm.configured_arm import load_arm
from spelgen.log_checks.check_logs import check_logs

# Codes of findings that are correct for these logs: joints may rest, move in one direction (`small-motion`, if most of
# them do), or exceed limits of effort or velocity in the short random motion; the inertials of the URDF are wrong.
TRUE = {
    "one-way", "small-motion", "joint-at-rest", "beyond-effort-limit", "beyond-velocity-limit", "urdf-inertials",
}  # fmt: skip


def recorded(robot: Path, seed: int, folder: Path, **properties):
    """Return an arm with wrong inertials, and logs of the true arm: 10 s of pick-and-place motions.

    properties: fields of `Case` that replace the defaults.
    """
    rng = np.random.default_rng([7, seed])
    (folder / "arm.urdf").write_bytes(wrong_urdf(robot, 0.3, rng))
    known = {"friction": "coulomb", "armature": True, "sample_rate": 200.0, "noise": 0.01}
    case = Case(
        number=seed, arm=robot.stem, urdf_error=0.3, offsets=False, springs=False, motion="pick-and-place",
        seconds=10.0, delay=0.0, **(known | properties),
    )  # fmt: skip
    truth = Truth(case, robot, rng)
    return load_arm(folder / "arm.urdf"), record_log(truth, case, rng)


@pytest.mark.parametrize(("robot", "seed"), [("ur10e", 0), ("panda", 2), ("ur10e", 5)])
def test_synchronous_joints_with_dry_friction_get_no_advice(robots, tmp_path, robot, seed):
    """Logs of joints that start and stop together, with dry friction, get no warning of couplings or mechanical stops.

    Friction after reversals resembles a motor coupling, and friction of one-way motion a mechanical stop.
    """
    arm, logs = recorded(robots / f"{robot}.urdf", seed, tmp_path)
    report = check_logs(logs, arm)
    assert not report.errors
    assert {x.code for x in report.findings} <= TRUE
