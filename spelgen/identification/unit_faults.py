"""Kinds of faults of the columns of a log: another unit of the torques, or of the positions and velocities."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial

import numpy as np

from spelgen.arm.arm import Chain
from spelgen.identification.column_faults import UNITS, JointSense, TorqueSense, WrongScale, position_unit
from spelgen.identification.hypotheses import Correction, Hypothesis, HypothesisFit
from spelgen.identification.log_geometry import GeometryProblem
from spelgen.identification.reference_inertials import ReferenceInertials, is_other_unit
from spelgen.identification.tuning import GEOMETRY
from spelgen.settings.log_mapping import SCALES

Form = tuple[np.ndarray, np.ndarray, int]
# [1] Largest plausible gear ratio: gears of robot arms have smaller ratios. A larger fitted ratio is not advised as a
# setting.
LARGEST_GEAR = 500.0
GIVE_GEAR = (
    "write its 'units', or, for positions of a motor, the units counts and counts/s with 'counts_per_turn', 2 pi times "
    "the gear ratio"
)


class TorqueUnit(WrongScale):
    """Kind of fault of a log: torques in another unit, with a factor of at least 5.

    The candidates for the factors are found by comparing the gravity in the torques to the URDF's (`torque_factors`).
    Unlike other faults, another unit is accepted even if it hardly lowers the cost: without it, bodies that are too
    light may explain torques that are too small.
    """

    code = "torque-unit"
    rarity = 2
    is_optimised = True
    needed = 0.0
    evidence = "by the URDF's masses"

    def __init__(
        self,
        factors: Sequence[np.ndarray],
        is_open: np.ndarray,
        is_milli: np.ndarray,
        reference: ReferenceInertials,
    ) -> None:
        """Define the candidates for factors that correct the unit of the torques.

        factors: candidates, (n,) each: one factor per joint, by which its torques are multiplied. is_open: (n,) True
        for joints whose torque may have another unit: the column mapping states no unit for it, or mNm, although the
        numbers may be in Nm. is_milli: (n,) True for the joints with mNm in the mapping, a subset of `is_open`.
        reference: inertial parameters with whose gravity torque the torques are compared.
        """
        super().__init__([])
        if reference.is_guess:
            self.evidence = "by the arm's size, since the URDF lacks masses or has copied ones"
        self._torque_factors, self._is_open, self._is_milli = factors, is_open, is_milli

    def fits(self, problem: GeometryProblem, base: HypothesisFit) -> Iterator[HypothesisFit]:
        """Yield the least-squares fits of the log with corrected units of the torques: one fit per candidate.

        A candidate has one factor per joint, (n,), by which its torques are multiplied. If the hypothesis of `base`
        does not correct the unit of torques yet, also yield fits in which each torque that may have another unit gets
        its own factor (see `_separate`). The other corrections in `base` remain.
        """
        is_open, is_found = self._is_open, self in base.hypothesis.faults
        is_wrong = problem.reference.is_other_unit
        fitted, of_urdf = problem.gravity_torques(base)
        ratio = float((fitted * of_urdf).sum() / max(float(np.square(of_urdf).sum()), 1e-12))
        # The candidates are ratios of gravity torques that were fitted without hysteresis, which resembles gravity in
        # small motions. They are omitted if the fit with hysteresis has masses near the URDF's.
        is_right = ratio > 0 and not is_wrong(ratio) and problem.explains(base)
        candidates = [] if is_found or is_right else [x.copy() for x in self._torque_factors]
        if is_open.all():
            # The ratio of the fitted gravity torque to the URDF's depends on the other corrections of `base`, such as
            # reversed or exchanged joints. The factor 1 / ratio is therefore computed for each `base`. If `base` has a
            # torque factor already, a negative ratio shows that the sign of this factor is wrong.
            if (ratio > 0 or (ratio and is_found)) and is_wrong(ratio):
                candidates.append(np.full(len(is_open), problem.reference.rounded_factor(1 / ratio)))
            # If the log has another fault, such as another zero, its torques may not show the gravity of the URDF.
            # Torques a hundred times as large as the URDF's, or as small, are then in another unit, too: in mNm if
            # the ratio, to which friction contributes, is near a thousand.
            tau = base.hypothesis.signals(problem.samples).tau
            expected = problem.reference_torques(base.hypothesis)
            size = float(np.linalg.norm(tau)) / max(float(np.linalg.norm(expected)), 1e-12)
            if not (candidates or is_found) and of_urdf.any() and not 0.01 < size < 100.0:
                size = size if is_wrong(size / 1e3) else 1e3
                candidates.append(np.full(len(is_open), problem.reference.rounded_factor(1 / size)))
        for factor in candidates:
            # Torques declared in mNm were multiplied by 0.001. If the logged numbers are in fact in Nm, the factor on
            # these torques must be 1000. The masses of the URDF give this factor only approximately, so factors from
            # 200 to 5000 are replaced by 1000.
            is_unit = self._is_milli & ~is_wrong(factor / 1e3)
            factor[is_unit] = np.copysign(1e3, factor[is_unit])
        if problem.reference.is_guess:
            # Guessed masses show mNm, but give no factor for other units.
            candidates = [x for x in candidates if np.isin(np.abs(x), (1e-3, 1e3)).all()]
        scales = [np.stack([np.ones(len(is_open)), factor]) for factor in candidates]
        fits = list(self._scaled_by(scales, problem, base))
        yield from fits
        if not is_found:
            lowest = min((base, *fits), key=lambda fit: fit.cost)
            yield from self._separate(problem, lowest, base, bool(candidates))

    def _separate(
        self, problem: GeometryProblem, lowest: HypothesisFit, base: HypothesisFit, has_gravity: bool
    ) -> Iterator[HypothesisFit]:
        """Yield the least-squares fits in which joints have different factors on their torques.

        The first fit has factors only on the joints whose gain differs much from the median gain. The second fit has
        factors on all joints; it is tried only if several joints, or all, have another unit.

        The factors come from a fit with free gains: the dynamic coupling of the joints determines their ratios, and the
        masses of the URDF their common factor. Factors also correct errors of the masses, which lowers the cost a
        little, and by up to 32 in short logs of wrists whose torque is mostly friction. A fit is therefore yielded only
        if (1) its cost is lower than the cost of `lowest` by twice `GEOMETRY.needed` and a penalty for each factor,
        (2) each factor lowers the cost, and (3) the relative residual of each joint is small.

        lowest: fit of lowest cost among `base` and the fits of the candidates. base: fit whose hypothesis gets the
        factors. has_gravity: True if the gravity in the logged torques gave at least one candidate. If it is False, and
        no gain differs much from the median gain, the factors are unknown and nothing is yielded.
        """
        present, scale = base.hypothesis, base.hypothesis.scale
        tau = present.signals(problem.samples).tau
        torque = problem.residual(present, problem.with_free_gains().fit(present).parameters) + tau
        products = (torque * tau).sum(axis=0)
        gains = np.square(torque).sum(axis=0) / np.where(products > 0, products, np.inf)
        common = float(np.median(gains[gains > 0])) if (gains > 0).any() else 1.0
        is_known = self._is_open & (gains > 0)
        is_free = is_known & present.signals(problem.samples).moving_joints
        ratios = np.where(is_free, gains, common) / common
        # The ratios compare joints with each other, so that their limit does not depend on the masses.
        is_other = is_other_unit(ratios, GEOMETRY.other_unit)
        # If no gain differs much from the median gain, only one common factor on all torques can be wrong. It is known
        # only if the torques contain gravity, which is compared to the URDF's gravity torques.
        if not (is_other.any() or has_gravity):
            return

        def fitted(factors: np.ndarray) -> HypothesisFit:
            rounded = [problem.reference.rounded_factor(x) for x in factors]
            if len(set(rounded)) > 1:
                rounded = [float(f"{x:.2g}") for x in factors]
            rescaled = scale * np.stack([np.ones_like(factors), rounded])
            return problem.fit(present.changed(self, scale=rescaled))

        is_common = bool(problem.reference.is_other_unit(common))
        # If only one joint differs from the common factor, the masses of the URDF are the reason for this factor.
        is_several = is_common or is_other_unit(np.square(ratios), GEOMETRY.other_unit).sum() > 1
        several = is_free & (is_known.all() and is_several)
        for initial, changed in ((ratios, is_other & (not is_common)), (gains, several)):
            factors, units = np.where(changed, initial, 1.0), np.eye(len(gains))[changed]
            fit = fitted(factors)
            # If the factors differ a lot, the fit with free gains may end far from the factors of lowest cost.
            for unit in units:
                for step in (GEOMETRY.other_unit**unit, GEOMETRY.other_unit**-unit):
                    while (rescaled := fitted(factors * step)).cost < fit.cost - self.rarity:
                        factors, fit = factors * step, rescaled
            is_sure = all(fitted(np.where(x, 1.0, factors)).cost > fit.cost + self.rarity for x in units)
            is_lower = fit.cost < lowest.cost - 2 * GEOMETRY.needed - self.rarity * changed.sum()
            if is_sure and is_lower and fit.errors.max() <= GEOMETRY.unexplained:
                lowest = fit
                yield fit

    def has(self, motion: np.ndarray, torque: np.ndarray) -> np.ndarray:
        """Return the mask (n,) of the joints whose torque has another unit than stated: |`torque`| is not 1.

        motion, torque: (n,) factors that correct motion and torque of the joints. `motion` is not used here, but by
        other kinds of faults.
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
        """Return "torque-scale", the code of a warning, if all factors on the torques are between 0.1 and 10; else "".

        Such factors may be due to masses of the URDF, which are never wrong by a factor of ten. With the result "", the
        caller reports the fault as an error. correction: its `factors` are factors on motion and torques, (2, n).
        """
        torque = correction.factors[1]
        return "torque-scale" if (torque > 0.1).all() and (torque < 10).all() else ""


class PositionUnit(WrongScale):
    """Kind of fault of a log: positions in another unit, of all joints of a type or of single joints.

    The unit of all joints of a type is one of `UNITS`. Positions may also have been measured at the motors, before
    gears of any ratio. For given groups of joints (a single joint, or all revolute joints), the factors on the
    positions are therefore optimised.
    """

    code = "joint-unit"
    rarity = 2
    is_optimised = True

    def __init__(
        self,
        factors: Sequence[np.ndarray],
        groups: Sequence[list[int]] = (),
        open_fault: PositionUnit | None = None,
    ) -> None:
        """Define the candidates for other units of the positions of n joints.

        Args:
            factors: candidates, (2, n) each: factors on the motion (first row) and on the torques (second row).
            groups: lists of joint indices. The factors on the positions of the joints in a list are optimised together.
            open_fault: the fault "positions in an unknown unit", which has no setting to write. It is reported instead
                of this fault if the optimised factors are uncertain. None: this object itself is that fault.
        """
        super().__init__(factors)
        self._groups, self._open_fault = groups, open_fault
        self.advice = "" if open_fault else GIVE_GEAR

    def fits(self, problem: GeometryProblem, base: HypothesisFit) -> Iterator[HypothesisFit]:
        """Yield the least-squares fits with other units of the positions: of the candidates, then of groups of joints.

        A candidate has given factors on the positions, such as pi / 180. The joints of a group, such as all revolute
        joints, get the factors of lowest cost. A group is omitted if the hypothesis of `base` already changes the unit
        of one of its joints. Single joints are omitted if `base` or a candidate explains the torques.
        """
        units = list(super().fits(problem, base))
        yield from units
        # A free factor explains small errors of the model, too. It is tried for a single joint only if the torques are
        # not explained. The factors of several joints are tried in any case, since degrees at all joints explain most
        # of the torques of a log of motor positions; but these factors must halve the residual.
        lowest = min((base, *units), key=lambda fit: fit.cost).errors
        is_changed = np.abs(base.hypothesis.scale[0]) != np.abs(problem.unchanged.scale[0])
        # Every factor that `_free` could try reduces a motion below 0.1 to less than 0.05 rad or m.
        is_moving = np.ptp(base.hypothesis.signals(problem.samples).motion[0], axis=0) > 0.1
        for joints in self._groups:
            is_open = is_moving[joints].any() and not is_changed[joints].any()
            if is_open and (lowest.max() > GEOMETRY.explained or len(joints) > 1):
                fit = self._free(problem, base, joints)
                yield from [fit] if len(joints) == 1 or 2 * fit.errors.mean() < lowest.mean() else []

    def _free(self, problem: GeometryProblem, base: HypothesisFit, joints: list[int]) -> HypothesisFit:
        """Return the least-squares fit with the best factors on the positions of a group of m joints, one per joint.

        A factor near the factor of a unit in `UNITS` is replaced by it if the cost is about equal. Other factors are
        rounded to three digits.

        base: fit whose hypothesis gets the factors. joints: indices of the m joints of the group.
        """
        scale, present = base.hypothesis.scale, np.abs(problem.unchanged.scale[0, joints])
        span = float(np.ptp(base.hypothesis.signals(problem.samples).motion[0][:, joints], axis=0).max())

        def scaled(exponents: np.ndarray, form: Form, fault: PositionUnit = self) -> Hypothesis:
            factors, (sense, torque_sense, power) = np.ones_like(scale), form
            factors[:, joints] = sense * np.exp(exponents), torque_sense * np.exp(-power * exponents)
            return base.hypothesis.changed(fault, scale=scale * factors)

        # A form is (sign of the positions, sign of the torques, power). Positions are multiplied by sign * x and
        # torques by sign * x^-power, with a factor x per joint. Power 0: only the positions are in another unit; if
        # they are reversed, the torques may be reversed or not. Power 1: positions and torques were measured at the
        # motor of a gear with the ratio 1 / x, so that the joint's torque is 1 / x times the motor's. Both have the
        # same sign.
        ones = np.ones(len(joints))
        signs = [(1, 1, 0), (1, 1, 1), (-1, 1, 0), (-1, -1, 0), (-1, -1, 1)]
        # For several joints, only the two forms without reversal are tried here; `_descended` then reverses joints.
        tried = signs[: 5 if len(ones) == 1 else 2]
        forms: list[Form] = [(x * ones, y * ones, power) for x, y, power in tried]
        # `common`: logarithms of the tried factors. The factor makes the largest motion at least 0.05 rad or m and at
        # most two turns, and is at most exp(-0.6) = 0.55: a factor near 1 is neither a unit nor a gear.
        common = np.arange(np.log(0.05 / span), min(np.log(4 * np.pi / span), -0.6), 0.15)
        costs = np.array([[problem.fit(scaled(x * ones, form)).cost for form in forms] for x in common])
        lowest = costs.min(axis=0)
        best, exponents, form = min(
            (self._descended(problem, scaled, float(common[costs[:, k].argmin()]) * ones, forms[k])
            for k in lowest.argsort()[: 1 if len(ones) == 1 else 2].tolist()),
            key=lambda x: x[0].cost,
        )  # fmt: skip
        # The factors are undetermined if factors that are 10 % larger or smaller explain the log about equally well.
        # For a single joint, they are also undetermined if the best factor in another form (other signs or power) does.
        steps = 0.1 * np.concatenate([np.eye(len(joints)), -np.eye(len(joints))])
        sides = [problem.fit(scaled(exponents + x, form)).cost for x in steps]
        if len(joints) == 1:
            lowest[lowest.argmin()] = np.inf
            sides.append(lowest.min() - GEOMETRY.ambiguous + GEOMETRY.right_angle)
        scales = [SCALES.get(x, 1.0) for x in UNITS[problem.arm.joint_types[joints[0]]]]
        exact = np.log(np.array(scales)[:, None] / present)
        nearest = np.take_along_axis(exact, np.abs(exact - exponents).argmin(axis=0)[None], axis=0)[0]
        is_unit = np.abs(nearest - exponents) < 0.1
        # A factor that is not near a unit's is the inverse of a gear ratio. The result is certain only if the largest
        # gear ratio is plausible, below LARGEST_GEAR.
        largest_gear = np.where(is_unit, 0.0, np.exp(-exponents)).max()
        is_sure = min(sides) > best.cost + GEOMETRY.right_angle and largest_gear < LARGEST_GEAR
        fault = self if is_sure else self._open_fault or self
        rounded = -np.log([float(f"{x:.3g}") for x in np.exp(-exponents) / present] * present)
        options = [(np.where(is_unit, nearest, rounded), fault)]
        if len(joints) > 1:
            # A unit of all joints that explains the log about equally well is no coincidence, even if single factors
            # are uncertain. Each free factor lowers the cost a little, since it explains errors of the friction model.
            options = [(exact[np.abs(np.median(exact - exponents, axis=1)).argmin()], self), *options]
        for values, kind in options:
            unit = problem.fit(scaled(values, form, kind))
            if unit.cost < best.cost + GEOMETRY.right_angle * len(joints):
                return unit
        return problem.fit(scaled(rounded, form, fault))

    def _descended(
        self, problem: GeometryProblem, scaled: Callable[..., Hypothesis], start: np.ndarray, form: Form
    ) -> tuple[HypothesisFit, np.ndarray, Form]:
        """Return the fit of lowest cost near initial factors on the positions of m joints, its exponents, and its form.

        The exponents (m,) are the logarithms of the factors by which the positions of the joints are multiplied;
        `start` has their initial values, (m,). A form has the signs of positions and torques (see `_free`).
        scaled(exponents, form) returns the hypothesis.

        If m > 1, joints are reversed one after the other: while the relative residual of a joint is above
        `GEOMETRY.explained`, the joint whose reversal lowers the cost most is reversed, if the decrease is significant.
        """

        def lowest(form: Form) -> tuple[HypothesisFit, np.ndarray, Form]:
            hypothesis_of = partial(scaled, form=form)
            exponents = start
            for _ in range(3):
                # The bounds permit logged positions that are 1.5 to 1100 times the joint's. Values in mm, for example,
                # are 1000 times the values in m.
                exponents, fit = problem.descend(
                    hypothesis_of,
                    exponents,
                    largest=0.5,
                    smallest=0.002,
                    allowed=lambda x: np.clip(x, -7.0, -0.4),
                )
            return fit, exponents, form

        best = lowest(form)
        while len(start) > 1 and best[0].errors.max() > GEOMETRY.explained:
            _, _, (sense, torque_sense, power) = best
            reversed_forms = [(x * sense, x**power * torque_sense, power) for x in 1 - 2 * np.eye(len(start))]
            other = min(map(lowest, reversed_forms), key=lambda x: x[0].cost)
            if other[0].cost > best[0].cost - GEOMETRY.ambiguous:
                break
            best = other
        return best

    def has(self, motion: np.ndarray, torque: np.ndarray) -> np.ndarray:
        """Return the mask (n,) of the joints whose positions have another unit than stated: |`motion`| is not 1.

        motion, torque: (n,) factors that correct motion and torque of the joints. `torque` is not used here.
        """
        return np.asarray(np.abs(motion) != 1)

    def text(self, correction: Correction) -> str:
        """Return the text about positions in another unit: the name of the unit, or the gear ratio if no unit fits.

        The text also states an opposite sense, unless the hypothesis contains `JointSense`, whose text states it.
        """
        motion, torque = correction.factors
        texts, ratios = [], dict[str, list[str]]()
        is_stated = any(isinstance(x, JointSense) for x in correction.hypothesis.faults)
        is_reversed = [bool(x < 0) and not is_stated for x in motion]
        for k in np.flatnonzero(self.has(motion, torque)).tolist():
            unit, sense = position_unit(correction, k), " and of the opposite sense" * is_reversed[k]
            if unit:
                texts.append(f"positions in {unit}{sense}")
            else:
                ratios.setdefault(sense, []).append(f"{abs(1 / motion[k]):.3g}")
        for sense, gears in ratios.items():
            times = ", ".join(dict.fromkeys(gears))
            gear = f"positions about {times} times as large as the joint's"
            texts.append(f"{gear}{sense}, as at the motor of a gear")
        return " and ".join(dict.fromkeys(texts)) if self._open_fault else "positions in an unknown unit"


def position_factors(arm: Chain, scale: np.ndarray) -> list[np.ndarray]:
    """Return candidates for factors (2, n) on the signals of the joints that correct a wrong unit of the positions.

    A candidate corrects all revolute joints, or all prismatic joints, as if their positions were logged in another unit
    than the mapping of the log states. Row 0 has the factors on positions and velocities, 1 for joints of the other
    type. Row 1 has the factors on torques: all are 1.

    scale: (n,) factors that the mapping specifies, from logged positions to SI units; negative for joints with the
    setting `sign: -1`.
    """
    types, candidates = np.array(arm.joint_types), []
    for joint_type, units in UNITS.items():
        for unit in units:
            motion = np.where(types == joint_type, SCALES.get(unit, 1.0) / np.abs(scale), 1.0)
            if (motion != 1).any():
                candidates.append(np.stack([motion, np.ones_like(motion)]))
    return candidates
