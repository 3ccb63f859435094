"""Kinds of faults of a log that have continuous parameters: a zero offset of positions, and the vector of gravity.

The parameters of lowest cost are found by Gauss-Newton steps (`GeometryProblem.descend`).
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np

from spelgen.identification.hypotheses import Correction, Fault, Hypothesis, HypothesisFit
from spelgen.identification.log_geometry import GeometryProblem
from spelgen.identification.tuning import GEOMETRY
from spelgen.logs.joint_signals import plain_number

RIGHT_ANGLE = np.pi / 2


class ZeroOffset(Fault):
    """Kind of fault of a log: the positions of a joint have another zero than in the URDF."""

    code = "joint-zero"
    rarity = 2
    is_optimised = True

    def fits(self, problem: GeometryProblem, base: HypothesisFit) -> Iterator[HypothesisFit]:
        """Yield, for each joint, the least-squares fit of the log's torques with the best zero offset of its position.

        Offsets as small as calibration errors, and offsets that hardly lower the torque residual, are omitted.
        """
        for k, coordinate in enumerate(problem.arm.coordinates):
            yield from self._best(problem, base, k, coordinate.joint_type == "revolute")

    def _best(
        self, problem: GeometryProblem, base: HypothesisFit, joint: int, is_revolute: bool
    ) -> Iterator[HypothesisFit]:
        """Yield the least-squares fit with the best zero offset of a joint, if it lowers the torque residual enough.

        Offsets as small as calibration errors are omitted. A multiple of 90 degrees is preferred to the offset of
        minimum cost if its cost is about equal. The other corrections in `base` remain.
        """
        reading, unit = base.hypothesis, np.eye(len(base.hypothesis.offset))[joint]
        min_offset = GEOMETRY.min_angle if is_revolute else GEOMETRY.min_shift

        def shifted(values: np.ndarray) -> Hypothesis:
            """Return the hypothesis in which the joint's zero offset is changed by `values`, (1,) [rad, m]."""
            return reading.changed(self, offset=reading.offset + values * unit)

        starts = RIGHT_ANGLE * np.array([[0], [1], [2], [-1]]) if is_revolute else np.zeros((1, 1))
        start = min(starts, key=lambda x: problem.fit(shifted(x)).cost)
        # The descent ends at a step below `smallest`. If it starts at the current zero, `smallest` is `min_offset`
        # (0.09 rad or 0.01 m): a smaller offset is only a calibration error. If it starts at a multiple of 90 degrees,
        # the offset is certainly large and should be accurate, so `smallest` is 0.01 rad.
        smallest = GEOMETRY.min_shift if start.any() else min_offset
        offset, best = problem.descend(shifted, start, largest=1.0, smallest=smallest)
        candidates = []
        if is_revolute:
            offset = (offset + np.pi) % (2 * np.pi) - np.pi
            right = RIGHT_ANGLE * np.round(offset / RIGHT_ANGLE)
            exact = problem.fit(shifted(right))
            if right.any() and exact.cost < best.cost + GEOMETRY.right_angle:
                candidates.append(exact)
        # If a multiple of 90 degrees is far from the best offset, but has about the same cost, the log does not
        # determine which of the two is right: both are candidates.
        if not candidates or abs(offset - right)[0] > GEOMETRY.serious_angle:
            candidates.append(problem.fit(shifted(offset.round(4))))
        # An offset must lower the torque residual (`misfit`), and not only the prior term of the cost. If it lowers
        # only the prior term, other masses than in the URDF explain the torques equally well without the offset.
        for fit in candidates:
            change = (fit.hypothesis.offset - reading.offset)[joint]
            if abs(change) >= min_offset and fit.misfit <= base.misfit - GEOMETRY.needed / 2:
                yield fit

    def text(self, correction: Correction) -> str:
        """Return the text about zero offsets, with the largest change of an offset."""
        shifts = correction.hypothesis.offset - correction.unchanged.offset
        k = int(np.abs(shifts).argmax())
        size = f"{np.rad2deg(shifts[k]):.3g} degrees"
        if correction.arm.coordinates[k].joint_type == "prismatic":
            size = f"{shifts[k]:.3g} m"
        return f"positions with another zero, by {size}"

    def joint_keys(self, correction: Correction, joint: int) -> dict[str, object]:
        """Return the setting `offset` [rad, m] of a joint whose zero `correction` changes; {} for other joints."""
        offset = correction.hypothesis.offset[joint]
        if offset == correction.unchanged.offset[joint]:
            return {}
        return {"offset": plain_number(offset)}

    def minor_code(self, correction: Correction) -> str:
        """Return `code`, the code of a warning, if all zero offsets are small; otherwise "", and the fault is an error.

        Offsets below `GEOMETRY.serious_angle` [rad] or `serious_shift` [m] are within the typical errors of a URDF.
        """
        shifts = np.abs(correction.hypothesis.offset - correction.unchanged.offset)
        is_revolute = np.array(correction.arm.joint_types) == "revolute"
        bounds = np.where(is_revolute, GEOMETRY.serious_angle, GEOMETRY.serious_shift)
        return self.code if (shifts < bounds).all() else ""


class Compensation(Fault):
    """Kind of fault of a log: a controller compensates gravity, or a part of it, and the torques lack this part."""

    code = "gravity-compensated"
    rarity = 3
    is_optimised = True

    def fits(self, problem: GeometryProblem, base: HypothesisFit) -> Iterator[HypothesisFit]:
        """Yield the least-squares fit of torques that contain only a fraction of the gravity torque, or none of it.

        The best fraction between -0.5 and 0.5 is used; it is negative if gravity is compensated too strongly. The fit
        without gravity is preferred if its cost is about equal.
        """
        present = np.array(base.hypothesis.gravity)
        if not present.any():
            return

        def reduced(fraction: np.ndarray) -> Hypothesis:
            """Return the hypothesis that the torques contain only a fraction of the gravity torque; fraction: (1,)."""
            return with_gravity(self, base, fraction * present)

        without = problem.fit(reduced(np.zeros(1)))
        # The logged torques contain the fraction -0.5 to 0.5 of the gravity torque: if they contained more than half of
        # it in all joints, wrong masses of the URDF would be a more likely reason than a compensation of gravity.
        fraction, _ = problem.descend(
            reduced, np.zeros(1), largest=0.5, smallest=1e-3, allowed=lambda x: np.clip(x, -0.5, 0.5)
        )
        some = problem.fit(with_gravity(self, base, (fraction * present).round(3)))
        yield some if some.cost < without.cost - GEOMETRY.ambiguous else without

    def text(self, correction: Correction) -> str:
        """Return the text about a gravity compensation, with the fraction of gravity that remains in the torques."""
        present = np.array(correction.unchanged.gravity)
        fraction = float(np.array(correction.hypothesis.gravity) @ present / (present @ present))
        return f"torques in which gravity is compensated: {fraction:.2g} times the URDF's gravity remains in all joints"

    def robot_keys(self, correction: Correction) -> dict[str, object]:
        """Return the setting `gravity` [m/s^2]: the vector of gravity in the hypothesis of `correction`."""
        return {"gravity": [plain_number(x) for x in correction.hypothesis.gravity]}


class Gravity(Compensation):
    """Kind of fault of a log: gravity has another direction, since the arm is not mounted as the settings state."""

    code = "gravity"
    rarity = 1

    def fits(self, problem: GeometryProblem, base: HypothesisFit) -> Iterator[HypothesisFit]:
        """Yield the least-squares fit of the torques with the best direction of gravity.

        Directions along the axes of the root link are preferred. Nothing is yielded if the direction differs from the
        direction in `base` by less than errors of the mounting (`GEOMETRY.min_tilt`), or if a gravity compensation
        explains the torques equally well.
        """
        present = np.array(base.hypothesis.gravity)
        size = float(np.linalg.norm(present))
        standard = size or 9.81  # [m/s^2] magnitude of gravity in `base`; 9.81 if it is zero

        def turned(gravity: np.ndarray) -> Hypothesis:
            """Return the hypothesis that gravity is this vector, (3,) [m/s^2]."""
            return with_gravity(self, base, gravity)

        def normalised(gravity: np.ndarray) -> np.ndarray:
            """Return the vector (3,) [m/s^2] in the direction of `gravity`, scaled to the magnitude `standard`."""
            return gravity * standard / max(float(np.linalg.norm(gravity)), 1e-9)

        # Gravity along -z is the first start, so it is preferred if the log does not determine the sign of gravity.
        # Example: only a vertical prismatic joint carries a gravity load. This load is constant, so the torque offset
        # of the friction model explains it for either sign.
        starts = [problem.fit(turned(standard * axis)) for axis in (*-np.eye(3)[::-1], *np.eye(3))]
        lowest = min(fit.cost for fit in starts)
        start = next(fit for fit in starts if fit.cost < lowest + 1.0)
        smallest = 0.01 * standard
        find = partial(problem.descend, turned, largest=standard, smallest=smallest, allowed=normalised)
        descents = [find(np.array(fit.hypothesis.gravity)) for fit in [start, *([base] if size else [])]]
        new, best = min(descents, key=lambda x: x[1].cost)
        # Gravity parallel to the axes of all joints causes no torque. If the torques contain no gravity, such a
        # direction therefore explains them as well as zero gravity does, and a gravity compensation is more likely. A
        # direction must thus have a lower cost than zero gravity. The exception is a direction found from the start -z,
        # the gravity of an upright arm, which is the most frequent mounting.
        is_likely = start is starts[0] or best.cost < problem.fit(turned(np.zeros(3))).cost - 1.0
        if is_likely and np.linalg.norm(new - present) > GEOMETRY.min_tilt * size:
            nearest = np.linalg.norm(new) * np.sign(new) * (np.abs(new) == np.abs(new).max())
            axis = problem.fit(turned(nearest))
            is_axis = axis.cost < best.cost + GEOMETRY.right_angle
            yield axis if is_axis else problem.fit(turned(new.round(3)))

    def text(self, correction: Correction) -> str:
        """Return the text about the orientation of the arm, with the angle between two directions of gravity [degrees].

        One is the direction in the settings, the other is the direction in the hypothesis of `correction`.
        """
        present, new = np.array(correction.unchanged.gravity), np.array(correction.hypothesis.gravity)
        cosine = float(new @ present / max(np.linalg.norm(new) * np.linalg.norm(present), 1e-9))
        angle = np.rad2deg(np.arccos(np.clip(cosine, -1, 1)))
        return f"torques of a gravity that is {angle:.3g} degrees from its direction in the settings"

    def minor_code(self, correction: Correction) -> str:
        """Return `code`, the code of a warning, if gravity is tilted slightly; otherwise "", and the fault is an error.

        Tilts below `GEOMETRY.serious_angle` [rad] are within the typical errors of the mounting.
        """
        present, new = np.array(correction.unchanged.gravity), np.array(correction.hypothesis.gravity)
        is_small = np.linalg.norm(present - new) < GEOMETRY.serious_angle * np.linalg.norm(present)
        return self.code if is_small else ""


def with_gravity(fault: Fault, base: HypothesisFit, gravity: np.ndarray) -> Hypothesis:
    """Return the hypothesis of `base` with another vector of gravity, (3,) [m/s^2], as a correction of `fault`."""
    x, y, z = (float(value) + 0.0 for value in gravity)
    return base.hypothesis.changed(fault, gravity=(x, y, z))
