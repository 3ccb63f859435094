"""A derived structure as people and programs read it: text of a given width, and the JSON contract (schema
1).
"""

from __future__ import annotations

import textwrap
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from spelgen.arm.actuation import Actuation
from spelgen.arm.arm import Arm, Coordinate
from spelgen.certificate.facts import Fact, facts
from spelgen.dynamics.servo_rank import servo_rank
from spelgen.errors import Diagnostic
from spelgen.labels import joint_ranges, joints_in_ranges, printable
from spelgen.listing import Listing
from spelgen.structure.structure import Entry, Structure

if TYPE_CHECKING:  # SymPy is read in only for formulas
    from spelgen.certificate.formulas import Entry as PlaceOfEntry
    from spelgen.certificate.formulas import Formulas

SCHEMA = 1
POSITION = "the springs of position servos: tau = clip(kp (u - q) - kd qd), which store 1/2 kp (q - u)^2"


@dataclass(frozen=True, repr=False)
class Inspection:
    """What ``spelgen inspect`` tells of an arm."""

    arm: Arm
    structure: Structure
    actuation: Actuation
    diagnostics: tuple[Diagnostic, ...]
    input: Literal["torque", "position"] = "torque"

    @property
    def facts(self) -> tuple[Fact, ...]:
        """What always holds, in plain words."""
        return facts(self.arm, self.structure)

    def closed_forms(self, entry: PlaceOfEntry | None = None, *, longest: int | None = None) -> Formulas:
        """M and V, or one entry, as expressions; arguments and errors as for ``formulas.formulas.formulas``."""
        from spelgen.certificate.formulas import formulas

        return formulas(self.arm, self.structure, entry=entry, longest=longest)

    def to_dict(self) -> dict[str, Any]:
        """The JSON contract; names are the URDF's, rows and columns count from 1."""
        structure = self.structure
        n = len(structure.joints)
        return {
            "schema": SCHEMA,
            "robot": self.arm.name,
            "assume": structure.assume,
            "joints": list(structure.joints),
            "joint_types": [coordinate.kind for coordinate in self.arm.coordinates],
            "mass_matrix": {
                "entries": [self._entry(entry) for entry in structure.entries],
                "outputs": len(structure.outputs),
                "constants": len(structure.constants),
                "output_joints": [self._names(output.joints) for output in structure.outputs],
            },
            "potential_energy": {
                "kind": "varying" if structure.potential else "zero",
                "joints": self._names(structure.potential),
            },
            "input_matrix": {
                **({} if self.input == "torque" else self._position()),
                "entries": [self._input(row, column) for row in range(n) for column in range(n)],
            },
            "base_parameters": structure.base_parameter_count,
            "facts": [fact.to_dict() for fact in self.facts],
            "diagnostics": [diagnostic.to_dict() for diagnostic in self.diagnostics],
        }

    def text(self, width: int = 80) -> str:
        """A report for a terminal ``width`` columns wide."""
        parts = [self._heading(), self._joint_table(), self._matrix(width), self._needs(width)]
        parts += [self._in_words(width)] if self.facts else []
        if self.diagnostics:
            parts.append(self._remarks(width))
        return "\n\n".join(parts)

    def __repr__(self) -> str:
        needs = self.needs()
        return f"<Inspection of {self.arm.name!r}: {needs['M(q)'].split(' make ')[0]}, {needs['base']}>"

    def _repr_html_(self) -> str:
        """The matrix, whole, for a notebook."""
        n = len(self.structure.joints)
        cells = {(e.row, e.column): _cell(e) for e in self.structure.entries}
        return Listing(
            f"{self.arm.name}: mass matrix; joints each entry depends on, C constant, 0 always zero",
            ("", *(str(column + 1) for column in range(n))),
            tuple(
                (
                    f"{row + 1} {self.structure.joints[row]}",
                    *(cells[max(row, k), min(row, k)] for k in range(n)),
                )
                for row in range(n)
            ),
            "; ".join(f"{name}: {need}" for name, need in self.needs().items()),
        ).html()

    def _position(self) -> dict[str, Any]:
        found = servo_rank(self.arm)
        groups = [self._names(group) for group in found.groups]
        left = [f"{name} of {self.structure.joints[joint]}" for name, joint in found.open]
        return {"input": "position", "kp_in_ratio": groups, "with_inertia_only": left}

    def _names(self, joints: tuple[int, ...]) -> list[str]:
        return [self.structure.joints[joint] for joint in joints]

    def _entry(self, entry: Entry) -> dict[str, Any]:
        return {
            "row": entry.row + 1,
            "col": entry.column + 1,
            "kind": entry.kind,
            "joints": self._names(entry.joints),
        }

    def _input(self, row: int, column: int) -> dict[str, Any]:
        found = [x for x in self.actuation.entries if (x.row, x.column) == (row, column)]
        kind, value = (found[0].kind, found[0].value) if found else ("zero", 0.0)
        return {"row": row + 1, "col": column + 1, "kind": kind, "value": value}

    def _determined(self) -> str:
        """What logs of positions tell, by the rank of their equations."""
        found = servo_rank(self.arm)
        told = "logs of positions determine inertia, weight and friction in ratio to kp only"
        known = [joints_in_ranges(group) for group in found.groups]
        if len(known) == 1:
            told += ": one kp, mass or load that is known tells all"
        else:
            told += f": one kp, mass or load that is known tells those of {' or of '.join(known)}"
        names: dict[str, list[int]] = {}
        for name, joint in found.open:
            names.setdefault(name, []).append(joint)
        for name, joints in names.items():
            told += f"; {name} of {joints_in_ranges(tuple(joints))} only together with the links' own inertia"
        return told

    def _inputs(self) -> str:
        """What is to be said of G."""
        entries = self.actuation.entries
        told = ["fixed" if self.input == "torque" else f"{POSITION}; {self._determined()}"]
        if not self.actuation.direct:
            told = ["motor torques"]
            for kind, what in (("fixed", "gear known"), ("gain", "gain trained"), ("coupled", "coupled")):
                joints = tuple(sorted({entry.row for entry in entries if entry.kind == kind}))
                told += [f"{what} at {joints_in_ranges(joints)}"] if joints else []
        if self.actuation.couplings:
            joints = tuple(sorted({entry.row for entry in self.actuation.couplings}))
            told.append(f"motors coupled at {joints_in_ranges(joints)}")
        passive = self.structure.passive
        return ", ".join(told + ([f"{joints_in_ranges(passive)} without a drive"] if passive else []))

    def _heading(self) -> str:
        trusted = (
            "any inertial values" if self.structure.assume == "kinematics" else "the URDF's inertial values"
        )
        return f"{printable(self.arm.name)}: structure for {trusted}"

    def _joint_table(self) -> str:
        lines = []
        for index, coordinate in enumerate(self.arm.coordinates, start=1):
            limits = reach(coordinate)
            passive = ", passive" if index - 1 in self.structure.passive else ""
            name = textwrap.shorten(printable(coordinate.name), 36, placeholder="...") or '""'
            lines.append(f"  {index:>2}  {name:<36}  {coordinate.kind:<9}  {limits}{passive}")
        return "Joints\n" + "\n".join(lines)

    def _matrix(self, width: int) -> str:
        """The lower triangle of M with each entry's joints, or by letters where that is too wide."""
        n = len(self.structure.joints)
        cells = {(e.row, e.column): _cell(e) for e in self.structure.entries}
        column_widths = [max(len(cells[row, c]) for row in range(c, n)) for c in range(n)]
        note = "joints each entry depends on; C constant, 0 always zero"
        if 6 + sum(column_widths) + 2 * n > width:
            cells = {key: cell if cell in ("0", "C") else "x" for key, cell in cells.items()}
            column_widths = [max(1, len(str(c + 1))) for c in range(n)]
            note = "x varies, C constant, 0 always zero"
        lines = [f"Mass matrix: {note}"]
        for row in range(n):
            line = "  ".join(cells[row, c].ljust(column_widths[c]) for c in range(row + 1))
            lines.append(f"  {row + 1:>2}  {line}".rstrip())
        return "\n".join(lines)

    def needs(self) -> dict[str, str]:
        """What a model of M(q), V(q) and G needs, in words, and the number of base parameters."""
        structure = self.structure
        counts: dict[tuple[int, ...], int] = {}
        for output in structure.outputs:
            counts[output.joints] = counts.get(output.joints, 0) + 1
        told = "; ".join(f"{count} of {joints_in_ranges(joints)}" for joints, count in counts.items())
        entries, constants = len(structure.entries), len(structure.constants)
        return {
            "M(q)": f"{_many(len(structure.outputs), 'output')} and {_many(constants, 'constant')} "
            f"make all {entries} entries" + (f": {told}" if told else ""),
            "V(q)": f"depends on {joints_in_ranges(structure.potential)}"
            if structure.potential
            else "zero: gravity does no work",
            "G": self._inputs(),
            "base": f"{structure.base_parameter_count} base inertial parameters",
        }

    def _needs(self, width: int) -> str:
        lines = []
        for name, fact in self.needs().items():
            lines += textwrap.wrap(fact, width, initial_indent=f"  {name:<5} ", subsequent_indent=" " * 8)
        return "The model needs\n" + "\n".join(lines)

    def _in_words(self, width: int) -> str:
        lines = []
        for fact in self.facts:
            lines += textwrap.wrap(str(fact), width, initial_indent="  ", subsequent_indent="    ")
        return "In words\n" + "\n".join(lines)

    def _remarks(self, width: int) -> str:
        lines = []
        for each in self.diagnostics:
            line = "" if each.line is None else f"line {each.line}: "
            text = printable(f"{each.severity}: {line}{each.where}: {each.message}")
            lines += textwrap.wrap(text, width, initial_indent="  ", subsequent_indent="    ")
        return "Remarks\n" + "\n".join(lines)


def reach(coordinate: Coordinate) -> str:
    """How far a joint can move, with its unit."""
    unit = "rad" if coordinate.kind == "revolute" else "m"
    if coordinate.continuous:
        return "continuous"
    if coordinate.lower is None or coordinate.upper is None:
        return "no limits"
    return f"{coordinate.lower:g} .. {coordinate.upper:g} {unit}"


def _cell(entry: Entry) -> str:
    if entry.kind == "varying":
        return joint_ranges(entry.joints)
    return "C" if entry.kind == "constant" else "0"


def _many(count: int, noun: str) -> str:
    return f"{count} {noun}{'s' * (count != 1)}"
