"""Kinds of faults of a log that settings can correct: the base class, and the settings that a hypothesis changes.

A subclass of `Fault` holds all that concerns a kind of fault: the hypotheses to test, the sentence about the fault, and
the settings that correct it. `kinds_of_faults` in `spelgen.identification.geometry_search` lists all kinds.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from spelgen.arm.arm import Chain
from spelgen.identification.hypotheses import Hypothesis, HypothesisFit
from spelgen.identification.log_geometry import GeometryProblem
from spelgen.identification.tuning import GEOMETRY
from spelgen.logs.joint_signals import joint_keys, settings_line
from spelgen.settings.log_mapping import LogMapping


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
        for k, name in enumerate(self.arm.joint_names):
            keys: dict[str, object] = {}
            for fault in self.hypothesis.faults:
                for key, value in fault.joint_keys(self, k).items():
                    previous = keys.get(key)
                    if isinstance(previous, dict) and isinstance(value, dict):
                        value = {**previous, **value}
                    keys[key] = value
            if keys:
                entries[name] = keys
        if entries:
            of_log = joint_keys(entries, self.arm.joint_names)
        for fault in self.hypothesis.faults:
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

    Methods with an argument `correction` return texts or settings for the hypothesis `correction.hypothesis`, which has
    a fault of this kind.
    """

    code: str
    description = ""
    rarity = 0
    needed = GEOMETRY.needed
    evidence = ""
    advice = ""

    @abstractmethod
    def fits(self, problem: GeometryProblem, base: HypothesisFit) -> Iterable[HypothesisFit]:
        """Return least-squares fits of hypotheses that correct one more fault of this kind in the log than `base`."""

    def thorough_fits(self, problem: GeometryProblem, unchanged: HypothesisFit) -> Iterable[HypothesisFit]:
        """Return least-squares fits of hypotheses that take seconds to find, such as permutations of all columns.

        `compare_hypotheses` calls this method only if none of the quick `fits` explains the torques, or if in the best
        one the delay of a signal drifts with time. unchanged: fit of the unchanged log.
        """
        return ()

    def text(self, correction: Correction) -> str:
        """Return a description of the fault of a log, for the error message."""
        return self.description

    def joints(self, correction: Correction) -> list[str]:
        """Return the names of the joints with the fault, for a message.

        These joints have settings that correct the fault; if no joint has, all joints are returned.
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
        """Return the code of a warning if `correction` is as small as errors of a URDF or mounting; "" for an error."""
        return ""
