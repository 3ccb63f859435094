"""Derive an arm's structure: which entries of M, V and G are zero, constant or vary, and with which joints.

It includes the smallest exact form of M.

M(q) = sum_k c_k A_k + sum_j f_j(q) B_j. Let T_k be the span of the changes M(q) - M(q') when joint k alone
moves, U the sum of all T_k and W the span of M itself. Then dim U networks outputs f_j are needed, and dim
W - dim U constants c_k. A linear read-out of M depends on the joints in J only, exactly when it vanishes
on T_k for every k outside J; the read-outs behind the f_j are chosen by that test. All questions are ranks
or zeros of samples in a prime field (``field``): exact but for odds of about 1e-16, without tolerances.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import compress
from typing import TYPE_CHECKING, Literal

from spelgen.arm.arm import Arm
from spelgen.errors import ArmError
from spelgen.structure.base_parameters import base_parameter_count
from spelgen.structure.basis import Term, smallest_form
from spelgen.structure.sampling import Spans

if TYPE_CHECKING:
    from spelgen.urdf.robot import Assume


@dataclass(frozen=True)
class Entry:
    """One entry of a symmetric matrix, 0-based, with the coordinates it depends on."""

    row: int
    column: int
    kind: Literal["zero", "constant", "varying"]
    joints: tuple[int, ...] = ()


@dataclass(frozen=True, repr=False)
class Structure:
    """Hold what is true for all values of the inertial parameters (``kinematics``), or the URDF's (``inertials``)."""

    assume: Assume
    joints: tuple[str, ...]
    entries: tuple[Entry, ...]
    outputs: tuple[Term, ...]
    constants: tuple[Term, ...]
    potential: tuple[int, ...]
    """Coordinates the potential energy depends on; none when gravity does no work."""
    passive: tuple[int, ...]
    """Coordinates without an actuator: their row of G is zero."""
    base_parameter_count: int

    def __repr__(self) -> str:
        made = f"{len(self.outputs)} outputs, {len(self.constants)} constants"
        base = f"{self.base_parameter_count} base parameters"
        return f"<Structure of {len(self.joints)} joints ({self.assume} used): {made}, {base}>"

    def outputs_from(self, first: int) -> int:
        """How many outputs read coordinates from ``first`` (0-based) to the tip only."""
        return sum(not output.joints or min(output.joints) >= first for output in self.outputs)


@lru_cache(maxsize=16)  # an arm is often loaded again, with other settings or logs
def derive(arm: Arm, assume: Assume = "kinematics") -> Structure:
    """The structure of ``arm``. Raises ArmError without inertials under ``inertials``."""
    if assume == "inertials" and not arm.has_inertials:
        raise ArmError(
            "links without inertial values",
            expected="an <inertial> on every moving body",
            do="use --assume kinematics, which needs none",
        )
    # every question below is a rank or a zero of these samples
    spans = Spans(arm, assume)
    outputs, constants = smallest_form(spans)
    return Structure(
        assume=assume,
        joints=arm.joint_names,
        entries=tuple(_entry(spans, index) for index in range(len(spans.keys))),
        outputs=outputs,
        constants=constants,
        potential=tuple(compress(range(spans.n), spans.potential_changes)),
        passive=tuple(k for k, coordinate in enumerate(arm.coordinates) if coordinate.passive),
        base_parameter_count=base_parameter_count(arm),
    )


def _entry(spans: Spans, index: int) -> Entry:
    # zero at random points of a field of 2e18 elements is zero everywhere, all but surely
    row, column = spans.keys[index]
    if not spans.mass[:, index].any():
        return Entry(row, column, "zero")
    joints = tuple(sorted(spans.entry_joints[index]))
    return Entry(row, column, "varying" if joints else "constant", joints)
