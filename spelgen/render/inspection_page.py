"""The page of a derived structure."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from spelgen.certificate.inspection import Inspection, reach
from spelgen.certificate.verification import Verification
from spelgen.render.arm_section import arm_section, matrix
from spelgen.render.page import render_page

if TYPE_CHECKING:
    from spelgen.certificate.formulas import Formulas


def page(
    inspection: Inspection,
    closed: Formulas | None = None,
    proof: Verification | None = None,
    urdf: Path | None = None,
) -> str:
    """Return the page about an inspection.

    Args:
        inspection: The derived structure.
        closed: Closed forms of the entries of M and V.
        proof: Verification of the structure.
        urdf: URDF of the arm, for a picture of it.
    """
    text = None
    if closed:  # SymPy is imported only for formulas
        from spelgen.certificate.formula_text import text as written

        text = written(closed, width=100)
    return render_page(
        "inspection.html.jinja",
        found=inspection,
        cells=matrix(inspection.arm, inspection.structure),
        arm=None if urdf is None else arm_section(inspection.arm, urdf),
        joints=[(joint.name, joint.kind, reach(joint)) for joint in inspection.arm.coordinates],
        closed=text,
        proof=proof,
    )
