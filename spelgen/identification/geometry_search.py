"""Search for the hypothesis about the columns of a log that fits the torques best.

A hypothesis corrects faults such as the opposite sense of a joint, exchanged joints, another zero, another unit or
another direction of gravity. Single corrections, orders of all joints, and combinations of corrections are tried.
"""

from collections.abc import Sequence
from dataclasses import replace
from operator import attrgetter

import numpy as np

from spelgen.arm.arm import Chain
from spelgen.identification.column_faults import JointSense, TorqueSense, WrongOrder
from spelgen.identification.continuous_faults import Compensation, Gravity, ZeroOffset
from spelgen.identification.hypotheses import Fault, Hypothesis, HypothesisFit
from spelgen.identification.log_geometry import GeometryProblem
from spelgen.identification.time_faults import Delay, JointClock
from spelgen.identification.tuning import GEOMETRY

RANK = attrgetter("rank")


def kinds_of_faults(arm: Chain, units: Sequence[Fault] = ()) -> tuple[Fault, ...]:
    """Return all kinds of faults that the search tests on logs of an arm with n joints.

    Examples: a joint whose positions have the opposite sign, or exchanged columns of joints. units: kinds of wrong
    units, with their candidates; none if the units are right.
    """
    n = len(arm.coordinates)
    return (
        WrongOrder("joint-order", "the columns of other joints", (0, 1)),
        WrongOrder("torque-order", "the torques of other joints", (1,)),
        # exchanged columns of only the motion are searched from fewer initial orders: such logs are rare, and each
        # order requires a new regressor
        WrongOrder("motion-order", "the positions and velocities of other joints", (0,), starts=3),
        JointSense(n),
        TorqueSense(n),
        *units,
        ZeroOffset(),
        Delay(),
        JointClock(),
        Compensation(),
        Gravity(),
    )


def kinds_of_servo_faults(arm: Chain) -> tuple[Fault, ...]:
    """Return the kinds of faults that the search tests on logs of servos, with commanded and measured positions.

    Each fault affects measured positions and commands in the same way, for example the opposite sign of both at a
    joint.
    """
    sense = JointSense(len(arm.coordinates))
    sense.factors = [factor for factor in sense.factors if (factor[1] < 0).any()]
    order = WrongOrder("joint-order", "the columns of other joints", (0, 1), starts=3)
    return order, sense, ZeroOffset(), Gravity()


def compare_hypotheses(problem: GeometryProblem, faults: Sequence[Fault]) -> tuple[HypothesisFit, ...]:
    """Return the fit of the unchanged log, then up to three fits of hypotheses with significantly lower costs.

    faults: kinds of faults, corrected singly and combined. There are three cases:

    - Hypotheses have significantly lower costs: the best is first, and the costs of the others are within
      `GEOMETRY.ambiguous` of its cost.
    - No decrease is significant, but a fault with `needed` = 0 lowers the cost at all: the best correction of such a
      fault is returned, since there is other evidence for it. Example: `TorqueUnit`, for which the URDF's gravity
      torque is evidence.
    - Otherwise the result has only the fit of the unchanged log.
    """
    # the many hypotheses are compared on few samples, and only the best ones are compared on more samples below
    coarse = problem.thinned(GEOMETRY.coarse_samples)
    stateful = coarse.with_hysteresis()
    unchanged = coarse.fit(problem.unchanged)
    fits = [unchanged]
    # At most three corrections are combined; a permutation of the columns counts as one. More corrections could explain
    # any log.
    for _ in range(3):
        base = min(fits, key=RANK)
        # If a log has two faults, the best single correction may be wrong. Further corrections are therefore added to
        # several of the best single corrections.
        is_partial = base.errors.max() > GEOMETRY.explained and base is not unchanged
        tried: list[HypothesisFit] = []
        for start in sorted(fits, key=RANK)[: GEOMETRY.beam if is_partial else 1]:
            tried += _weighed(coarse, stateful, _corrected(coarse, stateful, faults, start), start)
        better = min(tried, key=RANK)
        # `thorough_fits` search permutations of all joints, and drifts: delays that change by tenths of a second during
        # a recording. They take time, and are made only if no single correction explains the torques, or if the best
        # single correction is a drift. The search for single corrections starts at a drift of zero: if the true drift
        # is large, it may find a drift of the wrong signals.
        is_wrong = (
            better.cost < unchanged.cost - GEOMETRY.needed or unchanged.errors.mean() > GEOMETRY.unexplained
        )
        is_open = better.errors.max() > GEOMETRY.explained or better.hypothesis.drift.any()
        if base is unchanged and is_wrong and is_open:
            orders = [fit for fault in faults for fit in fault.thorough_fits(coarse, base)]
            tried += _weighed(coarse, stateful, orders, base)
        if min(tried, key=RANK).cost > base.cost - GEOMETRY.needed:
            break
        fits = [*tried, unchanged]
    likely = _likely(unchanged, fits)
    if not likely:
        # No decrease of the cost is significant. Faults with `needed` = 0, such as another torque unit, may be accepted
        # nevertheless: the comparison of their gravity torque with the URDF's is other evidence for them.
        known = _corrected(coarse, stateful, [fault for fault in faults if not fault.needed], unchanged)
        best = min(known, key=RANK, default=unchanged)
        return (unchanged, best) if best.cost < unchanged.cost else (unchanged,)
    finer = problem.thinned(GEOMETRY.confirming_samples)
    unchanged = finer.fit(problem.unchanged)
    # only three hypotheses are confirmed, since a message lists at most three
    fits = [_with_likely_senses(finer, finer.fit(fit.hypothesis)) for fit in likely[:3]]
    confirmed = _weighed(finer, finer.with_hysteresis(), fits, unchanged)
    return unchanged, *_likely(unchanged, confirmed)


def deviating_recordings(problem: GeometryProblem) -> list[int]:
    """Return the indices of the recordings whose torques contradict the other recordings; at most half of all.

    A recording deviates if parameters fitted to all other recordings explain the torques of the others, but not its own
    torques. Deviating recordings are removed one by one, the worst first. Of two recordings that contradict each other,
    one is returned, although it may be the right one.
    """
    coarse = problem.thinned(GEOMETRY.confirming_samples)
    number, unchanged = coarse.samples.recording, coarse.unchanged
    tau = unchanged.signals(coarse.samples).tau
    remaining, deviating = np.unique(number).tolist(), list[int]()

    def errors(fitted: Sequence[int]) -> dict[int, np.ndarray]:
        """Return {recording: (n,) mean squared residual / torque variance} for all remaining recordings.

        The model is fitted only to the recordings `fitted` (indices); the residuals of the others are held out.
        """
        counted = np.isin(number, fitted)[:, None] & np.ones(tau.shape[1], bool)
        residual = coarse.residual(unchanged, coarse.on_torques(counted).fit(unchanged).parameters)
        scale = np.maximum(tau.var(axis=0), 1e-30)
        return {x: np.square(residual[number == x]).mean(axis=0) / scale for x in remaining}

    while len(remaining) > len(deviating) + 1:
        present = errors(remaining)
        worst = max(remaining, key=lambda x: float(present[x].max()))
        if present[worst].max() < GEOMETRY.unexplained / 5:
            break
        reduced = [x for x in remaining if x != worst]
        without = errors(reduced)
        usual = np.mean([without[x] for x in reduced], axis=0)
        # No recording is reported if the others contradict each other, too: then the fault may be in all recordings.
        is_worse = (without[worst] > GEOMETRY.unexplained) & (without[worst] > GEOMETRY.deviation * usual)
        if not is_worse.any() or usual.mean() > GEOMETRY.explained:
            break
        remaining, deviating = reduced, [*deviating, worst]
    return deviating


def _corrected(
    problem: GeometryProblem, stateful: GeometryProblem, faults: Sequence[Fault], base: HypothesisFit
) -> list[HypothesisFit]:
    """Return fits of `problem` under hypotheses that correct one more fault than the hypothesis of `base` does.

    stateful: `problem` with a friction model with hysteresis. Continuous quantities of a hypothesis, such as a zero
    offset, are optimised in `stateful`: without hysteresis, the optimum would compensate errors of the friction model.
    """
    fits, start = list[HypothesisFit](), stateful.fit(base.hypothesis)
    for fault in faults:
        if fault.is_optimised:
            fits += [problem.fit(fit.hypothesis) for fit in fault.fits(stateful, start)]
        else:
            fits += fault.fits(problem, base)
    return fits


def _weighed(
    problem: GeometryProblem, stateful: GeometryProblem, fits: Sequence[HypothesisFit], base: HypothesisFit
) -> list[HypothesisFit]:
    """Return the fits with costs that take a friction model with hysteresis into account.

    Let a be the decrease of the cost (negative log posterior) from `base` to a hypothesis in fits without hysteresis,
    and b the decrease in fits with hysteresis. The result has the decrease min(b, max(a, b / 2)).

    - a can be too small for the right hypothesis: without presliding hysteresis, the friction model has an error of a
      few per cent of the torque, which remains in the residual under every hypothesis. b has no such error.
    - a can be too large for a wrong hypothesis, which may explain friction that the model without hysteresis lacks. b
      is then small, and is the upper bound of the decrease.
    - b can be too large for a wrong hypothesis: on recorded arms, wrong hypotheses have b up to 32 and a up to 17. If a
      is smaller than b, the decrease is therefore a or b / 2, whichever is larger.

    For a hypothesis with another delay than `base`, the decrease is min(a, b): hysteresis resembles a delay, so such a
    hypothesis must lower both costs.

    A lower torque residual may be due to errors of the friction model, above all if the model with hysteresis explains
    the torques under `base` (`GeometryProblem.explains`). The decrease is 0 unless `_is_certain`.

    Args:
        problem: problem without hysteresis.
        stateful: the same problem with hysteresis.
        fits: fits of `problem` under hypotheses. The fits with hysteresis take time: only hypotheses with a above
            `GEOMETRY.slight`, at most the `GEOMETRY.weighed` best, are fitted with hysteresis. The others have the
            decrease a.
        base: fit of `problem` with which the costs are compared.
    """
    best = sorted(fits, key=RANK)
    present, times = base.hypothesis, np.append(base.hypothesis.delay, base.hypothesis.drift)
    plain_base, stateful_base = problem.fit(present), stateful.fit(present)
    moving, is_exact = present.signals(problem.samples).moving_joints, stateful.explains(stateful_base)
    for k, fit in enumerate(best):
        change, hypothesis = fit.cost - plain_base.cost, fit.hypothesis
        if k < GEOMETRY.weighed and change < -GEOMETRY.slight:
            stateful_fit = stateful.fit(hypothesis)
            stateful_change = stateful_fit.cost - stateful_base.cost
            is_late = bool((np.append(hypothesis.delay, hypothesis.drift) != times).any())
            change = max(stateful_change, change if is_late else min(change, stateful_change / 2))
            moved = moving | hypothesis.signals(problem.samples).moving_joints
            pairs = (plain_base, fit), (stateful_base, stateful_fit)
            if not _is_certain(*pairs, moved, is_late=is_late, is_exact=is_exact):
                change = 0.0
        best[k] = replace(fit, cost=base.cost + change)
    return best


def _is_certain(
    plain: tuple[HypothesisFit, HypothesisFit],
    stateful: tuple[HypothesisFit, HypothesisFit],
    moving: np.ndarray,
    *,
    is_late: bool,
    is_exact: bool,
) -> bool:
    """Return True if a hypothesis is better than another one by more than errors of the friction model explain.

    If it does not exchange whole joints, it must lower the squared residual of a moving joint with hysteresis to the
    fraction `GEOMETRY.clear`, or have more plausible parameters in both models, by `GEOMETRY.ambiguous`. Delays are as
    plausible as hysteresis, so only the residual counts for them. If the other hypothesis explains the torques, this
    one must also concern joints that move, and the fraction is a fifth.

    Args:
        plain: fits of the other hypothesis and of this one, without hysteresis.
        stateful: the same with hysteresis.
        moving: mask (n,) of the joints that move.
        is_late: True if the hypothesis has other delays.
        is_exact: True if the other hypothesis explains the torques with hysteresis.
    """
    old, new = (fit.hypothesis for fit in plain)
    exchanged = old.source != new.source
    if exchanged.any() and (exchanged[0] == exchanged[1]).all():
        return bool(moving[exchanged[0]].all()) or not is_exact
    changed = (exchanged | (old.scale != new.scale)).any(axis=0) | (old.offset != new.offset)
    if is_exact and changed.any() and not moving[changed].any():
        return False
    is_lower = stateful[1].errors < (0.2 if is_exact else GEOMETRY.clear) * stateful[0].errors
    gain = min(present.penalties - fit.penalties for present, fit in (plain, stateful))
    return bool(is_lower[moving].any()) or (gain > GEOMETRY.ambiguous and not is_late)


def _with_likely_senses(problem: GeometryProblem, fit: HypothesisFit) -> HypothesisFit:
    """Return a fit in which the torques of other joints are reversed, if `fit` reverses several and this costs less.

    The search makes at most three corrections. If the torques of four joints are reversed, it may end with all other
    joints reversed, with too many or with too few: all torques are therefore reversed here, and single ones, too. The
    reversal of another joint must lower the cost significantly.
    """
    n = len(fit.hypothesis.offset)
    for torque in (-np.ones(n), *(1.0 - 2.0 * np.eye(n))):
        factors = fit.hypothesis.scale / problem.unchanged.scale
        is_reversed = (factors[1] < 0) & (factors[0] > 0)
        if is_reversed.sum() > 1:
            scale = fit.hypothesis.scale * [np.ones(n), torque]
            reversed_fit = problem.fit(replace(fit.hypothesis, scale=scale))
            needed = 0.0 if is_reversed[torque < 0].any() else GEOMETRY.needed
            fit = reversed_fit if reversed_fit.rank < fit.rank - needed else fit
    return fit


def _likely(unchanged: HypothesisFit, fits: Sequence[HypothesisFit]) -> tuple[HypothesisFit, ...]:
    """Return the best fit and all fits of about the same cost; () if none is significantly better than `unchanged`.

    unchanged: fit of the unchanged log. fits: fits of hypotheses that correct faults of the log.
    """
    best = min(fits, key=attrgetter("cost"))
    if best.cost > unchanged.cost - GEOMETRY.needed:
        return ()
    likely = sorted((fit for fit in fits if fit.cost < best.cost + GEOMETRY.ambiguous), key=RANK)
    # Exchanged columns may explain errors of the friction model, and then have a lower cost than the right hypothesis,
    # the reversed sign of a single joint, which is the more frequent fault. The best hypothesis of one reversed joint
    # is therefore moved to the front if its rank exceeds the rank of the exchanged columns by less than `needed`, and
    # is below the cost of the unchanged log by more than `ambiguous`.
    if isinstance(likely[0].hypothesis.faults[0], WrongOrder):
        bound = min(likely[0].rank + GEOMETRY.needed, unchanged.cost - GEOMETRY.ambiguous)
        senses = [fit for fit in fits if fit.rank < bound and _is_one_sense(fit.hypothesis)]
        likely = [*sorted(senses, key=RANK)[:1], *(fit for fit in likely if fit not in senses)]
    return tuple(likely)


def _is_one_sense(hypothesis: Hypothesis) -> bool:
    """Return True if a hypothesis only reverses the sign of the motion or torque, or of both, at a single joint."""
    is_sense = len(hypothesis.faults) == 1 and isinstance(hypothesis.faults[0], JointSense | TorqueSense)
    return is_sense and int((hypothesis.scale < 0).any(axis=0).sum()) == 1
