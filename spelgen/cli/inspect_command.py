"""The command `inspect`: the exact structure of an arm's dynamics, in each of its formats."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, get_args

import typer

from spelgen.cli import options
from spelgen.cli.console import FAILED, deliver, note, refuse_warnings
from spelgen.cli.options import AngleTolerance, Assumption, Entry, Joints, Output, Robot, Strict, Tip

if TYPE_CHECKING:
    from spelgen.certificate.formulas import Formulas
    from spelgen.certificate.inspection import Inspection
    from spelgen.certificate.verification import Verification

Format = Literal["text", "json", "html", "latex", "sympy"]


def inspect(
    robot: Robot,
    joints: Joints = None,
    tip: Tip = None,
    assume: Assumption = "kinematics",
    angle_tolerance: AngleTolerance = 2e-3,
    formulas: Annotated[
        bool, typer.Option("--formulas", help="Write M and V as expressions in q and base parameters.")
    ] = False,
    entry: Entry = None,
    format: Annotated[Format | None, options.result_format()] = None,
    output: Output = None,
    strict: Strict = False,
    verify: Annotated[
        bool, typer.Option("--verify", help="Verify the structure by Pinocchio, SymPy and numeric samples.")
    ] = False,
) -> None:
    """Show the exact structure of an arm's dynamics."""
    chosen_entry = options.entry(entry)
    chosen = options.choose_format(format, output, get_args(Format))
    from spelgen.certificate.inspection import inspect as inspect_arm
    from spelgen.certificate.verify import verify as verified

    arm = options.load(robot, joints, tip, angle_tolerance)
    inspection = inspect_arm(arm, assume=assume)
    # other programs, which take seconds
    proof = verified(arm.robot, arm.arm, inspection.structure) if verify else None
    closed = None
    if formulas or chosen_entry is not None or chosen in ("latex", "sympy"):
        from spelgen.certificate.formulas import WRITABLE

        longest = WRITABLE if chosen in ("json", "sympy") else None
        closed = inspection.closed_forms(chosen_entry, longest=longest)
    # the result comes first; --strict and a failed proof only decide the exit code
    deliver(_text(chosen, inspection, closed, proof, arm.robot.path), output)
    if strict:
        refuse_warnings(f"{robot}: ", [x.severity for x in inspection.diagnostics].count("warning"))
    if proof and not proof.agrees:
        note(f"{robot}: the proof contradicts the derivation; please report this file")
        raise typer.Exit(FAILED)


def _text(
    format: str, inspection: Inspection, closed: Formulas | None, proof: Verification | None, urdf: Path
) -> str:
    """Return the result with a line end; with ``closed``, the closed forms."""
    if closed and format in ("latex", "sympy"):
        return _formula_file(format, closed, proof)
    if format == "html":
        from spelgen.render.inspection_page import page

        return page(inspection, closed, proof, urdf)
    if format == "json":
        data = inspection.to_dict()
        if closed:
            from spelgen.certificate.formula_text import to_dict

            data["formulas"] = to_dict(closed)
        if proof:
            data["verification"] = proof.to_dict()
        return json.dumps(data, indent=2) + "\n"
    if closed is None:
        result = inspection.text()
    else:
        from spelgen.certificate import formula_text

        result = formula_text.text(closed)
    if proof:
        result += f"\n\n{proof.text()}"
    return result + "\n"


def _formula_file(format: str, closed: Formulas, proof: Verification | None) -> str:
    """Return a file of formulas; what has no place in it goes to stderr."""
    from spelgen.certificate import formula_files

    names = [formula.name for formula in closed.unwritten]
    if names:
        note(f"too long to be written: {', '.join(names)}")
    if proof:
        note(proof.text())
    if format == "latex":
        return formula_files.latex(closed)
    return formula_files.sympy_source(closed)
