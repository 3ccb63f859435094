"""Faults of the columns of a log: other joints, the opposite sense, another unit."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np
from scipy.optimize import minimize_scalar

from spelgen.arm.arm import Chain
from spelgen.identification.hypotheses import Hypothesis, HypothesisFit
from spelgen.identification.log_faults import Correction, Fault
from spelgen.identification.log_geometry import GeometryProblem
from spelgen.identification.tuning import GEOMETRY
from spelgen.logs.joint_signals import plain_number
from spelgen.settings.log_mapping import SCALES

# [1] Smallest factor between torques and the URDF's gravity that wrong inertials do not explain.
OTHER_UNIT = 5.0
UNITS = {"revolute": ("rad", "deg", "turns"), "prismatic": ("m", "mm")}


class WrongOrder(Fault):
    """Columns of the joints in another order."""

    def __init__(self, code: str, description: str, rows: tuple[int, ...], starts: int = 9) -> None:
        """Define the columns that are in another order.

        Args:
            code: code of the finding.
            description: text about the exchanged columns.
            rows: rows of `Hypothesis.source` that are permuted, 0 for the motion and 1 for the torques.
            starts: number of orders from which the search for the best order starts, at most 9.
        """
        self.code, self.description = code, description
        self._rows, self._starts = rows, starts

    def fits(self, problem: GeometryProblem, base: HypothesisFit) -> Iterator[HypothesisFit]:
        """Yield the fits with the columns of two joints exchanged, for all pairs."""
        return map(problem.fit, self._swapped(base.hypothesis))

    def _swapped(self, base: Hypothesis) -> Iterator[Hypothesis]:
        for pair in combinations(range(len(base.offset)), 2):
            source = base.source.copy()
            source[np.ix_(self._rows, pair)] = source[np.ix_(self._rows, pair[::-1])]
            yield base.changed(self, source=source)

    def thorough_fits(self, problem: GeometryProblem, unchanged: HypothesisFit) -> Iterator[HypothesisFit]:
        """Yield the fits with the best orders of all joints, one per start of the search.

        An order is improved by exchanging two joints at a time. The search also starts at random orders, since the
        cost has local minima for arms with many joints.
        """
        joints, rng = problem.arm.joint_names, np.random.default_rng(0)
        present = np.arange(len(joints))
        # joints may be logged in the alphabetical order of their names
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
        """Return the name of the joint in the log if all its columns belong to one joint; else the columns."""
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
    """Signals of joints in another sense or unit.

    factors: candidates (2, n) for factors on the motion and on the torques of n joints. The settings are the same for
    all kinds of scales, since the setting `sign` applies to the motion and to the torque of a joint.
    """

    def __init__(self, factors: Sequence[np.ndarray]) -> None:
        """Define the candidates, (2, n) each."""
        self.factors = factors

    @abstractmethod
    def has(self, motion: np.ndarray, torque: np.ndarray) -> np.ndarray:
        """Return the mask (n,) of the joints with this fault, for factors on their motion and torques (n,)."""

    def fits(self, problem: GeometryProblem, base: HypothesisFit) -> Iterator[HypothesisFit]:
        """Yield the fits with each candidate."""
        return self._scaled_by(self.factors, problem, base)

    def _scaled_by(
        self, factors: Sequence[np.ndarray], problem: GeometryProblem, base: HypothesisFit
    ) -> Iterator[HypothesisFit]:
        reading = base.hypothesis
        for factor in factors:
            # the offset in the mapping may have been measured with the right or with the wrong sign
            offsets = {x.tobytes(): x for x in (reading.offset, np.sign(factor[0]) * reading.offset + 0.0)}
            for offset in offsets.values():
                yield problem.fit(reading.changed(self, scale=reading.scale * factor, offset=offset))

    def joint_keys(self, correction: Correction, joint: int) -> dict[str, object]:
        """Return the sign, the units and the gain of a joint, and the offsets of its position and torque."""
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
    """Positions and velocities of a joint that have the opposite sense, with or without its torque."""

    code = "joint-sense"

    def __init__(self, n: int) -> None:
        signs = 1.0 - 2.0 * np.eye(n)
        super().__init__([np.stack([sign, torque]) for sign in signs for torque in (np.ones(n), sign)])

    def has(self, motion: np.ndarray, torque: np.ndarray) -> np.ndarray:
        """Return the mask (n,) of the joints whose motion has the opposite sense."""
        return np.asarray(motion < 0)

    def text(self, correction: Correction) -> str:
        """Return a description of the signals of the opposite sense."""
        motion, torque = correction.factors
        is_reversed = torque[motion < 0] < 0
        if is_reversed.all():
            return "positions, velocities and torques of the opposite sense"
        right = "torques of the right one" if not is_reversed.any() else "torques of either sense"
        return f"positions and velocities of the opposite sense, and {right}"


class TorqueSense(WrongScale):
    """Torques of the opposite sense, of all joints or of one joint."""

    code = "torque-sense"
    description = "torques of the opposite sense"

    def __init__(self, n: int) -> None:
        super().__init__([np.stack([np.ones(n), sign]) for sign in (-np.ones(n), *(1.0 - 2.0 * np.eye(n)))])

    def has(self, motion: np.ndarray, torque: np.ndarray) -> np.ndarray:
        """Return the mask (n,) of the joints of which only the torque has the opposite sense."""
        return np.asarray((torque < 0) & (motion > 0))


class TorqueUnit(WrongScale):
    """Torques in another unit, which has a factor larger than 5.

    The evidence for a factor is the magnitude of the gravity in the torques, and no decrease of the cost is required:
    light bodies can explain torques that are too small.
    """

    code = "torque-unit"
    rarity = 2
    needed = 0.0
    evidence = "by the URDF's gravity"

    def __init__(self, factors: Sequence[np.ndarray], is_open: np.ndarray, is_milli: np.ndarray) -> None:
        """Define the candidates.

        factors: factors (n,) on the torques. is_open: (n,) True for joints whose torque may have another unit.
        is_milli: (n,) True for joints whose torques are declared in mNm.
        """
        super().__init__([])
        self._torque_factors, self._is_open, self._is_milli = factors, is_open, is_milli

    def fits(self, problem: GeometryProblem, base: HypothesisFit) -> Iterator[HypothesisFit]:
        """Yield the fits with each candidate, and with a factor of its own for each joint if the factors differ."""
        is_open, is_found = self._is_open, self in base.hypothesis.faults
        candidates = [] if is_found else [x.copy() for x in self._torque_factors]
        if is_open.all():
            # Under a hypothesis with other senses or orders, the gravity in the torques has another magnitude. A factor
            # that was found with a wrong sense is corrected.
            fitted, of_urdf = problem.gravity_torques(base)
            ratio = float((fitted * of_urdf).sum() / max(float(np.square(of_urdf).sum()), 1e-12))
            if (ratio > 0 or (ratio and is_found)) and is_other_unit(ratio):
                candidates.append(np.full(len(is_open), rounded_factor(1 / ratio)))
        if not candidates:
            return
        for factor in candidates:
            # mNm in the mapping is wrong, whatever the masses of the URDF
            is_unit = self._is_milli & ~is_other_unit(factor / 1e3)
            factor[is_unit] = np.copysign(1e3, factor[is_unit])
        scales = [np.stack([np.ones(len(is_open)), factor]) for factor in candidates]
        fits = list(self._scaled_by(scales, problem, base))
        yield from fits
        if is_found:
            return
        best = lowest = min(fits, key=lambda fit: fit.cost)
        # the couplings of the joints show the ratios of the factors, and the URDF's masses a common factor
        for joints in (*np.eye(len(is_open))[is_open], 1.0 * is_open):
            exponent = minimize_scalar(
                lambda x, fit=best, joints=joints: self._scaled(problem, fit, np.exp(x * joints)).cost,
                bounds=(-np.log(10), np.log(10)), method="bounded", options={"xatol": 0.05},
            ).x  # fmt: skip
            best = min(best, self._scaled(problem, best, np.exp(exponent * joints)), key=lambda fit: fit.cost)
        # such factors also correct errors of the URDF's masses, and so lower the cost a little; no factor explains a
        # torque that does not resemble the URDF's, such as its magnitude
        is_unit = is_other_unit(best.hypothesis.scale[1] / problem.unchanged.scale[1]).any()
        if (
            is_unit
            and best.cost < lowest.cost - GEOMETRY.needed
            and best.errors.max() <= GEOMETRY.unexplained
        ):
            yield best

    def _scaled(self, problem: GeometryProblem, fit: HypothesisFit, factors: np.ndarray) -> HypothesisFit:
        """Return the fit with torques that are multiplied by further factors (n,), rounded to two digits in all."""
        (motion, torque), present = fit.hypothesis.scale, problem.unchanged.scale[1]
        rounded = np.array([float(f"{x:.2g}") for x in torque * factors / present])
        return problem.fit(fit.hypothesis.changed(self, scale=np.stack([motion, rounded * present])))

    def has(self, motion: np.ndarray, torque: np.ndarray) -> np.ndarray:
        """Return the mask (n,) of the joints whose torque has another unit."""
        return np.asarray(np.abs(torque) != 1)

    def text(self, correction: Correction) -> str:
        """Return a description with the largest factor, and with the sense of the torques if no other fault has it."""
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
        """Return a code for factors between 0.1 and 10; inertials of a URDF are never wrong by a factor of ten."""
        torque = correction.factors[1]
        return "torque-scale" if (torque > 0.1).all() and (torque < 10).all() else ""


def is_other_unit(factor: np.ndarray | float) -> np.ndarray:
    """Return True for factors between torques and the URDF's gravity that wrong inertials do not explain."""
    return np.asarray(np.abs(np.log(np.abs(factor))) >= np.log(OTHER_UNIT))


def rounded_factor(factor: float) -> float:
    """Return a rounded factor: 0.001, from mNm to Nm, if it is close; else with one significant digit, or with two.

    One digit is enough if it changes the factor by less than 10 %.
    """
    if 1 / 1.5 < abs(factor) / 1e-3 < 1.5:
        # a tolerance of 50 %, since the factor is only as exact as the masses of the URDF
        return float(np.copysign(1e-3, factor))
    one = float(f"{factor:.1g}")
    return one if abs(one - factor) < 0.1 * abs(factor) else float(f"{factor:.2g}")


class PositionUnit(WrongScale):
    """Positions of all revolute or of all prismatic joints in another unit than the mapping states."""

    code = "joint-unit"
    rarity = 2

    def has(self, motion: np.ndarray, torque: np.ndarray) -> np.ndarray:
        """Return the mask (n,) of the joints whose positions have another unit."""
        return np.asarray(np.abs(motion) != 1)

    def text(self, correction: Correction) -> str:
        """Return a description with the units."""
        joints = np.flatnonzero(self.has(*correction.factors)).tolist()
        return f"positions in {' and '.join(dict.fromkeys(position_unit(correction, k) for k in joints))}"


def position_factors(arm: Chain, scale: np.ndarray) -> list[np.ndarray]:
    """Return candidates for factors (2, n) on the motion of all joints of a type, for each other unit.

    scale: (n,) factor from logged positions to SI units, with the sign of the joint.
    """
    types, candidates = np.array(arm.joint_types), []
    for joint_type, units in UNITS.items():
        for unit in units:
            motion = np.where(types == joint_type, SCALES.get(unit, 1.0) / np.abs(scale), 1.0)
            if (motion != 1).any():
                candidates.append(np.stack([motion, np.ones_like(motion)]))
    return candidates


def position_unit(correction: Correction, joint: int) -> str:
    """Return the unit of a joint's positions whose factor to SI units is nearest to the factor of the hypothesis."""
    scale = abs(float(correction.hypothesis.scale[0, joint]))
    units = UNITS[correction.arm.coordinates[joint].joint_type]
    return min(units, key=lambda unit: abs(np.log(scale / SCALES.get(unit, 1.0))))
