"""The derived facts once more, by numbers: Pinocchio at random configurations and random inertials.

Under ``kinematics`` every sample has inertial values of its own; under ``inertials`` all have the URDF's.
Nothing of the derivation is used but the Arm; that the file says what the Arm says is checked by another
program (``urdf_cross_check``).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from spelgen.arm.arm import Arm
from spelgen.certificate.urdf_cross_check import urdf_cross_check
from spelgen.certificate.verification import Check, Verdict, Verification, size_told
from spelgen.errors import SpelgenError
from spelgen.labels import entry_name, joints_in_ranges
from spelgen.structure.basis import Weights
from spelgen.structure.recursion import triangle
from spelgen.structure.structure import Structure
from spelgen.urdf.robot import Robot

if TYPE_CHECKING:
    from spelgen.certificate.numeric_samples import NumericSamples

ROUNDING = 1e-12
"""Fraction of its scale below which a number is taken for rounding; what is found is told beside it."""
FORM_ROUNDING = 1e-6
"""The same for the smallest form: its long fractions are kept as doubles, found by least squares."""
_FINE = 1e-3
_SPARE = 6


@dataclass(frozen=True)
class _Case:
    """What is checked, and the samples that do it.

    ``is_fine``: the arm has numbers so small that their products can vanish in rounding. What is derived
    and not seen is then no contradiction.
    """

    structure: Structure
    samples: NumericSamples
    is_fine: bool

    def check(
        self, fact: str, derived: str, found: str, unexpected: Mapping[str, str], unseen: Mapping[str, str]
    ) -> Check:
        """A check that names up to four of the things found against what was derived."""
        verdict: Verdict = "agrees"
        if unexpected or unseen:
            verdict = "undecided" if self.is_fine and not unexpected else "differs"
        against = [f"{what} {how}" for what, how in [*unexpected.items(), *unseen.items()]]
        if len(against) > 4:
            against[4:] = [f"and {len(against) - 4} more"]
        return Check(fact, derived, "; ".join(against) or found, verdict)

    def rank_check(self, fact: str, rows: np.ndarray, derived: int) -> Check:
        """A check of a rank, with the gap between the singular values that decides it."""
        rank, sizes = _rank(rows)
        around = [(number, sizes[number - 1]) for number in (rank, rank + 1) if 0 < number <= len(sizes)]
        told = " and ".join(f"number {number} is {size_told(size)}" for number, size in around)
        found = f"{rank} by singular values" + (f" ({told} of the first)" if told else "")
        wrong = {"": found}
        nothing: dict[str, str] = {}
        return self.check(
            fact,
            str(derived),
            found,
            wrong if rank > derived else nothing,
            wrong if rank < derived else nothing,
        )


def verify(robot: Robot, arm: Arm, structure: Structure, *, samples: int = 0, seed: int = 0) -> Verification:
    """Check the structure of ``arm``, and the arm against the file of ``robot``, at random configurations.

    ``samples`` is how many; never fewer than show the ranks. Raises SpelgenError without Pinocchio.
    """
    try:
        from spelgen.certificate import numeric_samples
    except ModuleNotFoundError as missing:
        if (missing.name or "").split(".")[0] != "pinocchio":
            raise
        problem = "the numerical proof needs the package pinocchio, which is not installed"
        raise SpelgenError(problem, do="pip install 'spelgen[simulate]'") from None
    count = max(samples, len(structure.entries) + _SPARE)
    rng = np.random.default_rng(seed)
    free = structure.assume == "kinematics"
    drawn = numeric_samples.draw(arm, count, rng, random_inertials=free)
    case = _Case(structure, drawn, _is_fine(arm, structure))
    checks = (
        *_fixed_entries(case),
        _dependence(case),
        *_smallest_form(case),
        *_ranks(case),
        _potential(case),
        case.rank_check(
            "base parameters", numeric_samples.regressor(arm, rng), structure.base_parameter_count
        ),
        *urdf_cross_check(robot, arm, seed=seed),
    )
    inertials = "inertial values of its own" if free else "the URDF's inertial values"
    means = f"{numeric_samples.ENGINE} and yourdfpy at {count} random configurations, each with {inertials}"
    return Verification(means, count, seed, checks)


def _fixed_entries(case: _Case) -> Iterator[Check]:
    """What is always zero is zero, what is constant does not change."""
    values = np.abs(case.samples.mass).max(axis=(0, 1))
    moves = np.abs(case.samples.changes).max(axis=(0, 1))
    for kind, sizes, verb in (("zero", values, "reaches"), ("constant", moves, "changes by")):
        chosen = {
            entry_name(entry.row, entry.column): float(sizes[index])
            for index, entry in enumerate(case.structure.entries)
            if entry.kind == kind
        }
        if chosen:
            names = ", ".join(chosen) if len(chosen) <= 8 else f"{len(chosen)} entries"
            found = f"none {verb} more than {size_told(max(chosen.values()))} of its scale"
            wrong = {name: f"{verb} {size_told(size)}" for name, size in chosen.items() if size > ROUNDING}
            yield case.check(f"{kind} entries", names, found, wrong, {})


def _dependence(case: _Case) -> Check:
    """Every joint that an entry depends on moves it, and no other does."""
    moves = np.abs(case.samples.changes).max(axis=1)  # (n, entries)
    expected = np.zeros(moves.shape, dtype=bool)
    unexpected, unseen = {}, {}
    for index, entry in enumerate(case.structure.entries):
        expected[list(entry.joints), index] = True
        for joint, size in enumerate(moves[:, index]):
            what = f"{entry_name(entry.row, entry.column)} with joint {joint + 1}"
            if expected[joint, index] and size <= ROUNDING:
                unseen[what] = "is not seen to move"
            if not expected[joint, index] and size > ROUNDING:
                unexpected[what] = f"moves by {size_told(size)}"
    found = (
        f"no joint moves another entry by more than {size_told(moves[~expected].max(initial=0))} of its scale"
    )
    if expected.any():
        found = f"the weakest moves its entry by {size_told(moves[expected].min())} of its scale; {found}"
    derived = f"{expected.sum()} of the {expected.size} pairs of a joint and an entry"
    return case.check("dependence on joints", derived, found, unexpected, unseen)


def _smallest_form(case: _Case) -> Iterator[Check]:
    """M = sum c A + sum f B gives M back, and no f moves with a joint it does not read, no c with any."""
    structure, samples = case.structure, case.samples
    n = len(structure.joints)
    keys = {key: index for index, key in enumerate(triangle(n))}
    rebuilt = np.zeros_like(samples.mass)
    wrong, largest = {}, 0.0
    for joints, reads, basis in _terms(structure):
        values, size = samples.combined(reads)
        for i, j, factor in basis:
            rebuilt[..., keys[i, j]] += float(factor) * values / samples.scale[keys[i, j]]
        moves = np.abs(values[1:] - values[0]).max(axis=1) / size
        moved = max((float(moves[joint]) for joint in range(n) if joint not in joints), default=0.0)
        largest = max(largest, moved)
        if moved > FORM_ROUNDING:
            what = f"an output of {joints_in_ranges(joints)}" if joints else "a constant"
            wrong[what] = f"moves by {size_told(moved)} with another joint"
    residual = float(np.abs(rebuilt - samples.mass).max(initial=0.0))
    found = f"off by {size_told(residual)} of an entry's scale at most"
    derived = f"{len(structure.outputs)} outputs and {len(structure.constants)} constants give M"
    yield case.check("smallest form", derived, found, {"M": found} if residual > FORM_ROUNDING else {}, {})
    found = f"no other joint moves one by more than {size_told(largest)} of its scale"
    yield case.check("joints of outputs and constants", "as said for each", found, wrong, {})


def _terms(structure: Structure) -> Iterator[tuple[tuple[int, ...], Weights, Weights]]:
    yield from ((output.joints, output.reads, output.basis) for output in structure.outputs)
    yield from (((), constant.reads, constant.basis) for constant in structure.constants)


def _ranks(case: _Case) -> Iterator[Check]:
    """How many outputs and constants there must be, and how many outputs can do without the first joints."""
    structure, changes = case.structure, case.samples.changes
    width, outputs = changes.shape[-1], len(structure.outputs)
    yield case.rank_check("outputs", changes.reshape(-1, width), outputs)
    together = outputs + len(structure.constants)
    yield case.rank_check("outputs and constants together", case.samples.mass[0], together)
    fewer: dict[str, str] = {}
    more: dict[str, str] = {}
    for first in range(1, len(structure.joints)):
        left = outputs - _rank(changes[:first].reshape(-1, width))[0]
        derived = structure.outputs_from(first)
        if left != derived:
            (fewer if left < derived else more)[f"from joint {first + 1} on"] = f"{left} by singular values"
    counts = ", ".join(str(structure.outputs_from(first)) for first in range(len(structure.joints)))
    fact = "outputs without the first 0, 1, ... joints"
    # a change that is not seen leaves more outputs over
    yield case.check(fact, counts, "the same by singular values", fewer, more)


def _potential(case: _Case) -> Check:
    potential = case.samples.potential
    moves = np.abs(potential[1:] - potential[0]).max(axis=1)
    unexpected, unseen, largest = {}, {}, 0.0
    for joint, size in enumerate(moves):
        if joint in case.structure.potential:
            if size <= ROUNDING:
                unseen[f"joint {joint + 1}"] = "is not seen to move it"
        else:
            largest = max(largest, float(size))
            if size > ROUNDING:
                unexpected[f"joint {joint + 1}"] = f"moves it by {size_told(size)}"
    found = f"any other joint moves it by {size_told(largest)} of its size at most"
    joints = case.structure.potential
    return case.check(
        "potential energy", joints_in_ranges(joints) if joints else "no joint", found, unexpected, unseen
    )


def _rank(rows: np.ndarray) -> tuple[int, np.ndarray]:
    """The number of singular values above rounding, and all of them relative to the largest."""
    # the triangular factor has the same singular values, and is small
    factor = np.linalg.qr(rows, mode="r") if len(rows) > rows.shape[1] else rows
    sizes = np.linalg.svd(factor, compute_uv=False)
    if not len(sizes) or sizes[0] == 0:
        return 0, sizes[:0]
    relative = sizes / sizes[0]
    return int((relative > ROUNDING).sum()), relative


def _is_fine(arm: Arm, structure: Structure) -> bool:
    numbers = [abs(float(x)) for body in arm.bodies for row in body.rotation for x in row]
    if structure.assume == "inertials":
        for body in arm.bodies:
            tensor = [abs(float(x)) for x in (body.inertia or ())[4:]]
            numbers += [x / max(tensor) for x in tensor if x]
    return min(x for x in numbers if x) < _FINE
