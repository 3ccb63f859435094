"""Kinds of faults of the times of a log: signals that are delayed, or that have the times of another clock.

The delays of lowest cost are found by Gauss-Newton steps (`GeometryProblem.descend`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import partial
from operator import itemgetter

import numpy as np

from spelgen.identification.hypotheses import Correction, Fault, Hypothesis, HypothesisFit
from spelgen.identification.log_geometry import GeometryProblem
from spelgen.identification.motion_samples import interpolation
from spelgen.identification.tuning import GEOMETRY
from spelgen.logs.joint_signals import plain_number

DIFFERENCE = 1e-4  # [s] step of finite differences with respect to delays


class Delay(Fault):
    """Kind of fault of a log: some signals were logged later or earlier than the others.

    These signals are the motion, the torque or all signals of a joint, or the torques of all joints.
    """

    code = "joint-delay"
    rarity = 2

    def fits(self, problem: GeometryProblem, base: HypothesisFit) -> Iterator[HypothesisFit]:
        """Yield least-squares fits of the log's torques, each with a common delay of a set of signals.

        The sets (`_delayed_signals`) are the torques of all joints, and the motion, the torque or both of one joint.
        Each fit has the best delay of its set. Delays below `GEOMETRY.min_delay` are omitted: friction causes such
        apparent delays. Nothing is yielded if the hypothesis of the fit `base` already has a delay, or if the samples
        do not contain the signals at earlier and later times, which delayed signals need.
        """
        reading, reference = base.hypothesis, base
        if not problem.samples.longest_delay or reading.delay.any():
            return
        for signals in _delayed_signals(len(reading.offset)):

            def delayed(delay: np.ndarray, signals: np.ndarray = signals) -> Hypothesis:
                """Return the hypothesis that `signals`, a (2, n) mask of motions and torques, have a delay.

                delay: (1,) [s].
                """
                return reading.changed(self, delay=delay * signals)

            # The descent starts at the best of three delays: a Gauss-Newton step from 0 would be too short for noisy
            # torques, whose derivative with respect to time is mostly noise.
            starts = GEOMETRY.delay_start * np.array([[0.0], [1.0], [-1.0]])
            start = min(starts, key=lambda x: problem.fit(delayed(x)).cost)
            delay, delayed_fit = problem.descend(
                delayed, min((start, 4 * start), key=lambda x: problem.fit(delayed(x)).cost), largest=0.1,
                smallest=0.002, allowed=lambda x: np.clip(x, -GEOMETRY.longest_delay, GEOMETRY.longest_delay),
            )  # fmt: skip
            if abs(delay[0]) >= GEOMETRY.min_delay:
                fit = problem.fit(delayed(delay.round(3)))
                if _explains_more(problem, reference, fit):
                    yield _low_passed(problem, base, fit) or fit
            elif signals[1].all() and delayed_fit.cost < base.cost:
                # The delay of one joint must explain more than a short delay of all torques, which is not reported.
                reference = delayed_fit

    def text(self, correction: Correction) -> str:
        """Return the text about delayed signals: which signals of the joints, and the longest delay."""
        delay = correction.hypothesis.delay
        longest = 1e3 * float(delay.ravel()[np.abs(delay).argmax()])
        order = "later" if longest > 0 else "earlier"
        return f"{_late_signals(delay)} logged {abs(longest):.3g} ms {order}"

    def joint_keys(self, correction: Correction, joint: int) -> dict[str, object]:
        """Return the setting `delay` of a joint, {quantity: delay [s]} for its delayed signals; {} without a delay.

        {} is also returned if the torques of all joints have the same delay, which `log_keys` corrects for the whole
        log.
        """
        mapping, delays = correction.mapping, correction.hypothesis.delay[:, joint]
        if self.log_keys(correction) or not delays.any():
            return {}
        present = mapping.joint(correction.arm.joint_names[joint]).delay
        late = {}
        for quantity in mapping.quantities:
            delay = delays[int(quantity == "tau")]
            if delay:
                late[quantity] = plain_number(present.model_dump()[quantity] + delay)
        return {"delay": {**present.model_dump(exclude_unset=True), **late}}

    def log_keys(self, correction: Correction) -> dict[str, object]:
        """Return the setting `torque_delay` of the log if the torques of all joints have one delay; else {}."""
        delay = correction.hypothesis.delay[1]
        if not delay.any() or (delay != delay[0]).any():
            return {}
        return {"torque_delay": plain_number(correction.mapping.torque_delay + delay[0])}


class LowPass(Delay):
    """Kind of fault of a log: torques that a low-pass filter delays, as the filter of a drive or sensor does."""

    advice = "no setting corrects it: log the torques without this filter"

    def __init__(self, lag: float) -> None:
        """Define the filter by its time constant `lag` [s]."""
        self._lag = lag

    def text(self, correction: Correction) -> str:
        """Return the text about the filter with its cutoff frequency."""
        return f"torques after a low-pass filter of about {1 / (2 * np.pi * self._lag):.2g} Hz"


class JointClock(Fault):
    """Kind of fault of a log: some signals have times of another clock, so that their delay changes linearly.

    These signals are the motion, the torque or all signals of a joint, or the torques of all joints.
    """

    code = "joint-clock"
    rarity = 3
    advice = "no setting corrects it: log all joints with one clock"

    def fits(self, problem: GeometryProblem, base: HypothesisFit) -> Iterable[HypothesisFit]:
        """Return the best fit in which the delay of a set of signals changes linearly during a recording, or no fit.

        If the hypothesis of `base` has a delay, the search starts from this delay at both the start and the end of a
        recording. Otherwise there is one initial guess per set of signals, such as the torque of one joint
        (`_delayed_signals`): the delays at the start and at the end after one Gauss-Newton step from zero. The
        derivatives of the residual with respect to these two delays are (1 - t) d and t d, with the relative time t
        from 0 to 1 and the derivative d with respect to a constant delay of the set. There is no fit if the delay of
        `base` already changes.
        """
        reading = base.hypothesis
        if reading.drift.any() or not problem.samples.longest_delay:
            return []
        if reading.delay.any():
            signals, first = 1.0 * (reading.delay != 0), reading.delay[reading.delay != 0][0]
            faults = tuple(x for x in reading.faults if not isinstance(x, Delay))
            reading = replace(reading, faults=faults, delay=np.zeros_like(reading.delay))
            return self._best(problem, reading, [(np.full(2, first), signals)], np.inf)
        residual = problem.residual(reading, base.parameters)
        time = (problem.samples.times / problem.samples.times.max())[:, None, None]
        starts = []
        for signals in _delayed_signals(len(reading.offset)):
            shifted = problem.residual(reading.changed(self, delay=DIFFERENCE * signals), base.parameters)
            column = ((shifted - residual) / DIFFERENCE)[..., None]
            step = problem.step(base, np.concatenate([(1 - time) * column, time * column], axis=2))
            if abs(step[1] - step[0]) >= GEOMETRY.min_delay / 2:
                starts.append((np.clip(step, -0.3, 0.3), signals))
        return self._best(problem, reading, starts, base.cost - GEOMETRY.slight)

    def thorough_fits(self, problem: GeometryProblem, unchanged: HypothesisFit) -> Iterable[HypothesisFit]:
        """Return at most three least-squares fits in which the delay of some signals changes linearly with time.

        The delay is 0 at the start of a recording. An initial guess has a set of delayed signals (from
        `_delayed_signals`) and a delay at the end [s] (from `GEOMETRY.clock_starts`). All combinations are evaluated,
        and the three of lowest cost are refined: one of them probably has the right signals and the right sign of the
        drift. unchanged: fit of the unchanged log.
        """
        reading, starts = unchanged.hypothesis, []
        for signals in _delayed_signals(len(reading.offset)) if problem.samples.longest_delay else ():
            starts += [(np.array([0.0, last]), signals) for last in GEOMETRY.clock_starts]
        return self._best(problem, reading, starts, np.inf, 3)

    def _best(
        self,
        problem: GeometryProblem,
        reading: Hypothesis,
        starts: list[tuple[np.ndarray, np.ndarray]],
        limit: float,
        count: int = 1,
    ) -> Iterator[HypothesisFit]:
        """Yield least-squares fits in which a set of signals has the best delays at the start and end of a recording.

        Between start and end the delay changes linearly. A fit is omitted if both delays are about equal, if the change
        is larger than the error of a clock (`GEOMETRY.clock_error`), or if the fit lowers the torque residual too
        little: in the mean of the joints (`GEOMETRY.lower`), or at each joint (`_explains_more`).

        Args:
            problem: least-squares problem of the log.
            reading: hypothesis without these delays.
            starts: initial guesses: delays (2,) [s] at the start and at the end, and a mask (2, n) of the signals that
                are delayed (first row: motion, second row: torques of n joints).
            limit: only initial guesses with a cost below this limit are refined.
            count: only this number of initial guesses, with the lowest costs, are refined.
        """

        def drifting(delays: np.ndarray, signals: np.ndarray) -> Hypothesis:
            """Return the hypothesis in which the delay of some signals changes linearly during a recording.

            delays: (2,) [s], at the start and at the end. signals: mask (2, n), motions and torques.
            """
            first, last = delays
            drift = (last - first) / float(problem.samples.times.max())
            return reading.changed(self, delay=first * signals, drift=drift * signals)

        costs = [(problem.fit(drifting(*start)).cost, *start) for start in starts]
        base = problem.fit(reading)
        for cost, start, signals in sorted(costs, key=itemgetter(0))[:count]:
            if cost >= limit:
                return
            delays, best = problem.descend(
                partial(drifting, signals=signals), start, largest=0.3, smallest=0.002
            )
            is_clock = abs(delays[1] - delays[0]) >= GEOMETRY.min_delay
            is_clock &= bool(np.abs(best.hypothesis.drift).max() <= GEOMETRY.clock_error)
            # No setting corrects signals with the times of another clock: the user can only record again. The finding
            # must be certain, so the mean residual of the joints must fall, too.
            is_certain = best.errors.mean() < GEOMETRY.lower * base.errors.mean()
            if is_clock and is_certain and _explains_more(problem, base, best):
                yield best

    def text(self, correction: Correction) -> str:
        """Return the text about signals with another clock: which signals, and the error of the clock's rate."""
        drift = correction.hypothesis.drift
        largest = float(drift.ravel()[np.abs(drift).argmax()])
        return f"{_late_signals(drift)} of a clock that runs {abs(largest):.2%} {'fast' if largest > 0 else 'slow'}"

    def joints(self, correction: Correction) -> list[str]:
        """Return the names of the joints that have a signal with another clock according to `correction`."""
        names = np.array(correction.arm.joint_names)
        return list(names[correction.hypothesis.drift.any(axis=0)].tolist())


def _low_passed(problem: GeometryProblem, base: HypothesisFit, fit: HypothesisFit) -> HypothesisFit | None:
    """Return `fit`, the fit with delayed torques, with the fault `LowPass` if this fault explains them better.

    A first-order low-pass filter with the time constant T has the output tau for the input tau + T dtau/dt. The torques
    are replaced by this input, with the T of lowest cost, and their residual is compared with the residual of `fit`.
    base: fit without the delay.
    """
    delay = fit.hypothesis.delay
    if delay[0].any() or delay.min() < 0:
        return None
    rate = problem.samples.values[:, :, 3] @ interpolation()(0.0, 1)
    lags = float(delay.max()) * np.linspace(0.9, 1.6, 8)
    inputs = [problem.with_added_torques(lag * (delay[1] > 0) * rate) for lag in lags]
    errors = np.array([x.fit(base.hypothesis).errors.mean() for x in inputs])
    if errors.min() > GEOMETRY.delay_gain * fit.errors.mean():
        return None
    reading = base.hypothesis.changed(LowPass(float(lags[errors.argmin()])), delay=delay)
    return replace(fit, hypothesis=reading)


def _explains_more(problem: GeometryProblem, base: HypothesisFit, fit: HypothesisFit) -> bool:
    """Return True if delayed signals explain the torque of at least one joint much better than the fit `base`.

    The joint's squared torque residual in `fit` must be less than `GEOMETRY.delay_gain` times the residual in `base`.
    Hysteresis of friction resembles a delay, so this must also hold for the fits of both hypotheses with hysteresis.
    """
    stateful = problem.with_hysteresis()
    is_better = fit.errors < GEOMETRY.delay_gain * base.errors
    before, after = (stateful.fit(x.hypothesis).errors for x in (base, fit))
    return bool((is_better & (after < GEOMETRY.delay_gain * before)).any())


def _delayed_signals(n: int) -> list[np.ndarray]:
    """Return masks (2, n) of motion and torque, one per set of signals that may have a common delay.

    The sets: the torques of all n joints; then, for each of several joints, its motion, its torque, and both. A common
    delay of both at the only joint would shift the times of the whole log.
    """
    masks = [np.stack([np.zeros(n), np.ones(n)])]
    for rows in ([1.0, 0.0], [0.0, 1.0], [1.0, 1.0]) if n > 1 else ():
        masks += [np.outer(rows, unit) for unit in np.eye(n)]
    return masks


def _late_signals(delay: np.ndarray) -> str:
    """Return words for the signals with a delay, such as "torques".

    delay: (2, n), delays of the motions (first row) and torques [s], or their drifts [1]; 0 for signals without a
    delay.
    """
    names = {
        (0, 1): "torques",
        (1, 0): "positions and velocities",
        (1, 1): "positions, velocities and torques",
    }
    return names[bool(delay[0].any()), bool(delay[1].any())]
