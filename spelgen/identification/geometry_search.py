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
from spelgen.identification.drive_hints import OFFSETS
from spelgen.identification.log_geometry import GeometryProblem, Hypothesis, HypothesisFit
from spelgen.identification.tuning import GEOMETRY
from spelgen.logs.dynamics_samples import FREQUENCY
from spelgen.settings.log_mapping import SCALES

RIGHT_ANGLE = np.pi / 2
# Code of a change -> penalty on its cost, in multiples of `GEOMETRY.rare`, for changes that are rarer than a wrong sign
# or order. The penalty decides between changes that explain the torques equally well.
RARE = {
    "gravity": 1,
    "joint-zero": 2,
    "torque-unit": 2,
    "joint-unit": 2,
    "gravity-compensated": 3,
    "joint-delay": 2,
}


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


UNITS = {"revolute": ("rad", "deg", "turns"), "prismatic": ("m", "mm")}


def position_unit(joint_type: str, scale: float) -> str:
    """Return the unit of positions whose factor to SI units is nearest to the magnitude of `scale`."""
    return min(UNITS[joint_type], key=lambda unit: abs(np.log(abs(scale) / SCALES.get(unit, 1.0))))


def position_scalings(arm: Chain, scale: np.ndarray) -> list[Scaling]:
    """Return the candidates for positions of all joints of a type in another unit than the mapping states.

    scale: (n,) factor from logged positions to SI units, with the sign of the joint.
    """
    types, ones = np.array(arm.joint_types), np.ones(len(scale))
    scalings = []
    for joint_type, units in UNITS.items():
        for unit in units:
            motion = np.where(types == joint_type, SCALES.get(unit, 1.0) / np.abs(scale), ones)
            if (motion != 1).any():
                scalings.append(Scaling("joint-unit", motion, ones))
    return scalings


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
    coarse = problem.thinned(GEOMETRY.coarse_samples)
    unchanged = coarse.fit(problem.unchanged)
    fits = [unchanged]
    # At most three changes are combined, where an order of all joints is one change: more changes could explain any
    # log.
    for _ in range(3):
        best = min(fits, key=_rank)
        tried = single_changes(coarse, best, scalings)
        better = min(tried, key=_rank)
        # orders are searched only if no single change explains the torques, since the search takes seconds
        is_wrong = (
            better.cost < unchanged.cost - GEOMETRY.needed or unchanged.errors.mean() > GEOMETRY.unexplained
        )
        if best is unchanged and is_wrong and better.errors.max() > GEOMETRY.explained:
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
    """Return the fit for the best candidate for another torque unit, as a tuple; () if the unchanged log has less cost.

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
    return [*fits, *_with_delays(problem, base), *_with_gravity(problem, base)]


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
    """Return fits with the best order of the joints: of all columns, of the torque columns, and of the motion columns.

    Each start of the search gives one fit, unless it ends at the present order. An order is improved by exchanging two
    joints at a time. The search also starts at random orders, since the cost has local minima for arms with many
    joints.
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


def _descend(
    problem: GeometryProblem,
    at: Callable[[np.ndarray], Hypothesis],
    start: np.ndarray,
    *,
    largest: float,
    smallest: float,
    allowed: Callable[[np.ndarray], np.ndarray] = np.asarray,
) -> tuple[np.ndarray, HypothesisFit]:
    """Return continuous quantities of a hypothesis, (D,), with a low cost, and their fit.

    At most four Gauss-Newton steps are made. The descent ends when a step does not lower the cost, or is negligible.

    Args:
        problem: least-squares problem of the log.
        at: function of the quantities (D,) that returns the hypothesis.
        start: (D,) initial values.
        largest: bound of each component of a step, which is clipped.
        smallest: norm below which a step is negligible.
        allowed: function of values (D,) after a step that returns the nearest allowed values.
    """
    values, fit = start, problem.fit(at(start))
    difference = 1e-4 * largest
    for _ in range(4):
        residual = problem.residual(fit.hypothesis, fit.parameters)
        columns = []
        for shift in difference * np.eye(len(values)):
            changed = problem.residual(at(values + shift), fit.parameters)
            columns.append((changed - residual) / difference)
        step = np.clip(problem.step(fit, np.stack(columns, axis=2)), -largest, largest)
        new = allowed(values + step)
        if np.linalg.norm(new - values) < smallest:
            break
        best = problem.fit(at(new))
        if best.cost > fit.cost:
            break
        values, fit = new, best
    return values, fit


def _with_offset(
    problem: GeometryProblem, base: HypothesisFit, joint: int, revolute: bool
) -> list[HypothesisFit]:
    """Return a list with the fit for the best zero offset of a joint.

    It is empty if the offset is as small as calibration errors, or if it hardly improves the fit to the torques.
    revolute: True for a revolute joint, for which multiples of 90 degrees are preferred.
    """
    reading = base.hypothesis
    unit = np.eye(len(reading.offset))[joint]
    min_offset = GEOMETRY.min_angle if revolute else GEOMETRY.min_shift

    def shifted(values: np.ndarray) -> Hypothesis:
        return _changed(reading, "joint-zero", offset=reading.offset + values * unit)

    starts = RIGHT_ANGLE * np.array([[0], [1], [2], [-1]]) if revolute else np.zeros((1, 1))
    start = min(starts, key=lambda x: problem.fit(shifted(x)).cost)
    # from the unchanged zero, a step as small as calibration errors is no other zero
    smallest = GEOMETRY.min_shift if start.any() else min_offset
    offset, best = _descend(problem, shifted, start, largest=1.0, smallest=smallest)
    is_right_angle = False
    if revolute:
        offset = (offset + np.pi) % (2 * np.pi) - np.pi
        right = RIGHT_ANGLE * np.round(offset / RIGHT_ANGLE)
        exact = problem.fit(shifted(right))
        is_right_angle = bool(right.any()) and exact.cost < best.cost + GEOMETRY.right_angle
        if is_right_angle:
            best, offset = exact, right
    # An offset must also lower the torque residual (misfit), and not only the prior term: otherwise it only replaces a
    # change of the masses, whose values in the URDF are uncertain.
    if abs(offset[0]) < min_offset or best.misfit > base.misfit - GEOMETRY.needed / 2:
        return []
    return [best if is_right_angle else problem.fit(shifted(offset.round(4)))]


def _with_delays(problem: GeometryProblem, base: HypothesisFit) -> Iterator[HypothesisFit]:
    """Yield the fits for delays of one joint's motion, torque, or both, and of all torques.

    Delays as short as the apparent ones that friction causes are omitted, and a second delay. Samples without their
    neighbours show none.
    """
    reading = base.hypothesis
    if problem.samples.values.shape[3] == 1 or "joint-delay" in reading.codes:
        return
    units = np.eye(len(reading.offset))
    still = np.zeros(len(units))
    candidates = [(still, still + 1.0), *((unit, still) for unit in units)]
    candidates += [(still, unit) for unit in units] + [(unit, unit) for unit in units]
    longest, stateful = OFFSETS[-1] / FREQUENCY, problem.with_hysteresis()
    errors, stateful_errors = base.errors, stateful.fit(reading).errors
    for motion, torque in candidates:

        def delayed(
            delay: np.ndarray, motion: np.ndarray = motion, torque: np.ndarray = torque
        ) -> Hypothesis:
            return _changed(
                reading,
                "joint-delay",
                motion_delay=reading.motion_delay + delay * motion,
                torque_delay=reading.torque_delay + delay * torque,
            )

        # a step from 0 would be too short for noisy torques, whose derivative is mostly noise
        starts = GEOMETRY.delay_start * np.array([[0.0], [1.0], [-1.0]])
        delay, _ = _descend(
            problem, delayed, min(starts, key=lambda x: problem.fit(delayed(x)).cost), largest=0.05, smallest=0.002,
            allowed=lambda x: np.clip(x, -longest, longest),
        )  # fmt: skip
        if abs(delay[0]) >= GEOMETRY.min_delay:
            fit = problem.fit(delayed(delay.round(3)))
            # Friction with a history also resembles a delay. A delay explains a joint's residual with both friction
            # models.
            is_better = fit.errors < GEOMETRY.delay_gain * errors
            is_better &= stateful.fit(fit.hypothesis).errors < GEOMETRY.delay_gain * stateful_errors
            if is_better.any():
                yield fit


def _with_gravity(problem: GeometryProblem, base: HypothesisFit) -> list[HypothesisFit]:
    """Return at most two fits: with the best direction of gravity, and with torques that lack gravity compensation.

    Directions along the axes of the root link are preferred. A direction is omitted if it differs from the present one
    by less than typical calibration errors.
    """
    present = np.array(base.hypothesis.gravity)
    size = float(np.linalg.norm(present))
    standard = size or 9.81  # m/s^2

    def normalised(gravity: np.ndarray) -> np.ndarray:
        return np.asarray(gravity * standard / max(float(np.linalg.norm(gravity)), 1e-9))

    # gravity along -z is the first start: it is preferred if the log does not determine the sign of gravity, as with a
    # vertical prismatic joint
    starts = [problem.fit(_falling(base, standard * axis)) for axis in (*-np.eye(3)[::-1], *np.eye(3))]
    lowest = min(fit.cost for fit in starts)
    start = next(fit for fit in starts if fit.cost < lowest + GEOMETRY.rare)
    descents = []
    for fit in [start, *([base] if size else [])]:
        direction = np.array(fit.hypothesis.gravity)
        descents.append(
            _descend(
                problem, lambda x: _falling(base, x), direction, largest=standard, smallest=0.01 * standard,
                allowed=normalised,
            )
        )  # fmt: skip
    new, best = min(descents, key=lambda x: x[1].cost)
    fits = [_with_compensation(problem, base)] if size else []
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


def _with_compensation(problem: GeometryProblem, base: HypothesisFit) -> HypothesisFit:
    """Return the fit for torques from which a controller's gravity compensation is missing, entirely or in part.

    Gravity is multiplied by a fraction of at most a half, or by zero if this fits about equally well.
    """
    present = np.array(base.hypothesis.gravity)
    without = problem.fit(_falling(base, np.zeros(3), "gravity-compensated"))
    # a fraction of more than a half in all joints is ascribed to wrong masses of the URDF, not to a compensation
    part, _ = _descend(
        problem, lambda x: _falling(base, x * present, "gravity-compensated"), np.zeros(1), largest=0.5, smallest=1e-3,
        allowed=lambda x: np.clip(x, -0.5, 0.5),
    )  # fmt: skip
    some = problem.fit(_falling(base, (part * present).round(3), "gravity-compensated"))
    return some if some.cost < without.cost - GEOMETRY.ambiguous else without
