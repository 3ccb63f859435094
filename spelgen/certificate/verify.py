"""Check the derived facts once more, by numbers: Pinocchio at random configurations and random inertials.

Under ``kinematics`` every sample has inertial values of its own; under ``inertials`` all have the URDF's.
Nothing of the derivation is used but the Arm; that the file says what the Arm says is checked by
Pinocchio's own reader (``urdf_cross_check``).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from spelgen.arm.arm import Arm
from spelgen.certificate.numeric_samples import ENGINE, NumericSamples, draw, regressor
from spelgen.certificate.tuning import TUNING
from spelgen.certificate.urdf_cross_check import urdf_cross_check
from spelgen.certificate.verification import Check, Verdict, Verification, size_text
from spelgen.errors import shortened
from spelgen.labels import entry_name, joints_in_ranges
from spelgen.structure.basis import row_of
from spelgen.structure.structure import Structure
from spelgen.urdf.robot import Robot

_SPARE = 6  # samples more than a rank can be: they would show a larger one


@dataclass(frozen=True)
class _Size:
    """Hold a number relative to its scale, and whether it should be more than rounding."""

    name: str
    value: float
    expected: bool


@dataclass(frozen=True)
class _Fact:
    """Hold what was derived, and the sizes of all that is zero, or is not, if it holds."""

    fact: str
    derived: str
    sizes: list[_Size]
    rounding: float = TUNING.rounding

    def check(self, is_fine: bool) -> Check:
        """Return what the sizes say; where ``is_fine``, numbers that should not be zero may vanish in rounding."""
        unexpected, unseen = [], []
        for size in self.sizes:
            if size.expected and size.value <= self.rounding:
                unseen.append(f"{size.name} is not seen")
            if not size.expected and size.value > self.rounding:
                unexpected.append(f"{size.name} is {size_text(size.value)} of its scale")
        if unexpected or unseen:
            verdict: Verdict = "differs"
            if is_fine and not unexpected:
                verdict = "undecided"
            return Check(self.fact, self.derived, shortened([*unexpected, *unseen], 4), verdict)
        nonzero = [size.value for size in self.sizes if size.expected]
        largest = max((size.value for size in self.sizes if not size.expected), default=0.0)
        result = f"what should be zero is at most {size_text(largest)} of its scale"
        if nonzero:
            result = f"what should not be zero is at least {size_text(min(nonzero))} of its scale, {result}"
        return Check(self.fact, self.derived, result, "agrees")


def verify(robot: Robot, arm: Arm, structure: Structure, *, seed: int = 0) -> Verification:
    """Check the structure of ``arm``, and the arm against the file of ``robot``, at random configurations.

    There are as many of these as show the ranks.
    """
    # a rank r shows in r samples; the spare ones would show a larger rank
    count = len(structure.entries) + _SPARE
    rng = np.random.default_rng(seed)
    # a structure for any inertial values is tested with inertials that no URDF has
    inertials = "the URDF's inertial values"
    if structure.assume == "kinematics":
        inertials = "inertial values of its own"
    samples = draw(arm, count, rng, random_inertials=structure.assume == "kinematics")
    base_parameters = structure.base_parameter_count
    facts = [
        *_entries(structure, samples),
        _smallest_form(structure, samples),
        *_ranks(structure, samples),
        _potential(structure, samples),
        _rank("base parameters", regressor(arm, rng), base_parameters),
    ]
    is_fine = _is_fine(arm, structure)
    checks = [fact.check(is_fine) for fact in facts]
    means = f"{ENGINE} at {count} random configurations, each with {inertials}"
    return Verification(means, count, seed, (*checks, *urdf_cross_check(robot, arm, seed)))


def _entries(structure: Structure, samples: NumericSamples) -> Iterator[_Fact]:
    """Yield what is always zero, and that every joint that an entry depends on moves it and no other does."""
    sizes = np.abs(samples.mass).max(axis=(0, 1)).tolist()
    moves = np.abs(samples.changes).max(axis=1).T.tolist()  # (entries, n)
    zeros, pairs = [], []
    dependent = 0
    for entry, size, changes in zip(structure.entries, sizes, moves, strict=True):
        name = entry_name(entry.row, entry.column)
        dependent += len(entry.joints)
        if entry.kind == "zero":
            zeros.append(_Size(name, size, False))
        for joint, change in enumerate(changes):
            pairs.append(_Size(f"change of {name} with joint {joint + 1}", change, joint in entry.joints))
    if zeros:
        yield _Fact("zero entries", shortened([zero.name for zero in zeros], 8), zeros)
    derived = f"{dependent} of the {len(pairs)} pairs of an entry and a joint"
    yield _Fact("dependence on joints", derived, pairs)


def _smallest_form(structure: Structure, samples: NumericSamples) -> _Fact:
    """Return that M = sum c A + sum f B gives M back, that no f moves with a joint it does not read, no c with any."""
    n = len(structure.joints)
    remainder = samples.mass
    sizes = []
    for term in (*structure.outputs, *structure.constants):
        reads = row_of(term.reads, n)
        values = samples.mass @ (reads * samples.scale)
        remainder = remainder - values[..., None] * row_of(term.basis, n) / samples.scale
        # relative to what the sum would be if nothing cancelled
        moves = np.abs(values[1:] - values[0]).max(axis=1) / (np.abs(reads) @ samples.scale)
        moves[list(term.joints)] = 0.0
        name = "change of a constant"
        if term.joints:
            name = f"change of an output of {joints_in_ranges(term.joints)} with others"
        sizes.append(_Size(name, float(moves.max()), False))
    sizes.append(_Size("remainder of M", float(np.abs(remainder).max(initial=0.0)), False))
    derived = f"{len(structure.outputs)} outputs and {len(structure.constants)} constants give M"
    return _Fact("smallest form", derived, sizes, TUNING.form_rounding)


def _ranks(structure: Structure, samples: NumericSamples) -> Iterator[_Fact]:
    """Yield how many outputs and constants there must be, and how many outputs can do without the first joints."""
    changes, outputs = samples.changes, len(structure.outputs)
    width = changes.shape[-1]
    yield _rank("outputs", changes.reshape(-1, width), outputs)
    together = outputs + len(structure.constants)
    yield _rank("outputs and constants together", samples.mass[0], together)
    # networks near the tip should read few joints: this count is what the greedy choice maximises
    counts, sizes = [str(outputs)], []
    for first in range(1, len(structure.joints)):
        without = structure.outputs_from(first)
        counts.append(str(without))
        # all outputs but those that the joints before the first one move
        name = f"outputs before joint {first + 1}"
        sizes += _rank(name, changes[:first].reshape(-1, width), outputs - without).sizes
    yield _Fact("outputs without the first 0, 1, ... joints", ", ".join(counts), sizes)


def _potential(structure: Structure, samples: NumericSamples) -> _Fact:
    """Return that V depends on the joints it should, and on no others."""
    sizes = []
    for joint, size in enumerate(np.abs(samples.gravity).max(axis=0).tolist()):
        sizes.append(_Size(f"torque of gravity at joint {joint + 1}", size, joint in structure.potential))
    derived = "no joint"
    if structure.potential:
        derived = joints_in_ranges(structure.potential)
    return _Fact("potential energy", derived, sizes)


def _rank(fact: str, rows: np.ndarray, rank: int) -> _Fact:
    """Return that the rows have this rank: so many singular values are not zero, relative to the largest."""
    if len(rows) > rows.shape[1]:
        # the triangular factor has the same singular values, and is small
        rows = np.asarray(np.linalg.qr(rows, mode="r"))
    values = np.linalg.svd(rows, compute_uv=False)
    values = values / (values.max(initial=0.0) or 1.0)
    # there are no more than the rows have columns
    values = np.pad(values, (0, max(0, rank - len(values))))
    sizes = []
    for number, value in enumerate(values.tolist(), start=1):
        sizes.append(_Size(f"singular value {number} of {fact}", value, number <= rank))
    return _Fact(fact, str(rank), sizes)


def _is_fine(arm: Arm, structure: Structure) -> bool:
    """Whether some number of the arm is so small, and not 0, that products of it can vanish in rounding."""
    numbers = [np.array(body.rotation, dtype=float).ravel() for body in arm.bodies]
    if structure.assume == "inertials":
        for body in arm.bodies:
            if body.inertia is not None:
                tensor = np.array(body.inertia[4:], dtype=float)
                numbers.append(tensor / (np.abs(tensor).max() or 1.0))
    sizes = np.abs(np.concatenate(numbers))
    return bool(sizes[sizes > 0].min() < TUNING.fine)
