"""Search for the hypothesis about the columns of a log that fits the torques best.

A hypothesis consists of changes such as the opposite sign of a joint, exchanged joints, a zero offset, another unit or
another direction of gravity. Single changes, orders of all joints, and combinations of changes are tried.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product
from typing import NamedTuple

import numpy as np

from spelgen.arm.arm import Chain
from spelgen.identification.log_geometry import GeometryProblem, Hypothesis, HypothesisFit
from spelgen.identification.tuning import GEOMETRY
from spelgen.settings.log_mapping import SCALES

RIGHT_ANGLE = np.pi / 2
# Numbers of penalties `GEOMETRY.rare` that are added to the cost of changes which are rarer than a wrong sign or order.
# They decide between changes that explain the torques equally well.
RARE = {"gravity": 1, "joint-zero": 2, "torque-unit": 2, "joint-unit": 2, "gravity-compensated": 3}


# fields of `Hypothesis` that a change of the order of joints permutes
ORDERS = {
    "joint-order": ("motion_source", "torque_source"),
    "torque-order": ("torque_source",),
    "motion-order": ("motion_source",),
}


class Scaling(NamedTuple):
    """Candidate for wrong units: factors that convert the motion (n,) and the torques (n,) of the joints.

    code: code of the finding, "joint-unit" or "torque-unit".
    """

    code: str
    motion: np.ndarray
    torque: np.ndarray


ANGLES = {SCALES[unit]: unit for unit in ("turns", "deg")}


def angle_scalings(arm: Chain) -> list[Scaling]:
    """Return the candidates for angles of all revolute joints in revolutions, and in degrees; [] if there are none."""
    turning = np.array([x.joint_type == "revolute" for x in arm.coordinates])
    ones = np.ones(len(turning))
    return [Scaling("joint-unit", np.where(turning, size, ones), ones) for size in ANGLES if turning.any()]


@dataclass(frozen=True, eq=False)
class HypothesisComparison:
    """Result of the search for better hypotheses about a log.

    unchanged: fit of the unchanged log. better: fits that are significantly better than it, and about equally good; the
    best is first.
    """

    unchanged: HypothesisFit
    better: tuple[HypothesisFit, ...]

    @property
    def codes(self) -> tuple[str, ...]:
        """Codes of the changes that the best hypothesis makes to the log."""
        return self.better[0].hypothesis.codes


def compare_readings(problem: GeometryProblem, scalings: Sequence[Scaling] = ()) -> HypothesisComparison:
    """Return the hypotheses that fit a log significantly better than the unchanged log.

    scalings: candidates for wrong units.
    """
    # the many hypotheses are compared on few samples, and the best ones below on more
    coarse = problem.thinned(200)
    unchanged = coarse.fit(problem.unchanged)
    fits = [unchanged]
    # At most three changes are combined, where an order of all joints is one change: more changes could explain any
    # log.
    for _ in range(3):
        best = min(fits, key=_rank)
        tried = single_changes(coarse, best, scalings)
        if best is unchanged and min(tried, key=_rank).cost < unchanged.cost - GEOMETRY.needed:
            tried += reordered(coarse, unchanged)
        if min(tried, key=_rank).cost > best.cost - GEOMETRY.needed:
            break
        fits = [*tried, unchanged]
    likely = _likely(unchanged, fits)
    if not likely:
        return HypothesisComparison(unchanged, _rescaled(coarse, unchanged, scalings))
    finer = problem.thinned(GEOMETRY.confirming_samples)
    unchanged = finer.fit(problem.unchanged)
    # only three, since a message lists three hypotheses at most
    confirmed = [finer.fit(fit.hypothesis) for fit in likely[:3]]
    return HypothesisComparison(unchanged, _likely(unchanged, confirmed))


def _likely(unchanged: HypothesisFit, fits: Sequence[HypothesisFit]) -> tuple[HypothesisFit, ...]:
    """Return the best fit and all fits of about the same cost; () if the best is not significantly better.

    unchanged: fit of the unchanged log, with which the best fit is compared.
    """
    best = min(fit.cost for fit in fits)
    if best > unchanged.cost - GEOMETRY.needed:
        return ()
    return tuple(sorted((fit for fit in fits if fit.cost < best + GEOMETRY.ambiguous), key=_rank))


def _rescaled(
    problem: GeometryProblem, unchanged: HypothesisFit, scalings: Sequence[Scaling]
) -> tuple[HypothesisFit, ...]:
    """Return a tuple with the fit of the best torque unit if its cost is below the unchanged log's cost, else ().

    No significant cost decrease is required: light bodies can explain torques that are too small, so that the cost
    shows little. The evidence for the factor is the magnitude of gravity, from which the candidates were computed.
    """
    fits = [problem.fit(x) for x in _scaled(problem.unchanged, scalings) if "torque-unit" in x.codes]
    best = min(fits, key=_rank, default=unchanged)
    return (best,) if best.cost < unchanged.cost else ()


def _rank(fit: HypothesisFit) -> float:
    """Return the cost plus penalties for rare changes, so that common changes of about the same cost are preferred."""
    return fit.cost + GEOMETRY.rare * sum(RARE.get(code, 0) for code in fit.hypothesis.codes)


def single_changes(
    problem: GeometryProblem, base: HypothesisFit, scalings: Sequence[Scaling]
) -> list[HypothesisFit]:
    """Return the fits of all hypotheses with one change in addition to the changes of `base`."""
    reading = base.hypothesis
    changed = [*_senses(reading), *_swapped(reading), *_scaled(reading, scalings)]
    fits = [problem.fit(hypothesis) for hypothesis in changed]
    for k, coordinate in enumerate(problem.arm.coordinates):
        fits += _with_offset(problem, base, k, coordinate.joint_type == "revolute")
    return fits + _with_gravity(problem, base)


def _changed(base: Hypothesis, code: str, **changes: object) -> Hypothesis:
    codes = base.codes if code in base.codes else (*base.codes, code)
    return replace(base, codes=codes, **changes)  # type: ignore[arg-type]


def _senses(base: Hypothesis) -> Iterator[Hypothesis]:
    """Yield the hypotheses with opposite signs: of all torques, and of one joint's torque, motion, or both."""
    yield _changed(base, "torque-sense", torque_scale=-base.torque_scale)
    for sign in 1.0 - 2.0 * np.eye(len(base.offset)):
        torque = {"torque_scale": sign * base.torque_scale}
        yield _changed(base, "torque-sense", **torque)
        # the offset in the mapping may have been measured with the right or with the wrong sign
        offsets = {x.tobytes(): x for x in (base.offset, sign * base.offset + 0.0)}
        for offset in offsets.values():
            motion = {"motion_scale": sign * base.motion_scale, "offset": offset}
            yield _changed(base, "joint-sense", **motion)
            yield _changed(base, "joint-sense", **motion, **torque)


def _swapped(base: Hypothesis, codes: Iterable[str] = tuple(ORDERS)) -> Iterator[Hypothesis]:
    """Yield the hypotheses with the columns of two joints exchanged, for all pairs.

    codes: whether motion, torques or both are exchanged, see `ORDERS`.
    """
    for pair in combinations(range(len(base.offset)), 2):
        order = np.arange(len(base.offset))
        order[list(pair)] = pair[::-1]
        for code in codes:
            sources = {"motion_source": base.motion_source[order], "torque_source": base.torque_source[order]}
            yield _changed(base, code, **{name: sources[name] for name in ORDERS[code]})


def _scaled(base: Hypothesis, scalings: Sequence[Scaling]) -> Iterator[Hypothesis]:
    for code, motion, torque in scalings:
        yield _changed(
            base, code, motion_scale=base.motion_scale * motion, torque_scale=base.torque_scale * torque
        )


def reordered(problem: GeometryProblem, unchanged: HypothesisFit) -> list[HypothesisFit]:
    """Return the fits of the best orders of joints, for all columns, for the torques and for the motion.

    An order is improved by exchanging two joints at a time. The search also starts at random orders, since the cost has
    local minima for arms with many joints.
    """
    joints = problem.arm.joint_names
    starts = [np.arange(len(joints)), np.arange(len(joints))[::-1]]
    # joints may be logged in the alphabetical order of their names
    starts.append(np.argsort(np.argsort(joints)))
    rng = np.random.default_rng(0)
    starts += [rng.permutation(len(joints)) for _ in range(6)]
    fits = {}
    known: dict[tuple[object, ...], HypothesisFit] = {}

    def fitted(hypothesis: Hypothesis) -> HypothesisFit:
        """Return the fit of an order; it is cached, since searches from several starts visit the same orders."""
        key = hypothesis.codes, hypothesis.motion_source.tobytes(), hypothesis.torque_source.tobytes()
        if key not in known:
            known[key] = problem.fit(hypothesis)
        return known[key]

    # fewer starts for orders of only the motion: such logs are rare, and each order requires a new regressor
    motion, both = ("motion-order",), ("joint-order", "torque-order")
    for code, start in [*product(both, starts), *product(motion, starts[:3])]:
        fit = fitted(_changed(unchanged.hypothesis, code, **dict.fromkeys(ORDERS[code], start)))
        while True:
            best = min(map(fitted, _swapped(fit.hypothesis, [code])), key=_rank)
            if best.cost > fit.cost - 1.0:
                break
            fit = best
        order = np.array([fit.hypothesis.motion_source, fit.hypothesis.torque_source])
        if (order != starts[0]).any():
            fits[code, order.tobytes()] = fit
    return list(fits.values())


def _refined(
    problem: GeometryProblem,
    fit: HypothesisFit,
    jacobian: Callable[[HypothesisFit], np.ndarray],
    moved: Callable[[HypothesisFit, np.ndarray], Hypothesis | None],
) -> HypothesisFit:
    """Return the fit after at most four Gauss-Newton steps of D continuous quantities of its hypothesis.

    The iteration ends when a step does not lower the cost, or is negligible. jacobian: function of a fit that returns
    the derivative of the torques with respect to the quantities, (S, n, D). moved: function of a fit and a step (D,)
    that returns the changed hypothesis, or None if the step is negligible.
    """
    for _ in range(4):
        hypothesis = moved(fit, problem.step(fit, jacobian(fit)))
        if hypothesis is None:
            break
        best = problem.fit(hypothesis)
        if best.cost > fit.cost:
            break
        fit = best
    return fit


def _with_offset(
    problem: GeometryProblem, base: HypothesisFit, joint: int, revolute: bool
) -> list[HypothesisFit]:
    """Return a list with the fit for the best zero offset of a joint.

    It is empty if the offset is as small as calibration errors, or if it hardly improves the fit to the torques.
    revolute: True for a revolute joint, for which multiples of 90 degrees are preferred.
    """
    reading = base.hypothesis
    unit = np.eye(len(reading.offset))[joint]
    smallest = GEOMETRY.min_angle if revolute else GEOMETRY.min_shift

    def shifted(offset: float) -> Hypothesis:
        return _changed(reading, "joint-zero", offset=reading.offset + offset * unit)

    def offset_of(fit: HypothesisFit) -> float:
        return float(fit.hypothesis.offset[joint] - reading.offset[joint])

    def jacobian(fit: HypothesisFit) -> np.ndarray:
        step = 1e-4  # rad, m
        change = problem.torque(shifted(offset_of(fit) + step), fit.parameters)
        change = change - problem.torque(fit.hypothesis, fit.parameters)
        return np.asarray(change[..., None] / step)

    def moved(fit: HypothesisFit, step: np.ndarray) -> Hypothesis | None:
        step = np.clip(step, -1.0, 1.0)
        negligible = smallest if not offset_of(fit) else GEOMETRY.min_shift
        return None if abs(step[0]) < negligible else shifted(offset_of(fit) + float(step[0]))

    starts = [0.0, *(RIGHT_ANGLE * np.array([1, 2, -1]))] if revolute else [0.0]
    fits = [problem.fit(shifted(start)) for start in starts]
    best = _refined(problem, min(fits, key=lambda fit: fit.cost), jacobian, moved)
    offset, is_right_angle = offset_of(best), False
    if revolute:
        offset = (offset + np.pi) % (2 * np.pi) - np.pi
        right = RIGHT_ANGLE * round(offset / RIGHT_ANGLE)
        exact = problem.fit(shifted(right))
        is_right_angle = bool(right) and exact.cost < best.cost + GEOMETRY.right_angle
        if is_right_angle:
            best, offset = exact, right
    # Without a decrease of the misfit the offset has the same effect as other masses, and is as uncertain as the masses
    # of the URDF.
    if abs(offset) < smallest or best.misfit > base.misfit - GEOMETRY.needed / 2:
        return []
    return [best if is_right_angle else problem.fit(shifted(round(offset, 4)))]


def _with_gravity(problem: GeometryProblem, base: HypothesisFit) -> list[HypothesisFit]:
    """Return at most two fits: with the best direction of gravity, and with torques that lack gravity compensation.

    Directions along the axes of the root link are preferred. A direction is omitted if it differs from the present one
    by less than typical calibration errors.
    """
    present = np.array(base.hypothesis.gravity)
    size = float(np.linalg.norm(present))
    standard = size or 9.81  # m/s^2

    def moved(fit: HypothesisFit, step: np.ndarray) -> Hypothesis | None:
        gravity = np.array(fit.hypothesis.gravity)
        new = gravity + step
        new *= standard / max(float(np.linalg.norm(new)), 1e-9)
        return None if np.linalg.norm(new - gravity) < 0.01 * standard else _falling(base, new)

    # gravity along -z is the first start: it is preferred if the log does not determine the sign of gravity, as with a
    # vertical prismatic joint
    starts = [problem.fit(_falling(base, standard * axis)) for axis in (*-np.eye(3)[::-1], *np.eye(3))]
    lowest = min(fit.cost for fit in starts)
    starts = [next(fit for fit in starts if fit.cost < lowest + GEOMETRY.rare), *([base] if size else [])]
    refined = [_refined(problem, fit, lambda x: _gravity_jacobian(problem, x), moved) for fit in starts]
    best = min(refined, key=lambda fit: fit.cost)
    new, fits = np.array(best.hypothesis.gravity), []
    if size:
        fits.append(_with_compensation(problem, base))
    if np.linalg.norm(new - present) > GEOMETRY.min_angle * size:
        nearest = np.linalg.norm(new) * np.sign(new) * (np.abs(new) == np.abs(new).max())
        axis = problem.fit(_falling(base, nearest))
        is_axis = axis.cost < best.cost + GEOMETRY.right_angle
        fits.append(axis if is_axis else problem.fit(_falling(base, new.round(3))))
    return fits


def _falling(base: HypothesisFit, gravity: np.ndarray, code: str = "gravity") -> Hypothesis:
    """Return the hypothesis of a fit with another vector of gravity (3,) [m/s^2]. code: code of this change."""
    x, y, z = (float(value) + 0.0 for value in gravity)
    return _changed(base.hypothesis, code, gravity=(x, y, z))


def _gravity_jacobian(problem: GeometryProblem, fit: HypothesisFit) -> np.ndarray:
    """Return the derivative (S, n, 3) of the torques of a fit with respect to the vector of gravity."""
    without = problem.torque(_falling(fit, np.zeros(3)), fit.parameters)
    torques = [problem.torque(_falling(fit, unit), fit.parameters) - without for unit in np.eye(3)]
    return np.stack(torques, axis=2)


def _with_compensation(problem: GeometryProblem, base: HypothesisFit) -> HypothesisFit:
    """Return the fit for torques from which a controller's gravity compensation is missing, entirely or in part.

    Gravity is multiplied by a fraction of at most a half, or by zero if this fits about equally well.
    """
    present, code = np.array(base.hypothesis.gravity), "gravity-compensated"
    without = problem.fit(_falling(base, np.zeros(3), code))
    part = problem.step(without, (_gravity_jacobian(problem, without) @ present)[..., None])
    # a fraction of more than a half in all joints is ascribed to wrong masses of the URDF, not to a compensation
    some = problem.fit(_falling(base, (np.clip(part, -0.5, 0.5) * present).round(3), code))
    return some if some.cost < without.cost - GEOMETRY.ambiguous else without
