"""`simulate`: training and test logs of an arm."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from spelgen.cli import options
from spelgen.cli.console import progress_bar, say
from spelgen.cli.options import AngleTolerance, Force, Joints, Robot, Tip


def simulate(
    robot: Robot,
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="LOGS", help="Folder for train and test logs.")
    ],
    joints: Joints = None,
    tip: Tip = None,
    angle_tolerance: AngleTolerance = 2e-3,
    seed: Annotated[
        int | None, typer.Option(min=0, help="Random seed; default: that of the robot's settings.")
    ] = None,
    force: Force = False,
) -> None:
    """Simulate training and test logs with Pinocchio."""
    from spelgen.loaded_arm import load_arm
    from spelgen.logs.read import write_logs
    from spelgen.simulation.simulate import simulate as simulate_arm

    arm = load_arm(robot, options.names(joints), tip, angle_tolerance)
    paths = {role: output / f"{role}.parquet" for role in ("train", "test")}
    for path in paths.values():
        options.require_free(path, force=force)
    with progress_bar("simulating") as progress:
        logs = simulate_arm(arm, seed=seed, progress=progress)
    # logs are written in SI units under the URDF names: no mapping is needed to read them
    names = arm.arm.joint_names
    for path, trajectories in zip(paths.values(), (logs.train, logs.test), strict=True):
        if trajectories:
            write_logs(path, trajectories, names)
            say(f"wrote {path}: {len(trajectories)} trajectories, {sum(map(len, trajectories))} samples")
