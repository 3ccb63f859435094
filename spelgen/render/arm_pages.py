"""The pages of a derived structure and of an identification by least squares."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from spelgen.certificate.inspection import Inspection, range_text
from spelgen.fitting.run_record import Content
from spelgen.render.arm_section import arm_section, matrix
from spelgen.render.page import render_page
from spelgen.render.parameters import DETERMINED, base_table
from spelgen.structure.structure import derive

if TYPE_CHECKING:
    from spelgen.arm.configured_arm import Arm
    from spelgen.certificate.formulas import Formulas
    from spelgen.certificate.verify import Verification
    from spelgen.identification.identification import Identification


def inspection_page(
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


def identification_page(identification: Identification, arm: Arm) -> str:
    """Return the page: base parameters with confidence intervals, the arm, and the torque residual."""
    record: Content = identification.to_dict()
    words = [parameter["determined"] for parameter in record["base_parameters"]]
    never = [name for name, visibility in record["identifiability"].items() if visibility == "never"]
    return render_page(
        "identification.html.jinja",
        robot=identification.arm.name,
        quality=identification.quality(),
        sure=sum(word in DETERMINED for word in words),
        count=len(words),
        never=never,
        residuals=identification.listings()[0],
        parameters=base_table(None, arm, record),
        cells=matrix(arm.chain, derive(arm.chain)),
        arm=arm_section(arm.chain, arm.robot.path),
        heading=identification.heading(),
        notes=identification.diagnostics,
    )
