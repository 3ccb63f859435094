"""Structure of an arm: zero, constant and varying entries of M, the joints that M and V depend on, minimal form of M.

V is the potential energy. The minimal form is M(q) = sum_k c_k A_k + sum_j f_j(q) B_j, with constants c_k, functions
f_j and constant matrices A_k and B_j.

Let W be the span of M(q), and T_i the span of the changes M(q) - M(q') when only joint i moves, each for all q and for
all inertial parameters or the parameters of the URDF (see `Structure.assume`). U is the sum of all T_i. Every change of
M is a linear combination of the B_j, so the minimal number of functions f_j is dim U. The A_k and B_j together span W,
so the minimal number of constants c_k is dim W - dim U. A linear functional of M depends only on the joints in a set J
if and only if it vanishes on T_i for every i outside J; this test selects the functionals that define the f_j.

All tests compute ranks or zeros of random samples of M and its changes in a prime field (``field``): exact with an
error probability of about 1e-16, without tolerances.
"""

from dataclasses import dataclass
from functools import lru_cache
from itertools import compress
from typing import Literal, NamedTuple

from spelgen.arm.arm import Chain
from spelgen.errors import ArmError
from spelgen.structure.base_parameters import base_parameter_count
from spelgen.structure.basis import Term, smallest_form
from spelgen.structure.sampling import Spans
from spelgen.urdf.robot import Assume


class MassEntry(NamedTuple):
    """An entry of M: row and column, kind (zero, constant or varying), and its joints (0-based indices)."""

    row: int
    column: int
    kind: Literal["zero", "constant", "varying"]
    joints: tuple[int, ...] = ()


@dataclass(frozen=True, repr=False)
class Structure:
    """Structure of the mass matrix M and the potential energy V of an arm.

    Attributes:
        assume: ``kinematics``: the structure is valid for all values of the inertial parameters. ``inertials``: it is
            valid for the values of the URDF.
        joints: names of the coordinates.
        entries: entries of the lower triangle of M.
        outputs: varying terms of M(q) = sum_j f_j(q) B_j + sum_k c_k A_k: functions f_j of q, and constant matrices
            B_j. The sum has the smallest number of functions.
        constants: constant terms of this sum: inertial constants c_k, and constant matrices A_k.
        base_parameter_count: number of base inertial parameters.
    """

    assume: Assume
    joints: tuple[str, ...]
    entries: tuple[MassEntry, ...]
    outputs: tuple[Term, ...]
    constants: tuple[Term, ...]
    potential: tuple[int, ...]
    """Coordinates that the potential energy depends on; none if gravity does no work."""
    passive: tuple[int, ...]
    """Coordinates without an actuator: their rows of G are zero."""
    base_parameter_count: int

    def __repr__(self) -> str:
        terms = f"{len(self.outputs)} outputs, {len(self.constants)} constants"
        base = f"{self.base_parameter_count} base parameters"
        return f"<Structure of {len(self.joints)} joints ({self.assume} used): {terms}, {base}>"

    def outputs_from(self, first: int) -> int:
        """Return the number of outputs (varying terms of M) that depend on none of the first ``first`` coordinates."""
        return sum(not output.joints or min(output.joints) >= first for output in self.outputs)


@lru_cache(maxsize=16)  # The structure is cached, because an arm is used with several settings or logs.
def derive(arm: Chain, assume: Assume = "kinematics") -> Structure:
    """Return the structure of the mass matrix M and the potential energy V of ``arm``.

    It has the zero, constant and varying entries of M, the minimal form of M, and the joints that V depends on. The
    minimal form is M = sum_k c_k A_k + sum_j f_j(q) B_j, in which each f_j depends on a minimal set of joints. assume:
    ``kinematics`` for a structure that is valid for all values of the inertial parameters, ``inertials`` for the values
    in the URDF. Raises ArmError if ``assume`` is ``inertials`` and a body has no inertial with mass.
    """
    if assume == "inertials" and not arm.inertials_complete:
        raise ArmError(
            "links without inertial values",
            expected="an <inertial> on every moving body",
            do="use --assume kinematics, which needs none",
        )
    # An entry of M is zero if all its samples in `spans` are zero, and varying if it changes with a coordinate. The
    # ranks of the samples determine the terms of M.
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


def _entry(spans: Spans, index: int) -> MassEntry:
    row, column = spans.keys[index]
    if not spans.mass[:, index].any():
        return MassEntry(row, column, "zero")
    joints = tuple(sorted(spans.entry_joints[index]))
    return MassEntry(row, column, "varying" if joints else "constant", joints)
