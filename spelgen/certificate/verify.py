"""Numerical verification of the derived structure of an arm by Pinocchio at random configurations.

For a structure with ``assume="kinematics"``, each sample has other random inertial parameters; with ``inertials``, all
samples have the inertial parameters of the URDF. Verification and derivation of the structure both use the chain of
bodies that spelgen has read from the URDF. Therefore the chain is also compared with Pinocchio's reading of the URDF
(see ``numeric_samples``).
"""

import textwrap
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Literal

import numpy as np

from spelgen.arm.arm import Chain
from spelgen.certificate import numeric_samples
from spelgen.errors import shortened
from spelgen.labels import entry_name, joints_in_ranges
from spelgen.listing import WIDTH, Listing
from spelgen.structure.basis import row_of
from spelgen.structure.structure import Structure
from spelgen.urdf.robot import Robot

Verdict = Literal["agrees", "differs", "undecided"]
_MARKS = {"agrees": "ok", "differs": "DIFFERS", "undecided": "open"}


@dataclass(frozen=True)
class FactCheck:
    """Result of the numerical verification of one derived fact about M or the potential energy V.

    Attributes:
        fact: name of the fact, such as "zero entries".
        derived: result of the derivation, as text.
        found: result of the independent computation by Pinocchio, as text.
        verdict: "agrees", "differs", or "undecided" if rounding errors are too large or Pinocchio cannot read the file.
    """

    fact: str
    derived: str
    found: str
    verdict: Verdict

    def __str__(self) -> str:
        return f"{self.fact}: {self.derived}; {self.found}"


@dataclass(frozen=True, repr=False)
class Verification:
    """Result of the numerical verification of an arm's structure.

    Attributes:
        means: text that states the program (Pinocchio), the number of configurations and the inertial values.
        samples: number of random configurations.
        seed: seed of the random configurations.
        checks: one result per derived fact, then the comparison of the chain with the URDF.
    """

    means: str
    samples: int
    seed: int
    checks: tuple[FactCheck, ...]

    @property
    def agrees(self) -> bool:
        """True if no check contradicts the derivation of the structure or the chain read from the URDF."""
        return not self.differences

    @property
    def differences(self) -> tuple[FactCheck, ...]:
        """The checks that contradict the derivation of the structure or the chain read from the URDF."""
        return tuple(check for check in self.checks if check.verdict == "differs")

    def __repr__(self) -> str:
        return f"<Verification: {len(self.checks)} checks, {len(self.differences)} of them differ>"

    def _repr_html_(self) -> str:
        rows = [(check.fact, check.derived, check.found, check.verdict) for check in self.checks]
        head = ("fact", "derived", "found", "")
        return Listing(f"Verified by {self.means}", head, rows, left=(0, 1, 2, 3)).html()

    def to_dict(self) -> dict[str, object]:
        """Return the verification as a JSON object."""
        return {"agrees": self.agrees} | asdict(self)

    def text(self) -> str:
        """Return the verification as text for a terminal, with one or more lines per check."""
        lines = textwrap.wrap(f"Verified by {self.means}", WIDTH)
        for check in self.checks:
            mark = f"  {_MARKS[check.verdict]:<7} "
            lines += textwrap.wrap(
                str(check), WIDTH, initial_indent=mark, subsequent_indent=" " * 12, break_on_hyphens=False
            )
        return "\n".join(lines)


def size_text(size: float) -> str:
    """Return a number as text with one significant digit, such as ``3e-12``, or ``0``."""
    return f"{size:.0e}" if size else "0"


Magnitude = tuple[str, float, bool]
"""A sampled number that tests a fact: name, magnitude divided by its scale, and whether it must be nonzero or zero."""


@dataclass(frozen=True)
class _DerivedFact:
    """A derived fact, with the sampled numbers that confirm or refute it.

    Attributes:
        fact: name of the fact.
        derived: result of the derivation, as text.
        magnitudes: list of (name, number, is_nonzero). The fact is true if the numbers with is_nonzero = True are
            nonzero and all others are zero.
    """

    fact: str
    derived: str
    magnitudes: list[Magnitude]
    # [1] Sampled numbers, divided by their scales, count as zero up to this value: they may be rounding errors.
    rounding: float = 1e-12

    def check(self, has_tiny_numbers: bool) -> FactCheck:
        """Return the verification of the fact by the sampled numbers.

        has_tiny_numbers: True if numbers of the arm are so small that nonzero results may be lost in rounding errors
        (see `_has_tiny_numbers`). If a number that should be nonzero counts as zero, the verdict is then "undecided"
        instead of "differs".
        """
        zeros = [(name, value) for name, value, is_nonzero in self.magnitudes if not is_nonzero]
        nonzeros = [(name, value) for name, value, is_nonzero in self.magnitudes if is_nonzero]
        differences = [
            f"{name} is {size_text(value)} of its scale" for name, value in zeros if value > self.rounding
        ]
        verdict: Verdict = "undecided" if has_tiny_numbers and not differences else "differs"
        differences += [f"{name} is not seen" for name, value in nonzeros if value <= self.rounding]
        if differences:
            return FactCheck(self.fact, self.derived, shortened(differences, 4), verdict)
        largest = max((value for _, value in zeros), default=0.0)
        result = f"numbers that should be zero are at most {size_text(largest)} of its scale"
        if nonzeros:
            smallest = min(value for _, value in nonzeros)
            result = (
                f"numbers that should not be zero are at least {size_text(smallest)} of its scale, {result}"
            )
        return FactCheck(self.fact, self.derived, result, "agrees")


def verify(robot: Robot, arm: Chain, structure: Structure, *, seed: int = 0) -> Verification:
    """Verify the derived structure of an arm by Pinocchio, and compare the arm with the URDF of ``robot``.

    Args:
        robot: the URDF.
        arm: the chain of bodies that spelgen has read from the URDF.
        structure: structure that is derived from the chain.
        seed: seed of the random configurations and inertial parameters.
    """
    # A derived rank is at most the number of entries of M: this number of samples confirms it. Six more samples
    # are drawn to detect a true rank that is larger.
    count = len(structure.entries) + 6
    rng = np.random.default_rng(seed)
    is_random = structure.assume == "kinematics"
    # All facts are verified on the same samples, which are computed once.
    samples = numeric_samples.draw(arm, count, rng, random_inertials=is_random)
    facts = [
        *_entries(structure, samples),
        _smallest_form(structure, samples),
        *_ranks(structure, samples),
        _potential(structure, samples),
        _rank("base parameters", numeric_samples.regressor(arm, rng), structure.base_parameter_count),
    ]
    has_tiny_numbers = _has_tiny_numbers(arm, structure)
    checks = [fact.check(has_tiny_numbers) for fact in facts]
    inertials = "inertial values of its own" if is_random else "the URDF's inertial values"
    means = f"{numeric_samples.ENGINE} at {count} random configurations, each with {inertials}"
    return Verification(means, count, seed, (*checks, *_reading_checks(robot, arm, seed)))


def _reading_checks(robot: Robot, arm: Chain, seed: int) -> Iterator[FactCheck]:
    """Yield checks that compare the chain read by spelgen with Pinocchio's reading of the URDF."""
    try:
        differences = numeric_samples.differences_of_reading(robot, arm, seed)
    except Exception as problem:  # A failure of Pinocchio is no evidence against the chain: undecided.
        text = " ".join(str(problem).split())[:120]
        result = f"Pinocchio cannot read it ({type(problem).__name__}: {text})"
        yield FactCheck("reading of the file", "the moving bodies", result, "undecided")
        return
    is_rounded = any(remark.code.startswith("snapped-") for remark in arm.diagnostics)
    # [1] The tolerance of the comparison is 1e-9 per joint: the chain omits offsets below 1e-9 m, and the errors of its
    # rational rotations are 1e-11 rad each.
    allowed = 1e-9 * len(robot.joints)
    for quantity, (difference, rounding) in differences.items():
        verdict: Verdict = "agrees"
        if difference > allowed or (rounding > allowed and not is_rounded):
            verdict = "differs"
        result = f"at most {size_text(difference)} of their magnitude apart"
        if is_rounded:
            result += f"; the reported roundings change them by {size_text(rounding)}"
        yield FactCheck(f"{quantity} in the file", "as Pinocchio reads them", result, verdict)


def _entries(structure: Structure, samples: numeric_samples.NumericSamples) -> Iterator[_DerivedFact]:
    """Yield two facts about the entries of M: the zero entries, if any, and the joints on which each entry depends.

    The first fact is tested by the sampled entries of M, the second by the changes of the entries if only one joint
    moves.
    """
    largest = np.abs(samples.mass).max(axis=(0, 1)).tolist()
    # `largest_changes`, (entries, n): largest change of each entry of M when only one joint moves.
    largest_changes = np.abs(samples.changes).max(axis=1).T.tolist()
    zeros = []
    pairs = []
    dependent = 0
    for entry, size, changes in zip(structure.entries, largest, largest_changes, strict=True):
        name = entry_name(entry.row, entry.column)
        dependent += len(entry.joints)
        if entry.kind == "zero":
            zeros.append((name, size, False))
        for joint, change in enumerate(changes):
            pairs.append((f"change of {name} with joint {joint + 1}", change, joint in entry.joints))
    if zeros:
        yield _DerivedFact("zero entries", shortened([name for name, *_ in zeros], 8), zeros)
    derived = f"{dependent} of the {len(pairs)} pairs of an entry and a joint"
    yield _DerivedFact("dependence on joints", derived, pairs)


def _smallest_form(structure: Structure, samples: numeric_samples.NumericSamples) -> _DerivedFact:
    """Return the fact that M = sum_k c_k A_k + sum_j f_j(q) B_j with the fewest terms (minimal form), and its test.

    c_k are constants, f_j learned functions of q (outputs), A_k and B_j constant matrices. Each c_k and f_j is computed
    from sampled M as a weighted sum of entries. The test: this value of f_j must change only if one of its own joints
    moves, the value of c_k must not change, and M minus the sum must be zero. `_ranks` tests that no form has fewer
    terms.
    """
    n = len(structure.joints)
    remainder = samples.mass
    magnitudes = []
    for term in (*structure.outputs, *structure.constants):
        functional = row_of(term.functional, n)
        values = samples.mass @ (functional * samples.scale)
        remainder = remainder - values[..., None] * row_of(term.basis, n) / samples.scale
        # A term of the minimal form is a function f_j(q) or a constant c_k. Its value is a weighted sum of the entries
        # of M, with the weights `functional`; `samples.scale` has the magnitude of each entry. `changes`, (n,): largest
        # change of the value if one joint moves, divided by the sum of |weight| times magnitude over the entries.
        # Rounding errors of the value are proportional to this sum.
        changes = np.abs(values[1:] - values[0]).max(axis=1) / (np.abs(functional) @ samples.scale)
        # A term may change if one of its own joints, `term.joints`, moves: these changes are replaced by zero. The
        # minimal form is correct only if all other changes are zero up to rounding errors.
        changes[list(term.joints)] = 0.0
        name = f"an output of {joints_in_ranges(term.joints)} with others" if term.joints else "a constant"
        magnitudes.append((f"change of {name}", float(changes.max()), False))
    magnitudes.append(("remainder of M", float(np.abs(remainder).max(initial=0.0)), False))
    # The tolerance for rounding errors is larger than for other facts: the weights `term.functional` are exact
    # fractions in the derivation and are rounded to floats here.
    derived = f"outputs: {len(structure.outputs)}, constants: {len(structure.constants)}, which give M"
    return _DerivedFact("smallest form", derived, magnitudes, rounding=1e-6)


def _ranks(structure: Structure, samples: numeric_samples.NumericSamples) -> Iterator[_DerivedFact]:
    """Yield facts about the number of terms in the minimal form of M, each with the matrix rank that it must equal.

    The minimal form is M(q) = sum of f_j(q) A_j + sum of c_i B_i, with constant, linearly independent matrices A_j and
    B_i. The functions f_j are called outputs, the numbers c_i constants. The ranks are of two matrices with a column
    per entry of M: the rows of the first are M at random positions q. The rows of the second are changes M(q') - M(q),
    for which one joint moves to another random position.

    1. The number of outputs must be the rank of the changes.
    2. The number of outputs and constants together must be the rank of the values of M.
    3. For each number k of joints, the number of outputs that depend on any of the first k joints must be the rank of
       the changes for which one of these k joints moves.
    """
    changes, outputs = samples.changes, len(structure.outputs)
    width = changes.shape[-1]
    yield _rank("outputs", changes.reshape(-1, width), outputs)
    together = outputs + len(structure.constants)
    yield _rank("outputs and constants together", samples.mass[0], together)
    # In the minimal form, the number of outputs that do not depend on the first k joints is the largest possible one,
    # for each k. The ranks below prove this.
    counts, magnitudes = [str(outputs)], []
    for first in range(1, len(structure.joints)):
        without = structure.outputs_from(first)
        counts.append(str(without))
        # If one of the first k joints moves, M changes only by the outputs (functions f_j in the minimal form of M)
        # that depend on any of these joints. They are linearly independent, so their number is the rank of these
        # changes of M.
        name = f"outputs before joint {first + 1}"
        magnitudes += _rank(name, changes[:first].reshape(-1, width), outputs - without).magnitudes
    yield _DerivedFact("outputs without the first 0, 1, ... joints", ", ".join(counts), magnitudes)


def _potential(structure: Structure, samples: numeric_samples.NumericSamples) -> _DerivedFact:
    """Return the fact that the potential energy V depends only on the joints `structure.potential`, and its test.

    The test uses the gravity torques dV/dq in `samples`: they must be nonzero at these joints and zero at all others.
    """
    magnitudes = []
    for joint, size in enumerate(np.abs(samples.gravity).max(axis=0).tolist()):
        name = f"torque of gravity at joint {joint + 1}"
        magnitudes.append((name, size, joint in structure.potential))
    derived = joints_in_ranges(structure.potential) if structure.potential else "no joint"
    return _DerivedFact("potential energy", derived, magnitudes)


def _rank(fact: str, rows: np.ndarray, rank: int) -> _DerivedFact:
    """Return the fact that a matrix has the rank derived from the structure, with the singular values that test it.

    Args:
        fact: name of the fact.
        rows: the matrix, (m, k).
        rank: derived rank: the first `rank` singular values must be nonzero, all others zero.
    """
    if len(rows) > rows.shape[1]:
        # The matrix is replaced by the triangular factor of its QR decomposition, which has the same singular values
        # and fewer rows.
        rows = np.asarray(np.linalg.qr(rows, mode="r"))
    values = np.linalg.svd(rows, compute_uv=False)
    # The singular values are divided by the largest one, because the scale of the rows is arbitrary.
    values = values / (values.max(initial=0.0) or 1.0)
    values = np.pad(values, (0, max(0, rank - len(values))))
    magnitudes = []
    for number, value in enumerate(values.tolist(), start=1):
        magnitudes.append((f"singular value {number} of {fact}", value, number <= rank))
    return _DerivedFact(fact, str(rank), magnitudes)


def _has_tiny_numbers(arm: Chain, structure: Structure) -> bool:
    """Return True if the arm has nonzero numbers below 1e-3, whose products may be lost in rounding errors.

    The numbers are the entries of the rotations between joint frames and, if the structure depends on inertials, the
    moments of inertia of each body divided by its largest one.
    """
    numbers = [np.array(body.rotation, dtype=float).ravel() for body in arm.bodies]
    if structure.assume == "inertials":
        for body in arm.bodies:
            if body.inertia is not None:
                tensor = np.array(body.inertia[4:], dtype=float)
                numbers.append(tensor / (np.abs(tensor).max() or 1.0))
    magnitudes = np.abs(np.concatenate(numbers))
    return bool(magnitudes[magnitudes > 0].min() < 1e-3)
