"""The result of `spelgen inspect`: the structure of an arm as text, and as JSON (schema 1)."""

from __future__ import annotations

import textwrap
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from spelgen.arm.actuation import Actuation, InputEntry
from spelgen.arm.arm import Chain, Coordinate
from spelgen.arm.configured_arm import Arm, load_arm
from spelgen.certificate.facts import Fact, facts
from spelgen.errors import Diagnostic
from spelgen.labels import counted, joint_ranges, joints_in_ranges, printable, short_name
from spelgen.listing import WIDTH, Listing
from spelgen.structure.servo_rank import servo_rank
from spelgen.structure.structure import MassEntry, Structure, derive
from spelgen.urdf.robot import Assume

if TYPE_CHECKING:  # SymPy is imported for formulas only
    from spelgen.certificate.formulas import Entry as PlaceOfEntry
    from spelgen.certificate.formulas import Formulas

SCHEMA = 1
LETTERS = {"zero": "0", "constant": "C"}
"""Symbols of entries of M that do not depend on q."""
POSITION = "the springs of position servos: tau = clip(kp (u - q) - kd qd), which store 1/2 kp (q - u)^2"


@dataclass(frozen=True, repr=False)
class Inspection:
    """The facts that ``spelgen inspect`` shows of an arm."""

    arm: Chain
    structure: Structure
    actuation: Actuation
    diagnostics: tuple[Diagnostic, ...]
    input: Literal["torque", "position"] = "torque"

    @property
    def facts(self) -> tuple[Fact, ...]:
        """Return the facts about the structure, in plain words."""
        return facts(self.arm, self.structure)

    def closed_forms(self, entry: PlaceOfEntry | None = None, *, longest: int | None = None) -> Formulas:
        """Return M and V, or one entry, as expressions; arguments and errors as for ``formulas.formulas.formulas``."""
        from spelgen.certificate.formulas import formulas

        return formulas(self.arm, self.structure, entry=entry, longest=longest)

    def to_dict(self) -> dict[str, object]:
        """Return the documented JSON object; names are the names in the URDF, rows and columns are counted from 1."""
        structure = self.structure
        potential = "zero"
        if structure.potential:
            potential = "varying"
        return {
            "schema": SCHEMA,
            "robot": self.arm.name,
            "assume": structure.assume,
            "joints": list(structure.joints),
            "joint_types": list(self.arm.joint_types),
            "mass_matrix": {
                "entries": list(map(self._entry, structure.entries)),
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
        """Return a report for a terminal."""
        paragraphs = [self._heading(), self._joint_table(), self._matrix(), self._needs()]
        if self.facts:
            paragraphs.append(_indented("In words", map(str, self.facts)))
        if self.diagnostics:
            paragraphs.append(_indented("Remarks", map(_remark, self.diagnostics)))
        return "\n\n".join(paragraphs)

    def __repr__(self) -> str:
        needs = self.needs()
        return f"<Inspection of {self.arm.name!r}: {needs['M(q)'].split(' make ')[0]}, {needs['base']}>"

    def _repr_html_(self) -> str:
        """Return the whole matrix, for a notebook."""
        cells, n = self._cells(), len(self.structure.joints)
        rows = []
        for row, name in enumerate(self.structure.joints):
            # M is symmetric
            line = [cells[max(row, column), min(row, column)] for column in range(n)]
            rows.append((f"{row + 1} {name}", *line))
        title = f"{self.arm.name}: mass matrix; joints each entry depends on, C constant, 0 always zero"
        head = ("", *map(str, range(1, n + 1)))
        note = "; ".join(f"{name}: {need}" for name, need in self.needs().items())
        return Listing(title, head, tuple(rows), note).html()

    def _names(self, joints: Iterable[int]) -> list[str]:
        return [self.structure.joints[joint] for joint in joints]

    def _entry(self, entry: MassEntry) -> dict[str, object]:
        return {
            "row": entry.row + 1,
            "col": entry.column + 1,
            "kind": entry.kind,
            "joints": self._names(entry.joints),
        }

    def _input_matrix(self) -> dict[str, object]:
        n = len(self.structure.joints)
        # JSON contains the zero entries of G as well
        values = {(entry.row, entry.column): (entry.kind, entry.value) for entry in self.actuation.entries}
        entries: list[dict[str, object]] = []
        for row, column in product(range(n), repeat=2):
            kind, value = values.get((row, column), ("zero", 0.0))
            entries.append({"row": row + 1, "col": column + 1, "kind": kind, "value": value})
        content: dict[str, object] = {}
        if self.input == "position":
            rank = servo_rank(self.arm)
            undetermined = [f"{name} of {self.structure.joints[joint]}" for name, joint in rank.open]
            content = {"input": "position", "kp_in_ratio": list(map(self._names, rank.groups))}
            content["with_inertia_only"] = undetermined
        return {**content, "entries": entries}

    def _servo_needs(self) -> str:
        """Return the parameters that logs of positions determine, in words."""
        # Logs of positions do not determine the scale of torques: kp, mass and friction may be multiplied by a factor.
        rank = servo_rank(self.arm)
        text = f"{POSITION}; logs of positions determine inertia, weight and friction in ratio to kp only"
        # One known torque parameter determines the scale of a group of joints.
        if len(rank.groups) == 1:
            text += ": one known kp, mass or load determines all"
        else:
            groups = " or of ".join(map(joints_in_ranges, rank.groups))
            text += f": one known kp, mass or load determines those of {groups}"
        undetermined: dict[str, list[int]] = {}
        for name, joint in rank.open:
            undetermined.setdefault(name, []).append(joint)
        for name, joints in undetermined.items():
            text += f"; {name} of {joints_in_ranges(tuple(joints))} only together with the links' own inertia"
        return text

    def _input_needs(self) -> str:
        """Return the requirements on G in words."""
        needs = ["fixed"]
        if self.input == "position":
            needs = [self._servo_needs()]
        # logs contain motor torques, which a model converts to joint torques
        if not self.actuation.direct:
            needs = ["motor torques"]
            for kind, meaning in (("fixed", "gear known"), ("gain", "gain trained"), ("coupled", "coupled")):
                entries = [entry for entry in self.actuation.entries if entry.kind == kind]
                if entries:
                    needs.append(f"{meaning} at {_rows(entries)}")
        if self.actuation.couplings:
            needs.append(f"motors coupled at {_rows(self.actuation.couplings)}")
        # a joint without a drive has no input
        if self.structure.passive:
            needs.append(f"{joints_in_ranges(self.structure.passive)} without a drive")
        return ", ".join(needs)

    def _heading(self) -> str:
        trusted = "any inertial values"
        if self.structure.assume == "inertials":
            trusted = "the URDF's inertial values"
        return f"{printable(self.arm.name)}: structure for {trusted}"

    def _joint_table(self) -> str:
        lines = ["Joints"]
        names = [short_name(coordinate.name) for coordinate in self.arm.coordinates]
        width = max(map(len, names))
        for index, joint in enumerate(self.arm.coordinates):
            line = f"  {index + 1:>2}  {names[index]:<{width}}  {joint.joint_type:<9}  {range_text(joint)}"
            if index in self.structure.passive:
                line += ", passive"
            lines.append(line)
        return "\n".join(lines)

    def _cells(self) -> dict[tuple[int, int], str]:
        cells = {}
        for entry in self.structure.entries:
            cells[entry.row, entry.column] = LETTERS.get(entry.kind, joint_ranges(entry.joints))
        return cells

    def _matrix(self) -> str:
        """Return the lower triangle of M as aligned text: the joints that each entry depends on."""
        cells, n = self._cells(), len(self.structure.joints)
        lines = ["Mass matrix: joints each entry depends on; C constant, 0 always zero"]
        widths = [0] * n
        for (_, column), cell in cells.items():
            widths[column] = max(widths[column], len(cell))
        for row in range(n):
            line = f"  {row + 1:>2}"
            for column in range(row + 1):
                line += f"  {cells[row, column]:<{widths[column]}}"
            lines.append(line.rstrip())
        return "\n".join(lines)

    def needs(self) -> dict[str, str]:
        """Return the requirements of a model of M(q), V(q) and G in words, and the number of base parameters."""
        structure = self.structure
        # outputs that depend on the same joints are one network
        counts = Counter(output.joints for output in structure.outputs)
        outputs = counted(len(structure.outputs), "output")
        mass = f"{outputs} and {counted(len(structure.constants), 'constant')}"
        mass += f" make all {len(structure.entries)} entries"
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

    def _needs(self) -> str:
        lines = ["The model needs"]
        for name, need in self.needs().items():
            lines += textwrap.wrap(need, WIDTH, initial_indent=f"  {name:<5} ", subsequent_indent=" " * 8)
        return "\n".join(lines)


def _rows(entries: Iterable[InputEntry]) -> str:
    """Return the joints (rows) of these entries of G, in words."""
    return joints_in_ranges(tuple(sorted({entry.row for entry in entries})))


def _indented(title: str, paragraphs: Iterable[str]) -> str:
    lines = [title]
    for paragraph in paragraphs:
        lines += textwrap.wrap(paragraph, WIDTH, initial_indent="  ", subsequent_indent="    ")
    return "\n".join(lines)


def _remark(diagnostic: Diagnostic) -> str:
    line = ""
    if diagnostic.line is not None:
        line = f"line {diagnostic.line}: "
    return printable(f"{diagnostic.severity}: {line}{diagnostic.where}: {diagnostic.message}")


def range_text(coordinate: Coordinate) -> str:
    """Return the range of a joint with its unit."""
    if coordinate.continuous:
        return "continuous"
    if coordinate.lower is None or coordinate.upper is None:
        return "no limits"
    unit = "m"
    if coordinate.joint_type == "revolute":
        unit = "rad"
    return f"{coordinate.lower:g} .. {coordinate.upper:g} {unit}"


def inspect(
    arm: Arm | str | Path,
    joints: Sequence[str] | None = None,
    tip: str | None = None,
    assume: Assume = "kinematics",
    *,
    angle_tolerance: float = 2e-3,
) -> Inspection:
    """Return the derived structure of an arm.

    Args:
        arm: the result of ``load_arm``, or the path of a URDF; the other arguments of ``load_arm`` go with a path.
        assume: ``kinematics``: structure for any inertial parameters; ``inertials``: for the parameters of the URDF.

    Raises the errors of ``load_arm``, and ArmError for ``inertials`` if the URDF has none.
    """
    if not isinstance(arm, Arm):
        arm = load_arm(arm, joints, tip, angle_tolerance)
    structure = derive(arm.chain, assume)
    return Inspection(arm.chain, structure, arm.actuation, arm.diagnostics, arm.settings.input)
