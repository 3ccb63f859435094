"""A proposed motion as a table for a terminal, and as CSV for a controller."""

from __future__ import annotations

import csv
import io
import textwrap

import numpy as np

from spelgen.arm.arm import Arm
from spelgen.excitation.design import Excitation
from spelgen.excitation.trajectory import Motion
from spelgen.listing import WIDTH, Listing

WARNING = (
    "Not checked: collisions of the arm with itself, its load and its surroundings. Look at the motion, then run "
    "it slowly. Move to its first position before: it starts and ends at rest there."
)


def text(found: Excitation, arm: Arm) -> str:
    """What the motion is worth, and how near to the limits it goes."""
    motion = found.motion
    over = " (which overran effort limits)" if (found.first_efforts > 1).any() else ""
    head = (
        f"{arm.name}: {motion.t[-1]:g} s, {len(motion.t)} samples\n"
        f"condition number of the {found.parameters} base parameters' regressor: "
        f"{found.condition:.3g}\n  of the first motion at random{over}: {found.first:.3g}"
    )
    rows = []
    for k, coordinate in enumerate(arm.coordinates):
        q, speed = motion.q[:, k], np.abs(motion.qd[:, k]).max()
        torque = "-" if np.isnan(found.efforts[k]) else f"{found.efforts[k]:.0%}"
        limit = f"{speed / coordinate.velocity:.0%}" if coordinate.velocity else "-"
        rows.append(
            (
                coordinate.name,
                f"{q.min():.3g} .. {q.max():.3g}",
                f"{speed:.3g}",
                limit,
                f"{np.abs(motion.qdd[:, k]).max():.3g}",
                torque,
            )
        )
    columns = ("joint", "q", "qd", "of limit", "qdd", "effort")
    listing = Listing("Ranges [rad or m, s]; effort by the URDF's inertials", columns, tuple(rows), WARNING)
    lacking = [c.name for c in arm.coordinates if not c.velocity]
    parts = [head, listing.text()]
    if (found.efforts > 1).any():
        parts.append("warning: effort limits are overrun: no motion was found that keeps them")
    if lacking:
        told = f"no velocity limit, 1 rad/s or 0.25 m/s taken: {', '.join(lacking)}"
        parts.append(textwrap.fill(told, WIDTH, subsequent_indent="  "))
    return "\n\n".join(parts)


def csv_text(motion: Motion, arm: Arm) -> str:
    """Columns `t`, then `q_<joint>`, `qd_<joint>` and `qdd_<joint>` by joint, nine decimals."""
    names = [coordinate.name for coordinate in arm.coordinates]
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(["t", *(f"{what}_{name}" for what in ("q", "qd", "qdd") for name in names)])
    rows = np.concatenate([motion.t[:, None], motion.q, motion.qd, motion.qdd], axis=1)
    writer.writerows([f"{x + 0.0:.9f}" for x in row] for row in np.round(rows, 9))
    return file.getvalue()
