"""Hypotheses about a log: joint, scale, zero and delay of its columns, the direction of gravity, and kinds of faults.

A subclass of `Fault` defines a kind of fault: the hypotheses to test, the sentence about the fault, and the settings
that correct it. `kinds_of_faults` in `spelgen.identification.geometry_search` lists all kinds.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from spelgen.arm.arm import Chain
from spelgen.identification.motion_samples import MotionSamples
from spelgen.identification.tuning import GEOMETRY
from spelgen.logs.joint_signals import joint_keys, settings_line
from spelgen.settings.log_mapping import LogMapping

if TYPE_CHECKING:
    from spelgen.identification.log_geometry import GeometryProblem

Vector3 = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """Hypothesis about a log: columns, scales, offsets and delays of n joints, and gravity.

    Arrays of shape (2, n) have a row for the motion (position and velocity) and a row for the torque of each joint. The
    position of joint k is scale[0, k] times the logged position of joint source[0, k], plus offset[k]. The torque of
    joint k is scale[1, k] times the logged torque of joint source[1, k].

    Attributes:
        faults: kinds of faults that the hypothesis assumes; empty for the unchanged log.
        source: (2, n) indices of the joints under which the signals are logged.
        scale: (2, n) factors from logged signals to SI units.
        offset: (n,) zero offsets of the positions [rad, m].
        delay: (2, n) delays of the logged signals [s], at the start of a recording if they drift.
        drift: (2, n) derivatives of the delays with respect to time [1].
        gravity: vector of gravity in the frame of the root link [m/s^2].
    """

    faults: tuple[Fault, ...]
    source: np.ndarray
    scale: np.ndarray
    offset: np.ndarray
    delay: np.ndarray
    drift: np.ndarray
    gravity: Vector3

    @classmethod
    def unchanged(cls, arm: Chain) -> Hypothesis:
        """Return the hypothesis that a log in SI units has no faults: no exchanged columns, offsets or delays."""
        n = len(arm.coordinates)
        x, y, z = map(float, arm.gravity)
        order, zeros = np.tile(np.arange(n), (2, 1)), np.zeros((2, n))
        return cls((), order, np.ones((2, n)), np.zeros(n), zeros, zeros, (x, y, z))

    @property
    def motion_key(self) -> tuple[bytes, Vector3]:
        """Key of the cached regressor of the hypothesis, which depends only on the corrected motion and on gravity."""
        arrays = (self.source[0], self.scale[0], self.offset, self.delay[0], self.drift[0])
        return b"".join(x.tobytes() for x in arrays), self.gravity

    def changed(self, fault: Fault, **changes: object) -> Hypothesis:
        """Return the hypothesis with changed fields that correct one more kind of fault, `fault`."""
        faults = self.faults if fault in self.faults else (*self.faults, fault)
        return replace(self, faults=faults, **changes)  # type: ignore[arg-type]

    def signals(self, samples: MotionSamples) -> MotionSamples:
        """Return the samples corrected by this hypothesis: true signals of the joints, in SI units.

        samples: logged samples, with signals at E times around each sample if delays are tested. Delayed signals are
        interpolated between these times. The result has signals only at the time of each sample: its `values` are (S,
        n, 4, 1).
        """
        delays = _per_signal(self.delay)
        if self.drift.any():
            delays = delays + samples.times[:, None, None] * _per_signal(self.drift)
        values = samples.values if delays.any() else samples.central[..., None]
        signals = samples._replace(values=_permuted(values, self.source)).at(delays) * _per_signal(self.scale)
        signals[..., 0] += self.offset
        return samples._replace(values=signals[..., None])

    def logged(self, samples: MotionSamples) -> MotionSamples:
        """Return the samples that a log with these faults has for the true signals `samples` (inverse of `signals`).

        The hypothesis must have no delays, and no exchanged columns.
        """
        signals = samples.values.copy()
        signals[:, :, 0] -= self.offset[:, None]
        return samples._replace(values=signals / _per_signal(self.scale)[..., None])


def _per_signal(values: np.ndarray) -> np.ndarray:
    """Return values for the signals q, qd, qdd and tau, (n, 4), from values for motion and torque, (2, n)."""
    return values[[0, 0, 0, 1]].T


def _permuted(values: np.ndarray, source: np.ndarray) -> np.ndarray:
    """Return signals in which joint k has the motion of joint source[0, k] and the torque of joint source[1, k].

    values: signals (S, n, 4, E), see `MotionSamples`; the result has the same shape. Without a permutation, the result
    is `values` itself: a copy would take a twentieth of the time of a search.
    """
    if (source == np.arange(source.shape[1])).all():
        return values
    return np.concatenate([values[:, source[0], :3], values[:, source[1], 3:]], axis=2)


@dataclass(frozen=True, eq=False)
class HypothesisFit:
    """MAP estimate of the K parameters of an arm with n joints under a hypothesis about the log.

    Attributes:
        hypothesis: the hypothesis.
        cost: negative log posterior up to a constant.
        misfit: contribution of the torque residual to the cost.
        parameters: (K,) inertial parameters, then friction and rotor inertias.
        covariance: (K, K) posterior covariance of the parameters.
        errors: (n,) mean squared residual of each joint's torque, divided by the variance of the torque.
    """

    hypothesis: Hypothesis
    cost: float
    misfit: float
    parameters: np.ndarray
    covariance: np.ndarray
    errors: np.ndarray

    @property
    def penalties(self) -> float:
        """Contribution of implausible parameters to the cost, for example of negative rotor inertias."""
        return self.cost - self.misfit

    @property
    def rank(self) -> float:
        """Cost plus penalties for rare faults; the hypothesis of lowest rank is preferred."""
        return self.cost + sum(fault.rarity for fault in self.hypothesis.faults)


@dataclass(frozen=True, eq=False)
class Correction:
    """Correction of the settings of a log of n joints: the difference between a hypothesis and the unchanged log.

    Attributes:
        arm: arm of the log.
        mapping: current mapping of the log.
        by_name: True if the log consists of messages that contain joint names, as in ROS bags, and not of columns.
        unchanged: hypothesis without faults, with the signs, scales and offsets of the current mapping.
        hypothesis: hypothesis that explains the log better.
    """

    arm: Chain
    mapping: LogMapping
    by_name: bool
    unchanged: Hypothesis
    hypothesis: Hypothesis

    @property
    def factors(self) -> np.ndarray:
        """Scales in `hypothesis` divided by the scales in the current mapping, (2, n): motion, then torque."""
        return np.asarray(self.hypothesis.scale / self.unchanged.scale)

    def lines(self) -> str:
        """Return a text with the settings that correct the log, and where to write them; "" if there are none."""
        entries: dict[str, dict[str, object]] = {}
        of_log: dict[str, object] = {}
        of_robot: dict[str, object] = {}
        # The order in which faults were found must not distinguish equal settings.
        faults = sorted(self.hypothesis.faults, key=lambda fault: fault.code)
        for k, name in enumerate(self.arm.joint_names):
            keys: dict[str, object] = {}
            for fault in faults:
                for key, value in fault.joint_keys(self, k).items():
                    previous = keys.get(key)
                    if isinstance(previous, dict) and isinstance(value, dict):
                        value = {**previous, **value}
                    keys[key] = value
            if keys:
                entries[name] = keys
        if entries:
            of_log = joint_keys(entries, self.arm.joint_names)
        for fault in faults:
            of_log |= fault.log_keys(self)
            of_robot |= fault.robot_keys(self)
        texts = []
        if of_log:
            texts.append(f"'{settings_line(of_log)}' under 'logs' in the robot's YAML")
        if of_robot:
            texts.append(f"'{settings_line(of_robot)}' in the robot's YAML (then build the model again)")
        return " and ".join(texts)


class Fault(ABC):
    """Kind of fault of a log.

    Attributes:
        code: code of the finding.
        description: text about the fault, for faults with a constant text.
        rarity: penalty on the cost (negative log posterior) of hypotheses with this fault, 0 for the most frequent
            faults. The penalty decides between hypotheses that explain the torques equally well.
        needed: smallest decrease of the cost with which a hypothesis is accepted.
        evidence: sentence with the evidence for the fault; "" if the evidence is the torque residual.
        advice: remedy of a fault that no setting corrects.
        is_optimised: True for faults with a continuous quantity, such as a zero offset. The quantity is optimised with
            a friction model that has hysteresis.

    The argument `correction` of a method contains a hypothesis with a fault of this kind (`correction.hypothesis`). The
    method returns the text or the settings for this hypothesis.
    """

    code: str
    description = ""
    rarity = 0
    needed = GEOMETRY.needed
    evidence = ""
    advice = ""
    is_optimised = False

    @abstractmethod
    def fits(self, problem: GeometryProblem, base: HypothesisFit) -> Iterable[HypothesisFit]:
        """Return least-squares fits of hypotheses that correct one more fault of this kind in the log than `base`."""

    def thorough_fits(self, problem: GeometryProblem, unchanged: HypothesisFit) -> Iterable[HypothesisFit]:
        """Return least-squares fits of hypotheses that take seconds to find, such as permutations of all columns.

        `compare_hypotheses` calls this method in two cases: no quick fit (from `fits`) explains the torques, or the
        best quick fit has a delay that drifts with time. unchanged: fit of the unchanged log.
        """
        return ()

    def text(self, correction: Correction) -> str:
        """Return a description of the fault of a log, for the error message."""
        return self.description

    def joints(self, correction: Correction) -> list[str]:
        """Return the names of the joints with the fault, for a message.

        A joint has the fault if `joint_keys` returns settings that correct it. If no joint has such settings, the names
        of all joints are returned. correction: hypothesis with this fault.
        """
        names = correction.arm.joint_names
        return [x for k, x in enumerate(names) if self.joint_keys(correction, k)] or list(names)

    def joint_keys(self, correction: Correction, joint: int) -> dict[str, object]:
        """Return the settings of a joint, in the group `logs`, that correct a fault of the log; {} without a fault."""
        return {}

    def log_keys(self, correction: Correction) -> dict[str, object]:
        """Return the settings in the group `logs`, such as `torque_delay`, that correct a fault of all joints."""
        return {}

    def robot_keys(self, correction: Correction) -> dict[str, object]:
        """Return the settings of the robot, such as `gravity`, that correct a fault of the log."""
        return {}

    def minor_code(self, correction: Correction) -> str:
        """Return the code of a warning; "" if the fault is an error.

        A fault is only a warning if `correction` is as small as errors of a URDF or of the mounting.
        """
        return ""
