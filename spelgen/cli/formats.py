"""What `inspect` writes: its formats, and the text of each."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from spelgen.cli.console import note

if TYPE_CHECKING:
    from spelgen.certificate.formulas import Entry, Formulas
    from spelgen.certificate.inspection import Inspection
    from spelgen.certificate.verification import Verification

Format = Literal["text", "json", "html", "latex", "sympy"]


def rendered(
    found: Inspection,
    format: str,
    *,
    formulas: bool,
    entry: Entry | None,
    proof: Verification | None,
    urdf: Path,
) -> str:
    """The text of the result, with a line end; with ``formulas``, or an ``entry``, the closed forms.

    Raises SpelgenError for an entry that M does not have.
    """
    closed = None
    if formulas or entry is not None or format in ("latex", "sympy"):
        from spelgen.certificate import formula_files, formula_text
        from spelgen.certificate.formulas import WRITABLE

        longest = WRITABLE if format in ("json", "sympy") else None
        closed = found.closed_forms(entry, longest=longest)
    if closed and format in ("latex", "sympy"):
        _tell(closed, proof)
        return formula_files.latex(closed) if format == "latex" else formula_files.sympy_source(closed)
    if format == "html":
        from spelgen.render.inspection_page import page

        return page(found, closed, proof, urdf)
    if format == "text":
        told = found.text() if closed is None else formula_text.text(closed)
        return told + (f"\n\n{proof.text()}" if proof else "") + "\n"
    data = found.to_dict() | ({"formulas": formula_text.to_dict(closed)} if closed else {})
    return json.dumps(data | ({"verification": proof.to_dict()} if proof else {}), indent=2) + "\n"


def _tell(closed: Formulas, proof: Verification | None) -> None:
    """What has no place in a file of formulas."""
    names = [formula.name for formula in closed.unwritten]
    if names:
        note(f"too long to be written: {', '.join(names)}")
    if proof:
        note(proof.text())
