"""Search for the hypothesis about the columns of a log with the best fit to its torques: single changes, orders of
joints, combinations."""

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
# penalties of changes that are rarer than a wrong sense or order, which explain as much
RARE = {"gravity": 1, "joint-zero": 2, "torque-unit": 2, "joint-unit": 2, "gravity-compensated": 3}


# columns that another order of joints affects
ORDERS = {
    "joint-order": ("motion_source", "torque_source"),
    "torque-order": ("torque_source",),
    "motion-order": ("motion_source",),
}


class Scaling(NamedTuple):
    """Factors (n,) of the motion and of the torques of joints, if their columns are in another unit."""

    code: str
    motion: np.ndarray
    torque: np.ndarray


ANGLES = {SCALES[unit]: unit for unit in ("turns", "deg")}


def angle_scalings(arm: Chain) -> list[Scaling]:
    """Return the candidates for angles and their rates in revolutions, and in degrees, of all revolute joints."""
    turning = np.array([x.joint_type == "revolute" for x in arm.coordinates])
    ones = np.ones(len(turning))
    return [Scaling("joint-unit", np.where(turning, size, ones), ones) for size in ANGLES if turning.any()]


@dataclass(frozen=True, eq=False)
class HypothesisComparison:
    """Hypotheses that fit a log about equally well, and significantly better than the unchanged log; best first."""

    unchanged: HypothesisFit
    better: tuple[HypothesisFit, ...]

    @property
    def codes(self) -> tuple[str, ...]:
        """Codes of the changes that the best hypothesis makes to the log."""
        return self.better[0].hypothesis.codes


def compare_readings(problem: GeometryProblem, scalings: Sequence[Scaling] = ()) -> HypothesisComparison:
    """Return the hypotheses that fit a log significantly better than the unchanged log.

    scalings: candidates for other units.
    """
    coarse = problem.thinned(200)  # all hypotheses are compared on few samples
    unchanged = coarse.fit(problem.unchanged)
    fits = [unchanged]
    # three changes at most, an order of joints as one: more explain any log
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
    # a message names three readings at most
    confirmed = [finer.fit(fit.hypothesis) for fit in likely[:3]]
    return HypothesisComparison(unchanged, _likely(unchanged, confirmed))


def _likely(unchanged: HypothesisFit, fits: Sequence[HypothesisFit]) -> tuple[HypothesisFit, ...]:
    """Return the fits about as good as the best one, if it is significantly better than the unchanged log."""
    best = min(fit.cost for fit in fits)
    if best > unchanged.cost - GEOMETRY.needed:
        return ()
    return tuple(sorted((fit for fit in fits if fit.cost < best + GEOMETRY.ambiguous), key=_rank))


def _rescaled(
    problem: GeometryProblem, unchanged: HypothesisFit, scalings: Sequence[Scaling]
) -> tuple[HypothesisFit, ...]:
    """Return the fit with the best factor on the torques, if its cost is lower.

    A low cost is no evidence for a factor, since light bodies can explain small torques; the evidence is from gravity.
    """
    fits = [problem.fit(x) for x in _scaled(problem.unchanged, scalings) if "torque-unit" in x.codes]
    best = min(fits, key=_rank, default=unchanged)
    return (best,) if best.cost < unchanged.cost else ()


def _rank(fit: HypothesisFit) -> float:
    """Return the cost plus a penalty for rare changes, so that common ones of about the same cost come first."""
    return fit.cost + GEOMETRY.rare * sum(RARE.get(code, 0) for code in fit.hypothesis.codes)


def single_changes(
    problem: GeometryProblem, base: HypothesisFit, scalings: Sequence[Scaling]
) -> list[HypothesisFit]:
    """Return the fits with one change in addition to the changes of the base."""
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
    """Yield the readings with the opposite sense of a joint: of its position, its torque or both; of all torques."""
    yield _changed(base, "torque-sense", torque_scale=-base.torque_scale)
    for sign in 1.0 - 2.0 * np.eye(len(base.offset)):
        torque = {"torque_scale": sign * base.torque_scale}
        yield _changed(base, "torque-sense", **torque)
        # an offset of the mapping may have been determined in either sense
        offsets = {x.tobytes(): x for x in (base.offset, sign * base.offset + 0.0)}
        for offset in offsets.values():
            motion = {"motion_scale": sign * base.motion_scale, "offset": offset}
            yield _changed(base, "joint-sense", **motion)
            yield _changed(base, "joint-sense", **motion, **torque)


def _swapped(base: Hypothesis, codes: Iterable[str] = tuple(ORDERS)) -> Iterator[Hypothesis]:
    """Yield the hypotheses with the columns of two joints exchanged."""
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
    """Return the best orders of all columns, of the torques and of the motion, by exchanging two joints at a time.

    Long arms have local minima: the search starts at random orders, too.
    """
    joints = problem.arm.joint_names
    starts = [np.arange(len(joints)), np.arange(len(joints))[::-1]]
    # joints may be logged in the alphabetical order of their names
    starts.append(np.argsort(np.argsort(joints)))
    rng = np.random.default_rng(0)
    starts += [rng.permutation(len(joints)) for _ in range(6)]
    fits = {}
    # few orders of only the motion: such logs are rare, and each order needs another regressor
    motion, both = ("motion-order",), ("joint-order", "torque-order")
    for code, start in [*product(both, starts), *product(motion, starts[:3])]:
        fit = problem.fit(_changed(unchanged.hypothesis, code, **dict.fromkeys(ORDERS[code], start)))
        while True:
            best = min(map(problem.fit, _swapped(fit.hypothesis, [code])), key=_rank)
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
    """Return the fit after Gauss-Newton steps of D quantities of its hypothesis, while they lower the cost.

    jacobian: derivative of the torques at a fit, (S, n, D). moved: the hypothesis after a step (D,); None if the step
    is negligible.
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
    """Return [fit], with the best zero offset of a joint; [] if the offset is as small as calibration errors."""
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
    # if other masses have the same effect as the offset, its value is as uncertain as the masses of the URDF
    if abs(offset) < smallest or best.misfit > base.misfit - GEOMETRY.needed / 2:
        return []
    return [best if is_right_angle else problem.fit(shifted(round(offset, 4)))]


def _with_gravity(problem: GeometryProblem, base: HypothesisFit) -> list[HypothesisFit]:
    """Return the fits with the best direction of gravity, and with the fraction of gravity in compensated torques."""
    present = np.array(base.hypothesis.gravity)
    size = float(np.linalg.norm(present))
    standard = size or 9.81  # m/s^2

    def moved(fit: HypothesisFit, step: np.ndarray) -> Hypothesis | None:
        gravity = np.array(fit.hypothesis.gravity)
        new = gravity + step
        new *= standard / max(float(np.linalg.norm(new)), 1e-9)
        return None if np.linalg.norm(new - gravity) < 0.01 * standard else _falling(base, new)

    # upright first: a vertical prismatic joint does not determine the sign of gravity
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
    """Return the hypothesis of a fit with another gravity."""
    x, y, z = (float(value) + 0.0 for value in gravity)
    return _changed(base.hypothesis, code, gravity=(x, y, z))


def _gravity_jacobian(problem: GeometryProblem, fit: HypothesisFit) -> np.ndarray:
    """Return the derivative of the torques with respect to the vector of gravity, (S, n, 3)."""
    without = problem.torque(_falling(fit, np.zeros(3)), fit.parameters)
    torques = [problem.torque(_falling(fit, unit), fit.parameters) - without for unit in np.eye(3)]
    return np.stack(torques, axis=2)


def _with_compensation(problem: GeometryProblem, base: HypothesisFit) -> HypothesisFit:
    """Return the fit with the fraction of gravity in torques that do not include a controller's compensation."""
    present, code = np.array(base.hypothesis.gravity), "gravity-compensated"
    without = problem.fit(_falling(base, np.zeros(3), code))
    part = problem.step(without, (_gravity_jacobian(problem, without) @ present)[..., None])
    # with more than half of gravity in all joints, other masses are the reason
    some = problem.fit(_falling(base, (np.clip(part, -0.5, 0.5) * present).round(3), code))
    return some if some.cost < without.cost - GEOMETRY.ambiguous else without
