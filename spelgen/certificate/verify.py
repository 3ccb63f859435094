"""Numerical verification of a structure by Pinocchio at random configurations.

With ``kinematics`` every sample has its own random inertial parameters; with ``inertials`` all samples have the
parameters of the URDF. The verification shares only the chain with the derivation; the chain is compared with the
reading of the file by Pinocchio (``urdf_cross_check``).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from spelgen.arm.arm import Chain
from spelgen.certificate.numeric_samples import ENGINE, NumericSamples, draw, regressor
from spelgen.certificate.tuning import TUNING
from spelgen.certificate.urdf_cross_check import urdf_cross_check
from spelgen.certificate.verification import FactCheck, Verdict, Verification, size_text
from spelgen.errors import shortened
from spelgen.labels import entry_name, joints_in_ranges
from spelgen.structure.basis import row_of
from spelgen.structure.structure import Structure
from spelgen.urdf.robot import Robot


@dataclass(frozen=True)
class _Magnitude:
    """A number relative to its scale; is_nonzero: whether the derivation states that it differs from zero."""

    name: str
    value: float
    is_nonzero: bool


@dataclass(frozen=True)
class _DerivedFact:
    """A derived fact, and the numbers that are zero or nonzero according to the fact."""

    fact: str
    derived: str
    magnitudes: list[_Magnitude]
    rounding: float = TUNING.rounding

    def check(self, is_fine: bool) -> FactCheck:
        """Return the result of the check.

        is_fine: whether products of small dimensions may be below rounding errors.
        """
        unexpected, unseen = [], []
        for number in self.magnitudes:
            if number.is_nonzero and number.value <= self.rounding:
                unseen.append(f"{number.name} is not seen")
            if not number.is_nonzero and number.value > self.rounding:
                unexpected.append(f"{number.name} is {size_text(number.value)} of its scale")
        if unexpected or unseen:
            verdict: Verdict = "differs"
            if is_fine and not unexpected:
                verdict = "undecided"
            return FactCheck(self.fact, self.derived, shortened([*unexpected, *unseen], 4), verdict)
        nonzero = [number.value for number in self.magnitudes if number.is_nonzero]
        largest = max((number.value for number in self.magnitudes if not number.is_nonzero), default=0.0)
        result = f"what should be zero is at most {size_text(largest)} of its scale"
        if nonzero:
            result = f"what should not be zero is at least {size_text(min(nonzero))} of its scale, {result}"
        return FactCheck(self.fact, self.derived, result, "agrees")


def verify(robot: Robot, arm: Chain, structure: Structure, *, seed: int = 0) -> Verification:
    """Verify the structure of ``arm``, and the arm against the file of ``robot``, at random configurations."""
    # r samples have the rank r of a space; additional samples would reveal a larger rank
    count = len(structure.entries) + TUNING.spare_samples
    rng = np.random.default_rng(seed)
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


def _entries(structure: Structure, samples: NumericSamples) -> Iterator[_DerivedFact]:
    """Yield the zero entries, and the dependence of each entry on each joint."""
    largest = np.abs(samples.mass).max(axis=(0, 1)).tolist()
    largest_changes = np.abs(samples.changes).max(axis=1).T.tolist()  # (entries, n)
    zeros, pairs = [], []
    dependent = 0
    for entry, size, changes in zip(structure.entries, largest, largest_changes, strict=True):
        name = entry_name(entry.row, entry.column)
        dependent += len(entry.joints)
        if entry.kind == "zero":
            zeros.append(_Magnitude(name, size, False))
        for joint, change in enumerate(changes):
            pairs.append(
                _Magnitude(f"change of {name} with joint {joint + 1}", change, joint in entry.joints)
            )
    if zeros:
        yield _DerivedFact("zero entries", shortened([zero.name for zero in zeros], 8), zeros)
    derived = f"{dependent} of the {len(pairs)} pairs of an entry and a joint"
    yield _DerivedFact("dependence on joints", derived, pairs)


def _smallest_form(structure: Structure, samples: NumericSamples) -> _DerivedFact:
    """Return the fact that M = sum c A + sum f B, where each f depends only on its joints, and each c on none."""
    n = len(structure.joints)
    remainder = samples.mass
    magnitudes = []
    for term in (*structure.outputs, *structure.constants):
        functional = row_of(term.functional, n)
        values = samples.mass @ (functional * samples.scale)
        remainder = remainder - values[..., None] * row_of(term.basis, n) / samples.scale
        # relative to the sum of the absolute values of the terms
        changes = np.abs(values[1:] - values[0]).max(axis=1) / (np.abs(functional) @ samples.scale)
        changes[list(term.joints)] = 0.0
        name = "change of a constant"
        if term.joints:
            name = f"change of an output of {joints_in_ranges(term.joints)} with others"
        magnitudes.append(_Magnitude(name, float(changes.max()), False))
    magnitudes.append(_Magnitude("remainder of M", float(np.abs(remainder).max(initial=0.0)), False))
    derived = f"{len(structure.outputs)} outputs and {len(structure.constants)} constants give M"
    return _DerivedFact("smallest form", derived, magnitudes, TUNING.form_rounding)


def _ranks(structure: Structure, samples: NumericSamples) -> Iterator[_DerivedFact]:
    """Yield the numbers of outputs and constants, and of outputs that do not depend on the first joints."""
    changes, outputs = samples.changes, len(structure.outputs)
    width = changes.shape[-1]
    yield _rank("outputs", changes.reshape(-1, width), outputs)
    together = outputs + len(structure.constants)
    yield _rank("outputs and constants together", samples.mass[0], together)
    # The greedy selection maximises the number of outputs that depend only on joints close to the tip.
    counts, magnitudes = [str(outputs)], []
    for first in range(1, len(structure.joints)):
        without = structure.outputs_from(first)
        counts.append(str(without))
        # the rank of the changes with the first joints is the number of all other outputs
        name = f"outputs before joint {first + 1}"
        magnitudes += _rank(name, changes[:first].reshape(-1, width), outputs - without).magnitudes
    yield _DerivedFact("outputs without the first 0, 1, ... joints", ", ".join(counts), magnitudes)


def _potential(structure: Structure, samples: NumericSamples) -> _DerivedFact:
    """Return the joints that V depends on."""
    magnitudes = []
    for joint, size in enumerate(np.abs(samples.gravity).max(axis=0).tolist()):
        name = f"torque of gravity at joint {joint + 1}"
        magnitudes.append(_Magnitude(name, size, joint in structure.potential))
    derived = "no joint"
    if structure.potential:
        derived = joints_in_ranges(structure.potential)
    return _DerivedFact("potential energy", derived, magnitudes)


def _rank(fact: str, rows: np.ndarray, rank: int) -> _DerivedFact:
    """Return the fact that rows (m, k) have this rank: the number of singular values above rounding errors."""
    if len(rows) > rows.shape[1]:
        # The triangular factor has the same singular values and fewer rows.
        rows = np.asarray(np.linalg.qr(rows, mode="r"))
    values = np.linalg.svd(rows, compute_uv=False)
    values = values / (values.max(initial=0.0) or 1.0)
    values = np.pad(values, (0, max(0, rank - len(values))))
    magnitudes = []
    for number, value in enumerate(values.tolist(), start=1):
        magnitudes.append(_Magnitude(f"singular value {number} of {fact}", value, number <= rank))
    return _DerivedFact(fact, str(rank), magnitudes)


def _is_fine(arm: Chain, structure: Structure) -> bool:
    """Return True if a nonzero number of the arm is so small that its products may vanish in rounding errors."""
    numbers = [np.array(body.rotation, dtype=float).ravel() for body in arm.bodies]
    if structure.assume == "inertials":
        for body in arm.bodies:
            if body.inertia is not None:
                tensor = np.array(body.inertia[4:], dtype=float)
                numbers.append(tensor / (np.abs(tensor).max() or 1.0))
    magnitudes = np.abs(np.concatenate(numbers))
    return bool(magnitudes[magnitudes > 0].min() < TUNING.fine)
