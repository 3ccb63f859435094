"""Commands about an arm: `inspect`, the exact structure of its dynamics, and `identify`, its base parameters."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Literal, get_args

import typer

from spelgen.cli import options
from spelgen.cli.console import FAILED, deliver, note, refuse_warnings
from spelgen.cli.options import flag, option
from spelgen.urdf.robot import Assume

if TYPE_CHECKING:
    from spelgen.certificate.formulas import Formulas
    from spelgen.certificate.inspection import Inspection
    from spelgen.certificate.verify import Verification

InspectionFormat = Literal["text", "json", "html", "sympy"]
EFFECTS = ("stribeck", "polynomial", "memory")
FRICTION_HELP = (
    "Friction terms in addition to viscous and Coulomb friction: Stribeck effect; qd |qd| and qd^3; bristles "
    "(hysteresis)."
)


def inspect(
    chosen_arm: options.ArmOptions,
    assume: Assume = options.ASSUMPTION,
    formulas: bool = flag("--formulas", "Write M and V as expressions in q and base parameters."),
    entry: str | None = options.ENTRY,
    format: InspectionFormat | None = options.result_format(),
    output: Path | None = options.OUTPUT,
    strict: bool = options.STRICT,
    verify: bool = flag("--verify", "Verify the structure by Pinocchio, SymPy and numeric samples."),
) -> None:
    """Show the exact structure of an arm's dynamics."""
    chosen_entry = options.entry(entry)
    chosen = options.choose_format(format, output, get_args(InspectionFormat))
    from spelgen.certificate.inspection import inspect as inspect_arm

    arm = chosen_arm.load()
    inspection = inspect_arm(arm, assume=assume)
    proof = None
    if verify:
        # Pinocchio and SymPy take seconds to import, so they are imported only for --verify.
        from spelgen.certificate.verify import verify as verified

        proof = verified(arm.robot, arm.chain, inspection.structure)
    closed = None
    if formulas or chosen_entry is not None or chosen == "sympy":
        from spelgen.certificate.formulas import WRITABLE

        # JSON and SymPy files are read by programs, so they contain formulas up to the largest length that can be
        # written. Text contains formulas up to the default length.
        longest = WRITABLE if chosen in ("json", "sympy") else None
        closed = inspection.closed_forms(chosen_entry, longest=longest)
    # The result is printed first: afterwards a warning (with --strict) or a failed proof ends the command with an
    # error.
    deliver(_text(chosen, inspection, closed, proof, arm.robot.path), output)
    if strict:
        refuse_warnings(
            f"{chosen_arm.robot}: ", [x.severity for x in inspection.diagnostics].count("warning")
        )
    if proof and not proof.agrees:
        note(f"{chosen_arm.robot}: the proof contradicts the derivation; please report this file")
        raise typer.Exit(FAILED)


def _text(
    format: str, inspection: Inspection, closed: Formulas | None, proof: Verification | None, urdf: Path
) -> str:
    """Return the result of the inspection in the format ``format``, with a line end.

    closed: closed forms of M and of the potential energy V. proof: verification of the structure. urdf: path of the
    URDF, whose shapes an HTML page shows.
    """
    if closed:  # SymPy is slow to import, so it is imported only if formulas are written.
        from spelgen.certificate import formula_files
    if format == "html":
        from spelgen.render.arm_pages import inspection_page

        return inspection_page(inspection, closed, proof, urdf)
    if format == "json":
        data = inspection.to_dict()
        if closed:
            data["formulas"] = formula_files.to_dict(closed)
        if proof:
            data["verification"] = proof.to_dict()
        return json.dumps(data, indent=2) + "\n"
    if closed and format == "sympy":
        # A SymPy file contains only formulas, so the proof and the names of omitted formulas go to stderr.
        names = [formula.name for formula in closed.unwritten]
        if names:
            note(f"too long to be written: {', '.join(names)}")
        if proof:
            note(proof.text())
        return formula_files.sympy_source(closed)
    paragraphs = [formula_files.text(closed) if closed else inspection.text()]
    paragraphs += [proof.text()] if proof else []
    return "\n\n".join(paragraphs) + "\n"


def identify(
    chosen_arm: options.ArmOptions,
    extra_logs: list[Path] | None = options.MORE_DATA,
    data: list[Path] | None = options.DATA,
    mapping: Path | None = options.MAPPING_FILE,
    filter: float | None = options.FILTER,
    weights: Literal["equal", "range", "noise"] = option(
        "", "Weights of the joints: equal, by torque range, or by torque noise.", default="noise"
    ),
    friction: str | None = option(",".join(EFFECTS), FRICTION_HELP),
    accept: list[str] | None = options.ACCEPT,
    format: options.TextOrJson | None = options.result_format(),
    output: Path | None = options.OUTPUT,
) -> None:
    """Identify base parameters and friction by least squares."""
    paths = options.logs(data, extra_logs)
    from spelgen.dynamics.friction import FrictionModel
    from spelgen.identification.identification import LeastSquares
    from spelgen.identification.identify import identify as identify_arm
    from spelgen.log_checks.check_logs import require_sound_logs
    from spelgen.logs.preprocessing import Preprocessing
    from spelgen.logs.read import read_logs

    # One option takes the names of all friction effects, so that a new effect needs no new option.
    effects = options.names(friction) or []
    for name in effects:
        if name not in EFFECTS:
            raise typer.BadParameter(f"{name!r} is none of {', '.join(EFFECTS)}", param_hint="'--friction'")
    method = LeastSquares(weights, FrictionModel(**dict.fromkeys(effects, True)))
    arm = chosen_arm.load()
    # Error codes on the command line are accepted in addition to the codes in the settings.
    log_mapping = options.log_mapping(arm, mapping, accept)
    logs = read_logs(paths, arm, log_mapping, role="train")
    # Logs are checked before the identification: least squares would fit logs in wrong units without any error.
    for diagnostic in require_sound_logs(logs, arm, log_mapping):
        note(diagnostic)
    result = identify_arm(arm, logs, method, preprocessing=Preprocessing(cutoff=filter))
    for diagnostic in result.diagnostics:
        note(diagnostic)

    forms = {"text": result.text, "json": lambda: json.dumps(result.to_dict(), indent=2)}
    options.write_result(format, output, forms)
