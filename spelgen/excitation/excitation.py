"""A proposed motion and its quality, with output as text, table of ranges, CSV, and message for ROS 2 controllers."""

import csv
import io
import json
import textwrap
from dataclasses import dataclass

import numpy as np

from spelgen.arm.arm import Chain
from spelgen.excitation.trajectory import Motion, motion_columns
from spelgen.listing import WIDTH, Listing

ADVICE = "View the motion, then run it slowly: a load, cables and anything else around the arm are unknown."


@dataclass(frozen=True, eq=False, repr=False)
class Excitation:
    """A proposed motion and its quality.

    Attributes:
        arm: The arm.
        motion: The proposed motion, which starts and ends at rest.
        approach: Motion from the start position to the first position of `motion`.
        collisions: Text about the checked collisions.
        parameters: Number of base parameters, friction and armature included.
        first: Condition number for the first random motion, for comparison.
        first_overruns: True if the torques of the first random motion exceed effort limits.
        condition: Condition number of the base regressor with columns of unit length for `motion`.
        efforts: Largest rigid-body torque divided by the effort limit, (n,) [1]; NaN without a limit or inertials.
    """

    arm: Chain
    motion: Motion
    approach: Motion
    collisions: str
    parameters: int
    first: float
    first_overruns: bool
    condition: float
    efforts: np.ndarray

    def text(self) -> str:
        """Return a text of at most 80 columns about the quality of the motion and its use of the limits."""
        overruns = ", beyond effort limits" if self.first_overruns else ""
        head = (
            f"{self.arm.name}: {self.motion.t[-1]:g} s, {len(self.motion.t)} samples\n"
            f"condition number {self.condition:.3g}; of the first motion at random: {self.first:.3g}{overruns}\n"
            f"  of the regressor of {self.parameters} parameters: base parameters, friction and armature"
        )
        paragraphs = [head, self.listing().text()]
        if (self.efforts > 1).any():
            paragraphs.append("warning: effort limits are overrun: no motion was found that keeps them")
        # The text names the joints that have a default speed limit, because this limit may be wrong for the robot.
        lacking = [c.name for c in self.arm.coordinates if not c.velocity]
        if lacking:
            summary = f"no velocity limit, 1 rad/s or 0.25 m/s taken: {', '.join(lacking)}"
            paragraphs.append(textwrap.fill(summary, WIDTH, subsequent_indent="  "))
        return "\n\n".join(paragraphs)

    def to_dict(self) -> dict[str, object]:
        """Return the results of the design for JSON; an effort (largest torque / limit) that is unknown is None."""
        efforts = [None if np.isnan(effort) else float(effort) for effort in self.efforts]
        return {
            "robot": self.arm.name,
            "duration": float(self.motion.t[-1]),
            "samples": len(self.motion.t),
            "parameters": self.parameters,
            "condition": self.condition,
            "random_condition": self.first,
            "approach": float(self.approach.t[-1]),
            "start": self.approach.q[0].tolist(),
            "collisions": self.collisions,
            "efforts": efforts,
        }

    def listing(self) -> Listing:
        """Return a table with the ranges of position, velocity, acceleration and effort of each joint."""
        motion, rows = self.motion, []
        for k, coordinate in enumerate(self.arm.coordinates):
            q, speed = motion.q[:, k], np.abs(motion.qd[:, k]).max()
            rows.append((
                coordinate.name,
                f"{q.min():.3g} .. {q.max():.3g}",
                f"{speed:.3g}",
                f"{speed / coordinate.velocity:.0%}" if coordinate.velocity else "-",
                f"{np.abs(motion.qdd[:, k]).max():.3g}",
                "-" if np.isnan(self.efforts[k]) else f"{self.efforts[k]:.0%}",
            ))  # fmt: skip
        head = ("joint", "q", "qd", "of limit", "qdd", "effort")
        start = ", ".join(f"{x:.3g}" for x in self.approach.q[0])
        moved = f"Approach of {self.approach.t[-1]:.3g} s from {start}."
        note = f"{moved} The motion starts and ends at rest. {self.collisions} {ADVICE}"
        return Listing("Ranges [rad or m, s]; effort by the URDF's inertials", head, rows, note)

    def csv(self) -> str:
        """Return the motion as CSV with the columns t, q_<joint>, qd_<joint> and qdd_<joint>, with nine decimals."""
        motion, file = self.motion, io.StringIO()
        csv.writer(file, lineterminator="\n").writerow(motion_columns(self.arm.joint_names))
        rows = np.concatenate([motion.t[:, None], motion.q, motion.qd, motion.qdd], axis=1)
        np.savetxt(file, np.round(rows, 9) + 0.0, "%.9f", ",")  # The zero that is added turns -0 into 0.
        return file.getvalue()

    def joint_trajectory(self) -> str:
        """Return a message of ROS 2, trajectory_msgs/JointTrajectory, with the approach and then the motion.

        The text is valid JSON and valid YAML, with one line per point of the trajectory.
        """
        motion = self.approach.then(self.motion)
        points = []
        for t, q, qd, qdd in zip(motion.t, motion.q, motion.qd, motion.qdd, strict=True):
            nanoseconds = round(1e9 * t)
            stamp = f'{{"sec": {nanoseconds // 10**9}, "nanosec": {nanoseconds % 10**9}}}'
            points.append(
                f'{{"positions": {_numbers(q)}, "velocities": {_numbers(qd)}, "accelerations": {_numbers(qdd)}, '
                f'"effort": [], "time_from_start": {stamp}}}'
            )
        names = json.dumps(self.arm.joint_names, ensure_ascii=False)
        head = '{"header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""},'
        rows = ",\n".join(points)
        return f'{head}\n"joint_names": {names},\n"points": [\n{rows}\n]}}\n'

    def __repr__(self) -> str:
        return f"<Excitation of {self.arm.name!r}: {self.motion.t[-1]:g} s, condition number {self.condition:.3g}>"

    def _repr_html_(self) -> str:
        return self.listing().html()


def _numbers(values: np.ndarray) -> str:
    """Return numbers (n,) as the text of a list, with nine decimals.

    No number has an exponent, because YAML would read it as text.
    """
    # Adding 0.0 changes -0.0 to 0.0.
    return f"[{', '.join(f'{x:.9f}' for x in np.round(values, 9) + 0.0)}]"
