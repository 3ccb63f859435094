"""The result of `spelgen inspect`: the derived structure of an arm as text for users, and as JSON (schema 1)."""

from __future__ import annotations

import textwrap
from collections import Counter
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from spelgen.arm.actuation import Actuation, InputEntry
from spelgen.arm.arm import Chain, Coordinate
from spelgen.arm.configured_arm import Arm, load_arm
from spelgen.certificate.facts import Fact, facts
from spelgen.errors import Diagnostic
from spelgen.labels import UNITS, cell_text, counted, joints_in_ranges, printable, short_name
from spelgen.listing import WIDTH, Listing
from spelgen.structure.servo_rank import servo_rank
from spelgen.structure.structure import Structure, derive
from spelgen.urdf.robot import Assume

if TYPE_CHECKING:  # These modules are not imported at run time, since they import SymPy, which is slow.
    from spelgen.certificate.formulas import Entry as PlaceOfEntry
    from spelgen.certificate.formulas import Formulas


@dataclass(frozen=True, repr=False)
class Inspection:
    """The result of ``spelgen inspect`` for an arm: derived structure, inputs and diagnostics.

    Attributes:
        arm: the arm.
        structure: structure of the mass matrix M and the potential energy V.
        actuation: entries of the input matrix G.
        diagnostics: remarks about the URDF and the arm, such as rounded angles.
        input: "torque", or "position" for an arm with position servos.
    """

    arm: Chain
    structure: Structure
    actuation: Actuation
    diagnostics: tuple[Diagnostic, ...]
    input: Literal["torque", "position"] = "torque"

    @property
    def facts(self) -> tuple[Fact, ...]:
        """Facts about the structure of M and the potential energy V as sentences, with geometric reasons."""
        return facts(self.arm, self.structure)

    def closed_forms(self, entry: PlaceOfEntry | None = None, *, longest: int | None = None) -> Formulas:
        """Return M and the potential energy V, or one entry of M, as SymPy expressions.

        Args:
            entry: (row, column) of an entry of M, counted from 1, or "V"; None: all entries and V.
            longest: Largest number of terms of an entry; longer entries have no expression. Default: 40, or 3,000 for
                one entry.

        Raises SpelgenError for an entry that M does not have.
        """
        from spelgen.certificate.formulas import formulas

        return formulas(self.arm, self.structure, entry=entry, longest=longest)

    def to_dict(self) -> dict[str, object]:
        """Return the result as a JSON object. Joints have their names in the URDF; indices are counted from 1."""
        structure = self.structure
        entries = []
        for entry in structure.entries:
            indices = {"row": entry.row + 1, "col": entry.column + 1}
            entries.append({**indices, "kind": entry.kind, "joints": self._names(entry.joints)})
        potential = "varying" if structure.potential else "zero"
        return {
            "schema": 1,
            "robot": self.arm.name,
            "assume": structure.assume,
            "joints": list(structure.joints),
            "joint_types": list(self.arm.joint_types),
            "mass_matrix": {
                "entries": entries,
                "outputs": len(structure.outputs),
                "constants": len(structure.constants),
                "output_joints": [self._names(output.joints) for output in structure.outputs],
            },
            "potential_energy": {"kind": potential, "joints": self._names(structure.potential)},
            "input_matrix": self._input_matrix(),
            "base_parameters": structure.base_parameter_count,
            "facts": list(map(asdict, self.facts)),
            "diagnostics": list(map(Diagnostic.to_dict, self.diagnostics)),
        }

    def text(self) -> str:
        """Return text for a terminal: tables of joints and entries of M, learned functions, facts on M, V, remarks."""
        is_fixed = self.structure.assume == "inertials"
        trusted = "the URDF's inertial values" if is_fixed else "any inertial values"
        heading = f"{printable(self.arm.name)}: structure for {trusted}"
        needs = [f"{name:<5} {need}" for name, need in self.needs().items()]
        paragraphs = [heading, self._joint_table(), self._matrix(), _indented("The model needs", needs, 8)]
        if self.facts:
            paragraphs.append(_indented("In words", map(str, self.facts)))
        if self.diagnostics:
            paragraphs.append(_indented("Remarks", map(_remark, self.diagnostics)))
        return "\n\n".join(paragraphs)

    def __repr__(self) -> str:
        needs = self.needs()
        return f"<Inspection of {self.arm.name!r}: {needs['M(q)'].split(' make ')[0]}, {needs['base']}>"

    def _repr_html_(self) -> str:
        """Return a table of the whole mass matrix, for a notebook: the joints that each entry depends on."""
        cells, n = self._cells(), len(self.structure.joints)
        rows = []
        for row, name in enumerate(self.structure.joints):
            # M is symmetric, and only its lower triangle has cells.
            line = [cells[max(row, column), min(row, column)] for column in range(n)]
            rows.append((f"{row + 1} {name}", *line))
        title = f"{self.arm.name}: mass matrix; joints each entry depends on, C constant, 0 always zero"
        head = ("", *map(str, range(1, n + 1)))
        note = "; ".join(f"{name}: {need}" for name, need in self.needs().items())
        return Listing(title, head, rows, note).html()

    def _names(self, joints: Iterable[int]) -> list[str]:
        return [self.structure.joints[joint] for joint in joints]

    def _input_matrix(self) -> dict[str, object]:
        n = len(self.structure.joints)
        # The JSON object contains all entries of the input matrix G (joint torques per input torque);
        # `actuation.entries` has only its nonzero entries.
        values = {(entry.row, entry.column): (entry.kind, entry.value) for entry in self.actuation.entries}
        entries = []
        for row, column in product(range(n), repeat=2):
            kind, value = values.get((row, column), ("zero", 0.0))
            entries.append({"row": row + 1, "col": column + 1, "kind": kind, "value": value})
        if self.input == "torque":
            return {"entries": entries}
        # Logs of torques determine all base parameters. Logs of position servos determine some parameters only in ratio
        # to kp, or together with the inertial parameters: for such logs the JSON object lists these parameters, too.
        rank = servo_rank(self.arm)
        undetermined = [f"{name} of {self.structure.joints[joint]}" for name, joint in rank.open]
        ratios = list(map(self._names, rank.groups))
        content = {"input": "position", "kp_in_ratio": ratios, "with_inertia_only": undetermined}
        return {**content, "entries": entries}

    def _servo_needs(self) -> str:
        """Return a text for users about the parameters that logs of position servos can and cannot determine."""
        # Logs of positions do not determine the scale of torques: the logs would be the same if kp, mass and friction
        # of a group of joints were multiplied by a common factor. One known parameter of the group determines the
        # factor.
        rank = servo_rank(self.arm)
        determined = f"those of {' or of '.join(map(joints_in_ranges, rank.groups))}"
        if len(rank.groups) == 1:
            determined = "all"
        text = (
            "the springs of position servos: tau = clip(kp (u - q) - kd qd), which store 1/2 kp (q - u)^2; logs of "
            "positions determine inertia, weight and friction in ratio to kp only: one known kp, mass or load "
            f"determines {determined}"
        )
        undetermined: dict[str, list[int]] = {}
        for name, joint in rank.open:
            undetermined.setdefault(name, []).append(joint)
        for name, joints in undetermined.items():
            text += f"; {name} of {joints_in_ranges(tuple(joints))} only together with the links' own inertia"
        return text

    def _input_needs(self) -> str:
        """Return a text on the model's inputs: "motor torques, gear known at joints 1-3, gear trained at joint 4"."""
        needs = ["fixed"]
        if self.input == "position":
            needs = [self._servo_needs()]
        # G is not the identity if logs contain motor torques, which the model converts to joint torques by G.
        if not self.actuation.direct:
            needs = ["motor torques"]
            for kind, meaning in (("fixed", "gear known"), ("gain", "gain trained"), ("coupled", "coupled")):
                entries = [entry for entry in self.actuation.entries if entry.kind == kind]
                if entries:
                    needs.append(f"{meaning} at {_driven_joints(entries)}")
        if self.actuation.couplings:
            needs.append(f"motors coupled at {_driven_joints(self.actuation.couplings)}")
        # Joints without a drive are listed, because they have no input.
        if self.structure.passive:
            needs.append(f"{joints_in_ranges(self.structure.passive)} without a drive")
        return ", ".join(needs)

    def _joint_table(self) -> str:
        lines = ["Joints"]
        width = max(len(short_name(joint.name)) for joint in self.arm.coordinates)
        for index, joint in enumerate(self.arm.coordinates):
            line = f"  {index + 1:>2}  {short_name(joint.name):<{width}}  {joint.joint_type:<9}  {range_text(joint)}"
            lines.append(line + ", passive" * (index in self.structure.passive))
        return "\n".join(lines)

    def _cells(self) -> dict[tuple[int, int], str]:
        return {(x.row, x.column): cell_text(x.kind, x.joints) for x in self.structure.entries}

    def _matrix(self) -> str:
        """Return a text table of the lower triangle of M with a cell per entry, see `cell_text`."""
        cells, n = self._cells(), len(self.structure.joints)
        lines = ["Mass matrix: joints each entry depends on; C constant, 0 always zero"]
        # Each column of the table has the width of its widest cell, so that M of seven joints fits into 80 characters.
        widths = [max(len(cells[row, column]) for row in range(column, n)) for column in range(n)]
        for row in range(n):
            line = f"  {row + 1:>2}"
            for column in range(row + 1):
                line += f"  {cells[row, column]:<{widths[column]}}"
            lines.append(line.rstrip())
        return "\n".join(lines)

    def needs(self) -> dict[str, str]:
        """Return {quantity: text for users about the functions and constants that a model needs for it}.

        The quantities are "M(q)", "V(q)", "G" (the input matrix) and "base" (the number of base inertial parameters).
        """
        structure = self.structure
        # Outputs (varying terms of M) are counted per set of joints, because one network computes all outputs that
        # depend on the same joints.
        counts = Counter(output.joints for output in structure.outputs)
        outputs, constants = len(structure.outputs), len(structure.constants)
        mass = f"{counted(outputs, 'output')} and {counted(constants, 'constant')}"
        mass += f" make all {len(structure.entries)} entries"
        # Outputs are the learned functions of q in M. A constant M has no outputs, and no sets of joints are listed.
        if counts:
            groups = [f"{count} of {joints_in_ranges(joints)}" for joints, count in counts.items()]
            mass += f": {'; '.join(groups)}"
        potential = "zero: gravity does no work"
        if structure.potential:
            potential = f"depends on {joints_in_ranges(structure.potential)}"
        return {
            "M(q)": mass,
            "V(q)": potential,
            "G": self._input_needs(),
            "base": f"{structure.base_parameter_count} base inertial parameters",
        }


def _driven_joints(entries: Iterable[InputEntry]) -> str:
    """Return the joints of ``entries`` of the input matrix G (their rows) as text, such as ``joints 2-4``."""
    return joints_in_ranges(tuple(sorted({entry.row for entry in entries})))


def _indented(title: str, paragraphs: Iterable[str], indent: int = 4) -> str:
    lines = [title]
    for paragraph in paragraphs:
        lines += textwrap.wrap(paragraph, WIDTH, initial_indent="  ", subsequent_indent=" " * indent)
    return "\n".join(lines)


def _remark(diagnostic: Diagnostic) -> str:
    line = "" if diagnostic.line is None else f"line {diagnostic.line}: "
    return printable(f"{diagnostic.severity}: {line}{diagnostic.where}: {diagnostic.message}")


def range_text(coordinate: Coordinate) -> str:
    """Return the position limits of a joint as text, such as "-1.5 .. 1.5 rad", "continuous" or "no limits"."""
    if coordinate.continuous:
        return "continuous"
    if coordinate.lower is None or coordinate.upper is None:
        return "no limits"
    return f"{coordinate.lower:g} .. {coordinate.upper:g} {UNITS[coordinate.joint_type].position}"


def inspect(arm: Arm | str | Path, assume: Assume = "kinematics") -> Inspection:
    """Return the derived structure of an arm.

    Args:
        arm: The result of ``load_arm``, or the path of a URDF.
        assume: ``kinematics``: structure for any inertial parameters; ``inertials``: for the parameters of the URDF.

    Raises the errors of ``load_arm``, and ArmError for ``inertials`` if a body has no inertial.
    """
    if not isinstance(arm, Arm):
        arm = load_arm(arm)
    structure = derive(arm.chain, assume)
    return Inspection(arm.chain, structure, arm.actuation, arm.diagnostics, arm.settings.input)
