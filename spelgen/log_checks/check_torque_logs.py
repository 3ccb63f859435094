"""Checks of logs of torques against the model of the arm: columns, torque limits and stops, couplings of motors."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from spelgen.arm.configured_arm import Arm
from spelgen.dynamics.regressor_dynamics import body_chain
from spelgen.errors import Diagnostic, LogError, shortened
from spelgen.identification.column_faults import UNITS, TorqueGain, TorqueSense
from spelgen.identification.drive_hints import Coupling, drive_problem
from spelgen.identification.geometry_search import compare_hypotheses, deviating_recordings, kinds_of_faults
from spelgen.identification.hypotheses import Correction, Fault, HypothesisFit
from spelgen.identification.least_squares import varying
from spelgen.identification.load_changes import LoadChange, load_changes, torque_change
from spelgen.identification.log_geometry import GeometryProblem
from spelgen.identification.motion_samples import DriveLog, MotionSamples, joined_samples
from spelgen.identification.reference_inertials import reference_inertials
from spelgen.identification.torque_delay import delay_of
from spelgen.identification.tuning import GEOMETRY, HINTS
from spelgen.identification.unit_faults import GIVE_GEAR, PositionUnit, TorqueUnit, position_factors
from spelgen.listing import Listing, number
from spelgen.log_checks.geometry_finding import (
    UNEXPLAINED,
    WARNINGS,
    find_unexplained,
    geometry_finding,
    stated_hypothesis,
)  # fmt: skip
from spelgen.log_checks.limits_in_logs import CLIPPED, UNSIGNED, FlatTops, find_limits, find_unsigned
from spelgen.log_checks.report import JointReport, percent, signal_tables
from spelgen.log_checks.robot_checks import (
    CHECKS,
    TUNING,
    JointEvidence,
    find_one_way,
    fit_gravity,
    move_in_phase,
    torque_factors,
)
from spelgen.logs.checks import OF_ONE, Check, Findings, run_checks
from spelgen.logs.dynamics_samples import NEEDED
from spelgen.logs.formats import BAG
from spelgen.logs.preprocessing import Preprocessing
from spelgen.logs.tables import UNIT_CODES
from spelgen.logs.trajectory import QUANTITIES, Trajectory, require_torques, split_at_gaps
from spelgen.settings.log_mapping import CURRENTS, LogMapping

COUPLED, WRONG_LINK = "coupled-motors", "urdf-inertials"
CURRENT, WITHOUT_GRAVITY = "current-without-gain", "torque-without-gravity"
SMALL_MOTION, LOADS, CHANGED = "small-motion", "different-loads", "torque-changed"
# Codes of warnings after which couplings of motors and delays of torques are not tested. SMALL_MOTION: the motion is
# too small. UNEXPLAINED: the logged columns may not be the torques of the joints. WARNINGS: the scale or the zeros of
# torques, or their gravity, probably differ from the URDF.
UNEXPLAINING = {SMALL_MOTION, UNEXPLAINED, *WARNINGS}


class TorqueLogs:
    """Checks of logs of torques against the model of the arm: `add` each trajectory, then `check`.

    A subset of the samples of all trajectories is used.
    """

    def __init__(self, arm: Arm, mapping: LogMapping) -> None:
        self._arm, self._mapping, self._drives = arm, mapping, arm.actuation.drives()
        self._reference = reference_inertials(arm.chain)
        self._samples: list[MotionSamples] = []
        self._moving = DriveLog(arm.chain.joint_types, self._drives, Preprocessing())
        self._flat: list[FlatTops] = []
        self._declared: list[set[str]] = []
        self._seconds, self._is_bag = 0.0, False
        self._guessed: set[str] = set()
        self._sources: list[tuple[str, Path | None]] = []

    def add(self, trajectory: Trajectory) -> None:
        """Add a trajectory to the logs that `check` tests. Raises LogError if it has no torques."""
        require_torques([trajectory])
        inputs = self._drives.inputs.T
        pieces = []
        for x in split_at_gaps(trajectory, shortest=3):
            qdd = np.gradient(x.qd, x.t, axis=0)
            pieces.append(MotionSamples.of(x.q, x.qd, qdd, x.tau @ inputs, len(self._sources)))
        if pieces:
            # at most 400 samples of a trajectory are kept, which suffice, since gravity and friction change slowly
            self._samples.append(joined_samples(pieces).thinned(400))
        self._sources.append((trajectory.name, trajectory.file))
        self._moving.add(trajectory)
        self._flat.append(FlatTops.of(trajectory.q, trajectory.tau @ inputs))
        self._declared.append(set(trajectory.accepted))
        self._seconds += trajectory.duration
        if trajectory.file is not None:
            self._is_bag |= trajectory.file.suffix in BAG.suffixes or (trajectory.file / BAG.marker).exists()

    def check(
        self, reports: Sequence[JointReport], summary: Findings
    ) -> tuple[list[JointReport], tuple[Listing, ...]]:
        """Return the joint reports with the fit of gravity added, and the tables of the report.

        The findings are added to `summary`. reports: statistics of each joint.
        """
        # a check is omitted if `self._mapping`, or the mapping of every trajectory, accepts its findings
        accepted = set(self._mapping.accept) | set.intersection(*self._declared)
        empty = MotionSamples.of(*np.zeros((4, 0, len(reports))))
        motion = joined_samples([empty, *self._samples]).thinned(6000)
        evidence = self._evidence(reports, motion)
        completed = [joint.report for joint in evidence]
        moving = self._moving.samples()
        # The model is fitted only if earlier checks found no errors: an error, such as jumps, may make a wrong
        # correction of the log fit best. Errors about the unit of positions, which is only guessed from their range,
        # are no obstacle: if the fit to the torques determines the unit, an error with this unit replaces the guess.
        self._guessed = summary.guessed
        guesses = [x for x in summary.errors if self._guessed and "degrees" in x.codes]
        is_sound = bool(guesses) or not summary.errors
        unscaled = self._unscaled_currents()
        summary.notes.extend(unscaled)
        if moving is None:
            message = f"no samples for identify and for fits of torques: they need {NEEDED}"
            summary.notes.append(Diagnostic("warning", "no-accelerations", "logs", None, message))
        if is_sound:
            # Geometry is not tested if motor gains are unknown, since a wrong hypothesis about the log may then have
            # the lowest cost. Logs whose sample rate is too low for filtered accelerations are tested with unfiltered
            # samples.
            samples = [motion, motion if moving is None else moving]
            loads = [] if unscaled or self._guessed else self._load_changes(motion, moving)
            geometry = Findings()
            if not unscaled:
                geometry = self._geometry_findings(samples, evidence, accepted, loads)
            if guesses:
                # The error about the unit is the first, since the wrong unit may cause others, such as jumps.
                remaining = [x for x in summary.errors if x not in guesses]
                summary.errors[:] = [*(geometry.errors or guesses), *remaining]
            else:
                summary.notes += geometry.notes
                summary.errors += geometry.errors
            if not summary.errors and UNEXPLAINING.isdisjoint(x.code for x in geometry.notes):
                if moving is not None:
                    self._check_drives(moving, summary)
                summary.notes.extend(self._load_notes(loads))
        # Torques beyond the limits of the drives are not reported in two cases. If the log has another error, this
        # error is the reason. If the torques agree with the gravity of the URDF, the limits are only placeholders.
        faults = dict[Check[JointEvidence], dict[str, str]]()
        if summary.errors or any(joint.shows_unit(self._reference) for joint in evidence):
            accepted.add("torque-beyond-drive")
        for joint in evidence:
            # the units of a joint are not tested if the mapping states the unit of its torque
            is_stated = self._mapping.unit("tau", joint.coordinate.name) is not None
            passed = accepted.union(UNIT_CODES) if is_stated else accepted
            for check, found in run_checks(CHECKS, joint, passed):
                if check.severity == "error":
                    faults.setdefault(check, {})[joint.coordinate.name] = found.message
                else:
                    summary.add(check, found.message, f"joint {joint.coordinate.name!r}")
        for check, joints in faults.items():
            where = f"joint {', '.join(map(repr, joints))}, tau"
            summary.add(check, next(iter(joints.values())), where)
        physics = _physics_table(completed, self._reference.source)
        return completed, (*signal_tables(completed, QUANTITIES), physics)

    def _evidence(self, reports: Sequence[JointReport], motion: MotionSamples) -> list[JointEvidence]:
        """Return the joints of the URDF with their statistics `reports` and fits of gravity to the samples `motion`."""
        evidence, coordinates = [], self._arm.chain.coordinates
        fits = fit_gravity(self._arm.chain, motion, self._reference.parameters)
        for coordinate, report, gravity in zip(coordinates, reports, fits, strict=True):
            offset = self._mapping.offset("q", coordinate.name)
            evidence.append(JointEvidence(coordinate, replace(report, gravity=gravity), offset))
        return evidence

    def _geometry_findings(
        self,
        samples: Sequence[MotionSamples],
        evidence: Sequence[JointEvidence],
        accepted: set[str],
        loads: Sequence[LoadChange],
    ) -> Findings:
        """Return the findings about the geometry of the logs: senses, order, zeros and units of joints, and gravity.

        Recordings whose torques agree are tested together. If they have no errors, every other recording, which
        contradicts them or has another load, is tested by itself. Only its errors are returned; they name the
        recording. If the agreeing recordings are at most half of all, errors that only they have name them, too.

        Args:
            samples: two sets of samples, first unfiltered, then low-pass filtered. The filtered samples are used; if
                there are too few of them, for example at low sample rates, the unfiltered samples are used.
            evidence: each joint of the URDF with its statistics.
            accepted: codes of the checks that the mapping accepts.
            loads: changes of the load between recordings.
        """
        deviating = [change.recording for change in loads]
        unfiltered = self._problem(samples[0]) if len(self._sources) > 1 and not self._guessed else None
        if unfiltered is not None and not loads:
            deviating = deviating_recordings(unfiltered)
        agreeing = [k for k in range(len(self._sources)) if k not in deviating]
        findings = self._tested(agreeing, samples, evidence, accepted)
        if findings.errors and 2 * len(agreeing) > len(self._sources):
            return findings
        of_deviating = [self._tested([k], samples, evidence, accepted) for k in deviating]
        # If all recordings have errors, they may have the same fault, which is clearest in all recordings together.
        if findings.errors and all(x.errors for x in of_deviating):
            together = self._tested(range(len(self._sources)), samples, evidence, accepted)
            if together.errors:
                return together
        errors = [self._of_recordings(error, agreeing) for error in findings.errors]
        for k, tested in zip(deviating, of_deviating, strict=True):
            errors += [self._of_recordings(error, [k]) for error in tested.errors]
        if unfiltered and deviating and not (errors or loads):
            errors = self._torque_changes(unfiltered)
        return replace(findings, errors=errors)

    def _tested(
        self,
        numbers: Sequence[int],
        samples: Sequence[MotionSamples],
        evidence: Sequence[JointEvidence],
        accepted: set[str],
    ) -> Findings:
        """Return the findings about some of the recordings; none for too few samples.

        numbers: indices of these recordings. samples, evidence, accepted: see `_geometry_findings`.
        """
        is_part = len(numbers) < len(self._sources)
        chosen = [x.part(np.isin(x.recording, numbers)) if is_part else x for x in samples]
        problems = (self._problem(x, len(numbers) / len(self._sources)) for x in reversed(chosen))
        problem = next((x for x in problems if x is not None), None)
        if problem is None:
            return Findings()
        joints = self._evidence([x.report for x in evidence], chosen[0]) if is_part else evidence
        flat = FlatTops.joined([self._flat[k] for k in numbers])
        return self._findings(problem, flat, joints, accepted)

    def _of_recordings(self, error: LogError, numbers: Sequence[int]) -> LogError:
        """Return an error about some of the recordings, with their names. numbers: indices of these recordings."""
        if len(numbers) == len(self._sources) or str(error.element).startswith("trajectory"):
            return error
        names = shortened([self._sources[k][0] for k in numbers], 5)
        where = f"trajectory {names}, {error.element}"
        return replace(error, file=self._sources[numbers[0]][1], element=where, do=OF_ONE, codes=())

    def _load_changes(self, motion: MotionSamples, moving: MotionSamples | None) -> list[LoadChange]:
        """Return the changes of the load (the arm's payload) between recordings; [] for a single recording.

        motion: unfiltered samples of all recordings. moving: low-pass filtered samples; None if there are none. The
        filtered samples are used if they are from all recordings, since smaller changes are detectable in them.
        """
        problem = self._problem(motion)
        if problem is None or len(self._sources) == 1:
            return []
        if moving is not None and len(np.unique(moving.recording)) == len(self._sources):
            filtered = self._problem(moving)
            problem = problem if filtered is None else filtered.with_hysteresis()
        return load_changes(problem)

    def _load_notes(self, loads: Sequence[LoadChange]) -> Iterator[Diagnostic]:
        """Yield a warning that names the recordings with another load, with its mass; none if `loads` is empty."""
        masses = []
        for change in loads:
            width = 2 * change.deviation
            mass = f"{change.mass:+.2g} +- {width:.1g} kg"
            text = mass if abs(change.mass) > width else "mass undetermined"
            masses.append(f"{self._sources[change.recording][0]} ({text})")
        if masses:
            message = (
                f"recordings with another load than {self._sources[loads[0].reference][0]}: {shortened(masses, 5)}; a "
                "model that is fitted to all of them is wrong for each: train on the recordings of one load, and adapt "
                "the model to another load by 'train --from RUN'"
            )
            yield Diagnostic("warning", LOADS, "logs", None, message)

    def _unscaled_currents(self) -> list[Diagnostic]:
        """Return a warning about logged motor currents whose gain is still 1, as in the draft of a mapping.

        [] is returned if there are none. A gain that a fit estimates ('gain: trained') needs no warning.
        """
        names = []
        for name in self._arm.chain.joint_names:
            is_draft = self._mapping.unit("tau", name) in CURRENTS and self._mapping.joint(name).gain == 1.0
            if is_draft and self._arm.settings.joint(name).gain != "trained":
                names.append(name)
        if not names:
            return []
        message = (
            "currents or parts of a torque with a gain of 1: write 'gain', Nm per unit at the joint, the gear "
            "included, under 'logs' in the robot's YAML, or, if it is unknown, 'torque: motor' and for each joint "
            "'gain: trained' under 'joints'; until then, senses, order and zeros of the joints are not tested"
        )
        return [Diagnostic("warning", CURRENT, f"joint {', '.join(map(repr, names))}", None, message)]

    def _problem(self, samples: MotionSamples, share: float = 1.0) -> GeometryProblem | None:
        """Return the least-squares problem of the samples, for the comparison of hypotheses about the log.

        None is returned for too few samples, or if all torques are constant. share: number of recordings that the
        samples belong to, divided by the number of all recordings.
        """
        if len(samples.values) < HINTS.fewest_samples / 4 or not varying(samples.tau).any():
            return None
        joints, inputs = self._arm.chain.joint_names, self._drives.inputs
        # If each motor drives one joint, the factor from logged torques to joint torques includes the gear ratio.
        gears = np.diag(inputs) if np.count_nonzero(inputs) == len(joints) else np.ones(len(joints))
        stated = stated_hypothesis(self._arm.chain, self._mapping, np.where(gears, gears, 1.0))
        return GeometryProblem(self._arm.chain, samples, self._drives.speeds, share * self._seconds, stated)

    def _findings(
        self, problem: GeometryProblem, flat: FlatTops, evidence: Sequence[JointEvidence], accepted: set[str]
    ) -> Findings:
        """Return the findings about the geometry of recordings.

        Tested are the range of the motion, lost signs of torques, clipped torques, torques that change, and hypotheses
        (see `_compared`). The first error, or a warning about too little motion, ends the tests.

        Args:
            problem: least-squares problem of the samples.
            flat: extreme values at which positions and torques are constant.
            evidence: each joint of the URDF with its statistics.
            accepted: codes of the checks that the mapping accepts.
        """
        findings, motion = Findings(), problem.unchanged.signals(problem.samples).motion[0]
        is_stated = any(self._mapping.unit("q", name) for name in self._arm.chain.joint_names)
        # A motion may only seem small because the mapping states a wrong unit of positions. Logs with a stated unit are
        # therefore tested even if their motion is small.
        small = ""
        if not is_stated and np.ptp(motion, axis=0).max() < TUNING.smallest_motion:
            small = f"all joints stay within {TUNING.smallest_motion:g} rad or m"
        # Dry friction of a joint that moves one way is a constant torque, which wrong hypotheses explain as well.
        elif sum(find_one_way(joint) is not None for joint in evidence) > len(evidence) / 2:
            small = "most joints move one way only"
        # If all positions are functions of one variable, signals of other joints explain the torques as well.
        elif move_in_phase(motion):
            small = "all joints move in phase"
        if small:
            message = f"{small}: too little motion to test senses, order, zeros, units and gravity"
            findings.notes.append(Diagnostic("warning", SMALL_MOTION, "logs", None, message))
            return findings
        # If the unit of positions is unknown, signs and limits of torques are not tested: positions in a wrong unit
        # contradict all torques.
        if not self._guessed and UNSIGNED not in accepted:
            findings.errors += find_unsigned(problem)
        if not findings.errors and not self._guessed:
            limits = find_limits(problem, flat)
            findings.notes += limits.notes
            if CLIPPED not in accepted:
                findings.errors += limits.errors
        if not findings.errors and CHANGED not in accepted:
            findings.errors += self._torque_changes(problem)
        if not findings.errors:
            findings.extend(self._compared(problem, evidence, accepted))
        return findings

    def _compared(
        self, problem: GeometryProblem, evidence: Sequence[JointEvidence], accepted: set[str]
    ) -> Iterator[LogError | Diagnostic]:
        """Yield the findings of a comparison of hypotheses about senses, order, zeros, units and gravity.

        If the torques agree with the mapping, they are about the inertials of the URDF. The first finding that explains
        the torques, or states that nothing explains them, is the last. problem, evidence, accepted: see `_findings`.
        """
        unchanged, *better = compare_hypotheses(problem, self._faults(evidence, problem))
        # Factors of single torques are tested by themselves: combined with other faults, they could explain any log.
        is_open = np.array([self._mapping.unit("tau", name) is None for name in self._arm.chain.joint_names])
        if is_open.any() and not self._guessed:
            base, *scaled = compare_hypotheses(problem, [TorqueGain(is_open)])
            limit = min([base.cost - TorqueGain.needed, *(x.cost - GEOMETRY.ambiguous for x in better)])
            if scaled and scaled[0].cost < limit:
                unchanged, better = base, scaled
        unexplained = find_unexplained(problem, unchanged, better[0] if better else None)
        if isinstance(unexplained, LogError) and UNEXPLAINED in accepted:
            return
        if isinstance(unexplained, LogError) and self._guessed:
            do = f"positions beyond two turns have an unknown unit: {GIVE_GEAR}; {unexplained.do}"
            unexplained = replace(unexplained, do=do)
        if unexplained is not None:
            yield unexplained
            return
        faults = better[0].hypothesis.faults if better else ()
        # The torques do not show the unit of positions if no hypothesis about it lowers the torque error.
        if self._guessed and better:
            is_lower = better[0].errors.mean() < GEOMETRY.lower * unchanged.errors.mean()
            if not is_lower or not any(isinstance(fault, PositionUnit) for fault in faults):
                return
        if not better or {fault.code for fault in faults} <= accepted:
            yield from () if better else _link_notes(problem, self._mapping, unchanged)
            if WITHOUT_GRAVITY not in accepted:
                yield from _without_gravity(problem, [joint.report for joint in evidence])
            return
        # If the best hypothesis changes the unit of only one joint's torque, its evidence is that the gravity in this
        # torque is much larger or smaller than the URDF's. A wrong mass of a link in the URDF is another explanation of
        # this difference, so warnings about links are added.
        changed = better[0].hypothesis.scale != problem.unchanged.scale
        if changed.sum() == 1 and not any(fault.needed for fault in faults):
            yield from _link_notes(problem, self._mapping, unchanged)
        yield geometry_finding(problem, self._mapping, unchanged, better, by_name=self._is_bag)

    def _torque_changes(self, problem: GeometryProblem) -> list[LogError]:
        """Return an error if the scale or zero of torques changes within a recording, else []."""
        change = None if self._guessed else torque_change(problem)
        if change is None:
            return []
        name, file = self._sources[change.recording]
        joints = (
            ", all joints" if change.joint is None else f", joint {problem.arm.joint_names[change.joint]!r}"
        )
        since, reference = f", from about {change.time:.2g} s after the start on,", "those before it"
        do = "use the part before or after it"
        if not change.time:
            since, reference, do = "", "those of the other recordings", "omit or correct the wrong recordings"
        torque = f"{round(change.factor, 2) + 0.0:g} times {reference}"
        if change.offset:
            torque = f"another zero than before it, by {change.offset:.2g}"
        got, where = f"torques that are{since} {torque}", f"trajectory {name}{joints}, tau"
        expected, codes = "one scale and zero of the torques", (CHANGED,)
        return [LogError(got, file=file, element=where, expected=expected, do=do, codes=codes)]

    def _faults(self, evidence: Sequence[JointEvidence], problem: GeometryProblem) -> tuple[Fault, ...]:
        """Return the kinds of faults to test (see `kinds_of_faults`), with candidates for factors that correct units.

        Candidates for the unit of torques are derived from the ratio of gravity in the logged torques to the URDF's. A
        unit in the mapping is assumed to be right, except mNm: numbers declared as mNm may be in Nm. evidence: joints
        with their fits of gravity. problem: least-squares problem of the logs, from which ranges of positions and
        gravity torques are computed.
        """
        names = self._arm.chain.joint_names
        units = [self._mapping.unit("tau", name) for name in names]
        is_milli = np.array([unit == "mNm" for unit in units])
        is_open = is_milli | np.array([unit is None for unit in units])
        coarse = problem.thinned(GEOMETRY.coarse_samples)
        _, of_urdf = coarse.gravity_torques(coarse.fit(coarse.unchanged))
        loads = of_urdf.std(axis=0)
        loaded = loads > TUNING.loaded * loads.max()
        factors = torque_factors(evidence, is_open.tolist(), loaded, coarse.reference)
        # Units of positions are tested only if velocities have the same unit per second, so that one factor changes
        # both.
        motion = {(self._mapping.unit("q", name), self._mapping.unit("qd", name)) for name in names}
        stated = {(unit, f"{unit}/s") for unit in (*UNITS["revolute"], *UNITS["prismatic"])}
        torque_unit = TorqueUnit(factors, is_open, is_milli, coarse.reference)
        if not motion <= {(None, None), *stated}:
            return kinds_of_faults(problem.arm, [torque_unit])
        # The unit of a single joint's positions is tested if they range over more than its limits, or over more than
        # two turns. If this is true of most joints, they may all be logged at their motors.
        limits = np.diff([x.limits() for x in evidence], axis=1)[:, 0]
        width = np.where(limits > 0, np.minimum(limits, 4 * np.pi), np.inf)
        is_wide = np.ptp(problem.unchanged.signals(problem.samples).motion[0], axis=0) > width
        wide = [[k] for k, name in enumerate(names) if is_wide[k] or name in self._guessed]
        turning = [k for k, x in enumerate(problem.arm.joint_types) if x == "revolute"]
        if 2 * len(self._guessed) > len(turning):
            wide = [turning]
        candidates = position_factors(problem.arm, problem.unchanged.scale[0])
        return kinds_of_faults(problem.arm, [PositionUnit(candidates, wide, PositionUnit([])), torque_unit])

    def _check_drives(self, moving: MotionSamples, summary: Findings) -> None:
        """Add a warning to `summary` if the torques show a coupling of two motors; otherwise notes on delayed torques.

        moving: samples of joints in motion. If a coupling is found, no delay is reported.
        """
        late = delay_of(drive_problem(body_chain(self._arm.chain), self._drives, moving))
        if late.coupling is not None:
            summary.notes.append(_coupling_hint(self._arm, *late.coupling))
        else:
            summary.notes.extend(late.notes)


def _without_gravity(problem: GeometryProblem, joints: Sequence[JointReport]) -> Iterator[Diagnostic]:
    """Yield a warning for each joint whose torque contains no gravity, although gravity of the URDF loads the joint.

    Its torque is uncorrelated with the gravity torque of the URDF. Since wrong masses also lower this correlation, the
    torque must in addition fit better without gravity than with gravity and masses near the URDF's.
    """
    suspicious = []
    for k, joint in enumerate(joints):
        deviation, correlation = joint.gravity.relative_deviation or 0.0, joint.gravity.correlation
        if correlation is not None and deviation >= TUNING.visible and abs(correlation) <= 1 - TUNING.seen:
            suspicious.append((k, joint.name, deviation, correlation))
    if not suspicious:
        return
    problem = problem.thinned(GEOMETRY.confirming_samples)
    problems = [(x, x.fit(x.unchanged)) for x in (problem, problem.with_hysteresis())]
    for k, name, deviation, correlation in suspicious:
        # The torque of a joint is reported to have no gravity if the cost without gravity at this joint is lower. It
        # must be lower by more than `rarity`, the penalty of a rare fault, if the model with gravity fits the torque
        # (residual of at most 10 % of its variance): a wrong centre of mass of the last link also lowers the gravity
        # torque. In a free swing the inertial torque balances gravity, so that the torque does not vary with gravity.
        # Friction with hysteresis resembles gravity in small motions, so both must hold with it, too.
        gains = [fit.cost - x.without_gravity(k).fit(x.unchanged).cost for x, fit in problems]
        needed = 0.0 if problems[0][1].errors[k] > 0.1 else TorqueUnit.rarity
        if min(gains) > needed:
            message = (
                f"tau does not move with gravity: their correlation is {correlation:.2g}, while the URDF's gravity "
                f"torque varies {deviation:.2g} times as much as tau"
            )
            yield Diagnostic("warning", WITHOUT_GRAVITY, f"joint {name!r}", None, message)


def _link_notes(problem: GeometryProblem, mapping: LogMapping, fit: HypothesisFit) -> Iterator[Diagnostic]:
    """Yield a warning for each link whose fitted mass or first moment is outside 0.4 to 2.5 times the URDF's.

    The first moment is the mass times the centre of mass. The ratio is the least-squares ratio of the torque due to the
    fitted value to the torque due to the URDF's value. The difference of both torques must also be significant at a
    joint (more than half the standard deviation of its torque), and the ratio must differ from 1 by four of its
    standard deviations. The model has friction with hysteresis, which resembles gravity in small motions.
    """
    stateful = problem.thinned(GEOMETRY.confirming_samples).with_hysteresis()
    fit = stateful.fit(fit.hypothesis)
    rows, _ = stateful.equations(fit.hypothesis)
    torque = problem.unchanged.signals(problem.samples).tau.std(axis=0)
    for k, body in enumerate(problem.arm.bodies):
        quantities = {
            "first moment (mass times centre of mass)": slice(10 * k + 1, 10 * k + 4),
            "mass": slice(10 * k, 10 * k + 1),
        }
        for name, block in quantities.items():
            stated, found = problem.prior_mean[block], fit.parameters[block]
            columns = rows[..., block]
            of_urdf = columns @ stated
            size = float(np.square(of_urdf).sum())
            effect = (columns @ (found - stated)).std(axis=0)
            if not size or not (effect > 0.5 * torque).any():
                continue
            # `ratio`: torque due to the fitted value, divided by the torque due to the URDF's value. Torques are
            # compared because components of the value that have no effect on torques are undetermined.
            axis = np.tensordot(of_urdf, columns, 2) / size
            ratio = float(axis @ found)
            deviation = float(np.sqrt(axis @ fit.covariance[block, block] @ axis))
            # A body is reported if `ratio` is above 2.5 or below 1/2.5, since masses of CAD models are wrong by less.
            # The ratio must also differ from 1 by more than four standard deviations of the fit: among many bodies, a
            # difference of two standard deviations may occur by chance.
            if 1 / 2.5 < ratio < 2.5 or abs(ratio - 1) <= 4.0 * deviation:
                continue
            # A reversed torque reverses the fitted value, whose magnitude is then as plausible as above.
            is_reversed = 1 / 2.5 < -ratio < 2.5 and ratio < -4.0 * deviation
            other = _reversed_torque(problem, mapping) if is_reversed else ""
            message = (
                f"its {name} is {ratio:.2f} +- {deviation:.2f} times the URDF's by least squares: {other}check its "
                "mass and centre of mass in the URDF"
            )
            if all(x.parent != k for x in problem.arm.bodies):
                message += ", or add the tool or load that it carries"
            yield Diagnostic("warning", WRONG_LINK, f"link {body.link!r}", None, message)
            break


def _reversed_torque(problem: GeometryProblem, mapping: LogMapping) -> str:
    """Return the advice to correct a torque of the opposite sense, if this fits the log better; otherwise "".

    The reversed torque of a joint and a reversed first moment of its link explain gravity equally well. Only friction
    that drives the motion, or a negative rotor inertia, then shows the reversed torque. They are no certain evidence,
    since a drive may compensate friction.
    """
    coarse = problem.thinned(GEOMETRY.coarse_samples)
    unchanged, sense = coarse.fit(problem.unchanged), TorqueSense(len(problem.arm.joint_names))
    best = min(sense.fits(coarse, unchanged), key=lambda fit: fit.cost)
    stateful = coarse.with_hysteresis()
    decreases = (x.fit(problem.unchanged).cost - x.fit(best.hypothesis).cost for x in (coarse, stateful))
    if min(decreases) < GEOMETRY.ambiguous:
        return ""
    correction = Correction(problem.arm, mapping, False, problem.unchanged, best.hypothesis)
    joints = ", ".join(map(repr, sense.joints(correction)))
    return f"{sense.text(correction)} at joint {joints} would explain it: write {correction.lines()}, or "


def _coupling_hint(arm: Arm, coupling: Coupling, remaining: float) -> Diagnostic:
    """Return the warning about a coupling of motors, with the settings that declare it.

    remaining: squared torque residual of both joints with the coupling, divided by the residual without the coupling.
    """
    names = arm.chain.joint_names
    pair = [coupling.moved_by, coupling.joint]
    matrix = np.array([[1.0, coupling.ratio], [0.0, 1.0]]) * np.diag(arm.actuation.matrix())[pair]
    joints = json.dumps([names[k] for k in pair])
    setting = f"couplings: [{{joints: {joints}, matrix: {matrix.round(6).tolist()}}}]"
    if coupling.logged_at == "motors" and arm.settings.torque == "joint":
        uncoupled = [name for k, name in enumerate(names) if k not in pair]
        gears = ", ".join(f"{json.dumps(name)}: {{gear: 1}}" for name in uncoupled)
        setting += f", 'torque: motor' and joints: {{{gears}}}"
    message = (
        f"its motor turns with {names[coupling.moved_by]!r} too, {coupling.ratio:g} times as fast, and the logged "
        f"torques are those of the {coupling.logged_at}: least squares then misses {remaining:.0%} of what it missed "
        f"of both torques (mean square); say {setting} in the robot's YAML"
    )
    return Diagnostic("warning", COUPLED, f"joint {names[coupling.joint]!r}", None, message)


def _physics_table(joints: Sequence[JointReport], source: str) -> Listing:
    """Return the table of velocities and gravity; `source` of the gravity torque: "URDF" or "guess"."""
    head = ("joint", "dq/dt : qd", "agree", "gravity in tau", f"x {source}")
    torque = "the URDF's gravity torque" if source == "URDF" else "the gravity torque of guessed masses"
    rows = []
    for joint in joints:
        fit = joint.gravity
        # the ratio of the torque to the URDF's gravity is undetermined if their correlation is low
        is_seen = abs(fit.correlation or 0) > TUNING.seen
        velocity = number(joint.velocity_factor), number(joint.velocity_correlation)
        rows.append((joint.name, *velocity, percent(fit.explained), number(fit.factor if is_seen else None)))
    note = (
        "dq/dt : qd and its correlation are 1 where qd is the derivative of q; gravity in tau: part of tau's "
        f"variance that gravity explains, in addition to friction and acceleration; x {source}: ratio to {torque}."
    )
    return Listing("Physics", head, rows, note)
