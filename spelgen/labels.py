"""How joints are named in pictures of a structure."""

from __future__ import annotations


def joint_ranges(joints: tuple[int, ...]) -> str:
    """The joints' numbers, from 1, with runs of three and more shortened: ``2-6`` or ``2,4``."""
    runs: list[list[int]] = []
    for joint in joints:
        if runs and joint == runs[-1][-1] + 1:
            runs[-1].append(joint)
        else:
            runs.append([joint])
    return ",".join(
        f"{run[0] + 1}-{run[-1] + 1}" if len(run) > 2 else ",".join(str(joint + 1) for joint in run)
        for run in runs
    )
