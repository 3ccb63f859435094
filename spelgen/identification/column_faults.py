"""Kinds of faults of the columns of a log: columns of other joints, or signals of the opposite sense."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np

from spelgen.identification.hypotheses import Correction, Fault, Hypothesis, HypothesisFit
from spelgen.identification.log_geometry import GeometryProblem
from spelgen.identification.tuning import GEOMETRY
from spelgen.logs.joint_signals import plain_number
from spelgen.settings.log_mapping import SCALES

UNITS = {"revolute": ("rad", "deg", "turns"), "prismatic": ("m", "mm")}


class WrongOrder(Fault):
    """Kind of fault of a log: the columns of some joints contain the signals of other joints."""

    def __init__(self, code: str, description: str, rows: tuple[int, ...], starts: int = 9) -> None:
        """Define the columns of a log (motion, torques or both) that may belong to other joints.

        Args:
            code: code of the finding.
            description: text about the exchanged columns.
            rows: rows of `Hypothesis.source` that are permuted, 0 for the motion and 1 for the torques.
            starts: number of initial orders of the joints, at most 9, from which the best order is searched.
        """
        self.code, self.description = code, description
        self._rows, self._starts = rows, starts
        # the columns of whole joints are exchanged more often than only the motions or only the torques, whose
        # hypotheses therefore have a penalty of 2 on the cost
        self.rarity = 0 if len(rows) == 2 else 2

    def fits(self, problem: GeometryProblem, base: HypothesisFit) -> Iterator[HypothesisFit]:
        """Yield, for each pair of joints, the least-squares fit of the log's torques with their columns exchanged.

        The other corrections in `base` remain.
        """
        return map(problem.fit, self._swapped(base.hypothesis))

    def _swapped(self, base: Hypothesis) -> Iterator[Hypothesis]:
        for pair in combinations(range(len(base.offset)), 2):
            source = base.source.copy()
            source[np.ix_(self._rows, pair)] = source[np.ix_(self._rows, pair[::-1])]
            yield base.changed(self, source=source)

    def thorough_fits(self, problem: GeometryProblem, unchanged: HypothesisFit) -> Iterator[HypothesisFit]:
        """Yield least-squares fits of the log's torques with the best order of the columns that each search finds.

        Each search starts at another order of the joints' columns, and exchanges two joints at a time. Some of the
        orders are random, since the cost has local minima for arms with many joints. unchanged: fit of the unchanged
        log.
        """
        joints, rng = problem.arm.joint_names, np.random.default_rng(0)
        present = np.arange(len(joints))
        # The first three orders: unchanged, reversed, and alphabetical, since joints may be logged in the order of
        # their names.
        starts = [present, present[::-1], np.argsort(np.argsort(joints))]
        starts += [rng.permutation(len(joints)) for _ in range(6)]
        # fits are cached, since searches from several starts reach the same permutations of the columns
        known: dict[bytes, HypothesisFit] = {}

        def fitted(hypothesis: Hypothesis) -> HypothesisFit:
            key = hypothesis.source.tobytes()
            if key not in known:
                known[key] = problem.fit(hypothesis)
            return known[key]

        for start in starts[: self._starts]:
            source = unchanged.hypothesis.source.copy()
            source[list(self._rows)] = start
            fit = fitted(unchanged.hypothesis.changed(self, source=source))
            while True:
                best = min(map(fitted, self._swapped(fit.hypothesis)), key=lambda x: x.rank, default=fit)
                if best.cost > fit.cost - 1.0:
                    break
                fit = best
            if (fit.hypothesis.source != present).any():
                yield fit

    def joint_keys(self, correction: Correction, joint: int) -> dict[str, object]:
        """Return the settings that assign the right columns of the log to a joint; {} if it has its own columns.

        If all columns belong to one other joint, the setting is `name`, the name of that joint in the log; otherwise
        `columns`, the column of each quantity.
        """
        names, mapping = correction.arm.joint_names, correction.mapping
        motion, torque = (names[k] for k in correction.hypothesis.source[:, joint])
        if correction.by_name and motion == torque != names[joint]:
            return {"name": mapping.log_name(motion)}
        columns = {}
        for quantity in mapping.quantities:
            source = torque if quantity == "tau" else motion
            if source != names[joint]:
                columns[quantity] = mapping.column(quantity, source)
        return {"columns": columns} if columns else {}


class WrongScale(Fault):
    """Base class of faults that are corrected by factors: motion or torques of another sign or in another unit.

    factors: candidates for the factors, (2, n) each: first row for the motion, second row for the torques of n joints.

    All subclasses share the method `joint_keys`, which converts the factors to settings. The setting `sign` reverses
    both the motion and the torque of a joint. If only the motion is wrong, the setting `gain` of the torque is negated,
    too, so that the torque keeps its sign.
    """

    def __init__(self, factors: Sequence[np.ndarray]) -> None:
        """Define the candidates for the correction factors of n joints, (2, n) each: on the motion, on the torque."""
        self.factors = factors

    @abstractmethod
    def has(self, motion: np.ndarray, torque: np.ndarray) -> np.ndarray:
        """Return the mask (n,) of the joints with this fault.

        motion, torque: (n,) factors that correct the joints' motion and torques.
        """

    def fits(self, problem: GeometryProblem, base: HypothesisFit) -> Iterator[HypothesisFit]:
        """Yield least-squares fits of the log's torques, one or two for each candidate in `factors`.

        The correction factors of a candidate multiply the scales of motion and torques in the hypothesis of `base`.
        """
        return self._scaled_by(self.factors, problem, base)

    def _scaled_by(
        self, factors: Sequence[np.ndarray], problem: GeometryProblem, base: HypothesisFit
    ) -> Iterator[HypothesisFit]:
        """Yield least-squares fits of the log's torques with signals that are scaled by each array of `factors`.

        An array (2, n) has the factors on the motion, then the factors on the torques of n joints. The scales in the
        hypothesis of the fit `base` are multiplied by these factors. If the motion of a joint with a zero offset has a
        negative factor, two fits are yielded, with either sign of the offset: its sign after the reversal is unknown.
        """
        reading = base.hypothesis
        for factor in factors:
            # Both signs of the offset are tried: the offset in the mapping may have been measured with the right or the
            # wrong sign.
            offsets = {x.tobytes(): x for x in (reading.offset, np.sign(factor[0]) * reading.offset + 0.0)}
            for offset in offsets.values():
                yield problem.fit(reading.changed(self, scale=reading.scale * factor, offset=offset))

    def joint_keys(self, correction: Correction, joint: int) -> dict[str, object]:
        """Return the settings that correct the scale or the sign of a joint's signals; unchanged settings are omitted.

        The settings are `sign`, `units`, `gain`, `torque_offset` and `offset`.
        """
        if not self.has(*correction.factors)[joint]:
            return {}
        name, (motion, torque) = correction.arm.joint_names[joint], correction.factors[:, joint].tolist()
        present = correction.mapping.joint(name)
        keys: dict[str, object] = {}
        units = {}
        if motion < 0:
            keys["sign"] = -present.sign
        if abs(motion) != 1:
            unit = position_unit(correction, joint) or "counts"
            units = {"q": unit, "qd": f"{unit}/s"}
            if unit == "counts":
                ratio = 1 / abs(float(correction.hypothesis.scale[0, joint]))
                is_turning = correction.arm.joint_types[joint] == "revolute"
                key, turn = ("counts_per_turn", 2 * np.pi) if is_turning else ("counts_per_metre", 1.0)
                keys[key] = plain_number(turn * ratio)
        gain = torque * np.sign(motion)
        if correction.mapping.unit("tau", name) == "mNm" and np.isclose(abs(gain), 1e3):
            units["tau"] = "Nm"
            gain /= 1e3
        if units:
            keys["units"] = units
        if gain != 1.0:
            keys["gain"] = plain_number((present.gain or 1.0) * gain)
        if present.torque_offset and torque != np.sign(motion):
            keys["torque_offset"] = present.torque_offset * torque
        if motion < 0 and correction.hypothesis.offset[joint] != correction.unchanged.offset[joint]:
            keys["offset"] = plain_number(correction.hypothesis.offset[joint])
        return keys


class JointSense(WrongScale):
    """Kind of fault of a log: the positive direction of a joint's positions and velocities is opposite to the URDF's.

    The torques of the joint may have the opposite sign, too.
    """

    code = "joint-sense"

    def __init__(self, n: int) -> None:
        signs = 1.0 - 2.0 * np.eye(n)
        super().__init__([np.stack([sign, torque]) for sign in signs for torque in (np.ones(n), sign)])

    def has(self, motion: np.ndarray, torque: np.ndarray) -> np.ndarray:
        """Return the mask (n,) of the joints whose motion is reversed: its correction factor is negative.

        motion, torque: (n,) correction factors of the joints' motion and torques; the torques may be reversed or not.
        """
        return motion < 0

    def text(self, correction: Correction) -> str:
        """Return the text about joints whose positive direction of motion is opposite to the URDF's.

        The text also states whether the torques of these joints are reversed: all, none or some.
        """
        motion, torque = correction.factors
        is_reversed = torque[motion < 0] < 0
        if is_reversed.all():
            return "positions, velocities and torques of the opposite sense"
        right = "torques of the right one" if not is_reversed.any() else "torques of either sense"
        return f"positions and velocities of the opposite sense, and {right}"


class TorqueSense(WrongScale):
    """Kind of fault of a log: the torques of all joints, or of one joint, have the opposite sense."""

    code = "torque-sense"
    description = "torques of the opposite sense"

    def __init__(self, n: int) -> None:
        super().__init__([np.stack([np.ones(n), sign]) for sign in (-np.ones(n), *(1.0 - 2.0 * np.eye(n)))])

    def has(self, motion: np.ndarray, torque: np.ndarray) -> np.ndarray:
        """Return the mask (n,) of the joints of which only the torque has the opposite sense.

        motion, torque: (n,) correction factors. For joints in the mask, `motion` is positive and `torque` negative.
        """
        return (torque < 0) & (motion > 0)


class TorqueGain(WrongScale):
    """Kind of fault of a log: the torques of single joints are about half or twice the true torques."""

    code = "torque-scale"
    # A hypothesis with this fault must lower the cost by 40. On recorded arms, the largest decrease of a wrong one is
    # 30, on 62 simulated arms with wrong inertials 23. Factors of 2 lower it by more at most joints that carry a load.
    needed = 2 * GEOMETRY.needed

    def __init__(self, is_open: np.ndarray) -> None:
        """Define the candidates: a factor 0.5 or 2 for each joint of the mask `is_open`, (n,)."""
        scales = [np.where(x, factor, 1.0) for x in np.eye(len(is_open))[is_open] for factor in (0.5, 2.0)]
        super().__init__([np.stack([np.ones_like(x), x]) for x in scales])

    def has(self, motion: np.ndarray, torque: np.ndarray) -> np.ndarray:
        """Return the mask (n,) of the joints whose torque has a correction factor.

        motion, torque: (n,) correction factors of the joints' motion and torques. `motion` is not used here.
        """
        return np.asarray(torque != 1)

    def text(self, correction: Correction) -> str:
        """Return the text about the torques of single joints, with the ratio of the torques to the expected torques."""
        torque = correction.factors[1]
        ratios = dict.fromkeys(f"{1 / x:.2g}" for x in torque[torque != 1])
        return f"torques about {' or '.join(ratios)} times as large as other joints and the inertials explain"

    def minor_code(self, correction: Correction) -> str:
        """Return the code of a warning: the inertials of the URDF may be the reason."""
        return self.code


def position_unit(correction: Correction, joint: int) -> str | None:
    """Return the unit, such as "deg", that a hypothesis about a log assumes for the positions of a joint.

    None is returned for a scale of the positions that is no unit in `UNITS`.
    """
    scale = abs(float(correction.hypothesis.scale[0, joint]))
    units = UNITS[correction.arm.joint_types[joint]]
    return next((unit for unit in units if np.isclose(scale, SCALES.get(unit, 1.0))), None)
