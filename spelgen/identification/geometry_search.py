"""Search for the hypothesis about the columns of a log with the best fit to its torques: single changes, orders of
joints, combinations."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from spelgen.identification.log_geometry import GeometryProblem, Hypothesis, HypothesisFit, Vector3
from spelgen.identification.tuning import GEOMETRY

STANDARD_GRAVITY = 9.81  # m/s^2
RIGHT_ANGLE = np.pi / 2
RARE = {"gravity": 1, "joint-zero": 2, "torque-unit": 2, "gravity-compensated": 3}
STEP = 1e-4  # [rad, m] of finite differences


@dataclass(frozen=True, eq=False)
class HypothesisComparison:
    """Hypotheses that fit a log about equally well, and significantly better than the unchanged log; best first."""

    unchanged: HypothesisFit
    better: tuple[HypothesisFit, ...]

    @property
    def codes(self) -> tuple[str, ...]:
        """Codes of the changes that the best hypothesis makes to the log."""
        return self.better[0].hypothesis.codes


def compare_readings(problem: GeometryProblem, factors: Sequence[np.ndarray] = ()) -> HypothesisComparison:
    """Return the hypotheses that fit a log significantly better than the unchanged log.

    factors: candidates of factors on the torques, (n,) each, for another unit or motor constant.
    """
    coarse = problem.thinned(GEOMETRY.samples)
    unchanged = coarse.fit(problem.unchanged)
    fits = [unchanged]
    for _ in range(GEOMETRY.changes):
        best = min(fits, key=_rank)
        tried = single_changes(coarse, best, factors)
        if best is unchanged and min(tried, key=_rank).cost < unchanged.cost - GEOMETRY.needed:
            tried += reordered(coarse, unchanged)
        if min(tried, key=_rank).cost > best.cost - GEOMETRY.needed:
            break
        fits = [*tried, unchanged]
    likely = _likely(unchanged, fits)
    if not likely:
        return HypothesisComparison(unchanged, _rescaled(coarse, unchanged, factors))
    finer = problem.thinned(GEOMETRY.confirming_samples)
    unchanged = finer.fit(problem.unchanged)
    confirmed = [finer.fit(fit.hypothesis) for fit in likely[: GEOMETRY.named]]
    return HypothesisComparison(unchanged, _likely(unchanged, confirmed))


def _likely(unchanged: HypothesisFit, fits: Sequence[HypothesisFit]) -> tuple[HypothesisFit, ...]:
    """Return the fits about as good as the best one, if it is significantly better than the unchanged log."""
    best = min(fit.cost for fit in fits)
    if best > unchanged.cost - GEOMETRY.needed:
        return ()
    return tuple(sorted((fit for fit in fits if fit.cost < best + GEOMETRY.ambiguous), key=_rank))


def _rescaled(
    problem: GeometryProblem, unchanged: HypothesisFit, factors: Sequence[np.ndarray]
) -> tuple[HypothesisFit, ...]:
    """Return the fit with the best factor on the torques, if its cost is lower.

    A low cost is no evidence for a factor, since light bodies can explain small torques; the evidence is from gravity.
    """
    fits = [problem.fit(hypothesis) for hypothesis in _scaled(problem.unchanged, factors)]
    best = min(fits, key=_rank, default=unchanged)
    return (best,) if best.cost < unchanged.cost else ()


def _rank(fit: HypothesisFit) -> float:
    """Return the cost plus a penalty for rare changes, so that common ones of about the same cost come first."""
    return fit.cost + GEOMETRY.rare * sum(RARE.get(code, 0) for code in fit.hypothesis.codes)


def single_changes(
    problem: GeometryProblem, base: HypothesisFit, factors: Sequence[np.ndarray]
) -> list[HypothesisFit]:
    """Return the fits with one change in addition to the changes of the base."""
    reading = base.hypothesis
    changed = [*_senses(reading), *_swapped(reading), *_scaled(reading, factors)]
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
    for k in range(len(base.offset)):
        sign: np.ndarray = 1.0 - 2.0 * (np.arange(len(base.offset)) == k)
        torque = {"torque_scale": sign * base.torque_scale}
        yield _changed(base, "torque-sense", **torque)
        # an offset of the mapping may have been determined in either sense
        for offset in (base.offset, sign * base.offset)[: 1 + (base.offset[k] != 0)]:
            motion = {"motion_scale": sign * base.motion_scale, "offset": offset}
            yield _changed(base, "joint-sense", **motion)
            yield _changed(base, "joint-sense", **motion, **torque)


def _swapped(base: Hypothesis) -> Iterator[Hypothesis]:
    """Yield the readings with the columns of two joints exchanged: all columns, or the torques."""
    for pair in combinations(range(len(base.offset)), 2):
        order = np.arange(len(base.offset))
        order[list(pair)] = pair[::-1]
        torque = base.torque_source[order]
        yield _changed(base, "joint-order", motion_source=base.motion_source[order], torque_source=torque)
        yield _changed(base, "torque-order", torque_source=torque)


def _scaled(base: Hypothesis, factors: Sequence[np.ndarray]) -> Iterator[Hypothesis]:
    for factor in factors:
        yield _changed(base, "torque-unit", torque_scale=base.torque_scale * factor)


def reordered(problem: GeometryProblem, unchanged: HypothesisFit) -> list[HypothesisFit]:
    """Return the best orders of all columns, and of the torques, by exchanging two joints at a time.

    Long arms have local minima: the search starts at random orders, too.
    """
    joints = problem.arm.joint_names
    starts = [np.arange(len(joints)), np.arange(len(joints))[::-1]]
    # joints may be logged in the alphabetical order of their names
    starts.append(np.argsort(np.argsort(joints)))
    rng = np.random.default_rng(0)
    starts += [rng.permutation(len(joints)) for _ in range(GEOMETRY.random_orders)]
    fits = {}
    for code in ("joint-order", "torque-order"):
        for start in starts:
            order = {"torque_source": start}
            if code == "joint-order":
                order["motion_source"] = start
            fit = problem.fit(_changed(unchanged.hypothesis, code, **order))
            while True:
                swaps = [x for x in _swapped(fit.hypothesis) if x.codes == (code,)]
                best = min(map(problem.fit, swaps), key=_rank)
                if best.cost > fit.cost - 1.0:
                    break
                fit = best
            fits[code, fit.hypothesis.torque_source.tobytes()] = fit
    return [fit for fit in fits.values() if not np.array_equal(fit.hypothesis.torque_source, starts[0])]


def _with_offset(
    problem: GeometryProblem, base: HypothesisFit, joint: int, revolute: bool
) -> list[HypothesisFit]:
    """Return the fit with the best zero offset of a joint; an empty list for an offset below calibration errors."""
    reading = base.hypothesis

    def shifted(offset: float) -> Hypothesis:
        changed = reading.offset.copy()
        changed[joint] += offset
        return _changed(reading, "joint-zero", offset=changed)

    starts = [0.0, *(RIGHT_ANGLE * np.array([1, 2, -1]))] if revolute else [0.0]
    fits = {start: problem.fit(shifted(start)) for start in starts}
    offset = min(fits, key=lambda start: fits[start].cost)
    best = fits[offset]
    for _ in range(GEOMETRY.refinements):
        nudged = shifted(offset + STEP)
        change = problem.torque(nudged, best.parameters) - problem.torque(best.hypothesis, best.parameters)
        step = float(np.clip(problem.step(best, change[..., None] / STEP)[0], -1.0, 1.0))
        if abs(step) < (GEOMETRY.min_angle if best is fits[0.0] and revolute else GEOMETRY.min_shift):
            break
        fit = problem.fit(shifted(offset + step))
        if fit.cost > best.cost:
            break
        best, offset = fit, offset + step
    if revolute:
        offset = (offset + np.pi) % (2 * np.pi) - np.pi
        right = RIGHT_ANGLE * round(offset / RIGHT_ANGLE)
        exact = problem.fit(shifted(right))
        if right and exact.cost < best.cost + GEOMETRY.right_angle:
            best, offset = exact, right
    if abs(offset) < (GEOMETRY.min_angle if revolute else GEOMETRY.min_shift):
        return []
    # if other masses have the same effect as the offset, its value is as uncertain as the masses of the URDF
    if best.misfit > base.misfit - GEOMETRY.needed / 2:
        return []
    is_right_angle = offset in (RIGHT_ANGLE, -RIGHT_ANGLE, -np.pi)
    return [best if is_right_angle else problem.fit(shifted(round(offset, 4)))]


def _with_gravity(problem: GeometryProblem, base: HypothesisFit) -> list[HypothesisFit]:
    """Return the fits with the best direction of gravity, and with the fraction of gravity in compensated torques."""
    present = np.array(base.hypothesis.gravity)
    size = float(np.linalg.norm(present))
    fits = []
    if size:
        fits += _with_compensation(problem, base)
    axes = [
        *-np.eye(3)[::-1],
        *np.eye(3),
    ]  # upright first: a vertical prismatic joint does not determine the sign of gravity
    starts = [_gravity(problem, base, (size or STANDARD_GRAVITY) * axis) for axis in axes]
    lowest = min(fit.cost for fit in starts)
    best = next(fit for fit in starts if fit.cost < lowest + GEOMETRY.rare)
    directions = [_best_direction(problem, start) for start in ((best, base) if size else (best,))]
    direction = min(directions, key=lambda fit: fit.cost)
    new = np.array(direction.hypothesis.gravity)
    if np.linalg.norm(new - present) > GEOMETRY.min_angle * size:
        axis = _gravity(problem, base, _nearest_axis(new))
        is_axis = axis.cost < direction.cost + GEOMETRY.right_angle
        fits.append(axis if is_axis else _gravity(problem, base, new.round(3)))
    return fits


def _gravity(problem: GeometryProblem, base: HypothesisFit, gravity: np.ndarray) -> HypothesisFit:
    x, y, z = (float(value) + 0.0 for value in gravity)
    return problem.fit(_changed(base.hypothesis, "gravity", gravity=(x, y, z)))


def _nearest_axis(gravity: np.ndarray) -> np.ndarray:
    return np.asarray(np.linalg.norm(gravity) * np.sign(gravity) * (np.abs(gravity) == np.abs(gravity).max()))


def _gravity_columns(problem: GeometryProblem, fit: HypothesisFit) -> np.ndarray:
    """Return the derivative of the torques with respect to the vector of gravity, (S, n, 3)."""
    bodies = [problem.torque(replace(fit.hypothesis, gravity=x), fit.parameters) for x in UNIT_GRAVITIES]
    return np.asarray(np.stack(bodies[1:], axis=2) - bodies[0][..., None])


UNIT_GRAVITIES: tuple[Vector3, ...] = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def _best_direction(problem: GeometryProblem, fit: HypothesisFit) -> HypothesisFit:
    """Return the fit with the best direction of gravity near the direction of a fit."""
    size = float(np.linalg.norm(fit.hypothesis.gravity))
    for _ in range(GEOMETRY.refinements):
        gravity = np.array(fit.hypothesis.gravity)
        new = gravity + problem.step(fit, _gravity_columns(problem, fit))
        new *= size / max(float(np.linalg.norm(new)), 1e-9)
        if np.linalg.norm(new - gravity) < 0.01 * size:
            break
        turned = _gravity(problem, fit, new)
        if turned.cost > fit.cost:
            break
        fit = turned
    return fit


def _with_compensation(problem: GeometryProblem, base: HypothesisFit) -> list[HypothesisFit]:
    """Return the fit with the fraction of gravity in torques that do not include a controller's compensation."""
    present = np.array(base.hypothesis.gravity)
    without = _gravity(problem, base, np.zeros(3))
    column = (_gravity_columns(problem, without) @ present)[..., None]
    part = float(np.clip(problem.step(without, column)[0], -GEOMETRY.compensated, GEOMETRY.compensated))
    some = _gravity(problem, base, (part * present).round(3))
    best = some if some.cost < without.cost - GEOMETRY.ambiguous else without
    codes = tuple("gravity-compensated" if code == "gravity" else code for code in best.hypothesis.codes)
    return [replace(best, hypothesis=replace(best.hypothesis, codes=codes))]
