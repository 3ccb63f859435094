"""A derived structure as one self-contained HTML page."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from spelgen.certificate.inspection import Inspection, range_text
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
    """The page about the inspection, with the closed forms, the proof and the arm of the URDF where they are given.

    It needs no other file, and all that comes from the URDF is escaped.
    """
    text = None
    if closed:  # SymPy is read in only for formulas
        from spelgen.certificate.formula_files import text as written

        text = written(closed, width=100)
    return render_page(
        "inspection.html.jinja",
        found=inspection,
        cells=matrix(inspection.arm, inspection.structure),
        arm=None if urdf is None else arm_section(inspection.arm, urdf),
        joints=[(joint.name, joint.joint_type, range_text(joint)) for joint in inspection.arm.coordinates],
        closed=text,
        proof=proof,
    )
