"""Kinds of faults of the columns of a log: columns of other joints, signals of the opposite sense or another unit."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np
from scipy.optimize import minimize_scalar

from spelgen.arm.arm import Chain
from spelgen.identification.hypotheses import Correction, Fault, Hypothesis, HypothesisFit
from spelgen.identification.log_geometry import GeometryProblem
from spelgen.identification.tuning import GEOMETRY
from spelgen.logs.joint_signals import plain_number
from spelgen.settings.log_mapping import SCALES

UNITS = {"revolute": ("rad", "deg", "turns"), "prismatic": ("m", "mm")}


class WrongOrder(Fault):
    """Kind of fault of a log: the columns of the joints are in another order."""

    def __init__(self, code: str, description: str, rows: tuple[int, ...], starts: int = 9) -> None:
        """Define the columns of a log (motion, torques or both) that may belong to other joints.

        Args:
            code: code of the finding.
            description: text about the exchanged columns.
            rows: rows of `Hypothesis.source` that are permuted, 0 for the motion and 1 for the torques.
            starts: number of orders from which the search for the best order starts, at most 9.
        """
        self.code, self.description = code, description
        self._rows, self._starts = rows, starts

    def fits(self, problem: GeometryProblem, base: HypothesisFit) -> Iterator[HypothesisFit]:
        """Yield least-squares fits of the log's torques with the columns of two joints exchanged, for all pairs."""
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
        # fits are cached, since searches from several starts visit the same orders
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
                best = min(map(fitted, self._swapped(fit.hypothesis)), key=lambda x: x.rank)
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
    """Base class of faults that are corrected by factors: motion or torques of the opposite sense or in another unit.

    factors: candidates for the factors, (2, n) each: first row for the motion, second row for the torques of n joints.

    All subclasses share the method `joint_keys`, which converts the factors to settings. The setting `sign` reverses
    both the motion and the torque of a joint. If only the motion is wrong, the setting `gain` of the torque is
    therefore negated, too.
    """

    def __init__(self, factors: Sequence[np.ndarray]) -> None:
        """Define the candidates for factors on the motion and torque of n joints, (2, n) each."""
        self.factors = factors

    @abstractmethod
    def has(self, motion: np.ndarray, torque: np.ndarray) -> np.ndarray:
        """Return the mask (n,) of the joints with this fault.

        motion, torque: (n,) factors that correct the joints' motion and torques.
        """

    def fits(self, problem: GeometryProblem, base: HypothesisFit) -> Iterator[HypothesisFit]:
        """Yield least-squares fits of the log's torques, with the scales in `base` multiplied by each of `factors`."""
        return self._scaled_by(self.factors, problem, base)

    def _scaled_by(
        self, factors: Sequence[np.ndarray], problem: GeometryProblem, base: HypothesisFit
    ) -> Iterator[HypothesisFit]:
        """Yield, for each array of `factors`, the least-squares fits of the log's torques with scaled signals.

        Rows of an array (2, n) are factors on the motion and on the torques in the hypothesis of the fit `base`.
        """
        reading = base.hypothesis
        for factor in factors:
            # Both signs of the offset are tried: the offset in the mapping may have been measured with the right or the
            # wrong sign.
            offsets = {x.tobytes(): x for x in (reading.offset, np.sign(factor[0]) * reading.offset + 0.0)}
            for offset in offsets.values():
                yield problem.fit(reading.changed(self, scale=reading.scale * factor, offset=offset))

    def joint_keys(self, correction: Correction, joint: int) -> dict[str, object]:
        """Return the settings that correct the scale of a joint's signals; unchanged settings are omitted.

        These settings are `sign`, `units`, `gain`, `torque_offset` and `offset`.
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
            unit = position_unit(correction, joint)
            units = {"q": unit, "qd": f"{unit}/s"}
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
    """Kind of fault of a log: a joint's positions and velocities, and perhaps its torques, have the opposite sense."""

    code = "joint-sense"

    def __init__(self, n: int) -> None:
        signs = 1.0 - 2.0 * np.eye(n)
        super().__init__([np.stack([sign, torque]) for sign in signs for torque in (np.ones(n), sign)])

    def has(self, motion: np.ndarray, torque: np.ndarray) -> np.ndarray:
        """Return the mask (n,) of the joints whose motion has the opposite sense: its correction factor is negative.

        motion, torque: (n,) correction factors of the joints.
        """
        return np.asarray(motion < 0)

    def text(self, correction: Correction) -> str:
        """Return the text about joints whose motion is opposite to the URDF's sense, and the sense of their torques."""
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
        return np.asarray((torque < 0) & (motion > 0))


class TorqueUnit(WrongScale):
    """Kind of fault of a log: torques in another unit, with a factor of at least 5.

    The factors are fitted together with the inertial parameters: the dynamic coupling of the joints determines their
    ratios, and the masses of the URDF determine their common factor. A common factor need not lower the cost, unlike
    other faults: the fit without it may explain torques that are too small with bodies that are too light.
    """

    code = "torque-unit"
    rarity = 2
    needed = 0.0
    evidence = "by the URDF's masses"

    def __init__(self, is_open: np.ndarray, is_milli: np.ndarray) -> None:
        """Define the joints that are tested.

        is_open: (n,) True for joints whose torque may have another unit: the mapping states mNm or none. is_milli: (n,)
        True for torques declared in mNm.
        """
        super().__init__([])
        self._is_open, self._is_milli = is_open, is_milli

    def fits(self, problem: GeometryProblem, base: HypothesisFit) -> Iterator[HypothesisFit]:
        """Yield least-squares fits of torques with a common factor, with factors of few joints, and of all joints.

        A factor of a single joint must lower the cost by more than `rarity`: only the masses of the URDF determine the
        load of the last joint, for example.
        """
        extended, reading = problem.with_free_gains(), base.hypothesis
        signals = reading.signals(problem.samples)
        of_urdf = signals.tau + problem.residual(reading, problem.prior_mean)
        correlated = np.where((signals.tau * of_urdf).sum(axis=0) < 0, -1.0, 1.0)
        # The torques of all joints, or of those whose torque opposes the URDF's, may also have the opposite sense.
        for sense in np.unique([-np.ones_like(correlated), correlated], axis=0):
            opposite = extended.fit(
                reading.changed(self, scale=reading.scale * np.stack([np.ones_like(sense), sense]))
            )
            factors = opposite.gains
            if (sense < 0).all():
                factors = np.full_like(factors, self._common(factors))
            is_changed = (sense < 0) & self._is_open & is_other_unit(factors)
            if is_changed.any():
                factors = np.where(is_changed, [-rounded_factor(x) for x in factors], 1.0)
                scaled = self._of_masses if is_changed.all() else self._scaled
                yield scaled(problem, base, factors)
        gains = np.where(self._is_open, extended.fit(reading).gains, 1.0)
        common = self._common(gains)
        shared = rounded_factor(common) if is_other_unit(common) else 1.0
        factors, best = np.full(len(gains), shared), base
        if shared != 1.0:
            best = self._of_masses(problem, base, factors)
            yield best
        differing = is_other_unit(gains / common)
        # relative to the other joints or by the masses of the URDF, whichever explains the torques better
        options = []
        for ratio in (shared / common, 1.0):
            options.append(np.where(differing, list(map(rounded_factor, ratio * gains)), factors))
        fit, factors = min(((self._scaled(problem, base, x), x) for x in options), key=lambda x: x[0].cost)
        for k in np.flatnonzero(differing):
            fewer = np.where(np.arange(len(gains)) == k, shared, factors)
            without = self._scaled(problem, base, fewer)
            if without.cost < fit.cost + self.rarity:
                factors, fit, gains[k] = fewer, without, common
        if (factors != shared).any():
            yield fit
            best = min(best, fit, key=lambda x: x.cost)
        # Separate factors also correct errors of the URDF's masses, which lowers the prior term of the cost: they must
        # be large enough for another unit, lower the torque residual, too, and explain the torque of each joint. Joints
        # with about the same factor get the same one.
        gains[np.abs(np.log(gains / common)) < np.log(1.5)] = common
        if is_other_unit(gains / gains[:, None]).any() or is_other_unit(gains).any():
            fit = self._scaled(problem, base, gains)
            is_better = min(best.cost - fit.cost, 2 * (best.misfit - fit.misfit)) > GEOMETRY.needed
            if is_better and fit.errors.max() <= GEOMETRY.unexplained:
                yield fit

    def _of_masses(self, problem: GeometryProblem, fit: HypothesisFit, factors: np.ndarray) -> HypothesisFit:
        """Return the fit of lowest cost if a number from 1/3 to 3 multiplies all factors (n,) that are not 1."""

        def multiplied(exponent: float) -> HypothesisFit:
            return self._scaled(problem, fit, np.where(factors == 1.0, 1.0, factors * np.exp(exponent)))

        options = {"xatol": 0.05}
        found = minimize_scalar(
            lambda x: multiplied(x).cost, bounds=(-np.log(3), np.log(3)), method="bounded", options=options
        )
        return multiplied(found.x)

    def _common(self, gains: np.ndarray) -> float:
        """Return the gain with which most of n gains agree, up to a ratio of 2, and the one nearest to 1 of several.

        1 is returned if the unit of some joints is right.
        """
        logarithms = np.log(gains)
        agreeing = (np.abs(logarithms[:, None] - logarithms) < np.log(2)).sum(axis=1)
        best = np.lexsort((np.abs(logarithms), -agreeing))[0]
        return float(gains[best]) if self._is_open.all() else 1.0

    def _scaled(self, problem: GeometryProblem, fit: HypothesisFit, factors: np.ndarray) -> HypothesisFit:
        """Return the least-squares fit of the torques after multiplication by `factors` (n,), rounded to three digits.

        For torques declared in mNm, a factor near 1000 becomes 1000: the logged numbers are in Nm, and the factor is
        inexact because the masses of the URDF are.
        """
        rounded = np.array([float(f"{x:.3g}") for x in factors])
        is_unit = self._is_milli & ~is_other_unit(rounded / 1e3)
        rounded[is_unit] = np.copysign(1e3, rounded[is_unit])
        motion, torque = fit.hypothesis.scale
        return problem.fit(fit.hypothesis.changed(self, scale=np.stack([motion, rounded * torque])))

    def has(self, motion: np.ndarray, torque: np.ndarray) -> np.ndarray:
        """Return the mask (n,) of the joints whose torque has another unit than the mapping states.

        motion, torque: (n,) correction factors of the joints; only `torque` counts: it is neither 1 nor -1.
        """
        return np.asarray(np.abs(torque) != 1)

    def text(self, correction: Correction) -> str:
        """Return the text about torques in another unit, with the factor of the joint whose |log |factor|| is largest.

        If this factor is negative, the text also states that the sense is opposite, unless the hypothesis contains
        `JointSense` or `TorqueSense`, whose texts state it.
        """
        torque = correction.factors[1]
        largest = torque[np.abs(np.log(np.abs(torque))).argmax()]
        senses = (JointSense, TorqueSense)
        is_reversed = largest < 0 and not any(isinstance(x, senses) for x in correction.hypothesis.faults)
        sense = " and of the opposite sense" if is_reversed else ""
        times = f"{abs(1 / largest):.3g} times as large"
        if np.ptp(np.abs(torque[torque != 1])):
            times = f"by another factor at each joint, up to {times}"
        return f"torques of another unit{sense}, {times}"

    def minor_code(self, correction: Correction) -> str:
        """Return the code of a warning if all factors on the torques are between 0.1 and 10; else "", for an error.

        Masses of a URDF may be wrong by such a factor, but never by a factor of ten.
        """
        torque = correction.factors[1]
        return "torque-scale" if (torque > 0.1).all() and (torque < 10).all() else ""


def is_other_unit(factor: np.ndarray | float) -> np.ndarray:
    """Return True for ratios of the gravity in logged torques to the URDF's gravity torque that show another unit.

    Wrong inertials do not explain a ratio whose magnitude is at least `GEOMETRY.other_unit`, or at most its inverse.
    factor: a ratio, or an array of ratios; the result has the same shape.
    """
    return np.asarray(np.abs(np.log(np.abs(factor))) >= np.log(GEOMETRY.other_unit))


def rounded_factor(factor: float) -> float:
    """Return a factor on torques, rounded for a message; its sign remains.

    A factor near 0.001 becomes 0.001, the factor from mNm to Nm. Any other factor is rounded to one digit if this
    changes it by less than 10 %, otherwise to two digits.
    """
    if 1 / 1.5 < abs(factor) / 1e-3 < 1.5:
        # The tolerance of 1.5 is wide, since the factor is only as exact as the masses of the URDF.
        return float(np.copysign(1e-3, factor))
    one = float(f"{factor:.1g}")
    return one if abs(one - factor) < 0.1 * abs(factor) else float(f"{factor:.2g}")


class PositionUnit(WrongScale):
    """Kind of fault of a log: positions of all revolute or all prismatic joints in another unit than in the mapping."""

    code = "joint-unit"
    rarity = 2

    def has(self, motion: np.ndarray, torque: np.ndarray) -> np.ndarray:
        """Return the mask (n,) of the joints whose positions have another unit than the mapping states.

        motion, torque: (n,) correction factors of the joints; only `motion` counts: it is neither 1 nor -1.
        """
        return np.asarray(np.abs(motion) != 1)

    def text(self, correction: Correction) -> str:
        """Return the text that the positions have another unit, with the name of the unit in `correction`."""
        joints = np.flatnonzero(self.has(*correction.factors)).tolist()
        return f"positions in {' and '.join(dict.fromkeys(position_unit(correction, k) for k in joints))}"


def position_factors(arm: Chain, scale: np.ndarray) -> list[np.ndarray]:
    """Return candidates for factors (2, n) that correct the unit of the positions of all joints of one type.

    There is one candidate for each type of joint and each unit that differs from the unit in the mapping; torques have
    the factor 1.

    scale: (n,) factor from logged positions to SI units in the current mapping; negative for joints with the setting
    `sign: -1`.
    """
    types, candidates = np.array(arm.joint_types), []
    for joint_type, units in UNITS.items():
        for unit in units:
            motion = np.where(types == joint_type, SCALES.get(unit, 1.0) / np.abs(scale), 1.0)
            if (motion != 1).any():
                candidates.append(np.stack([motion, np.ones_like(motion)]))
    return candidates


def position_unit(correction: Correction, joint: int) -> str:
    """Return the unit, such as "deg", that a hypothesis about a log assumes for the positions of a joint.

    It is the unit whose factor to SI units is nearest to the scale of the positions in the hypothesis.
    """
    scale = abs(float(correction.hypothesis.scale[0, joint]))
    units = UNITS[correction.arm.coordinates[joint].joint_type]
    return min(units, key=lambda unit: abs(np.log(scale / SCALES.get(unit, 1.0))))
