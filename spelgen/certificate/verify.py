"""Check the derived facts once more, by numbers: Pinocchio at random configurations and random inertials.

Under ``kinematics`` every sample has inertial values of its own; under ``inertials`` all have the URDF's.
Nothing of the derivation is used but the Arm; that the file says what the Arm says is checked by
Pinocchio's own reader (``urdf_cross_check``).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from math import inf
from typing import TYPE_CHECKING

import numpy as np

from spelgen.arm.arm import Arm
from spelgen.certificate.urdf_cross_check import urdf_cross_check
from spelgen.certificate.verification import Check, Verdict, Verification, size_text
from spelgen.errors import SpelgenError, shortened
from spelgen.labels import entry_name, joints_in_ranges
from spelgen.settings.tuning.structure import CertificateTuning
from spelgen.structure.basis import row_of
from spelgen.structure.structure import Structure
from spelgen.urdf.robot import Robot

if TYPE_CHECKING:
    from spelgen.certificate.numeric_samples import NumericSamples

TUNING = CertificateTuning()
_SPARE = 6  # samples more than a rank can be: they would show a larger one


@dataclass(frozen=True)
class _Case:
    """Hold what is checked, and the samples that do it; ``is_fine``: numbers may vanish in rounding."""

    structure: Structure
    samples: NumericSamples
    is_fine: bool

    def check(
        self, fact: str, derived: str, result: str, unexpected: Sequence[str], unseen: Sequence[str]
    ) -> Check:
        """Return a check that names up to four contradictions.

        unexpected: what moves where nothing should. unseen: what does not move where something should, which is no
        contradiction where an arm has numbers so small that their products can vanish in rounding.
        """
        contradictions = [*unexpected, *unseen]
        if not contradictions:
            return Check(fact, derived, result, "agrees")
        verdict: Verdict = "differs"
        if self.is_fine and not unexpected:
            verdict = "undecided"
        return Check(fact, derived, shortened(contradictions, 4), verdict)

    def movement_check(
        self, fact: str, derived: str, verb: str, rows: Iterable[tuple[str, float, bool]], rounding: float
    ) -> Check:
        """Return a check of sizes: (what, its size relative to its scale, whether it must be more than rounding)."""
        unexpected, unseen = [], []
        largest, weakest = 0.0, inf
        for name, size, expected in rows:
            if expected:
                weakest = min(weakest, size)
            else:
                largest = max(largest, size)
            if expected and size <= rounding:
                unseen.append(f"{name} is not seen to")
            if not expected and size > rounding:
                unexpected.append(f"{name} {verb} {size_text(size)}")
        result = f"what should be zero is at most {size_text(largest)} of its scale"
        if weakest < inf:
            result = f"what should move does by at least {size_text(weakest)} of its scale, {result}"
        return self.check(fact, derived, result, unexpected, unseen)

    def rank_check(self, fact: str, rows: np.ndarray, derived: int) -> Check:
        """Return a check of a rank, with the gap between the singular values that decides it."""
        rank, sizes = _rank(rows)
        # a rank is believed by its gap: the reader sees both sides of it
        gap = []
        for number in (rank, rank + 1):
            if 0 < number <= len(sizes):
                gap.append(f"number {number} is {size_text(sizes[number - 1])}")
        result = f"{rank} by singular values ({' and '.join(gap)} of the first)"
        return self.check(
            fact, str(derived), result, [result] * (rank > derived), [result] * (rank < derived)
        )


def verify(robot: Robot, arm: Arm, structure: Structure, *, seed: int = 0) -> Verification:
    """Check the structure of ``arm``, and the arm against the file of ``robot``, at random configurations.

    There are as many of these as show the ranks. Raises SpelgenError without Pinocchio.
    """
    try:
        from spelgen.certificate import numeric_samples
    except ModuleNotFoundError as missing:
        if (missing.name or "").split(".")[0] != "pinocchio":
            raise
        problem = "the numerical proof needs the package pinocchio, which is not installed"
        raise SpelgenError(problem, do="pip install 'spelgen[simulate]'") from None
    # a rank r shows in r samples; the spare ones would show a larger rank
    count = len(structure.entries) + _SPARE
    rng = np.random.default_rng(seed)
    # a structure for any inertial values is tested with inertials that no URDF has
    free = structure.assume == "kinematics"
    drawn = numeric_samples.draw(arm, count, rng, random_inertials=free)
    case = _Case(structure, drawn, _is_fine(arm, structure))
    regressor = numeric_samples.regressor(arm, rng)
    checks = (
        *_zeros(case),
        _dependence(case),
        *_smallest_form(case),
        *_ranks(case),
        _potential(case),
        case.rank_check("base parameters", regressor, structure.base_parameter_count),
        *urdf_cross_check(robot, arm, seed),
    )
    inertials = "the URDF's inertial values"
    if free:
        inertials = "inertial values of its own"
    means = f"{numeric_samples.ENGINE} at {count} random configurations, each with {inertials}"
    return Verification(means, count, seed, checks)


def _zeros(case: _Case) -> Iterator[Check]:
    """Check that what is always zero is zero."""
    sizes = np.abs(case.samples.mass).max(axis=(0, 1)).tolist()
    rows = []
    for entry, size in zip(case.structure.entries, sizes, strict=True):
        if entry.kind == "zero":
            rows.append((entry_name(entry.row, entry.column), size, False))
    if rows:
        derived = shortened([name for name, _, _ in rows], 8)
        yield case.movement_check("zero entries", derived, "reaches", rows, TUNING.rounding)


def _dependence(case: _Case) -> Check:
    """Check that every joint that an entry depends on moves it, and no other does; a constant one no joint moves."""
    moves = np.abs(case.samples.changes).max(axis=1)  # (n, entries)
    rows = []
    pairs = 0
    for entry, sizes in zip(case.structure.entries, moves.T.tolist(), strict=True):
        pairs += len(entry.joints)
        for joint, size in enumerate(sizes):
            name = f"{entry_name(entry.row, entry.column)} with joint {joint + 1}"
            rows.append((name, size, joint in entry.joints))
    derived = f"{pairs} of the {len(rows)} pairs of an entry and a joint"
    return case.movement_check("dependence on joints", derived, "moves by", rows, TUNING.rounding)


def _smallest_form(case: _Case) -> Iterator[Check]:
    """Check that M = sum c A + sum f B gives M back, that no f moves with a joint it does not read, no c with any."""
    structure, samples = case.structure, case.samples
    n = len(structure.joints)
    rebuilt = np.zeros_like(samples.mass)
    rows = []
    for term in (*structure.outputs, *structure.constants):
        reads = row_of(term.reads, n)
        values = samples.mass @ (reads * samples.scale)
        rebuilt += values[..., None] * row_of(term.basis, n) / samples.scale
        # relative to what the sum would be if nothing cancelled
        moves = np.abs(values[1:] - values[0]).max(axis=1) / (np.abs(reads) @ samples.scale)
        name = "a constant"
        if term.joints:
            name = f"an output of {joints_in_ranges(term.joints)}"
            moves[list(term.joints)] = 0.0
        rows.append((name, float(moves.max()), False))
    residual = float(np.abs(rebuilt - samples.mass).max(initial=0.0))
    derived = f"{len(structure.outputs)} outputs and {len(structure.constants)} constants give M"
    yield case.movement_check(
        "smallest form", derived, "is off by", [("M", residual, False)], TUNING.form_rounding
    )
    fact = "joints of outputs and constants"
    yield case.movement_check(fact, "as said for each", "moves by", rows, TUNING.form_rounding)


def _ranks(case: _Case) -> Iterator[Check]:
    """Check how many outputs and constants there must be, and how many outputs can do without the first joints."""
    structure, changes = case.structure, case.samples.changes
    width, outputs = changes.shape[-1], len(structure.outputs)
    yield case.rank_check("outputs", changes.reshape(-1, width), outputs)
    together = outputs + len(structure.constants)
    yield case.rank_check("outputs and constants together", case.samples.mass[0], together)
    # networks near the tip should read few joints: this count is what the greedy choice maximises
    unexpected, unseen = [], []
    counts = [str(outputs)]
    for first in range(1, len(structure.joints)):
        # all outputs but those that the joints before the first one move
        without = outputs - _rank(changes[:first].reshape(-1, width))[0]
        derived = structure.outputs_from(first)
        counts.append(str(derived))
        text = f"from joint {first + 1} on {without} by singular values"
        if without < derived:
            unexpected.append(text)
        if without > derived:
            unseen.append(text)  # a change that is not seen leaves more outputs over
    fact = "outputs without the first 0, 1, ... joints"
    yield case.check(fact, ", ".join(counts), "the same by singular values", unexpected, unseen)


def _potential(case: _Case) -> Check:
    """Check that V depends on the joints it should, and on no others."""
    potential = case.samples.potential
    joints = case.structure.potential
    rows = []
    for joint, size in enumerate(np.abs(potential[1:] - potential[0]).max(axis=1).tolist()):
        rows.append((f"joint {joint + 1}", size, joint in joints))
    derived = "no joint"
    if joints:
        derived = joints_in_ranges(joints)
    return case.movement_check("potential energy", derived, "moves it by", rows, TUNING.rounding)


def _rank(rows: np.ndarray) -> tuple[int, np.ndarray]:
    """Return the number of singular values above rounding, and all of them relative to the largest."""
    if len(rows) > rows.shape[1]:
        # the triangular factor has the same singular values, and is small
        rows = np.asarray(np.linalg.qr(rows, mode="r"))
    sizes = np.linalg.svd(rows, compute_uv=False)
    if not len(sizes) or sizes[0] == 0:
        return 0, sizes[:0]
    relative = sizes / sizes[0]
    return int((relative > TUNING.rounding).sum()), relative


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
