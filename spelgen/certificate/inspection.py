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
from spelgen.labels import UNITS, counted, joint_ranges, joints_in_ranges, printable, short_name
from spelgen.listing import WIDTH, Listing
from spelgen.structure.servo_rank import servo_rank
from spelgen.structure.structure import MassEntry, Structure, derive
from spelgen.urdf.robot import Assume

if TYPE_CHECKING:  # SymPy is imported for formulas only
    from spelgen.certificate.formulas import Entry as PlaceOfEntry
    from spelgen.certificate.formulas import Formulas


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
        """Return a report for a terminal."""
        is_fixed = self.structure.assume == "inertials"
        trusted = "the URDF's inertial values" if is_fixed else "any inertial values"
        heading = f"{printable(self.arm.name)}: structure for {trusted}"
        paragraphs = [heading, self._joint_table(), self._matrix(), self._needs()]
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

    def _input_matrix(self) -> dict[str, object]:
        n = len(self.structure.joints)
        # JSON contains the zero entries of G as well
        values = {(entry.row, entry.column): (entry.kind, entry.value) for entry in self.actuation.entries}
        entries: list[dict[str, object]] = []
        for row, column in product(range(n), repeat=2):
            kind, value = values.get((row, column), ("zero", 0.0))
            entries.append({"row": row + 1, "col": column + 1, "kind": kind, "value": value})
        if self.input == "torque":
            return {"entries": entries}
        # logs of torques have a scale; under servos only ratios are determined, and JSON states which
        rank = servo_rank(self.arm)
        undetermined = [f"{name} of {self.structure.joints[joint]}" for name, joint in rank.open]
        ratios = list(map(self._names, rank.groups))
        content = {"input": "position", "kp_in_ratio": ratios, "with_inertia_only": undetermined}
        return {**content, "entries": entries}

    def _servo_needs(self) -> str:
        """Return the parameters that logs of positions determine, in words."""
        # Logs of positions do not determine the scale of torques: kp, mass and friction may be multiplied by a factor.
        rank = servo_rank(self.arm)
        # One known torque parameter determines the scale of a group of joints.
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

    def _joint_table(self) -> str:
        lines = ["Joints"]
        width = max(len(short_name(joint.name)) for joint in self.arm.coordinates)
        for index, joint in enumerate(self.arm.coordinates):
            line = f"  {index + 1:>2}  {short_name(joint.name):<{width}}  {joint.joint_type:<9}  {range_text(joint)}"
            lines.append(line + ", passive" * (index in self.structure.passive))
        return "\n".join(lines)

    def _cells(self) -> dict[tuple[int, int], str]:
        return {(entry.row, entry.column): cell_text(entry) for entry in self.structure.entries}

    def _matrix(self) -> str:
        """Return the lower triangle of M as aligned text: the joints that each entry depends on."""
        cells, n = self._cells(), len(self.structure.joints)
        lines = ["Mass matrix: joints each entry depends on; C constant, 0 always zero"]
        # each column as narrow as possible: seven joints must fit into 80 characters
        widths = [max(len(cells[row, column]) for row in range(column, n)) for column in range(n)]
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
        outputs, constants = len(structure.outputs), len(structure.constants)
        mass = f"{counted(outputs, 'output')} and {counted(constants, 'constant')}"
        mass += f" make all {len(structure.entries)} entries"
        # an arm whose M is constant needs no networks
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
    line = "" if diagnostic.line is None else f"line {diagnostic.line}: "
    return printable(f"{diagnostic.severity}: {line}{diagnostic.where}: {diagnostic.message}")


def range_text(coordinate: Coordinate) -> str:
    """Return the range of a joint with its unit."""
    if coordinate.continuous:
        return "continuous"
    if coordinate.lower is None or coordinate.upper is None:
        return "no limits"
    return f"{coordinate.lower:g} .. {coordinate.upper:g} {UNITS[coordinate.joint_type].position}"


def cell_text(entry: MassEntry) -> str:
    """Return the joints that an entry of M depends on; C: constant, 0: always zero."""
    return {"zero": "0", "constant": "C"}.get(entry.kind, joint_ranges(entry.joints))


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
    # an arm that is loaded keeps its own options
    if not isinstance(arm, Arm):
        arm = load_arm(arm, joints, tip, angle_tolerance)
    structure = derive(arm.chain, assume)
    return Inspection(arm.chain, structure, arm.actuation, arm.diagnostics, arm.settings.input)
